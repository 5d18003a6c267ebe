"""What every plot asks of its arrays: finite numbers, lengths that agree. Draws nothing."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def finite(function: str, argument: str, values: ArrayLike) -> Floats:
    """`values` as float64. Raises ValueError that counts the values that are not finite."""
    array = np.asarray(values, dtype=np.float64)
    bad = int(array.size - np.isfinite(array).sum())
    if bad:
        raise ValueError(f"{function}: {argument} holds {bad} of {array.size} values that are not finite; leave out what was not measured")
    return array


def together(function: str, **named: ArrayLike) -> list[Floats]:
    """The named arrays, each (n,), flat and of one length. Raises ValueError where they differ or are not finite."""
    arrays = {key: finite(function, key, values).ravel() for key, values in named.items()}
    if len({array.size for array in arrays.values()}) > 1:
        raise ValueError(f"{function}: lengths differ: {', '.join(f'{key} {array.size}' for key, array in arrays.items())}")
    return list(arrays.values())

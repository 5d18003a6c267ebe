"""Which of many points a plot draws, so that a page stays light: the most telling ones, and an even choice of the rest. Draws nothing."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from reports.figures.arrays import Floats

MOST_POINTS = 400  # in one plot
MOST_STEPS = 400  # of a curve


def telling(weight: Floats, most: int = MOST_POINTS) -> NDArray[np.intp]:
    """Indices, in order, of at most `most` of n points: the half with the greatest `weight` (n,), and every so-manieth of the others."""
    if weight.size <= most:
        return np.arange(weight.size)
    order = np.argsort(-weight, kind="stable")
    heavy, rest = order[: most // 2], np.sort(order[most // 2 :])
    others = rest[np.linspace(0, rest.size - 1, most - heavy.size).round().astype(np.intp)]
    return np.union1d(heavy, others)


def told(drawn: int, of: int) -> str:
    """What a legend says of the choice; nothing where all are drawn."""
    return "" if drawn == of else f" ({drawn} of {of} drawn, the worst among them)"


def envelope(values: Floats, most: int = MOST_STEPS) -> NDArray[np.intp]:
    """Indices, in order, of the least and the greatest of each stretch of a curve (n,), its ends among them: no peak is lost."""
    if values.size <= 2 * most:
        return np.arange(values.size)
    edges = np.linspace(0, values.size, most + 1).round().astype(np.intp)
    parts = [(start + int(values[start:end].argmin()), start + int(values[start:end].argmax())) for start, end in pairwise(edges)]
    return np.unique([0, *(index for pair in parts for index in pair), values.size - 1])

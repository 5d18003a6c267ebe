"""Which loops the fits of outlines run: numba's (`kernels`) where the extra ``fast`` is installed,
else numpy's, which say what is right.
"""

from __future__ import annotations

import os
from functools import cache
from importlib import import_module
from types import ModuleType
from typing import NamedTuple

VARIABLE = "TEATBENCH_KERNELS"  # "numpy": numba is left alone


class Chosen(NamedTuple):
    """The compiled loops, or None; what computes, such as "numba 0.68.1"; why nothing faster."""

    loops: ModuleType | None
    by: str
    why: str = ""


@cache
def chosen() -> Chosen:
    """Loading numba and the loops takes a second; the first time in an installation they are
    compiled, in some ten.
    """
    if os.environ.get(VARIABLE) == "numpy":
        return Chosen(None, "numpy", f"{VARIABLE}=numpy is set")
    try:
        numba = import_module("numba")
        return Chosen(import_module("detector.outline.kernels"), f"numba {numba.__version__}")
    except ModuleNotFoundError as error:
        if error.name == "numba":
            return Chosen(None, "numpy", "numba isn't installed: pip install 'teatbench[fast]'")
        said: Exception = error
    except Exception as error:  # a numpy that numba doesn't know, a compiler's error: of any kind
        said = error
    line = " ".join(str(said).split())[:200]
    return Chosen(None, "numpy", f"numba can't be used here: {type(said).__name__}: {line}")


def compiled() -> ModuleType | None:
    """The compiled loops, or None."""
    return chosen().loops

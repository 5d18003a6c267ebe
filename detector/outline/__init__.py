"""The outline of a teat's end as a model, its edges in pictures, and where known ends are seen."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from detector.outline import kernels as kernels


def __getattr__(name: str) -> ModuleType:
    """`kernels`, loaded when it is first called: numba takes a third of a second, and a page
    without outlines needs none of it.
    """
    if name != "kernels":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module(f"{__name__}.kernels")

"""The scene behind the wires: what it is made of, how it warms, and how the cameras see it."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from instruments.world import kernels as kernels


def __getattr__(name: str) -> ModuleType:
    """`kernels`, loaded for the first picture: numba takes a third of a second."""
    if name != "kernels":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return import_module(f"{__name__}.kernels")

"""Names of a package that are loaded when they are first used."""

from importlib import import_module
from sys import modules

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from typing import Any


def lazily(package: str, promised: "Mapping[str, Sequence[str]]") -> "Callable[[str], Any]":
    """``__getattr__`` of ``package``, for its names by the module that has them."""
    places = {name: module for module, names in promised.items() for name in names}

    def get(name: str) -> "Any":
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = getattr(import_module(places[name]), name)
        setattr(modules[package], name, found)
        return found

    return get

"""Names of a package that are loaded when they are first used."""

from importlib import import_module
from sys import modules

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Any


def lazily(
    package: str, places: "Mapping[str, tuple[str, ...]]", guard: str = ""
) -> "Callable[[str], Any]":
    """``__getattr__`` of ``package``, for the names that the modules in ``places`` have. What is
    loaded is handed out as ``guarded`` of the module ``guard`` gives it back.
    """
    known = {name: module for module, names in places.items() for name in names}

    def get(name: str) -> "Any":
        if name not in known:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = getattr(import_module(known[name]), name)
        if guard:
            found = import_module(guard).guarded(found, package)
        setattr(modules[package], name, found)
        return found

    return get

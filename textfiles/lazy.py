"""Names of a package that are loaded when they are first used."""

from importlib import import_module
from sys import modules

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


def lazily(package: str, file: str, guard: str = "") -> "Callable[[str], Any]":
    """``__getattr__`` of ``package``, for the names that its ``file`` imports for type checkers
    alone, before ``__all__``. What is loaded is handed out as ``guarded`` of the module ``guard``
    gives it back.
    """
    places: dict[str, str] = {}
    with open(file, encoding="utf-8") as source:  # noqa: PTH123 - pathlib takes 8 ms to import
        imports = source.read().partition("__all__")[0].split("    from ")[1:]
    for one in imports:
        module, _, names = one.partition(" import ")
        for mark in "(),":
            names = names.replace(mark, " ")
        places |= dict.fromkeys(names.split(), module)

    def get(name: str) -> "Any":
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        found = getattr(import_module(places[name]), name)
        if guard:
            found = import_module(guard).guarded(found, package)
        setattr(modules[package], name, found)
        return found

    return get

"""Names of a package that are loaded when they are first used. Its stub lists them, as
``from MODULE import NAME as NAME``: the only list, which type checkers read too.
"""

from importlib import import_module
from sys import modules

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


def lazily(package: str, guard: str = "") -> "tuple[Callable[[str], Any], Callable[[], list[str]]]":
    """``__getattr__`` and ``__dir__`` of ``package``, for the names in its stub, and ``__all__``.
    What is loaded is handed out as ``guarded`` of the module ``guard`` gives it back.
    """
    known = dict[str, str]()

    def get(name: str) -> "Any":
        there = modules[package]
        if not known:
            spec: Any = there.__spec__
            for line in spec.loader.get_data(f"{spec.origin}i").decode().splitlines():
                if line.startswith("from "):
                    _, module, _, one, *_ = line.split()
                    known[one] = module
        if name == "__all__":
            return [one for one in known if one[0] != "_"]
        if name not in known:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        if known[name] == package:  # a package within it
            return import_module(f"{package}.{name}")
        try:
            found = getattr(import_module(known[name]), name)
        except ImportError as error:
            _refuse_hidden(error)
            raise
        if guard:
            found = import_module(guard).guarded(found, package)
        setattr(there, name, found)
        return found

    return get, lambda: [*vars(modules[package]), *get("__all__")]


def _refuse_hidden(error: ImportError) -> None:
    """Raise ImportError where another's file or package has the name of one of the packages."""
    from _teatbench_packages import hiding, installed_over

    if why := hiding() or installed_over():
        raise ImportError(why) from error

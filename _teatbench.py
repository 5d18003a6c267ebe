"""What is asked before a package of teatbench is imported: their names are common, and another's
``bench.py`` or package ``instruments`` may be found instead. The command and the plug-in for pytest
begin here, under a name that nobody else has.
"""

import os
from importlib.util import find_spec
from types import ModuleType

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

PACKAGES = ("bench", "detector", "instruments", "reports", "textfiles")


def hiding() -> str:
    """What hides a package of teatbench, and what to do; "" where nothing does: they lie in one
    folder.
    """
    found = {name: getattr(find_spec(name), "origin", None) or name for name in PACKAGES}
    parents = {name: os.path.split(os.path.split(origin)[0])[0] for name, origin in found.items()}
    home = max(parents.values(), key=[*parents.values()].count)
    for name, origin in found.items():
        folder, file = os.path.split(origin)
        if not file.startswith("__init__."):
            return f"{origin} hides teatbench's package {name!r}: give that file another name"
        if parents[name] != home:
            return f"{folder} hides teatbench's package {name!r}: give that folder another name"
    return ""


def installed_over() -> str:
    """Which package's files pip wrote over those of teatbench, and what to do; "" for none."""
    from importlib.metadata import packages_distributions

    owners = packages_distributions()
    for name in PACKAGES:
        others = sorted({*owners.get(name, [])} - {"teatbench"})
        if others:
            why = f"{others[0]} has files in teatbench's package {name!r}"
            return f"{why}: give teatbench an environment of its own, and install it anew"
    return ""


def main() -> int:
    """The command ``teatbench``; gives back its exit code."""
    why = hiding()
    if not why:
        try:
            from bench.cli.__main__ import main as command

            return command()
        except ImportError:
            why = installed_over()
            if not why:
                raise
    os.write(2, f"teatbench: {why}.\n".encode())
    return 2  # of CODES


def __getattr__(name: str) -> "Any":
    """``plugin``, for pytest: of a session in which a package is hidden, a line that says so."""
    if name != "plugin":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if why := hiding():
        without = ModuleType("teatbench, left out")
        said = f"teatbench's plug-in is left out: {why}"
        vars(without)["pytest_report_header"] = lambda: said
        return without
    from bench.testing import plugin

    return plugin

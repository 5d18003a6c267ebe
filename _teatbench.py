"""Where the command and the plug-in for pytest begin, under a name of their own: before a package
of teatbench is imported, they ask whether another's file or folder hides one.
"""

import os
from types import ModuleType

from _teatbench_packages import hiding, installed_over

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any


def main() -> int:
    """The command ``teatbench``; gives back its exit code."""
    why = hiding()
    if not why:
        try:
            from bench.cli.process import main as command

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

"""`completion SHELL`, and what a shell gets when a user presses Tab: commands, options, and
names that ship. By argcomplete, which calls the program at each Tab.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import argcomplete
from argcomplete.completers import FilesCompleter
from argcomplete.shell_integration import shellcode

BENCH = Path(__file__).parents[1]
# what an argument is called -> the folder with the files that ship
SHIPPED = {"script": "trials", "rig": "rigs", "board": "boards"}
# as in bench.rig.loading, which is too heavy for each Tab
NO_RIGS = ("calibration", "thesis-calibration", "depth-calibration", "lab.example")


def shell_code(given: argparse.Namespace) -> None:
    sys.stdout.write(shellcode(["teatbench"], shell=given.shell) + "\n")


def complete(top: argparse.ArgumentParser) -> None:
    """Answer the shell and end, where it is a shell that asks."""
    for action in _actions(top):
        if action.dest in SHIPPED:
            action.completer = _names(SHIPPED[action.dest])  # type: ignore[attr-defined]
        elif action.dest in ("detector", "word"):
            action.completer = _detectors  # type: ignore[attr-defined]
    argcomplete.autocomplete(top, always_complete_options=False)


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield from _actions(below)


def _names(folder: str) -> Callable[..., Iterable[str]]:
    """Names that ship, and files."""
    names = [path.name.removesuffix(".toml") for path in (BENCH / folder).glob("*.toml")]

    def found(prefix: str, **_: object) -> list[str]:
        return [*(name for name in names if name not in NO_RIGS), *FilesCompleter()(prefix)]

    return found


def _detectors(prefix: str, **_: object) -> list[str]:
    from bench.script.detectors import declared
    from detector.registry import available

    return [*available(), *declared(), *FilesCompleter()(prefix)]

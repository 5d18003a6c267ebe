"""The commands by family, a module each: its arguments, and what it calls. Jobs themselves are done elsewhere."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bench.commands.capturing import add_capture

if TYPE_CHECKING:
    SubParsers = argparse._SubParsersAction[argparse.ArgumentParser]

EXIT_CODES = """exit codes: 0 all requirements met, 1 a requirement not met, 2 wrong use or file,
3 aborted or instrument fault, 4 inconclusive"""
OUT = Path("runs")


class Codes(NamedTuple):
    """What a command's exit code says."""

    met: int = 0
    not_met: int = 1
    wrong_use: int = 2
    fault: int = 3
    inconclusive: int = 4


CODES = Codes()


class Commands:
    """Where a family puts its commands."""

    def __init__(self, subparsers: SubParsers) -> None:
        self._subparsers = subparsers

    def add(
        self, name: str, what: str, command: Callable[[argparse.Namespace], int], *, opens_links: bool = True
    ) -> argparse.ArgumentParser:
        """A command that calls ``command``; gives back its parser for its arguments.

        One that opens links has ``--capture FILE``, and asks ``given.capture.tap(name, clock)`` for each link's tap.
        """
        sub = self._subparsers.add_parser(name, help=what, description=what, epilog=EXIT_CODES)
        sub.set_defaults(command=add_capture(sub, command) if opens_links else command)
        return sub

    def group(self, name: str, what: str) -> Commands:
        """A command with commands of its own, as ``arm read``."""
        sub = self._subparsers.add_parser(name, help=what, description=what, epilog=EXIT_CODES)
        return Commands(sub.add_subparsers(title="commands", metavar="COMMAND", required=True))


def add_rig(parser: argparse.ArgumentParser) -> None:
    """The rig as a positional argument that may be left out."""
    parser.add_argument("rig", nargs="?", help="a shipped rig by name, or a .toml file (default: emulated)")


def add_out(parser: argparse.ArgumentParser) -> None:
    """Where run folders go."""
    parser.add_argument("--out", type=Path, default=OUT, metavar="DIR", help="where run folders go (default: runs)")


def add_detectors(parser: argparse.ArgumentParser) -> None:
    """Detectors by name, command or file."""
    what = "a detector by name, a file DETECTOR.toml, or exec:COMMAND (docs/detectors.md); may be given several times"
    parser.add_argument("--detector", action="append", default=[], metavar="NAME", help=what)

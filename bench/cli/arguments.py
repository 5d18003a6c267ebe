"""`--capture FILE`, for every command that opens a link: the file is opened before the command and
closed behind it.

The command finds in ``given.capture`` whom to ask for a tap, whether or not anything is captured.

The commands by family, a module each: its arguments, and what it calls. Jobs themselves are done
elsewhere.

Words of the command line to values, for argparse's ``type``: what several families of commands
take. Each says what is wrong.
"""

from __future__ import annotations

import argparse
import platform
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from bench import __version__

Command = Callable[[argparse.Namespace], int]


def add_capture(parser: argparse.ArgumentParser, command: Command) -> Command:
    """The option for ``parser``; gives back ``command`` with a capture around it."""
    parser.add_argument(
        "--capture",
        type=Path,
        metavar="FILE",
        help="record the bytes of every link in a new file (docs/captures.md)",
    )
    return lambda given: _captured(given, command)


def _captured(given: argparse.Namespace, command: Command) -> int:
    from instruments.captures.capture import NO_CAPTURE, CaptureFile

    if given.capture is None:
        given.capture = NO_CAPTURE
        return command(given)
    with CaptureFile(given.capture, _facts()) as given.capture:
        capture: CaptureFile = given.capture
        try:
            return command(given)
        finally:
            if capture.fault:
                print(f"teatbench: {capture.fault}", file=sys.stderr)
            elif not capture.events:
                print(
                    f"teatbench: {capture.path} was not written: no link was opened",
                    file=sys.stderr,
                )


def _facts() -> dict[str, str]:
    machine = (
        f"{platform.system()} {platform.release()} {platform.machine()}, Python"
        f" {platform.python_version()}"
    )
    return {
        "teatbench": __version__,
        "command": shlex.join(["teatbench", *sys.argv[1:]]),
        "machine": machine,
    }


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
        self,
        name: str,
        what: str,
        command: Callable[[argparse.Namespace], int],
        *,
        opens_links: bool = True,
        once: tuple[str, ...] = (),
    ) -> argparse.ArgumentParser:
        """A command that calls ``command``; gives back its parser for its arguments.

        One that opens links has ``--capture FILE``, and asks ``given.capture.tap(name, clock)`` for
        each link's tap. ``once`` has names of earlier releases, which work for one more.
        """
        sub = self._subparsers.add_parser(
            name, aliases=once, help=what, description=what, epilog=EXIT_CODES
        )
        sub.set_defaults(command=add_capture(sub, command) if opens_links else command)
        return sub

    def group(self, name: str, what: str) -> Commands:
        """A command with commands of its own, as ``arm read``."""
        sub = self._subparsers.add_parser(name, help=what, description=what, epilog=EXIT_CODES)
        return Commands(sub.add_subparsers(title="commands", metavar="COMMAND", required=True))


def add_rig(parser: argparse.ArgumentParser) -> None:
    """The rig as a positional argument that may be left out."""
    parser.add_argument(
        "rig", nargs="?", help="a shipped rig by name, or a .toml file (default: emulated)"
    )


def add_out(parser: argparse.ArgumentParser) -> None:
    """Where run folders go."""
    parser.add_argument(
        "--out", type=Path, default=OUT, metavar="DIR", help="where run folders go (default: runs)"
    )


def add_detectors(parser: argparse.ArgumentParser) -> None:
    """Detectors by name, command or file."""
    what = (
        "a detector by name, a file DETECTOR.toml, or exec:COMMAND (docs/detectors.md); may be"
        " given several times"
    )
    parser.add_argument("--detector", action="append", default=[], metavar="NAME", help=what)


def number(text: str) -> float:
    """Any number, not a number and the infinite among them: who asks looks at the range."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def seconds(text: str) -> float:
    """A duration above 0, in plain digits."""
    value = float(text) if text.replace(".", "", 1).isdigit() else 0.0
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds above 0")
    return value


def natural(text: str) -> int:
    """A whole number of 0 or more."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"must be a whole number of 0 or more, is {text!r}")
    return int(text)


def whole(low: int, high: int) -> Callable[[str], int]:
    """A whole number from ``low`` to ``high``."""

    def take(text: str) -> int:
        if not text.isdecimal() or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {low} to {high}")
        return int(text)

    return take


def address(instrument: str) -> Callable[[str], str]:
    """Where a "bath" or a "stage" is, as in a rig file, but not an emulated one: that lives in the
    bench.
    """

    def take(text: str) -> str:
        from bench.rig.urls import EMULATED, bath_url, serial_url

        try:
            if text == EMULATED:
                raise ValueError(
                    f"an emulated {instrument} lives in the bench; 'teatbench emulate' serves one"
                    " at a port"
                )
            return bath_url(text) if instrument == "bath" else serial_url(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"{text!r} is no {instrument}: {error}") from error

    return take

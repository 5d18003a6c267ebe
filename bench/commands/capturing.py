"""`--capture FILE`, for every command that opens a link: the file is opened before the command and closed behind it.

The command finds in ``given.capture`` whom to ask for a tap, whether or not anything is captured.
"""

from __future__ import annotations

import argparse
import platform
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

from bench import __version__

Command = Callable[[argparse.Namespace], int]


def add_capture(parser: argparse.ArgumentParser, command: Command) -> Command:
    """The option for ``parser``; gives back ``command`` with a capture around it."""
    parser.add_argument("--capture", type=Path, metavar="FILE", help="record the bytes of every link in a new file (docs/captures.md)")
    return lambda given: _captured(given, command)


def _captured(given: argparse.Namespace, command: Command) -> int:
    from instruments.capture import NO_CAPTURE, CaptureFile

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
                print(f"teatbench: {capture.path} was not written: no link was opened", file=sys.stderr)


def _facts() -> dict[str, str]:
    machine = f"{platform.system()} {platform.release()} {platform.machine()}, Python {platform.python_version()}"
    return {"teatbench": __version__, "command": shlex.join(["teatbench", *sys.argv[1:]]), "machine": machine}

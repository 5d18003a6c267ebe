"""What the command line is made of: exit codes, values, arguments and commands. `commands` has the
table of them all.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from contextvars import ContextVar
from datetime import datetime
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple, TextIO

from bench.version import __version__
from textfiles.bounds import Bounds
from textfiles.text import one_command, wrapped
from textfiles.whole import nearest_there, refusal, refuse_no_name, try_write

STAMP = re.compile(r"\d{8}-\d{6}")  # with which the bench begins the name of a run
PATHS = ("FILE", "DIR", "FOLDER", "CSV", "PART", "CAL", "FRAMES", "RUN")
Argument = Callable[[argparse._ActionsContainer], object]  # adds itself to a parser

EXIT_CODES = """exit codes: 0 all requirements met, 1 a requirement not met, 2 wrong use or file,
3 aborted or instrument fault, 4 inconclusive"""


class Codes(NamedTuple):
    """What a command's exit code says."""

    met: int = 0
    not_met: int = 1
    wrong_use: int = 2
    fault: int = 3
    inconclusive: int = 4


CODES = Codes()


def code_of(verdict: str) -> int:
    """The exit code for a verdict's value."""
    return {"met": CODES.met, "not met": CODES.not_met}.get(verdict, CODES.inconclusive)


def a_run(text: str) -> Path:
    """A run's folder by its path or by its name in runs/; ``latest``: the newest one there."""
    if Path(text).exists():
        return Path(text)
    there = (path.parent for path in Path("runs").glob("*/run.sqlite"))
    fitting = (run for run in there if text in (run.name, "latest"))
    return max(fitting, key=_begun, default=Path(text))


def _begun(run: Path) -> tuple[str, str]:
    """When it was begun, by its name or, where a person has given it one, by its record; its name.
    One that can't be read is the oldest.
    """
    if STAMP.match(run.name):
        return run.name, run.name
    import bench

    with suppress(bench.ConfigError, LookupError, ValueError):
        begun = datetime.fromisoformat(bench.read_run(run).facts["wall_started"])
        return f"{begun:%Y%m%d-%H%M%S}", run.name
    return "", run.name


def complain(text: str, code: int) -> int:
    """Say on standard error what is wrong; gives back ``code``."""
    _write(f"teatbench: {text}", sys.stderr)
    return code


def say(*texts: object) -> None:
    """Each text as a line of standard output; at a terminal wrapped between words."""
    for text in texts:
        print(wrapped(str(text), sys.stdout), flush=True)


def mm(point: Iterable[float]) -> str:
    """A place, for a person."""
    return ", ".join(f"{v:.2f}" for v in point) + " mm"


def _write(text: str, out: TextIO) -> None:
    """A line; at a terminal wrapped between words."""
    if not out.isatty():
        print(text, file=out)
        return
    from bench.cli.terminal import Terminal

    Terminal(out).print(text, markup=False, highlight=False)


def in_switches(text: object, given: argparse.Namespace) -> str:
    """A message of the API, whose `arguments` stand in backquotes, with the command's own words."""
    words = {one.dest: (*one.option_strings, one.dest.upper())[0] for one in given.parser._actions}

    def word(found: re.Match[str]) -> str:
        name = {"url": "port"}.get(found[1], found[1])
        # without its unit; one of several
        forms = name, name.rpartition("_")[0], name.removesuffix("s")
        return next((words[one] for one in forms if one in words), found[1])

    return re.sub(r"`(\w+)`", word, str(text))


def refuse_existing(
    out: Path, *, replace: bool, option: str = "--out", makes_folder: bool = False
) -> None:
    """Raises ConfigError for a file that can't be written, before anybody works for it; with
    ``makes_folder`` into a new one.
    """
    from bench.config import ConfigError

    try:
        refuse_no_name(out)
        folder = nearest_there(out.parent) if makes_folder else out.resolve().parent
        if out.is_dir() or not folder.is_dir():
            why = f"there is no folder {out.parent}" if not out.is_dir() else "this is a folder"
            raise ConfigError.plain(
                f"{option} {out}: {why}; name a file in a folder that is there."
            )
        if out.exists() and not replace:
            raise ConfigError.plain(
                f"{option} {out} is there already. Name another file, or give --replace."
            )
        try_write(folder / out.name)
    except OSError as error:
        why = refusal(error, "Name another place.")
        raise ConfigError.plain(f"{option} {out}: it can't be written: {why}") from error


def command_line() -> str:
    """The command as it was given, to be given again."""
    from bench.run.notify import without_secrets

    return one_command(["teatbench", *without_secrets(sys.argv[1:])])


JSON_VERSION = 1  # of what `--json` prints; docs/json.md has the keys


_JSON_TO = ContextVar[TextIO]("_JSON_TO")


@contextmanager
def stdout_for_json() -> Iterator[None]:
    """Only `print_json` writes to stdout; what drivers and detectors of others print goes to
    stderr.
    """
    before = _JSON_TO.set(sys.stdout)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        _JSON_TO.reset(before)


def print_json(value: Mapping[str, Any], **how: Any) -> None:
    """What `--json` gives: an object that says its version first."""
    text = json.dumps({"schema_version": JSON_VERSION, **value}, ensure_ascii=False, **how)
    print(text, file=_JSON_TO.get(sys.stdout), flush=True)


def print_values(values: Mapping[str, object], *, as_json: bool = False) -> None:
    """A line each: its name, and what there is to say of it; or `print_json`."""
    if as_json:
        print_json(values)
        return
    for name, value in values.items():
        _write(name if value == "" else f"{name}: {value}", sys.stdout)


def call(given: argparse.Namespace) -> int:
    """Call the command; gives back its exit code, 0 for one that gives none. With ``--capture
    FILE``, ``given.capture`` has the taps of its links, and is open while it works.
    """
    module, name = given.command
    work: Callable[[argparse.Namespace], int | None]
    work = getattr(import_module(f"bench.cli.{module}"), name)
    out = "write_rig" if "write_rig" in given else "out"
    if "replace" in given and (path := getattr(given, out)):
        refuse_existing(
            path,
            replace=given.replace,
            option=f"--{out.replace('_', '-')}",
            makes_folder="makes_folder" in given,
        )
    if getattr(given, "capture", None) is None:
        return work(given) or CODES.met
    import platform

    from instruments import CaptureFile

    facts = {
        "teatbench": __version__,
        "command": command_line(),
        "machine": f"{platform.system()} {platform.release()} {platform.machine()}, Python"
        f" {platform.python_version()}",
    }
    with CaptureFile(given.capture, facts) as capture:
        given.capture = capture
        try:
            return work(given) or CODES.met
        finally:
            if capture.fault:
                complain(capture.fault, CODES.fault)
            elif not capture.events:
                complain(f"{capture.path} was not written: no link was opened", CODES.met)


# Arguments


def flag(name: str, what: str) -> Argument:
    """An option without a value."""
    return lambda to: to.add_argument(name, action="store_true", help=what)


def option(
    name: str,
    what: str | None = None,
    kind: Callable[[str], Any] | None = None,
    default: object = None,
    *,
    many: bool = False,
    **more: Any,
) -> Argument:
    """An option with a value, or an argument without ``--``; ``name`` ends with its metavar, which
    for `PATHS` is a path. Help names the default where ``what`` doesn't.
    """
    word, _, metavar = name.partition(" ")
    kind = kind or (Path if metavar in PATHS else str)
    if many:
        more |= {"action": "append", "default": []}
    elif default is not None:
        more["default"] = default
        if what and default != "" and "default" not in what:
            what = f"{what} (default: {default})"
    return lambda to: to.add_argument(word, metavar=metavar or None, help=what, type=kind, **more)


def one_of(*arguments: Argument, required: bool = False) -> Argument:
    """Options that exclude each other."""

    def add(to: argparse._ActionsContainer) -> None:
        group = to.add_mutually_exclusive_group(required=required)
        for argument in arguments:
            argument(group)

    return add


# Words to values, for argparse's ``type``


def number(
    what: str | Bounds = "a number",
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    below: float = math.inf,
) -> Callable[[str], float]:
    """A finite number within these bounds; ``what`` says which, for the message."""
    bounds = what if isinstance(what, Bounds) else Bounds(what, above, least, below)

    def take(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not bounds.has(value):
            raise argparse.ArgumentTypeError(f"{text!r} is not {bounds.what}")
        return value

    return take


def whole(low: int, high: int | None = None) -> Callable[[str], int]:
    """A whole number from ``low`` to ``high``."""

    def take(text: str) -> int:
        if not text.isdecimal() or int(text) < low or (high is not None and int(text) > high):
            raise argparse.ArgumentTypeError(
                f"{text!r} is not a whole number"
                f" {f'of {low} or more' if high is None else f'from {low} to {high}'}"
            )
        return int(text)

    return take


def point(axes: int, limit_mm: float) -> Callable[[str], tuple[float, ...]]:
    """Numbers in mm with commas between them, one an axis."""
    example = ",".join(("120", "-80", "0")[:axes])

    def take(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) != axes or not all(abs(value) <= limit_mm for value in values):
            raise argparse.ArgumentTypeError(
                f"{text!r} is not a point; write {axes} numbers as {example}, each within"
                f" {limit_mm:g} mm"
            )
        return values

    return take


def size(text: str) -> tuple[int, int]:
    """COLUMNSxROWS as numbers."""
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} is no size such as 640x480")
    return int(found[1]), int(found[2])


def parsed(function: str) -> Callable[[str], Any]:
    """What ``function``, "module:name", makes of the text; its ValueError is the message."""

    def take(text: str) -> Any:
        module, _, name = function.partition(":")
        try:
            return attrgetter(name)(import_module(module))(text)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return take

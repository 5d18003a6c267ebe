"""Reads arguments, calls a command, and gives each kind of failure its exit code."""

from __future__ import annotations

import argparse
import atexit
import errno
import gc
import os
import re
import sqlite3
import sys
import traceback
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from functools import cache
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, NoReturn

from bench.cli import commands
from bench.cli.arguments import CODES, EXIT_CODES, call, complain, in_switches, stdout_for_json
from bench.safety.signals import installed
from bench.version import __version__, overwritten
from reports.sanitize import keep_writing, sanitizing
from textfiles.text import did_you_mean, full_stop, in_command, near_words, words_of
from textfiles.whole import is_full

if TYPE_CHECKING:
    SubParsers = argparse._SubParsersAction[argparse.ArgumentParser]

FILENAME_EXCED_RANGE = 206  # of Windows, which gives it the errno of a file that is not there

ODD_BYTES = re.compile("[\ud800-\udfff]")  # what no record, page or terminal can hold
HELP_COLUMNS = 78
FEW = 8  # choices that a message lists
MORE_HELP = (
    "'teatbench COMMAND --help' has a command's arguments, an example and its exit codes;"
    " 'teatbench help COMMAND' the page that explains it."
)

# What libraries read when they are loaded. OpenCV and its FFmpeg would write to the terminal
# themselves; OpenBLAS would share out small sums, which costs a quarter of a detector's time.
LIBRARIES = {
    "OPENCV_LOG_LEVEL": "SILENT",
    "OPENCV_FFMPEG_LOGLEVEL": "-8",
    "OPENBLAS_NUM_THREADS": "1",
}
LIMIT = "give the machine, or the limit that it works under (ulimit -v), more"
# of addresses: the libraries take 370 MB, and one that is refused them while it loads never returns
LEAST_BYTES = 512 << 20


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; gives back its exit code."""
    _set_up_libraries(alone=arguments is None)
    given = argparse.Namespace(left="nothing was begun", kept="")
    if None in (sys.stdin, sys.stdout, sys.stderr):  # closed, as by a scheduler (`>&-`)
        _take_low_descriptors()
    streams = sys.stdout, sys.stderr
    for stream in streams:
        if hasattr(stream, "reconfigure"):
            # a Windows console may be set to less
            stream.reconfigure(encoding="utf-8", errors="replace")
    try:
        sys.stdout, sys.stderr = map(sanitizing, streams)
        with installed():
            if "_ARGCOMPLETE" in os.environ:
                import argcomplete

                argcomplete.autocomplete(parser(), always_complete_options=False)
            words = sys.argv[1:] if arguments is None else arguments
            if odd := next(filter(ODD_BYTES.search, words), None):
                shown = ascii(odd)
                return complain(f"{shown} isn't UTF-8: name it otherwise", CODES.wrong_use)
            starts = (" ".join(words[:count]) for count in (1, 2, 3))
            asked = (*starts, *(word for word in words if "-" in word))
            if gone := next((one for one in asked if one in commands.table("removed")), None):
                instead = commands.table("removed")[gone]
                return complain(f"'{gone}' went: {instead}", CODES.wrong_use)
            given = parser(_named(words)).parse_args(arguments, given)
            if (limit := _address_limit()) < LEAST_BYTES:
                why = f"{limit >> 20} MB of memory are allowed, {LEAST_BYTES >> 20} are needed"
                return complain(f"{why}: {LIMIT}", CODES.fault)
            # a verdict is of all that was asked for, even where its reader has left
            keep_writing("1" in commands.exit_codes(given.called))
            with stdout_for_json() if vars(given).get("json") else nullcontext():
                return _run(given)
    except KeyboardInterrupt:
        return complain(f"interrupted: {given.left}.", CODES.fault)
    except Exception as error:
        return _unforeseen(error, given.kept)
    finally:
        sys.stdout, sys.stderr = streams


def _set_up_libraries(*, alone: bool) -> None:
    """Before they are loaded; ``alone``: in a process of the command's own, whose searches for
    cycles come after more objects, as those of figures are many.
    """
    for name, value in LIBRARIES.items():
        os.environ.setdefault(name, value)
    if alone:
        gc.set_threshold(20_000, 20, 20)
        atexit.register(_freeze)


def _take_low_descriptors() -> None:
    """Else a file of a run gets a closed stream's number, and what a library writes to that."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:  # stderr's
        continue
    os.close(number)
    nowhere = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 - to the end
    sys.stdout, sys.stderr = sys.stdout or nowhere, sys.stderr or nowhere


def _freeze() -> None:
    """Python's search for cycles among all objects at its end takes a third of a second; where
    DuckDB is loaded it is done, or DuckDB lists what it takes for leaks.
    """
    if "_duckdb" not in sys.modules:
        gc.freeze()


def _address_limit() -> int:
    """Of this process, in bytes; without end on Windows, which has none."""
    if sys.platform == "win32":
        return sys.maxsize
    import resource

    soft, _ = resource.getrlimit(resource.RLIMIT_AS)
    return sys.maxsize if soft == resource.RLIM_INFINITY else soft


def _run(given: argparse.Namespace) -> int:
    from bench import ConfigError, OperatorAbort, OperatorSkip, RecordingError
    from bench.config import UnwrittenError
    from instruments import CaptureError, InstrumentError

    try:
        code = call(given)
        _say_next(given, code)
        sys.stdout.flush()
        return code
    except (ConfigError, RecordingError, CaptureError) as error:
        code = CODES.fault if is_full(error) else CODES.wrong_use
        if isinstance(error, UnwrittenError):
            print(f"{HELD.format(error.place)}\n\n{error.text}")
        return complain(_with_cure(in_switches(error, given), error), code)
    except InstrumentError as error:
        return complain(in_switches(error, given), CODES.fault)
    except (OperatorAbort, OperatorSkip) as stop:
        return complain(f"{stop}; {given.left.partition('. ')[0]}", CODES.fault)
    except sqlite3.Error as error:
        hint = "" if is_full(error) else f" {HINT}"
        why = f"the run's record can't be written or read: {error}.{hint}"
        return complain(_with_cure(why, error), CODES.fault)
    except BrokenPipeError:  # the reader of our output has gone (`| head`)
        return CODES.met
    except BaseException as error:
        if isinstance(error, Exception | KeyboardInterrupt):
            raise
        return _unforeseen(error, given.kept)  # of a driver's thread: SystemExit is no verdict


def _say_next(given: argparse.Namespace, code: int) -> None:
    """The next two commands, to a person at a terminal whose command did its work."""
    values = vars(given)
    tried = " --dry-run" if values.get("dry_run") else ""
    following = commands.table("following").get(f"{given.called}{tried}")
    read = not values.get("json") and sys.stdout.isatty()
    if not following or not read or code in (CODES.wrong_use, CODES.fault):
        return

    def given_or_named(found: re.Match[str]) -> str:
        value = values.get(found[1])
        one = value[0] if isinstance(value, list) and value else value
        return in_command(one) if one else found[1].upper()

    then = (re.sub(r"\{(\w+)\}", given_or_named, text) for text in following)
    print("Then, for instance:", *(f"teatbench {text}" for text in then), sep="\n  ")


def _with_cure(text: str, error: Exception) -> str:
    """What a full disk needs is said with whatever could not be written."""
    cured = "Make room" in text or not is_full(error)
    return text if cured else f"{full_stop(text)} Make room."


HELD = "What {} was to hold follows. Keep it: copy it into a file of that name."
HINT = "Is the disk full, or the folder read-only?"
if os.name == "nt":
    HINT = "Is the disk full, the folder read-only, or the file open in another program?"
MEMORY_WORDS = (
    "insufficient memory",
    "cannot allocate memory",
    "failed to map segment",
    "can't start new thread",  # its stack is 8 MB of the limit
)


def _is_of_memory(error: BaseException) -> bool:
    """Whether ``error``, or what it was raised in the course of, is of memory."""
    cause, words = error.__cause__ or error.__context__, words_of(error).lower()
    if isinstance(error, MemoryError) or any(w in words for w in MEMORY_WORDS):
        return True
    return cause is not None and _is_of_memory(cause)


def _unforeseen(error: BaseException, kept: str) -> int:
    """Of the system amid whatever the command did, or a mistake of ours: its exit code must not
    look like a requirement that isn't met, which Python's own would. ``kept``: what is there all
    the same.
    """
    stays = f"; {kept}" if kept else ""
    if _is_of_memory(error):
        what = f"out of memory: {LIMIT}, or ask for less at once ({error})"
        return complain(f"{what}{stays}", CODES.fault)
    if isinstance(error, OSError):
        from bench.files import is_unreadable

        windows_says = getattr(error, "winerror", 0) == FILENAME_EXCED_RANGE
        if error.errno == errno.ENAMETOOLONG or windows_says:
            return complain(f"{error}: give it a shorter name", CODES.wrong_use)
        if is_unreadable(error):
            return complain(f"{error.filename} can't be read: {error.strerror}", CODES.wrong_use)
        text = ": ".join(str(part) for part in (error.filename, error.strerror) if part)
        hint = "" if is_full(error) else f" {HINT}"
        said = f"{text}.{hint}" if error.errno else str(error)
        return complain(_with_cure(said, error), CODES.fault)
    traceback.print_exception(error)
    with suppress(Exception):  # of such a module
        if why := overwritten():
            return complain(f"internal error{stays}. {why}", CODES.fault)
    return complain(f"internal error; please report the traceback above{stays}", CODES.fault)


class Parser(argparse.ArgumentParser):
    """Names what was meant where a word is not known, and lists choices only where they are few."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        found, odd = super().parse_known_args(args, namespace)
        if odd:  # reported with the usage of the command that they were given to
            meant = did_you_mean(odd[0].partition("=")[0], self._option_string_actions)
            self.error(f"unrecognized arguments: {' '.join(odd)}{meant}")
        return found, odd

    def error(self, message: str) -> NoReturn:
        """Without a command, those of its group; all are too many."""
        groups = [one for one in self._actions if isinstance(one, argparse._SubParsersAction)]
        if message.endswith(": COMMAND") and not self.prog.count(" "):
            message = f"no command is named; '{self.prog} --help' lists them by task"
        elif message.endswith(": COMMAND"):
            rows = ((one.dest, one.help) for group in groups for one in group._choices_actions)
            message += "".join(f"\n  {self.prog} {name}: {what}" for name, what in rows)
        super().error(message)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        choices = list(action.choices or ())
        if action.choices is None or value in choices:
            return
        near = near_words(str(value), map(str, choices))[:3]
        said = " or ".join(f"'{one}'" for one in near)
        rest = f"choose from {', '.join(map(str, choices))}"
        if near:
            rest = f"did you mean {said}?"
        elif len(choices) > FEW:
            rest = f"'{self.prog} --help' lists all {len(choices)}"
        raise argparse.ArgumentError(action, f"invalid choice: {value!r} ({rest})")


class TopParser(Parser):
    """The help of all commands has them by task, with an example each."""

    def format_help(self) -> str:
        help_text = self._get_formatter()
        help_text.add_usage(self.usage, self._actions, self._mutually_exclusive_groups)
        help_text.add_text(self.description)
        (listed,) = (one for one in self._actions if isinstance(one, argparse._SubParsersAction))
        by_name = {action.dest: action for action in listed._choices_actions}
        for task, names in commands.table("tasks")["tasks"].items():
            help_text.start_section(task)
            help_text.add_arguments([by_name[name] for name in names])
            help_text.end_section()
            first = next(one for one in commands.COMMANDS if one.split()[0] == names[0])
            help_text.add_text(f"  example: teatbench {commands.COMMANDS[first][1]}")
        help_text.start_section("options")
        help_text.add_arguments([one for one in self._actions if one is not listed])
        help_text.end_section()
        help_text.add_text(MORE_HELP)
        help_text.add_text(self.epilog)
        return help_text.format_help()


def _exit_codes(name: str) -> str:
    """Of a command, a line each; of a group nothing, since each of its commands has its own."""
    if name not in commands.COMMANDS:
        return ""
    lines = ["", "", "exit codes:"]
    for code, text in commands.exit_codes(name).items():
        lines += wrap(f"  {code} {text}", HELP_COLUMNS, subsequent_indent="    ")
    return "\n".join(lines)


def _named(words: Sequence[str]) -> frozenset[str]:
    """Commands and groups that ``words`` may name, by a name of earlier releases too."""
    first = {name.split()[0] for name in commands.COMMANDS}
    return frozenset(one for one in first if {one, *commands.ONCE.get(one, ())} & set(words))


@cache
def parser(named: frozenset[str] | None = None) -> argparse.ArgumentParser:
    """The whole command line; made once. Of other commands and groups than ``named`` only what the
    help of all has, for it takes longer to make them than to answer.
    """
    unnamed = Parser()

    def made(prog: str, **how: Any) -> Parser:
        return unnamed if others(prog.split()[1]) else Parser(prog=prog, **how)

    def others(first: str) -> bool:
        return named is not None and first not in named

    top = TopParser(
        prog="teatbench",
        description="A hardware-in-the-loop test bench for teat detectors.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=f"teatbench {__version__}")
    parsers: dict[str, argparse.ArgumentParser] = {"": top}
    subparsers: dict[str, SubParsers] = {}
    groups = commands.table("tasks")["groups"]

    def add(name: str, what: str, example: str) -> argparse.ArgumentParser:
        group, _, own = name.rpartition(" ")
        if group not in parsers:
            add(group, groups[group], example)
        if group not in subparsers:
            subparsers[group] = parsers[group].add_subparsers(  # type: ignore[call-overload]
                title="commands",
                metavar="COMMAND",
                required=group in ("", *groups),
                parser_class=made,  # argparse only calls it
            )
        parsers[name] = subparsers[group].add_parser(
            own,
            aliases=commands.ONCE.get(name, ()),
            help=what,
            description="\n".join(wrap(what.replace("%%", "%"), HELP_COLUMNS)),
            epilog=f"example: teatbench {example}{_exit_codes(name)}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        return parsers[name]

    for name, (what, example, *arguments) in commands.COMMANDS.items():
        first, last = name.split()[0], name.split()[-1]
        if others(first):
            if first not in parsers:
                parsers[first] = add(first, groups.get(first, what), example)
            continue
        parser = add(name, what, example)
        for argument in arguments:
            argument(parser)
        work = commands.WORK.get(name) or commands.WORK.get(f"{first} *", first)
        module, _, own = work.partition(":")
        done, left = (module, own or last), commands.interrupted(name)
        parser.set_defaults(command=done, called=name, parser=parser, left=left)
    return top

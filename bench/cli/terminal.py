"""What a person at the terminal sees while a run goes on: a bar, and what is being done.

Rich's console as the bench uses it: what others wrote moves no cursor, changes no colour and is no
markup.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from functools import partial
from typing import TextIO, cast

from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.live import Live
from rich.measure import measure_renderables
from rich.padding import Padding
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
)
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from reports.sanitize import SanitizedStream, sanitized, unfiltered
from textfiles.text import plural

# rich ends the program where the reader of its output has gone (`| head`)
FAILURES = (Exception, SystemExit)


class _Count(MofNCompleteColumn):
    """Done of total; nothing where the total is not known."""

    def render(self, task: Task) -> Text:
        return Text("") if task.total is None else super().render(task)


def _columns() -> tuple[ProgressColumn, ...]:
    """What every bar is made of."""
    return TextColumn("{task.description}"), BarColumn(), _Count(), TimeElapsedColumn()


class ProgressBar:
    """A bar of `working`; to be called with how many are done, of how many, and words to that."""

    def __init__(self, bar: Progress, what: str, pace: str) -> None:
        self._bar, self._pace = bar, pace
        self._task = bar.add_task(what, total=None, detail="")
        self._first: int | None = None

    def __call__(self, done: int, total: int, detail: str = "") -> None:
        first = self._first = done if self._first is None else self._first
        spent_s = self._bar.tasks[0].elapsed or 0.0
        if self._pace and done > first and spent_s:
            a_second = (done - first) / spent_s
            left_s = round((total - done) / a_second)
            left = f"{left_s // 60} min" if left_s >= 120 else f"{left_s} s"
            detail = f"{a_second:.1f} {self._pace}/s, {left} left; {detail}"
        self._bar.update(self._task, completed=done, total=total, detail=detail)

    def say(self, text: str) -> None:
        """A line that stays, above the bar."""
        with suppress(*FAILURES):
            self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def working(what: str, pace: str = "") -> Iterator[ProgressBar]:
    """A transient bar on standard error, where that and the output are a terminal; gives what to
    call with the progress. ``pace`` names what is counted, for the rate.
    """
    console = Terminal(sys.stderr)
    columns = (*_columns(), *([TextColumn("{task.fields[detail]}")] if pace else []))
    with Progress(
        *columns,
        console=console,
        transient=True,
        disable=not (console.is_terminal and Terminal().is_terminal),
        redirect_stdout=sys.stdout.isatty(),  # a pipe's lines stay its own, whatever is forced
    ) as bar:
        yield ProgressBar(bar, what, pace)


@contextmanager
def no_echo() -> Iterator[None]:
    """What is typed isn't shown meanwhile: an Enter would move the cursor away from the bar, and
    leave one that nothing clears. Windows shows only what is read.
    """
    if sys.platform == "win32" or sys.stdin is None or not sys.stdin.isatty():
        yield
        return
    import termios

    at = sys.stdin.fileno()
    try:
        before = termios.tcgetattr(at)
        if os.tcgetpgrp(at) != os.getpgrp():  # in the background it is another's terminal
            raise OSError
    except (termios.error, OSError):
        yield
        return
    quiet = [*before]
    quiet[3] &= ~termios.ECHO
    termios.tcsetattr(at, termios.TCSANOW, quiet)
    try:
        yield
    finally:
        with suppress(termios.error, OSError):  # the terminal may have gone
            termios.tcsetattr(at, termios.TCSANOW, before)


COMMAND = re.compile(r":? '?(?=teatbench )(?!.* '?teatbench )((?:[^\n']| '[^\n']*')+?)'?\.?$")


def print_wrapped(console: Console, text: str, style: str = "") -> None:
    """``text`` wrapped between words; a command at its end on a line of its own, to be pasted.
    In a file lines stay whole, for who searches them.
    """
    command = COMMAND.search(text) if console.is_terminal else None
    before, piped = f"{text[: command.start()]}:" if command else text, not console.is_terminal
    console.print(before, style=style, markup=False, highlight=False, soft_wrap=piped)
    if command:
        console.print(f"  {command[1]}", markup=False, highlight=False, soft_wrap=True)


def print_table(console: Console, table: Table) -> None:
    """``table`` with each word whole; where a terminal has no room for that, each row as a text. A
    file or a pipe has no edge.
    """
    wide = console.options.update(width=10_000)
    needs = table.__rich_measure__(console, wide)
    if not console.is_terminal:
        console.width = max(console.width, needs.maximum)
    if needs.minimum <= console.width:
        for column in table.columns:
            cells = (column.header, *column.cells)
            column.min_width = measure_renderables(console, wide, cells).minimum
        console.print(table)
        return
    first, *others = table.columns
    console.print(*filter(None, [table.title]), end="\n" * bool(table.title))
    for name, *row in zip(first.cells, *(column.cells for column in others), strict=True):
        values = zip(others, cast("list[str | Text]", row), strict=True)
        said = (Text.assemble(f"{of.header}: ", value) for of, value in values)
        console.print(*filter(None, [name]), Padding(Text("; ").join(said), (0, 0, 0, 2)))
    console.print(*filter(None, [table.caption]), end="\n" * bool(table.caption))


class _Printed(SanitizedStream):
    """Standard output while a run is shown: a line that a driver or detector prints says whose it
    is. Questions go to the stream itself, as from under rich's bar.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        super().__init__(unfiltered(sys.stdout))
        self.goes_on = getattr(sys.stdout, "goes_on", False)
        self.rich_proxied_file, self._say, self._line = sys.stdout, say, ""

    def write(self, text: str) -> int:
        whose = sys._getframe(1).f_globals.get("__name__", "a plug-in")
        *lines, self._line = (self._line + text).split("\n")
        for line in lines:
            self._say(line if whose.startswith("bench.") else f"{whose} prints: {line}")
        return len(text)


class _Display(Live):
    """What is written above it is not parted by a refresh: rich moves by the rows that it drew
    last, which may be others by then.
    """

    def above(self, write: Callable[[], None]) -> None:
        with self._lock:
            write()


class TerminalProgress:
    """A context with a bar on ``console``, or a line a trial without a terminal. Each stretch
    between two questions has a new display: rich's would clear what was written since.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bar = Progress(*_columns(), console=console)
        self._task = self._bar.add_task("trials", total=None)
        self._doing = ""  # trial, what is done, bath, time left, last error
        self._live: _Display | None = None
        self._asking = False  # the cursor stands behind a question
        self._echo, self._printed = ExitStack(), ExitStack()

    def state(self, text: str) -> None:
        self._doing = text

    def trial(self, done: int, total: int, name: str) -> None:
        self._bar.update(self._task, completed=done, total=total)
        if not self._console.is_terminal:
            next_one = f"trial {done + 1} of {total}: {name}"
            over = f"{total} of {plural(total, 'trial')} done"
            self._console.print(next_one if done < total else over)

    def say(self, text: str) -> None:
        """A line that stays above the bar; a failure to show it is ignored."""
        with suppress(*FAILURES):
            self._write(text)

    def warn(self, text: str) -> None:
        self._write(text, "bold red")

    def _write(self, text: str, style: str = "") -> None:
        shown = f"\n{text}" if self._asking else text
        write, live = partial(print_wrapped, self._console, shown, style), self._live
        live.above(write) if live else write()

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Without a terminal nothing moves anyway."""
        if self._live is None:
            yield
            return
        self._stop(leave=False)
        self._asking = True
        try:
            yield
        finally:
            self._asking = False
            self._start()

    def __enter__(self) -> TerminalProgress:
        self._printed.enter_context(redirect_stdout(_Printed(self.say)))
        with suppress(*FAILURES):
            self._start()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(*FAILURES):
            self._stop(leave=any(task.total is not None for task in self._bar.tasks))
        self._printed.close()

    def _start(self) -> None:
        if self._console.is_terminal:
            self._echo.enter_context(no_echo())
            shown, console = self._shown, self._console
            self._live = _Display(console=console, get_renderable=shown, redirect_stdout=False)
            self._live.start()

    def _stop(self, *, leave: bool) -> None:
        live, self._live = self._live, None
        if live is not None:
            live.transient = not leave
            live.stop()
        self._echo.close()

    def _shown(self) -> RenderableType:
        return Group(self._bar.get_renderable(), Text(self._doing))


class Terminal(Console):
    """The program's standard output, or ``file``; rich's own control segments pass."""

    def __init__(self, file: TextIO | None = None) -> None:
        super().__init__(file=unfiltered(file or sys.stdout), markup=False, emoji=False)

    def on_broken_pipe(self) -> None:
        """As any writing to standard output; rich would end with code 1, that of a failure."""
        if not isinstance(sys.stdout, SanitizedStream):
            raise BrokenPipeError
        sys.stdout.lose_reader()

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        """As rich does, with each text sanitized before lines are measured and cut."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(sanitized(segment.text), segment.style)

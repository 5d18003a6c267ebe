"""Who shows what goes on. Showing may fail, as on a terminal that has gone; it has no say in what
the bench does.

What goes on as JSON lines, for others to watch (`--events FILE`): each line is whole when it is
there, and flushed.

It only watches: what fails here is told once and ends the lines, never the run. May not know what
is done with the lines.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol, TextIO

from bench.config import ConfigError
from instruments.clock import wall_time

# rich ends the program where the reader of its output has gone (`| head`)
FAILURES = (Exception, SystemExit)


class Progress(Protocol):
    """A terminal, or whatever a person looks at. May be called from any thread."""

    def state(self, text: str) -> None:
        """What is being done or waited for."""
        ...

    def trial(self, done: int, total: int, name: str) -> None:
        """``done`` of ``total`` trials are finished; ``name`` is next."""
        ...

    def warn(self, text: str) -> None:
        """What a person has to see at once, and do something about."""
        ...

    def aside(self) -> AbstractContextManager[None]:
        """While this lasts nothing moves on the screen: somebody is asked something there."""
        ...


class SafeProgress:
    """Shows on ``progress``; from its first failure on only what a person has to see at once is
    still tried there.

    ``told`` hears of that failure, once.
    """

    def __init__(self, progress: Progress, told: Callable[[str], None] = lambda _: None) -> None:
        self._progress = progress
        self._told = told
        self._failed = False

    def state(self, text: str) -> None:
        if not self._failed:
            self._tried(lambda: self._progress.state(text))

    def trial(self, done: int, total: int, name: str) -> None:
        if not self._failed:
            self._tried(lambda: self._progress.trial(done, total, name))

    def warn(self, text: str) -> None:
        self._tried(lambda: self._progress.warn(text))

    @contextmanager
    def aside(self) -> Iterator[None]:
        around = self._progress.aside()
        entered = self._tried(around.__enter__)
        try:
            yield
        finally:
            if entered:
                self._tried(lambda: around.__exit__(None, None, None))

    def _tried(self, show: Callable[[], object]) -> bool:
        """Whoever only watches ends no run, whatever went wrong with him."""
        try:
            show()
        except FAILURES as error:
            first, self._failed = not self._failed, True
            if first:
                self._told(f"the screen shows nothing any more: {type(error).__name__}: {error}")
            return False
        return True


ERRORS = ("dropped out", "camera", "fault", "trip", "suspended")  # kinds of events
LONGEST = 60  # of an error, in a line of the terminal


class EventLines:
    """Lines into ``file``: ``wall_time``, ``t_s`` (the bench's time, null before it has one),
    ``what``, and what belongs to it.
    """

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self._lock = threading.Lock()  # the watch tells of a trip from its own thread
        self.now_s: Callable[[], float | None] = lambda: None

    def write(self, what: str, **more: Any) -> None:
        """A line. Raises OSError, and ValueError once the file is closed."""
        with self._lock:
            line = {
                "wall_time": wall_time().isoformat(timespec="milliseconds"),
                "t_s": self.now_s(),
                "what": what,
                **more,
            }
            self._file.write(json.dumps(line, ensure_ascii=False) + "\n")
            self._file.flush()


class WatchedProgress:
    """Shows on ``progress``, as one line: trial, what is done, bath, time left, last error; and
    tells ``lines``.

    Neither can end what it shows, nor the other: of lines that fail the person at ``progress``
    hears, of a screen that fails the lines, of both whoever is ``fed_by``, once.
    """

    def __init__(self, progress: Progress, lines: EventLines | None) -> None:
        self._progress = SafeProgress(progress, self._screen_failed)
        self._lines = lines
        self._failed: Callable[[str], None] = lambda _: None
        self._live: Callable[[], Mapping[str, str]] = dict
        self._name = self._text = self._error = ""

    def state(self, text: str) -> None:
        self._text = text
        self._tell("doing", text=text, **self._show())

    def refresh(self) -> None:
        """The line once more, with the bath as it is now. From any thread; what goes wrong with it
        is nobody's trouble.
        """
        with suppress(*FAILURES):
            self._show()

    def _show(self) -> dict[str, str]:
        """The line on the screen; gives back what stands there beside trial and text."""
        live = self._live()
        error = {"last error": self._error} if self._error else {}
        parts = [
            self._name,
            self._text,
            *live.values(),
            *(f"last error: {said[:LONGEST]}" for said in error.values()),
        ]
        self._progress.state("; ".join(part for part in parts if part))
        return {**live, **error}

    def trial(self, done: int, total: int, name: str) -> None:
        self._name = name
        self._progress.trial(done, total, name)
        self._tell("trial", done=done, total=total, name=name)

    def warn(self, text: str) -> None:
        self._progress.warn(text)
        self._tell("warning", text=text)

    @contextmanager
    def aside(self) -> Iterator[None]:
        with self._progress.aside():
            yield

    def event(self, kind: str, text: str) -> None:
        """An event that is in the record."""
        if kind in ERRORS:
            self._error = text
        self._tell("event", kind=kind, text=text)

    def fed_by(
        self,
        now_s: Callable[[], float],
        live: Callable[[], Mapping[str, str]],
        failed: Callable[[str], None] = lambda _: None,
    ) -> None:
        """From now on lines have the bench's time, and the line in the terminal what ``live`` says:
        bath, time left.

        ``failed`` hears what can't be shown any more.
        """
        self._live = live
        self._failed = failed
        if self._lines:
            self._lines.now_s = now_s

    def _tell(self, what: str, **more: Any) -> None:
        if self._lines is None:
            return
        try:
            self._lines.write(what, **more)
        except Exception as error:  # whatever it is, it only watched
            self._lines = None
            said = f"--events: no further lines: {error}"
            self._progress.warn(said)
            self._failed(said)

    def _screen_failed(self, said: str) -> None:
        self._tell("warning", text=said)
        self._failed(said)


@contextmanager
def event_lines(path: Path | None) -> Iterator[EventLines | None]:
    """Lines at the end of the file ``path``, None where none is asked for. Raises ConfigError where
    it can't be opened.
    """
    if path is None:
        yield None
        return
    try:
        file = path.open("a", encoding="utf-8", newline="\n")
    except OSError as error:
        raise ConfigError.plain(
            f"--events {path}: it can't be opened: {error.strerror or error}"
        ) from error
    try:
        yield EventLines(file)
    finally:
        with suppress(OSError):  # every line was flushed, or its failure told
            file.close()

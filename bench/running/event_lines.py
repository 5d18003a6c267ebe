"""What goes on as JSON lines, for others to watch (`--events FILE`): each line is whole when it is there, and flushed.

It only watches: what fails here is told once and ends the lines, never the run. May not know what is done with the lines.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

from bench.config import ConfigError
from bench.running.showing import Progress
from instruments.clock import wall_time

ERRORS = ("dropped out", "camera", "fault", "trip", "suspended")  # kinds of events
LONGEST = 60  # of an error, in a line of the terminal


class EventLines:
    """Lines into ``file``: ``wall_time``, ``t_s`` (the bench's time, null before it has one), ``what``, and what belongs to it."""

    def __init__(self, file: TextIO) -> None:
        self._file = file
        self.now_s: Callable[[], float | None] = lambda: None

    def write(self, what: str, **more: Any) -> None:
        """A line. Raises OSError, and ValueError once the file is closed."""
        line = {"wall_time": wall_time().isoformat(timespec="milliseconds"), "t_s": self.now_s(), "what": what, **more}
        self._file.write(json.dumps(line, ensure_ascii=False) + "\n")
        self._file.flush()


class WatchedProgress:
    """Shows on ``progress``, as one line: trial, what is done, bath, time left, last error; and tells ``lines``.

    Lines that fail end, and the person at ``progress`` hears of it.
    """

    def __init__(self, progress: Progress, lines: EventLines | None) -> None:
        self._progress = progress
        self._lines = lines
        self._live: Callable[[], Mapping[str, str]] = dict
        self._name = self._error = ""

    def state(self, text: str) -> None:
        live = self._live()
        error = {"last error": self._error} if self._error else {}
        parts = [self._name, text, *live.values(), *(f"last error: {said[:LONGEST]}" for said in error.values())]
        self._progress.state("; ".join(part for part in parts if part))
        self._tell("doing", text=text, **live, **error)

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

    def fed_by(self, now_s: Callable[[], float], live: Callable[[], Mapping[str, str]]) -> None:
        """From now on lines have the bench's time, and the line in the terminal what ``live`` says: bath, time left."""
        self._live = live
        if self._lines:
            self._lines.now_s = now_s

    def _tell(self, what: str, **more: Any) -> None:
        if self._lines is None:
            return
        try:
            self._lines.write(what, **more)
        except Exception as error:  # whatever it is, it only watched
            self._lines = None
            self._progress.warn(f"--events: no further lines: {error}")


@contextmanager
def event_lines(path: Path | None) -> Iterator[EventLines | None]:
    """Lines at the end of the file ``path``, None where none is asked for. Raises ConfigError where it can't be opened."""
    if path is None:
        yield None
        return
    try:
        file = path.open("a", encoding="utf-8", newline="\n")
    except OSError as error:
        raise ConfigError.plain(f"--events {path}: it can't be opened: {error.strerror or error}") from error
    try:
        yield EventLines(file)
    finally:
        with suppress(OSError):  # every line was flushed, or its failure told
            file.close()

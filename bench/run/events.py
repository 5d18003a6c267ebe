"""What happens in a run: its states, which may follow which, and one numbered stream of events for
its listeners: the screen, ``--events FILE``, and `events.jsonl` in the run's folder, which goes on
with its numbers when the run is resumed (docs/runs.md has the states and the lines).

A listener that fails is named once, to the others and in the record, and gets no more (but for what
a person has to see at once); none can stop a run. The record is no listener: it comes first, and
what it can't take ends the run. Each line is one write at the end of the file, so a killed bench
leaves whole lines; half a line of a machine that lost its power is cut off when the run goes on.
Events that `events.jsonl` lacks, such as those of a full disk, are put in from the record, at the
session's end or by `resume`, behind a warning that says since when lines are missing.
"""

from __future__ import annotations

import errno
import json
import os
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from enum import StrEnum
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from bench.config import ConfigError
from bench.record.schema import Row
from bench.record.state import TRIP
from instruments.clock import wall_time
from textfiles.whole import refusal

if TYPE_CHECKING:
    from bench.results.status import RunStatus

PROMPTED, TRIPPED, NOT_SAFE, ENDED = "asked", "tripped", "not safe", "ended"  # to be notified
EVENT = "run state"  # the kind of a change of state, in the record


class RunState(StrEnum):
    PLANNED = "planned"
    PREPARING = "preparing"
    SETTLING = "settling"
    RUNNING = "running"
    PAUSED = "paused"
    SAFING = "safing"
    FINISHED = "finished"
    ABORTED = "aborted"
    FAULTED = "faulted"
    TRIPPED = "tripped"


_S = RunState
TABLE: Mapping[RunState, frozenset[RunState]] = {
    _S.PLANNED: frozenset({_S.PREPARING, _S.SAFING, _S.ABORTED, _S.FAULTED}),
    _S.PREPARING: frozenset({_S.SETTLING, _S.RUNNING, _S.PAUSED, _S.SAFING}),
    _S.SETTLING: frozenset({_S.RUNNING, _S.PAUSED, _S.SAFING}),
    _S.RUNNING: frozenset({_S.SETTLING, _S.PAUSED, _S.SAFING}),
    _S.PAUSED: frozenset({_S.PREPARING, _S.SETTLING, _S.RUNNING, _S.SAFING}),
    _S.SAFING: frozenset({_S.FINISHED, _S.ABORTED, _S.FAULTED, _S.TRIPPED}),
    **dict.fromkeys((_S.FINISHED, _S.ABORTED, _S.FAULTED, _S.TRIPPED), frozenset()),
}
AWAY = frozenset({_S.PAUSED, _S.SETTLING})


class RunStates:
    """The state of one run. ``report`` gets each change, ``now_s`` is the time."""

    def __init__(self, report: Callable[[RunState], None], now_s: Callable[[], float]) -> None:
        self._report = report
        self._now_s = now_s
        self._since_s = now_s()
        self._away_s = 0.0
        self.current = RunState.PLANNED

    def to(self, state: RunState) -> None:
        """Change to ``state``. Raises ValueError for a change that the table doesn't have."""
        if state is self.current:
            return
        if state not in TABLE[self.current]:
            only = ", ".join(sorted(TABLE[self.current])) or "nothing"
            raise ValueError(f"a run that is {self.current} can't be {state} next (only {only})")
        self._away_s, self._since_s = self.away_s, self._now_s()
        self.current = state
        self._report(state)

    @contextmanager
    def during(self, state: RunState) -> Iterator[None]:
        """In ``state`` while this lasts, then back; after an exception the state stays."""
        before = self.current
        self.to(state)
        yield
        self.to(before)

    @property
    def away_s(self) -> float:
        """Seconds spent paused or settling so far."""
        return self._away_s + (self._now_s() - self._since_s if self.current in AWAY else 0.0)


# a screen may end the program, as rich does where the reader of its output has gone
FAILURES = (Exception, SystemExit)
EVENTS_FILE = "events.jsonl"  # in the run's folder
ERRORS = ("dropped out", "camera", "fault", "trip", "suspended")  # kinds of events
BACK = "back"  # what was away; its error is over
TAIL_BYTES = 1 << 16


class Progress(Protocol):
    """A terminal or other screen, for any thread: the present work (``state``), trials done, and
    what a person has to see at once (``warn``). Nothing moves on it during ``aside``.
    """

    def state(self, text: str) -> None: ...
    def trial(self, done: int, total: int, name: str) -> None: ...
    def warn(self, text: str) -> None: ...
    def aside(self) -> AbstractContextManager[None]: ...


class SafeProgress:
    """Shows on ``progress``; after its first failure, reported to ``failed``, only warnings."""

    def __init__(self, progress: Progress, failed: Callable[[str], None] = lambda _: None) -> None:
        self._progress = progress
        self._report = failed
        self._failed = False

    def state(self, text: str) -> None:
        self._tried(lambda: self._progress.state(text))

    def trial(self, done: int, total: int, name: str) -> None:
        self._tried(lambda: self._progress.trial(done, total, name))

    def warn(self, text: str) -> None:
        self._tried(lambda: self._progress.warn(text), urgent=True)

    @contextmanager
    def aside(self) -> Iterator[None]:
        around = self._progress.aside()
        entered = self._tried(around.__enter__, urgent=True)
        try:
            yield
        finally:
            if entered:
                self._tried(lambda: around.__exit__(None, None, None), urgent=True)

    def _tried(self, show: Callable[[], object], *, urgent: bool = False) -> bool:
        if self._failed and not urgent:
            return False
        try:
            show()
        except FAILURES as error:
            first, self._failed = not self._failed, True
            if first:
                self._report(f"the screen shows nothing any more: {type(error).__name__}: {error}")
            return False
        return True


class Events:
    """The stream, from any thread, shown on ``screen`` as one line and written to ``file``.
    ``status``: the run now; ``not_shown`` gets a listener that failed; ``notify`` what a person
    elsewhere has to know. ``replaying`` is shown with what is done, and nothing is written.
    """

    def __init__(self, screen: Progress, file: FileIO | None = None) -> None:
        self._screen = SafeProgress(screen, self._screen_failed)
        self._files = {"--events": file} if file else {}
        self._lock = threading.RLock()
        self._number = 0
        self.pose = self.doing = self.error = ""
        self.now_s: Callable[[], float | None] = lambda: None
        self.status: Callable[[], RunStatus | None] = lambda: None
        self.not_shown: Callable[[str], object] = lambda _: None
        self.replaying = ""
        self.notify: Callable[[str], None] = lambda _: None

    @contextmanager
    def kept_in(
        self, folder: Path, recorded: Callable[[], Sequence[Row]] = tuple
    ) -> Iterator[None]:
        """Written to `EVENTS_FILE` in ``folder`` too, on from its last number, with those of the
        events ``recorded`` in the run's record that it lacks.
        """
        self.pose = self.doing = self.error = ""
        try:
            file = FileIO(folder / EVENTS_FILE, "a+")
        except OSError as error:
            self._file_failed(EVENTS_FILE, error)
            yield
            return
        with file:
            try:
                self._number = max(self._number, _last_number(file))
                self._catch_up(file, recorded())
                self._files[EVENTS_FILE] = file
            except Exception as error:  # also of a record that can't be read
                self._file_failed(EVENTS_FILE, error)
            try:
                yield
            finally:
                with self._lock, suppress(Exception):  # a disk that is full still
                    if not self._files.pop(EVENTS_FILE, None):
                        self._catch_up(file, recorded())

    def state(self, text: str) -> None:
        self.doing = f"{self.replaying}: {text}" if self.replaying else text
        self._write("doing", text=text, **self._show())

    def refresh(self) -> None:
        """Show the line once more, with the bath as it is now. Raises nothing."""
        with suppress(*FAILURES):
            self._show()

    def trial(self, done: int, total: int, name: str) -> None:
        self.pose = name
        self._screen.trial(done, total, name)
        self._write("trial", done=done, total=total, name=name)

    def asked(self, kind: str) -> None:
        """The operator is asked for something of this kind; "" once it is done."""
        self._write("asked", kind=kind)
        if kind and not self.replaying:
            self.notify(PROMPTED)

    def warn(self, text: str) -> None:
        self._screen.warn(text)
        self._write("warning", text=text)

    def event(self, kind: str, text: str) -> None:
        """An event that is in the record."""
        if kind in (*ERRORS, BACK):
            self.error = "" if kind == BACK else text
        self._write("event", kind=kind, text=text)
        if kind == TRIP:
            self.notify(TRIPPED)

    def aside(self) -> AbstractContextManager[None]:
        return self._screen.aside()

    def _show(self) -> dict[str, str]:
        """The line on the screen; gives back what stands there beside trial and text."""
        status = self.status()
        self._screen.state(status.line if status else self.doing)
        return status.parts if status else {}

    def _write(self, what: str, **more: Any) -> None:
        if self.replaying and what != "warning" and more.get("kind") != TRIP:
            return
        with self._lock:
            whole = self._line({"wall_time": _now(), "t_s": self.now_s(), "what": what, **more})
            failed: dict[str, Exception] = {}
            for name, file in self._files.items():
                try:
                    _append(file, whole)
                except Exception as error:  # whatever it is, it only listened
                    failed[name] = error
            for name in failed:
                del self._files[name]  # before any warning, which is a line of the others
            for name, why in failed.items():
                self._file_failed(name, why)

    def _line(self, what: Mapping[str, Any]) -> bytes:
        self._number += 1
        return json.dumps({"number": self._number, **what}, ensure_ascii=False).encode() + b"\n"

    def _catch_up(self, file: FileIO, recorded: Sequence[Row]) -> None:
        """Write which events ``file`` lacks, and since when lines are missing. Raises OSError."""
        if not (missing := _missing(file, recorded)):
            return
        since = missing[0]["wall_time"]
        text = (
            f"Lines since {since} are missing here. Of the record's events, {len(missing)} follow."
        )
        warning = {"wall_time": _now(), "t_s": None, "what": "warning", "text": text}
        _append(file, self._line(warning))
        for one in missing:
            line = {"wall_time": one["wall_time"], "t_s": one["t_s"], "what": "event"}
            _append(file, self._line({**line, "kind": one["kind"], "text": one["text"]}))

    def _file_failed(self, name: str, error: Exception) -> None:
        why = f"{name}: no further lines: {refusal(error)}"
        self.warn(why)
        self.not_shown(why)

    def _screen_failed(self, why: str) -> None:
        self._write("warning", text=why)
        self.not_shown(why)


def read_events(folder: Path) -> Iterator[dict[str, Any]]:
    """The lines of the run in ``folder``. Raises OSError, ValueError."""
    for line in (folder / EVENTS_FILE).read_bytes().splitlines():
        yield json.loads(line)


def _append(file: FileIO, line: bytes) -> None:
    """The whole of ``line`` or nothing. Raises OSError."""
    if (wrote := file.write(line) or 0) != len(line):
        with suppress(OSError):  # a pipe has no half line to take back
            file.truncate(file.tell() - wrote)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _missing(file: FileIO, recorded: Sequence[Row]) -> Sequence[Row]:
    """Those of the events ``recorded`` that come behind the last one in ``file``."""
    file.seek(0)
    lines = map(_event_in, file.readall().splitlines() if recorded else ())
    there = [event for event in lines if event]
    for last in reversed(there):  # one that only the file has says nothing
        same = [i for i, one in enumerate(recorded) if (one["kind"], one["text"]) == last]
        if len(same) >= (times := there.count(last)):
            return recorded[same[times - 1] + 1 :]
    return recorded


def _event_in(line: bytes) -> tuple[str, str] | None:
    """Kind and text of an event; None for another line, or one that was damaged."""
    with suppress(ValueError, LookupError, TypeError):
        found = json.loads(line)
        return (found["kind"], found["text"]) if found["what"] == "event" else None
    return None


def _now() -> str:
    return wall_time().isoformat(timespec="milliseconds")


def _last_number(file: FileIO) -> int:
    """The number of the last whole line; half a line behind it is cut off. Raises OSError."""
    end = file.seek(0, os.SEEK_END)
    start = file.seek(max(0, end - TAIL_BYTES))
    tail = file.read(TAIL_BYTES) or b""
    whole = tail[: tail.rfind(b"\n") + 1]
    if len(whole) < len(tail):
        file.truncate(start + len(whole))
    try:
        return int(json.loads(whole.splitlines()[-1])["number"])
    except (IndexError, ValueError, KeyError, TypeError):
        return 0


@contextmanager
def event_lines(path: Path | None) -> Iterator[FileIO | None]:
    """The file ``path``, open for `Events`, if any. Raises ConfigError."""
    if path is None:
        yield None
        return
    try:
        if path.is_file():
            with FileIO(path, "r+") as there:  # a bench that was killed may have left half a line
                _last_number(there)
        file = FileIO(path, "a")
    except OSError as error:
        why = f"{path}: it can't be opened for the events: {refusal(error, 'Name another file.')}"
        raise ConfigError.plain(why) from error
    try:
        yield file
    finally:
        with suppress(OSError):
            file.close()

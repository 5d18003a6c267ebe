"""Runs whose bench is killed at a moment of one's choice, as a process of its own, and what two
records have in common.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sqlite3
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing, nullcontext
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

from bench.record.schema import DATABASE
from bench.rig.loading import load_rig
from bench.run.events import Progress, RunState
from bench.run.start import RunOptions, resume_run, run_queue
from bench.script.model import load_script
from instruments.clock import VirtualClock
from tests.waiting import PATIENCE_S

TABLES = (
    *("trials", "skipped", "frames", "touches", "truth", "checks", "detections", "found"),
    *("scores", "bath", "invalidated"),
)
# which session it was, and which call was a process's first, is no part of the result
OF_THE_SESSION = ("session", "cold")


class Silent:
    """Shows nothing; keeps warnings."""

    def __init__(self) -> None:
        self.warned: list[str] = []

    def state(self, text: str) -> None: ...
    def trial(self, done: int, total: int, name: str) -> None: ...
    def warn(self, text: str) -> None:
        self.warned.append(text)

    def aside(self) -> nullcontext[None]:
        return nullcontext()


class Person(Silent):
    """Types ``lines``, one at each look, once ``since`` is the name of the next trial or stood in a
    warning ("": from the beginning).
    """

    def __init__(self, since: str, lines: Sequence[str]) -> None:
        super().__init__()
        self._since, self._lines, self.seen = since, [*lines], ""
        self.states: list[str] = []

    def state(self, text: str) -> None:
        self.states.append(text)

    def trial(self, done: int, total: int, name: str) -> None:
        self.seen += name

    def warn(self, text: str) -> None:
        super().warn(text)
        self.seen += text

    def typed(self) -> str | None:
        return self._lines.pop(0) if self._lines and self._since in self.seen else None


def start(
    folder: Path, out: str = "runs", progress: Progress | None = None, how: RunOptions | None = None
) -> tuple[Path, RunState]:
    """The script in ``folder`` on the rig there, from the beginning; a `Person` types too."""
    rig, shown = load_rig(folder / "rig.toml"), progress or Silent()
    script = load_script(folder / "script.toml", rig.rig.limits.set_point_c)
    if isinstance(shown, Person):
        how = RunOptions(typed=shown.typed)
    return run_queue(rig, [script], folder / out, shown, how)[0]


def only_run(folder: Path, out: str) -> Path:
    (run,) = (folder / out).iterdir()
    return run


def steps_of(work: Callable[[], Any]) -> int:
    """How many steps the virtual clock makes in ``work``."""
    made, step = count(), VirtualClock.step

    def counted(clock: VirtualClock, limit_s: float) -> bool:
        next(made)
        return step(clock, limit_s)

    with patch.object(VirtualClock, "step", counted):
        work()
    return next(made)


def killed_at(step: int, work: Callable[[], Any]) -> bool:
    """Do ``work`` in a process that is killed, as by the system, at the clock's ``step``; False
    where it was over before.
    """
    left = count(step - 1, -1)
    return _killed(lambda _: next(left) <= 0, "step", VirtualClock, work)


def killed_while(words: str, method: str, kind: type | ModuleType, work: Callable[[], Any]) -> bool:
    """The same, in the call of ``method`` of ``kind`` whose arguments have ``words`` in them."""
    return _killed(lambda arguments: words in repr(arguments), method, kind, work)


def _killed(
    when: Callable[[object], bool], method: str, kind: type | ModuleType, work: Callable[[], Any]
) -> bool:
    own = getattr(kind, method)

    def fatal(*arguments: Any, **more: Any) -> Any:
        if when(arguments):
            os.kill(os.getpid(), signal.SIGKILL)
        return own(*arguments, **more)

    def dying() -> None:
        with patch.object(kind, method, fatal):
            work()

    process = multiprocessing.get_context("fork").Process(target=dying)
    process.start()
    process.join(PATIENCE_S)
    return process.exitcode == -signal.SIGKILL


def resume(folder: Path, out: str, progress: Progress | None = None) -> tuple[Path, RunState]:
    return resume_run(only_run(folder, out), progress or Silent())


def results(run: Path) -> dict[str, list[tuple[Any, ...]]]:
    """All rows of all results, without what depends on real time or on the session."""
    return rows_of(run, TABLES, lambda name: name in OF_THE_SESSION)


def rows_of(
    run: Path, tables: Iterable[str], left_out: Callable[[str], bool]
) -> dict[str, list[tuple[Any, ...]]]:
    """Rows by table, sorted, without the computer's time and the columns that are ``left_out``."""
    found = {}
    with closing(sqlite3.connect(run / DATABASE)) as db:
        for table in tables:
            columns = [row[1] for row in db.execute(f"PRAGMA table_info({table})")]
            kept = [name for name in columns if not (name.startswith("wall") or left_out(name))]
            if kept:
                query = f"SELECT {', '.join(kept)} FROM {table}"
                found[table] = sorted(db.execute(query).fetchall(), key=repr)
    return found

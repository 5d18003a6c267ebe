"""The bench as a process that says when it comes to a step, and lingers in it, so that it can be
killed in that very step.

All but the mark is the bench's own: its command's work without the report, its drivers, its
guardian. Processes are forked from a server that has loaded everything, for there are many of them.
Linux and macOS.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.cli.terminal import TerminalProgress
from bench.record.recording import RecordingCameras
from bench.record.schema import Row
from bench.record.writer import Store
from bench.results.answers import Examiner
from bench.rig.devices import Devices
from bench.rig.guardian_client import GuardianClient
from bench.rig.loading import load_rig
from bench.run import start
from bench.run.events import RunState
from bench.run.start import resume_run, run_queue
from bench.run.trial import TrialRun
from bench.safety.bath_monitor import BathMonitor
from bench.safety.signals import CTRL_CLOSE_EVENT, Handler, installed
from bench.script.model import load_script
from bench.truth.touching import Toucher
from instruments.camera.cameras import CameraSet
from instruments.microscribe.driver import MicroScribe
from instruments.operators.operator import CheckPoint, Touch
from instruments.stage.driver import OwnStage
from tests.bench.forked import as_in_a_shell, context, take
from tests.bench.real_rig import RealRig
from tests.waiting import PATIENCE_S, within

MARK = "@@ "
LINGER_S = 0.6
CLOSED_CODE = 58
LONG_S = 10.0
PROMPT = "a = abort the run): "
CHECK, TOUCH = r"(\d) of (\d)\] Arm check", r"teat (\d+) of (\d+), \d+ of \d+ touches left"
CODES = {RunState.FINISHED: 0, RunState.ABORTED: 3, RunState.FAULTED: 3}


def say(step: str) -> None:
    print(f"\n{MARK}{step}", flush=True)


def put(owner: Any, name: str, instead: Callable[..., Any]) -> None:
    """From now on ``owner.name`` is ``instead``, in this process."""
    setattr(owner, name, instead)


def begins(owner: Any, name: str, step: str, linger_s: float = 0.0) -> None:
    """From now on ``step`` is told when ``owner.name`` is called; ``linger_s`` are spent in it
    before it does anything.
    """
    original: Callable[..., Any] = getattr(owner, name)

    def marked(*args: Any, **more: Any) -> Any:
        say(step)
        time.sleep(linger_s)
        return original(*args, **more)

    put(owner, name, marked)


class Lingering(tuple[Row, ...]):
    """Rows that take their time to be written: the transaction is open meanwhile."""

    def __iter__(self) -> Iterator[Row]:
        for number, row in enumerate(super().__iter__()):
            if number == 1:
                say("storing")
                time.sleep(LINGER_S)
            yield row


def storing() -> None:
    write = Store._write

    def marked(store: Store, tables: Sequence[tuple[str, Sequence[Row]]]) -> None:
        write(
            store, [(name, Lingering(rows) if name == "touches" else rows) for name, rows in tables]
        )

    put(Store, "_write", marked)


def hanging() -> None:
    """The main thread stands still in a move for good, whatever the other threads do."""

    def hangs(*_: object, **__: object) -> None:
        say("hanging")
        threading.Event().wait()

    put(OwnStage, "move_to", hangs)


def mistaken() -> None:
    """A mistake of the bench's own, amid a trial."""

    def divides(*_: object, **__: object) -> float:
        return 1.0 / 0.0

    put(RecordingCameras, "capture", divides)


def ending() -> None:
    """The bath is safe, and the record doesn't say yet how the run ended."""
    fact = Store.fact

    def marked(store: Store, key: str, value: Any) -> None:
        if key == "ending":
            say("ending")
            time.sleep(LINGER_S)
        fact(store, key, value)

    put(Store, "fact", marked)


class ClosingWindow:
    """Stands in for Windows: a second after the bench has begun to settle it calls the handler, and
    ends the process behind it.
    """

    def __init__(self) -> None:
        self._handlers: list[Handler] = []
        settle = TrialRun._settle

        def marked(trial_run: TrialRun) -> None:
            threading.Timer(1.0, self._close).start()
            settle(trial_run)

        put(TrialRun, "_settle", marked)

    def register(self, handler: Handler, add: bool) -> None:
        (self._handlers.append if add else self._handlers.remove)(handler)

    def _close(self) -> None:
        say("closing")
        self._handlers[-1](CTRL_CLOSE_EVENT)
        os._exit(CLOSED_CODE)


MARKS: dict[str, Callable[[], None]] = {
    "homing": lambda: begins(OwnStage, "home", "homing"),
    "settling": lambda: begins(TrialRun, "_settle", "settling"),
    "moving": lambda: begins(OwnStage, "move_to", "moving"),
    "capturing": lambda: begins(RecordingCameras, "capture", "capturing", LINGER_S),
    "capturing long": lambda: begins(RecordingCameras, "capture", "capturing long", LONG_S),
    "detecting": lambda: begins(Examiner, "ask", "detecting", LINGER_S),
    "storing": storing,
    "going to safe": lambda: begins(Devices, "make_safe", "going to safe", LINGER_S),
    "starting the guardian": lambda: begins(
        GuardianClient, "_await_ready", "starting the guardian", LINGER_S
    ),
    "bringing up": lambda: begins(start, "open_instruments", "bringing up", LINGER_S),
    "signing on": lambda: begins(MicroScribe, "sign_on", "signing on", LINGER_S),
    "heating": lambda: begins(BathMonitor, "heating", "heating", LINGER_S),
    "photographing": lambda: begins(CameraSet, "capture", "photographing", LINGER_S),
    "touching": lambda: begins(Toucher, "_touch_end", "touching", LINGER_S),
    "ending": ending,
    "hanging": hanging,
    "mistaken": mistaken,
}


def child(
    answers: Connection,
    said: Connection,
    step: str,
    rig: Path,
    script: Path,
    out: Path,
    run: Path | None,
) -> None:
    """The process: a bench at the two pipes. ``run``: one to be resumed."""
    take((answers, said, said))
    sys.stdout = sys.stderr  # line by line
    as_in_a_shell()
    MARKS.get(step, lambda: None)()
    register = ClosingWindow().register if step == "closing" else None
    loaded = load_rig(rig)
    with installed(register), TerminalProgress(Console()) as progress:
        if run:
            _, ending = resume_run(run, progress)
        else:
            loaded_script = load_script(script, loaded.rig.limits.set_point_c)
            ((_, ending),) = run_queue(loaded, [loaded_script], out, progress)
    print(f"ended: {ending.value}", flush=True)
    sys.exit(CODES[ending])


class MarkedBench:
    """A running bench that tells of its steps, with a person at its terminal; it resumes ``run``
    where that is given.
    """

    def __init__(self, rig: RealRig, step: str, run: Path | None = None) -> None:
        self._rig = rig
        forking = context()
        answers, self._answers = forking.Pipe(duplex=False)
        self._out, said = forking.Pipe(duplex=False)
        paths = (rig.rig_path, rig.script_path, rig.out)
        self.process = forking.Process(
            target=child, args=(answers, said, step, *paths, run), daemon=True
        )
        self.process.start()
        for end in (answers, said):
            end.close()
        self._read_to = 0
        self._pieces: list[bytes] = []
        self._reader = threading.Thread(target=self._listen, daemon=True)
        self._reader.start()

    @property
    def said(self) -> str:
        return b"".join(self._pieces).decode("utf-8", "replace")

    def enter(self) -> None:
        """Press Enter."""
        os.write(self._answers.fileno(), b"\n")

    def signal(self, name: str) -> None:
        os.kill(self.process.pid or 0, getattr(signal, name))

    def until(self, there: Callable[[], bool], what: str) -> None:
        within(there, what, said=lambda: self.said, code=lambda: self.process.exitcode)

    def wait_for(self, words: str) -> None:
        """Until the bench has said ``words`` behind what was waited for before."""
        self.until(lambda: words in self.said[self._read_to :], f"said {words!r}")
        self._read_to = self.said.index(words, self._read_to) + len(words)

    def attended(self, there: Callable[[], bool], words: str = "", nth: int = 1) -> float:
        """Be the person at the terminal and at the arm until the bench has said ``words`` for the
        ``nth`` time, or ``there``; gives back when Enter was last pressed.
        """
        left, read_to, entered_s = nth, self._read_to, time.monotonic()
        while left and not there():
            new = self.said[read_to:]
            found = {one: new.index(one) for one in (PROMPT, words) if one and one in new}
            if not found:
                self._until_longer(read_to + len(new), there)
                continue
            first = min(found, key=lambda one: found[one])
            if first == PROMPT:
                self._put_the_hand(new[: found[first]])
                self.enter()
                entered_s = time.monotonic()
            else:
                left -= 1
            read_to += found[first] + len(first)
        return entered_s

    def _until_longer(self, than: int, there: Callable[[], bool]) -> None:
        self.until(lambda: there() or len(self.said) > than, "came on")

    def _put_the_hand(self, asked: str) -> None:
        if match := re.search(CHECK, asked):
            self._rig.twin.operator.ask(CheckPoint(int(match[1]), int(match[2])))
        elif match := re.search(TOUCH, asked):
            self._rig.twin.operator.ask(Touch(int(match[1]), int(match[2])))

    def _listen(self) -> None:
        while piece := os.read(self._out.fileno(), 4096):  # prompts don't end with a line
            self._pieces.append(piece)

    def close(self) -> None:
        if self.process.is_alive():
            self.process.kill()
        self.process.join()
        self._reader.join(PATIENCE_S)
        for end in (self._answers, self._out):
            end.close()
        self.process.close()


@contextmanager
def marked_bench(rig: RealRig, step: str, run: Path | None = None) -> Iterator[MarkedBench]:
    """A bench on ``rig`` that tells of ``step``; killed at the end if it still runs."""
    running = MarkedBench(rig, step, run)
    try:
        yield running
    finally:
        running.close()

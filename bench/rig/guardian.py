"""The guardian: a small process of its own that puts the bath into standby, and stops the stage,
when the bench dies or hangs.

    python -m bench.rig.guardian --url tcp://host:502 --profile julabo-presto --record
    runs/…/guardian-1.json

The bench starts it and writes lines to its standard input: ``alive`` once a second, ``hung: …``
when its main thread makes no progress, ``done`` once it has made the bath safe itself, ``take
over`` when it could not. The input's end without one of the last two is the bench's death: it
comes at once, however the bench died, on every system. Each ``alive`` is echoed on its standard
output, so that the bench notices a guardian that is frozen. While the bench runs, it owns no link,
and the bath's lock (`hand_over`), by which the next session's guardian takes the bath from one that
acts. All that it needs is loaded before, and locked in memory where the system allows it, because a
dying machine may have no disk any more. A pump with a switch of its own runs on for a minute behind
the heater, and then stops; the ports are free meanwhile. It is no safety function: it dies with the
computer.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from bench.rig.guardian_stage import PLUGIN, StageStop, StageTarget, retried
from bench.rig.hand_over import BathLock, write_note
from bench.rig.watched_bench import WatchedBench
from instruments.bath.driver import OwnBath, PumpAt
from instruments.bath.interface import Bath
from instruments.bath.profile import PUMP, load_profile, load_relay
from instruments.bath.sequence import OFF, ON, OVERRUN_S
from instruments.clock import RealClock, stopwatch_s, wall_time
from instruments.device_file import DeviceFileError
from instruments.errors import InstrumentError

READY, ALIVE, HUNG, DONE, TAKE_OVER = "ready", "alive", "hung: ", "done", "take over"
ACTS = "acts"  # to the bench, which may live after all
HANG_S = 10.0  # without a line from the bench
STOPPED_S = 2.0  # without one from a bench that the system has stopped (SIGSTOP, Ctrl-Z)
LOOK_S = 0.25  # between looks at whether the bench is being ended
WANTED_S = 0.1  # between looks at whether another guardian waits for the bath
GIVE_UP_S = 300.0  # then an operator has long been there, or never comes
NICE = (-20, -10, -5)  # the first that the system grants
MCL_CURRENT, MCL_ONFAULT = 1, 4  # mman.h of Linux
# they are meant for the bench; the end of the input always ends us
IGNORED = ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")


class GuardianRecord:
    """What the guardian writes down, at ``path``: one state at a time, from any thread."""

    def __init__(self, path: Path, facts: dict[str, Any]) -> None:
        self._path = path
        self._facts = facts
        self._lock = threading.Lock()

    def add(self, **facts: Any) -> None:
        with self._lock:
            self._facts |= facts
            write_note(self._path, self._facts)

    def hand_over(self) -> None:
        """Write that the bath is handed over, and end this process, whatever its threads do."""
        with self._lock:
            write_note(self._path, self._facts | {"handed_over": _text(wall_time())})
            os._exit(0)


class HeartbeatReader:
    """Reads the bench's lines from ``source`` on a thread (not every system can wait for a pipe
    with a time limit), and echoes heartbeats to ``echo``. ``bench``: its process.
    """

    def __init__(self, source: int, echo: int, bench: WatchedBench) -> None:
        self._echo = echo
        self._bench = bench
        self._lines: queue.SimpleQueue[str] = queue.SimpleQueue()
        threading.Thread(target=self._listen, args=(source,), daemon=True).start()

    def wait_for_loss(self) -> tuple[str, str, float] | None:
        """``died``, ``hung`` or ``gave up``, why, and when it last beat; None when done."""
        last_s, dying = stopwatch_s(), False
        while True:
            try:
                line = self._lines.get(timeout=LOOK_S / 5 if dying else LOOK_S)
            except queue.Empty:
                if dying:
                    return "died", "the system is ending it", stopwatch_s()
                state = self._bench.state()
                if dying := state == "dying":  # its last line may be in the pipe
                    continue
                if why := _hang(stopwatch_s() - last_s, stopped=state == "stopped"):
                    return "hung", why, last_s
                continue
            if line == DONE:
                return None
            if line.startswith(HUNG):
                return "hung", line.removeprefix(HUNG), last_s
            if line == TAKE_OVER:
                return "gave up", "the bench could not make the bath safe itself", stopwatch_s()
            if not line:
                return "died", "its end of the pipe closed without a word", stopwatch_s()
            last_s = stopwatch_s()
            _tell_bench(self._echo, line)

    def _listen(self, source: int) -> None:
        rest = b""
        with contextlib.suppress(OSError):
            while data := os.read(source, 4096):
                *lines, rest = (rest + data).split(b"\n")
                for line in lines:
                    self._lines.put(line.decode("utf-8", "replace"))
        self._lines.put("")


def main(arguments: Sequence[str] | None = None) -> int:
    """Guard a bath, a stage or both; 0: safe, or nothing was needed; 1: one was not reached."""
    about = "Puts a bath into standby when the bench that started it dies."
    parser = argparse.ArgumentParser(prog="bench.rig.guardian", description=about)
    add = parser.add_argument
    add("--url", default="", help="the bath; none: only a stage is guarded")
    add("--profile", default="")
    add("--pump-url", default="", help="the relay of a pump that the controller doesn't turn")
    add("--pump-profile", default="")
    add("--allow-inferred", action="store_true")
    add("--stage", type=json.loads, help="a stage, as its target in JSON")
    add("--overrun-s", type=float, default=OVERRUN_S, help="how long the pump runs on")
    add("--record", required=True, type=Path)
    add("--bench", required=True, type=int, help="the bench's process id")
    given = parser.parse_args(arguments)
    for name in IGNORED:
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    source, echo = sys.stdin.fileno(), sys.stdout.fileno()
    if PLUGIN in f"{given.url} {given.stage}":
        source, echo = _apart(source, echo)
    clock, watched = RealClock(), WatchedBench(given.bench)
    try:
        bath = _bath_of(given, clock) if given.url else None
        at = StageTarget(**given.stage) if given.stage else None
        stop = StageStop(at, clock) if at else None
        lock = BathLock(given.url or (at.url if at else ""), given.record, given.bench)
        taken = lock.take()
    except (DeviceFileError, InstrumentError, OSError) as error:
        sys.stderr.write(f"guardian: {error}\n")
        return 2
    preferred = _raise_priority()
    _tell_bench(echo, f"{READY} {taken}")
    lost = HeartbeatReader(source, echo, watched).wait_for_loss()
    if lost is None:
        lock.release()
        return 0
    cause, why, last_sign_s = lost
    _tell_bench(echo, ACTS)
    noticed, silent = wall_time(), timedelta(seconds=stopwatch_s() - last_sign_s)
    facts: dict[str, Any] = {"cause": cause, "why": why, "bath": given.url}
    facts |= {"guardian": os.getpid(), **preferred}
    facts |= {"wall_last_sign": _text(noticed - silent), "wall_noticed": _text(noticed)}
    # of a stage alone there is no standby
    facts |= {"standby": False, "tries": 0, "error": "not tried yet"} if bath else {}
    record = GuardianRecord(given.record, facts)
    lock.acts()
    # one that hangs and holds the port; its record is whole at every moment
    end_bench = (lambda: record.add(killed=watched.end())) if cause == "hung" else None
    with _handed_over(lock, record):
        # a bench that could not reach its bath has seen to its stage itself
        if stop and (cause != "gave up" or bath is None):
            stop.begin(end_bench)
        reached = bath is None or _make_safe(bath, clock, record, end_bench)
        stage = stop.result() if stop else None
        if stage:
            record.add(stage=stage)
        if bath:
            if reached and bath.pump == "own":
                _run_pump_on(bath, clock, record, given.overrun_s)
            bath.close()
    lock.release()
    return 0 if reached and (stage is None or stage["stands"]) else 1


def _apart(source: int, echo: int) -> tuple[int, int]:
    """Both, apart from what a driver may print, read or close: the log, and an empty input."""
    pipes = os.dup(source), os.dup(echo)
    os.dup2(os.open(os.devnull, os.O_RDONLY), source)
    os.dup2(sys.stderr.fileno(), echo)
    return pipes


def _tell_bench(echo: int, line: str) -> None:
    """To a bench that may have died: the end of the input says so."""
    with contextlib.suppress(OSError):
        os.write(echo, line.encode() + b"\n")


@contextlib.contextmanager
def _handed_over(lock: BathLock, record: GuardianRecord) -> Iterator[None]:
    """What is done within ends, and this process, once another guardian waits for the bath."""
    over = threading.Event()

    def look() -> None:
        while not over.wait(WANTED_S):
            if lock.wanted:
                lock.hand_over()
                record.hand_over()

    looks = threading.Thread(target=look, daemon=True)
    looks.start()
    try:
        yield
    finally:
        over.set()
        looks.join()


def _bath_of(given: argparse.Namespace, clock: RealClock) -> Bath:
    if given.url.startswith(PLUGIN):  # loads numpy: not for a bath that has a profile
        from instruments.drivers.bath import PluggedBath
        from instruments.drivers.entry_points import load, plugin_url

        if plug := plugin_url(given.url):
            return PluggedBath(load("bath", plug), clock, identify=False)
    pump = PumpAt(given.pump_url, load_relay(given.pump_profile)) if given.pump_url else None
    return OwnBath(
        given.url,
        load_profile(given.profile),
        clock,
        allow_inferred=given.allow_inferred,
        identify=False,
        pump=pump,
    )


def _hang(silent_s: float, *, stopped: bool) -> str:
    """Why a bench that is silent for so long hangs; "" where a busy machine may be why."""
    if stopped and silent_s >= STOPPED_S:
        return "its process is stopped"
    return f"no sign of life for {HANG_S:g} s" if silent_s >= HANG_S else ""


def _raise_priority() -> dict[str, Any]:
    """Raise the priority, and lock what is loaded in memory, as far as the system grants it."""
    got: dict[str, Any] = {"nice": None, "memory_locked": False}
    if sys.platform == "win32":
        return got  # the bench starts the process at high priority
    for nice in NICE:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, nice)
            break
    got["nice"] = os.getpriority(os.PRIO_PROCESS, 0)
    if sys.platform == "linux":
        got["memory_locked"] = ctypes.CDLL(None).mlockall(MCL_CURRENT | MCL_ONFAULT) == 0
    return got


def _make_safe(
    bath: Bath, clock: RealClock, record: GuardianRecord, end_bench: Callable[[], None] | None
) -> bool:
    """Standby, tried for GIVE_UP_S. ``end_bench`` as in `retried`."""

    def stand_by() -> None:
        bath.safe()
        bath.release_watchdog(0.0)  # as shipped: no program asks it from now on

    def note(said: dict[str, Any]) -> None:
        safe = {} if "error" in said else {"wall_safe": _text(wall_time()), "error": ""}
        record.add(standby=bool(safe), **said, **safe)

    return retried(stand_by, clock, GIVE_UP_S, note, end_bench)


def _run_pump_on(bath: Bath, clock: RealClock, record: GuardianRecord, overrun_s: float) -> None:
    """Let the pump carry off the heater's heat, then stop it, unless the bath is started again."""
    try:
        bath.set(PUMP, ON)
        record.add(pump=f"runs on for {overrun_s:g} s")
        bath.close()  # the ports are free for a person who comes to look
        clock.sleep(overrun_s)
        bath.set(PUMP, OFF)
        record.add(pump=f"ran on for {overrun_s:g} s and is off")
    except InstrumentError as error:
        record.add(pump=f"was left as it was: {error}")


def _text(when: datetime) -> str:
    return when.isoformat(timespec="milliseconds")


if __name__ == "__main__":
    sys.exit(main())

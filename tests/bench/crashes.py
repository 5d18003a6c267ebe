"""A bench that is killed in real time and its run resumed: the cells of the matrix.

The rig is that of `emulate --write-rig`: emulators in this process, which go on when a bench of
another process dies, cameras as streams. Its arm, hands and stage make no errors and a scene looks
the same whenever it is seen, so that trials can be compared to the last bit.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import psutil

from bench.record.check import check_record
from bench.record.reader import read_run
from bench.results.headline import guardian_text
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.loading import load_rig
from bench.rig.urls import ELSEWHERE
from instruments.camera.frame import FrameSet
from instruments.camera.stream import StreamServer
from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.operators.remote import OperatorPort
from tests.bench import operated_runs
from tests.bench.killed_runs import rows_of
from tests.bench.marked_bench import MARK, marked_bench
from tests.bench.real_rig import CHECK, RELAY, RIG, STAGE, RealRig
from tests.bench.safety.guards import guardians_of
from tests.bench.small_cameras import write_calibration
from tests.waiting import PATIENCE_S, alive, within

SCRIPT = operated_runs.SCRIPT.replace(", yaw_deg = 4.0 }, {}]", " }]")
STREAMS = """
[cameras]
settle_s = 0.6
max_skew_s = 5.0

[cameras.left]
url = "opencv:{left}"

[cameras.right]
url = "opencv:{right}"

[cameras.thermal]
url = "opencv:{thermal}"

[cameras.checks]
frozen = false
"""
HERE = """
[cameras]
url = "emulator:"
"""

EMULATION = """
[emulation]
bath_start_c = 33.0
arm_accuracy_mm = 0.0
hand_tremor_mm = 0.0
hand_error_mm = 0.0

[emulation.stage.settings]
24 = 1500.0
25 = 6000.0
110 = 6000.0
111 = 6000.0
112 = 6000.0
120 = 1000.0
121 = 1000.0
122 = 1000.0
"""


class SteadyCameras:
    """The cameras of ``twin``. A place of the phantom is drawn once for all rigs of a process."""

    _drawn: ClassVar[dict[bytes, FrameSet]] = {}
    _lock = threading.Lock()

    def __init__(self, twin: EmulatedRig, clock: RealClock) -> None:
        self._twin, self._clock = twin, clock
        self._last: FrameSet | None = None

    def capture(self) -> FrameSet:
        twin = self._twin
        with twin.world.lock:
            ends = np.round(twin.world.ends_mm(), 3).tobytes()
            stands = twin.stage is None or not twin.stage.velocity().any()
        with self._lock:
            if stands or self._last is None:
                if ends not in self._drawn:
                    self._drawn[ends] = twin.cameras.capture()
                self._last = self._drawn[ends]
        now_s = self._clock.now()
        return replace(self._last, exposed_s=dict.fromkeys(self._last.exposed_s, now_s))


@contextmanager
def lasting_rig(
    folder: Path, *, profile: str = "julabo-presto", pump: bool = False, pty: bool = False
) -> Iterator[RealRig]:
    """Emulators in real time and the files of a rig whose bench may die. ``pump``: a relay of its
    own turns the bath's; ``pty``: whatever has a serial port is on a pseudo-terminal.
    """
    folder.mkdir(parents=True, exist_ok=True)
    write_calibration(folder)

    def rig_of(name: str, urls: Mapping[str, str], cameras: str, limits: str) -> Path:
        parts = {
            "operator": urls["operator"],
            "cameras_part": cameras,
            "stage_part": STAGE.format(stage=urls["stage"], feed=5000.0),
            "pump_part": RELAY.format(urls["pump"]) if pump else "",
            "check_part": CHECK.format(2),
        }
        parts |= {"profile": profile, "silence_s": "30.0", "limits": limits}
        text = RIG.format(arm=urls["arm"], bath=urls["bath"], **parts)
        (folder / name).write_text(text, encoding="utf-8")
        return folder / name

    names = ("operator", "arm", "bath", "pump", "stage")
    emulated = rig_of("twin.toml", dict.fromkeys(names, "emulator:"), HERE, EMULATION)
    with (
        closing(RealClock()) as clock,
        EmulatedRig(load_rig(emulated), clock, 3, pty=pty) as twin,
        closing(StreamServer(SteadyCameras(twin, clock), clock)) as streams,
        closing(
            Listener(OperatorPort(twin.operator), clock, lock=threading.RLock(), name="operator")
        ) as hands,
    ):
        urls = twin.urls | {"operator": hands.url.replace("socket://", ELSEWHERE)}
        rig, script = (
            rig_of("lab.toml", urls, STREAMS.format(**streams.urls), ""),
            folder / "short.toml",
        )
        script.write_text(SCRIPT, encoding="utf-8")
        yield RealRig(twin, folder, rig, script)


# ---- a cell: where the bench is killed, whether its bath can be reached, what its guardian does

# the mark of each, and which time it is said: the second is of the second trial, where there is one
STATES = {
    "starting the guardian": ("starting the guardian", 1),
    "bring-up": ("bringing up", 1),
    "signing on": ("signing on", 1),
    "homing": ("homing", 1),
    "heating": ("heating", 1),
    "settling": ("settling", 1),
    "moving": ("moving", 2),
    "capture": ("photographing", 2),
    "touch": ("touching", 6),
    "detect": ("detecting", 2),
    "storing": ("storing", 2),
    "going to safe": ("going to safe", 1),
    "at the end": ("ending", 1),
}
REACHED, SILENT = "reached", "silent"
# what becomes of the guardian until the run is resumed, by whether the bath answers at the death;
# with a pump of its own there is also PUMP_ON: it has acted, and waits to stop the pump
PUMP_ON = "running the pump on"
GUARDIANS = {
    REACHED: ("acted", "at once", "gone", "frozen"),
    SILENT: ("acted later", "trying", "gone", "frozen"),
}
CELLS = [(state, bath, how) for bath in GUARDIANS for how in GUARDIANS[bath] for state in STATES]


@dataclass(frozen=True)
class Outcome:
    """What became of one cell: the run's folder, its sessions, how long the resumed bench took."""

    run: Path
    sessions: int
    seconds: float
    trials: dict[str, list[Any]]
    said: str
    latched: bool


def undisturbed(folder: Path) -> dict[str, list[Any]]:
    with lasting_rig(folder) as rig, marked_bench(rig, "none") as running:
        running.process.join(PATIENCE_S)
        assert running.process.exitcode == 0, running.said
        return trials_of(rig.run_folder())


def crash(folder: Path, state: str, bath: str, how: str, **more: Any) -> Outcome:
    """Kill a bench in ``state`` and resume its run to the end."""
    with lasting_rig(folder, **more) as rig, ended_at_last() as left:
        guardian = killed_in(rig, state, silent=bath == SILENT, with_guardian=how)
        left.append(guardian)
        run = rig.run_folder()
        wait_for_the_guardian(rig, guardian, how)
        if how == "trying":
            resumed(rig, run, 3)
        if bath == SILENT:
            silence(rig, on=False)
        start_s = time.monotonic()
        said = resumed(rig, run, 0)
        seconds = time.monotonic() - start_s
        with suppress(psutil.NoSuchProcess):  # one that was frozen before it had the bath
            psutil.Process(guardian).resume()
        within(lambda: not alive(guardian), "the old guardian has ended")
        assert not rig.twin.world.plant.running
        assert check_record(run).whole
        record = read_run(run)
        assert record.ending == "finished"
        assert record.guardian is None, "the last session needed none"
        for one in record.guardians.values():
            assert guardian_text(one)
        latched = rig.rig_path.with_name("lab.tripped.json").exists()
        return Outcome(run, record.sessions, seconds, trials_of(run), said, latched)


@contextmanager
def ended_at_last() -> Iterator[list[int]]:
    """Processes that are not left behind by a test that fails."""
    left: list[int] = []
    try:
        yield left
    finally:
        for pid in filter(alive, left):
            psutil.Process(pid).kill()


def killed_in(rig: RealRig, state: str, *, silent: bool, with_guardian: str) -> int:
    """The pid of the guardian that the bench left."""
    step, nth = STATES[state]
    with marked_bench(rig, step) as running:
        for _ in range(nth):
            running.wait_for(f"{MARK}{step}")
        (guardian,) = guardians_of(running.process.pid)
        if silent:
            silence(rig)
        if with_guardian == "gone":
            guardian.kill()
        elif with_guardian == "frozen":
            guardian.suspend()
        running.signal("SIGKILL")
        running.process.join(PATIENCE_S)
        assert running.process.exitcode == -signal.SIGKILL
    return int(guardian.pid)


def wait_for_the_guardian(rig: RealRig, guardian: int, how: str) -> None:
    if how == PUMP_ON:
        within(lambda: "pump" in acted(rig), "the pump runs on")
        assert rig.twin.world.plant.pump == "on"
    if how == "acted later":
        within(lambda: tries(rig) > 0, "a try that failed")
        silence(rig, on=False)
    if how in ("acted", "acted later"):
        within(lambda: not alive(guardian), "the guardian has acted and gone")
        assert acted(rig)["standby"] is True
    elif how == "trying":
        within(lambda: tries(rig) > 0, "a try that failed")
    elif how == "gone":
        within(lambda: not alive(guardian), "the guardian has died")


def acted(rig: RealRig) -> Mapping[str, Any]:
    """What the first session's guardian has written."""
    return read_run(rig.run_folder()).guardians.get(1, {})


def tries(rig: RealRig) -> int:
    return int(acted(rig).get("tries", 0))


def silence(rig: RealRig, *, on: bool = True) -> None:
    with rig.twin.world.lock:
        rig.twin.bath.fault("silence", on=on)


def resumed(rig: RealRig, run: Path, code: int) -> str:
    """What the bench said that resumed ``run``, and ended with ``code``."""
    with marked_bench(rig, "none", run) as running:
        running.process.join(PATIENCE_S)
        assert running.process.exitcode == code, running.said
    return running.said


# ---- what two runs in real time have in common

VARIES = ("session", "cold", "bath_c")
TABLES = (
    *("trials", "skipped", "frames", "touches", "truth", "detections", "found", "invalidated"),
    "scores",
)


def trials_of(run: Path) -> dict[str, list[tuple[Any, ...]]]:
    """All rows of all trials without times, and what depends on them."""
    return rows_of(run, TABLES, lambda name: name.endswith("_s") or name in VARIES)

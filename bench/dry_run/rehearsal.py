"""Goes through a script on the emulated twin of a rig, in a temporary run folder, by the engine of
runs: every trial is set up, moved to, settled, touched and stored. Then the events are read back.

The twin has the rig's tables with emulators at every address, in a world as like the lab as is
known: the stage's own settings, the table frame, the registration, the room's temperature, the
bath's family. A rig that is emulated already is its own twin. It stops where the run would stop.
Not gone through are most frames, and all detections but one a detector.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass, replace
from math import atan2
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from bench.dry_run.pose_checks import USUAL_ARM, PoseFault, registered_at, way_to
from bench.files import Picture
from bench.record.reader import read_run
from bench.record.schema import SCRIPT as SCRIPT_FILE
from bench.record.schema import Row
from bench.record.writer import Store
from bench.results.answers import Examiner
from bench.rig.emulated_rig import EmulatedRig, has_emulator
from bench.rig.frame_capture import FrameTaker
from bench.rig.loading import LoadedRig
from bench.rig.model import (
    CamerasTable,
    Checks,
    EmulatedStage,
    Emulation,
    FocusTable,
    Placement,
    StageTable,
    usual_stage,
)
from bench.rig.opening import open_instruments
from bench.rig.scripted_answers import load_answers
from bench.rig.urls import EMULATED, PEOPLE, SCRIPT
from bench.run.context import RunContext
from bench.run.engine import Engine
from bench.run.events import Events, read_events
from bench.scoring.errors import Floats
from bench.script.model import LoadedScript
from bench.script.planned_trials import PlannedTrial, shared
from detector.geometry import Motion
from detector.protocol import Detector, Outcome
from instruments.bath.profile import load_profile
from instruments.camera.frame import FrameSet
from instruments.clock import VirtualClock
from instruments.drivers.entry_points import plugin_url
from instruments.drivers.protocols import Cameras as OpenCameras
from instruments.errors import DeviceError
from instruments.microscribe.unit import shipped_unit
from instruments.operators.emulated import NEARER
from instruments.operators.operator import (
    Answer,
    OperatorAbort,
    OperatorSkip,
    Request,
    no_check,
)
from instruments.stage.protocol import AXES
from instruments.stage.settings import StageSettings

MOST_SETS = 12  # rendered; a second or so each on a busy machine
DARK, LIGHT = 60, 180  # of a picture that passes for one
STAND_IN_BATH = "julabo-ascii"  # for a lab's own lines, which no emulator speaks
ROOM_MM = 10.0  # beyond the furthest place, where a stage's travel is unknown
# for pictures that are all alike: nothing is compared, and no edge is measured
LENIENT = Checks(
    frozen=False, swapped=False, focus_px=FocusTable(), flat_dn=0, saturated_share=1.0, black_dn=0
)

BEFORE, AFTER = "before the trials", "after the trials"
INTERRUPTED = "the run was interrupted"
OPERATOR_SKIPPED = "the operator skipped it"
# kinds of events that no run should have, and what the finding is
FINDINGS = {
    "trip": "interlock",
    "fault": "fault",
    "invalid": "truth",
    "reach": "reach",
    "frames": "frames",
    "detector": "detector",
}
GOT_OVER = {
    "dropped out": "an instrument dropped out and came back",
    "suspended": "the bath left its band, and settled again",
    "repeated": "a trial was repeated",
    "registration": "the stage's registration is in doubt",
}


class NoTwinError(Exception):
    """There can be no emulated twin of this rig; the text says why."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """``trials`` done, findings, what the run recovered from, frame sets rendered."""

    trials: int
    findings: tuple[PoseFault, ...]
    recovered: Mapping[str, int]
    rendered: int


class PicturelessStore(Store):
    """A record that keeps no pictures, for stand-ins show no ends, and need not outlive a crash."""

    keeps_pictures = False
    pragmas = ("journal_mode = MEMORY", "synchronous = OFF")

    def frames(
        self,
        trial: str,  # noqa: ARG002
        images: Mapping[str, Picture],  # noqa: ARG002
        exposed_s: Mapping[str, float],  # noqa: ARG002
    ) -> list[Row]:
        return []


class RehearsalProgress:
    """The progress of a rehearsal; ``shown`` gets how many trials have begun, of how many."""

    def __init__(self, planned: Sequence[PlannedTrial], shown: Callable[[int, int], None]) -> None:
        self._ids = {one.number: one.id for one in planned}
        self._begun = 0
        self._shown = shown
        self.trial_id = ""

    def state(self, text: str) -> None: ...

    def trial(self, done: int, total: int, name: str) -> None:  # noqa: ARG002
        self.trial_id = self._ids[done + 1] if name else ""
        self._shown(self._begun, len(self._ids))
        self._begun += 1

    def warn(self, text: str) -> None:
        """An event has the same text."""

    def aside(self) -> AbstractContextManager[None]:
        return nullcontext()


def rehearse(
    rig: LoadedRig,
    script: LoadedScript,
    detectors: Sequence[Detector],
    *,
    stage: StageSettings | None = None,
    seed: int | None = None,
    shown: Callable[[int, int], None] = lambda _done, _of: None,
) -> Rehearsal:
    """Run ``script`` on the twin of ``rig``. Raises NoTwinError, KeyboardInterrupt."""
    clock, twin_rig, url = VirtualClock(), twin_of(rig, script, stage), rig.rig.operator.url
    course = RehearsalProgress(script.planned, shown)
    events = Events(course)
    with TemporaryDirectory(prefix="teatbench-dry-run-") as folder:
        run = Path(folder) / "run"
        files = {"rig.toml": rig.text, SCRIPT_FILE: script.text}
        used_seed = rig.rig.seed if seed is None else seed
        with (
            closing(PicturelessStore.create(run, files)) as store,
            events.kept_in(run),
            _emulated(twin_rig, clock, used_seed, by_hand=not rig.rig.simulated) as twin,
        ):
            store.fact("detectors", [])
            cameras = StandInCameras(twin, twin_rig, events, script.planned, detectors, course)
            hands = ReachOperator(
                twin, twin_rig.rig.emulation.arm_placed, events, leans=url in PEOPLE
            )
            table = twin_rig.rig.cameras.model_copy(update={"checks": LENIENT})
            tested = replace(twin_rig, rig=twin_rig.rig.model_copy(update={"cameras": table}))
            names = ("arm", "bath", "stage")
            with open_instruments(tested, names, clock, twin=twin, supervised=True) as opened:
                devices = replace(opened, cameras=cameras, operator=hands)
                if url.startswith(SCRIPT):
                    answers = load_answers(rig.path.parent / url.removeprefix(SCRIPT))
                    answers.hands = hands
                    devices = replace(devices, operator=answers)
                ctx = RunContext(tested, script, devices, store, events)
                ctx.live.ended, events.status = True, lambda: None  # no person watches it
                Engine(ctx, (), exact_ends=twin.world.ends_mm).run()
        lines = list(read_events(run))
        if any(e.get("kind") == "aborted" and e["text"].startswith(INTERRUPTED) for e in lines):
            raise KeyboardInterrupt
        return Rehearsal(len(read_run(run).trials), *_findings(lines), cameras.rendered)


def _findings(
    lines: Sequence[Mapping[str, Any]],
) -> tuple[tuple[PoseFault, ...], Mapping[str, int]]:
    """What would end the run or cost a trial's truth; and what the run recovers from, counted."""
    where = BEFORE
    found: dict[PoseFault, None] = {}
    recovered: Counter[str] = Counter()

    def known(kind: str) -> bool:
        return any((one.trial, one.kind) == (where, kind) for one in found)

    for line in lines:
        kind, text = line.get("kind", ""), line.get("text", "")
        if line["what"] == "trial":
            where = line["name"] or AFTER
        elif line["what"] != "event":
            continue
        elif kind in FINDINGS:
            if kind != "fault" or not known("interlock"):  # by which the run ends too
                found[PoseFault(where, FINDINGS[kind], text)] = None
        elif kind in GOT_OVER:
            recovered[GOT_OVER[kind]] += 1
        # an arm that doesn't reach skips a trial and ends a run, and was found already
        elif kind == "skipped" and OPERATOR_SKIPPED in text and not known("reach"):
            recovered["the operator's script skips a trial"] += 1
        elif kind in ("skipped", "aborted") and not known("reach"):
            found[PoseFault(where, "truth" if kind == "skipped" else kind, text)] = None
    return tuple(found), recovered


@contextmanager
def _emulated(
    rig: LoadedRig, clock: VirtualClock, seed: int, *, by_hand: bool
) -> Iterator[EmulatedRig]:
    """``by_hand``: a pump that no instrument turns on is turned on by a person, as in a lab."""
    if by_hand:
        still = rig.rig.emulation.model_copy(update={"prompt_s": 0.0})
        rig = replace(rig, rig=rig.rig.model_copy(update={"emulation": still}))
    try:
        twin = EmulatedRig(rig, clock, seed)
    # a calibration that nothing can be rendered with, a table that an emulator can't be made of
    except ValueError as error:
        raise NoTwinError(str(error)) from error
    if by_hand and rig.profile.capabilities.pump == "none" and rig.relay is None:
        twin.world.plant.pump = "on"
    with twin:
        yield twin


def twin_of(rig: LoadedRig, script: LoadedScript, stage: StageSettings | None) -> LoadedRig:
    """``rig`` with an emulator at each address; ``stage`` is what its controller reports."""
    r = rig.rig
    checks = r.cameras.checks
    if "cameras" not in r.emulated:  # emulated cameras can't show how sharp the real ones are
        checks = checks.model_copy(update={"focus_px": FocusTable()})
    kept = r.cameras.model_dump(include={"settle_s", "max_skew_s", "retries", "retry_s"})
    tables: dict[str, object] = {
        "cameras": CamerasTable(url=EMULATED).model_copy(update={**kept, "checks": checks}),
        "operator": r.operator.model_copy(update={"url": EMULATED}),
    }
    if r.simulated:
        return replace(rig, rig=r.model_copy(update=tables))
    pump_url = EMULATED if r.bath.pump_url else ""
    tables |= {
        "arm": r.arm.model_copy(update={"url": EMULATED}),
        "bath": r.bath.model_copy(update={"url": EMULATED, "pump_url": pump_url}),
        "stage": r.stage.model_copy(update={"url": EMULATED}) if r.stage else None,
        "emulation": _world(rig, script, stage),
    }
    unit = rig.arm_unit or shipped_unit(USUAL_ARM)
    if made_with := rig.frame or script.registration:
        names = replace(unit.names, serial_number=made_with.serial_number)
        unit = replace(unit, names=names)
    profile = rig.profile if has_emulator(rig.profile) else load_profile(STAND_IN_BATH)
    return replace(rig, rig=r.model_copy(update=tables), arm_unit=unit, profile=profile)


def _world(rig: LoadedRig, script: LoadedScript, stage: StageSettings | None) -> Emulation:
    """The lab as far as it is known, without planned faults."""
    room_c = max(0.0, rig.rig.bath.room_c)
    update: dict[str, object] = {
        "ambient_c": room_c,
        "bath_start_c": room_c,
        "hand_error_mm": 0.0,
        "faults": (),
        "mistakes": (),
    }
    if rig.frame is not None:
        motion = rig.frame.world_from_arm
        place = {"om": tuple(motion.om.tolist()), "T": tuple(motion.T.tolist())}
        update["arm_placed"] = Placement().model_copy(update=place)
    if rig.rig.stage is not None:
        settings, high_mm = _stage_settings(rig, script, rig.rig.stage, stage)
        firmware = "grblHAL" if "A" in rig.rig.stage.axes else "grbl"
        turned = script.registration.world_from_stage.R if script.registration else np.eye(3)
        table = {
            "dialect": "FluidNC" if _configured(rig.rig.stage, stage) else firmware,
            "settings": settings,
            "high_mm": high_mm,
            "yaw_rad": atan2(turned[1, 0], turned[0, 0]),
        }
        update["stage"] = EmulatedStage().model_copy(update=table)
    return rig.rig.emulation.model_copy(update=update)


def _configured(stage: StageTable, known: StageSettings | None) -> bool:
    """Whether its high ends are not at 0, which of the emulated firmwares FluidNC has too. Where a
    plug-in's are is not known before it was asked; its places may be above 0.
    """
    if known is None:
        return plugin_url(stage.url) is not None
    return stage.dialect == "grbl" and bool(known.low_mm) and any(_highs(known))


def _highs(known: StageSettings) -> list[float]:
    return [limits.high_mm for limits in known.limits.values()]


def _stage_settings(
    rig: LoadedRig, script: LoadedScript, table: StageTable, known: StageSettings | None
) -> tuple[dict[int, float], tuple[float, ...] | None]:
    """Settings by Grbl's numbers, and the machine coordinates of the high ends where they are not
    0: those ``known``, or a travel that no place of the script exceeds.
    """
    from_low_end, configured = table.dialect != "grbl", _configured(table, known)
    if known is not None:
        pull_off_mm = known.pull_off_mm or 1.0
        way = [travel + pull_off_mm * from_low_end for travel in known.travel_mm]
        each = (known.steps_per_mm, known.rate_mm_min, known.accel_mm_s2, way)
        numbered = {
            first + axis: value
            for first, values in zip((100, 110, 120, 130), each, strict=True)
            for axis, value in enumerate(values)
            if known.travel_mm[axis] > 0
        }
        homing = {24: known.homing_feed_mm_min, 25: known.homing_seek_mm_min, 27: pull_off_mm}
        high_mm = (*_highs(known), 0.0)[:4] if from_low_end or configured else None
        return numbered | homing, high_mm
    poses = [pose for one in script.planned for pose in (one.approach, one.pose) if pose]
    sent = [shared(pose, table.axes)[0] for pose in (*poses, *registered_at(rig, script))]
    places = np.array([list(table.machine(pose).values()) for pose in sent])
    at = [AXES.index(axis) for axis in table.axes]
    high = [0.0] * 4
    if from_low_end or configured:
        for axis, place in zip(at, places.max(axis=0).tolist(), strict=True):
            high[axis] = place + ROOM_MM
    usual = usual_stage()
    ways = {
        130 + axis: max(usual[130 + axis], high[axis] + ROOM_MM - low)
        for axis, low in zip(at, places.min(axis=0).tolist(), strict=True)
    }
    return ways, tuple(high) if from_low_end or configured else None


def to_render(planned: Sequence[PlannedTrial], most: int = MOST_SETS) -> frozenset[str]:
    """Ids of trials to render: the first of each table, then evenly spaced poses."""
    tables = list({one.trial.name: one.id for one in reversed(planned)}.values())[::-1][:most]
    poses = list({one.name: one.id for one in reversed(planned)}.values())[::-1]
    left = [one for one in poses if one not in tables]
    room = min(most - len(tables), len(left))
    return frozenset([*tables, *(left[int((at + 0.5) * len(left) / room)] for at in range(room))])


class StandInCameras:
    """Render and check frames at some trials, for each detector once; give ramps at others."""

    def __init__(
        self,
        twin: EmulatedRig,
        rig: LoadedRig,
        events: Events,
        planned: Sequence[PlannedTrial],
        detectors: Sequence[Detector],
        course: RehearsalProgress,
    ) -> None:
        c = rig.calibration
        self._cameras: OpenCameras = twin.cameras
        self._taker = FrameTaker(
            twin.cameras, rig.rig.cameras, c, twin.world.clock.sleep, lambda _kind, _text: None
        )
        left, right, thermal = (
            np.tile(np.linspace(DARK, LIGHT, width).astype(np.uint8), (height, 1))
            for width, height in (one.image_size for one in (c.left, c.right, c.thermal))
        )
        self._stand_in = FrameSet(left, right, thermal)
        self._events, self._course = events, course
        self._due = set(to_render(planned))
        self._detectors = detectors
        self._examiner = Examiner(c, rig.rig.limits.detection_timeout_s)
        self.rendered = 0

    @property
    def identity(self) -> Mapping[str, str]:
        return self._cameras.identity

    def capture(self) -> FrameSet:
        """At a trial that is due, its frames are rendered and checked first."""
        if self._course.trial_id in self._due:
            self._due.remove(self._course.trial_id)
            self._look()
        return self._stand_in

    def close(self) -> None:
        self._cameras.close()

    def _look(self) -> None:
        try:
            frames = self._taker.take()
        except DeviceError as fault:
            self._events.event("frames", str(fault))
            return
        self.rendered += 1
        for detector in self._detectors if self.rendered == 1 else ():
            answer = self._examiner.ask(detector, frames)
            if answer.outcome is not Outcome.ANSWERED:
                self._events.event("detector", f"{detector.name}: {answer.detection.reason}")


class ReachOperator:
    """The operator of ``twin``, whose reports of what the arm doesn't reach are findings. A person
    ``leans`` the stylus where that helps.
    """

    def __init__(
        self, twin: EmulatedRig, placed: Placement, events: Events, *, leans: bool
    ) -> None:
        self._twin, self._events = twin, events
        self._arm_from_world = Motion.from_vectors(placed.om, placed.T).inverse()
        # by place to within a millimetre, how the stylus is held: no pose is solved twice
        self._ways: dict[bytes, Floats | None] = {}
        if leans:
            twin.operator.way = self._leaning

    def ask(self, request: Request, check: Callable[[], None] = no_check) -> Answer:
        """Raises OperatorAbort for a check point out of reach, OperatorSkip for a teat's end."""
        try:
            return self._twin.operator.ask(request, check)
        except (OperatorAbort, OperatorSkip) as unreached:
            why = unreached.reason if isinstance(unreached, OperatorSkip) else str(unreached)
            self._events.event("reach", why.removesuffix(f". {NEARER}"))
            raise

    def _leaning(self, point: Floats, axis: Floats) -> Floats | None:
        """The stylus's axis by which the arm gets there, leaning if need be."""
        key = np.round(point).tobytes() + axis.tobytes()
        if key not in self._ways:
            there, R = self._arm_from_world.apply(point), self._arm_from_world.R
            way = way_to(self._twin.arm.unit, there, R @ axis, upright_only=False)
            self._ways[key] = None if way is None else np.asarray(R.T @ way)
        return self._ways[key]

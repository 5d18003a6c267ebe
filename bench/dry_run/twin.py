"""The emulated twin of a rig, and what stands in on it during a rehearsal.

The twin has the same tables with emulators at every address, in a world that is as far like the lab
as anybody knows: the stage's settings as its controller tells them, the table frame, how a
registration lies, the room's temperature, the bath's family. A rig that is emulated already is its
own twin.

Its cameras render at a few trials only, since rendering is what a rehearsal of a thousand trials
can't afford. Its hands look whether the arm reaches before they try: an arm that is pulled too far
hangs up, and the bench would take it for one that has lost its cable. Both say what they met.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import atan2

import numpy as np

from bench.dry_run.pose_checks import USUAL_ARM, Floats, registered_at, way_to
from bench.files import png_bytes
from bench.results.answers import Examiner
from bench.rig.devices import Cameras as OpenCameras
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.frame_capture import FrameTaker
from bench.rig.loading import LoadedRig
from bench.rig.model import Cameras, Checks, EmulatedStage, Emulation, FocusTable, Placed, Stage
from bench.rig.urls import EMULATED
from bench.run.rows import stage_pictures
from bench.script.model import LoadedScript
from bench.script.planned_trials import PlannedTrial, shared
from detector.geometry import Motion
from detector.protocol import Detector, Outcome
from instruments.camera.frame import FrameSet, Grey
from instruments.errors import DeviceError
from instruments.microscribe.unit import ArmIdentity, shipped_unit
from instruments.operators.operator import (
    Answer,
    CheckPoint,
    OperatorAbort,
    OperatorSkip,
    Prompt,
    Request,
    Touch,
    no_check,
)
from instruments.operators.prompted import PromptedOperator
from instruments.stage.emulator.store import DEFAULTS, ROTARY_DEFAULTS
from instruments.stage.protocol import AXES
from instruments.stage.settings import StageSettings

MOST_SETS = 12  # rendered; a second or so each on a busy machine
DARK, LIGHT = 60, 180  # of a picture that passes for one
Met = Callable[[str, str], None]  # a kind of finding, and its text

ROOM_MM = 10.0  # beyond the furthest place, where nobody knows a stage's travel


def twin_of(rig: LoadedRig, script: LoadedScript, stage: StageSettings | None) -> LoadedRig:
    """``rig`` with an emulator at each address; ``stage`` is what its controller says, None where
    it has none or nobody could ask.
    """
    r = rig.rig
    checks = r.cameras.checks
    if not r.emulated:  # how sharp the real cameras are, the emulated ones can't tell
        checks = checks.model_copy(update={"focus_px": FocusTable()})
    kept = r.cameras.model_dump(include={"settle_s", "max_skew_s", "retries", "retry_s"})
    tables: dict[str, object] = {
        "cameras": Cameras(url=EMULATED).model_copy(update={**kept, "checks": checks}),
        "operator": r.operator.model_copy(update={"url": EMULATED}),
    }
    if r.emulated:
        return replace(rig, rig=r.model_copy(update=tables))
    pump_url = EMULATED if r.bath.pump_url else ""
    tables |= {
        "arm": r.arm.model_copy(update={"url": EMULATED}),
        "bath": r.bath.model_copy(update={"url": EMULATED, "pump_url": pump_url}),
        "stage": r.stage.model_copy(update={"url": EMULATED}) if r.stage else None,
        "emulation": _world(rig, script, stage),
    }
    return replace(rig, rig=r.model_copy(update=tables), arm_unit=_arm(rig, script))


def _world(rig: LoadedRig, script: LoadedScript, stage: StageSettings | None) -> Emulation:
    """Without what is to go wrong: in the lab nobody plans that."""
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
        update["arm_placed"] = Placed().model_copy(update=place)
    if rig.rig.stage is not None:
        update["stage"] = _stage(rig, rig.rig.stage, script, stage)
    return rig.rig.emulation.model_copy(update=update)


def _stage(
    rig: LoadedRig, table: Stage, script: LoadedScript, told: StageSettings | None
) -> EmulatedStage:
    dialect = "grblHAL" if "A" in table.axes else "grbl"
    turned = script.registration.world_from_stage.R if script.registration else np.eye(3)
    settings = _far_enough(rig, table, script) if told is None else _as_told(told)
    yaw_rad = atan2(turned[1, 0], turned[0, 0])
    return EmulatedStage().model_copy(
        update={"dialect": dialect, "settings": settings, "yaw_rad": yaw_rad}
    )


def _as_told(told: StageSettings) -> dict[int, float]:
    each = {
        100: told.steps_per_mm,
        110: told.rate_mm_min,
        120: told.accel_mm_s2,
        130: told.travel_mm,
    }
    return {
        first + axis: value for first, values in each.items() for axis, value in enumerate(values)
    } | {24: told.homing_feed_mm_min, 25: told.homing_seek_mm_min, 27: told.pull_off_mm}


def _far_enough(rig: LoadedRig, table: Stage, script: LoadedScript) -> dict[int, float]:
    """Travel that no place of the script exceeds, so that what nobody knows isn't found wanting."""
    usual = DEFAULTS | ROTARY_DEFAULTS
    poses = [pose for one in script.planned for pose in (one.approach, one.pose) if pose]
    sent = [shared(pose, table.axes)[0] for pose in (*poses, *registered_at(rig, script))]
    places = [tuple(table.machine(pose).values()) for pose in sent]
    numbers = [130 + AXES.index(axis) for axis in table.axes]
    return {
        number: max(usual[number], ROOM_MM - min(values))
        for number, values in zip(numbers, zip(*places, strict=True), strict=True)
    }


def _arm(rig: LoadedRig, script: LoadedScript) -> ArmIdentity:
    """Of the usual size, under the serial number that frame and registration are of."""
    unit = rig.arm_unit or shipped_unit(USUAL_ARM)
    if made_with := rig.frame or script.registration:
        names = replace(unit.names, serial_number=made_with.serial_number)
        return replace(unit, names=names)
    return unit


def lenient(rig: LoadedRig) -> LoadedRig:
    """``rig`` for pictures that are all alike: nothing is compared, and no edge is measured."""
    checks = Checks(
        frozen=False,
        swapped=False,
        focus_px=FocusTable(),
        flat_dn=0,
        saturated_share=1.0,
        black_dn=0,
    )
    cameras = rig.rig.cameras.model_copy(update={"checks": checks})
    return replace(rig, rig=rig.rig.model_copy(update={"cameras": cameras}))


def to_render(planned: Sequence[PlannedTrial], most: int = MOST_SETS) -> frozenset[str]:
    """Ids of the trials whose frames are rendered: the first of each of the script's tables, and
    evenly spaced poses; at most ``most``.
    """
    tables = list({one.trial.name: one.id for one in reversed(planned)}.values())[::-1][:most]
    poses = list({one.name: one.id for one in reversed(planned)}.values())[::-1]
    left = [one for one in poses if one not in tables]
    room = min(most - len(tables), len(left))
    return frozenset([*tables, *(left[int((at + 0.5) * len(left) / room)] for at in range(room))])


def _ramp(size: tuple[int, int]) -> Grey:
    """A picture (height, width) that rises from dark to light."""
    width, height = size
    return np.tile(np.linspace(DARK, LIGHT, width).astype(np.uint8), (height, 1))


class StandInCameras:
    """``cameras`` render at the trials that are ``due``, and what they give has to pass the checks
    of ``rig``, as they stand; the first is shown to each detector. Otherwise a picture that nobody
    looks at is given. ``trial`` is the id of the trial now, ``takes_s`` how long a frame set takes.

    ``rendered`` are the sets that passed.
    """

    def __init__(
        self,
        twin: EmulatedRig,
        rig: LoadedRig,
        met: Met,
        due: frozenset[str],
        detectors: Sequence[Detector],
        takes_s: float,
    ) -> None:
        clock, c = twin.world.clock, rig.calibration
        self._cameras: OpenCameras = twin.cameras
        self._taker = FrameTaker(
            twin.cameras, rig.rig.cameras, c, clock.sleep, lambda _kind, _text: None
        )
        left, right, thermal = (_ramp(one.image_size) for one in (c.left, c.right, c.thermal))
        self._stand_in = FrameSet(left, right, thermal)
        self._met = met
        self._due = set(due)
        self._detectors = detectors
        self._examiner = Examiner(rig.calibration, rig.rig.limits.detection_timeout_s)
        self._clock = clock
        self._takes_s = takes_s
        self._set_bytes = self._stage_bytes = 0
        self.rendered = 0
        self.trial = ""

    @property
    def identity(self) -> Mapping[str, str]:
        """As the cameras say."""
        return self._cameras.identity

    def capture(self) -> FrameSet:
        """At a trial that is due, its frames are rendered first, and looked at."""
        self._clock.sleep(self._takes_s)
        if self.trial in self._due:
            self._due.remove(self.trial)
            self._look()
        return self._stand_in

    def close(self) -> None:
        self._cameras.close()

    def bytes_of(self, trials: int) -> float:
        """What so many trials' pictures and those of their detectors take, by what was rendered."""
        each = self._set_bytes / self.rendered + self._stage_bytes if self.rendered else 0.0
        return trials * each

    def _look(self) -> None:
        try:
            frames = self._taker.take()
        except DeviceError as fault:
            self._met("frames", str(fault))
            return
        pictures = (frames.left, frames.right, frames.thermal, frames.thermal_ck)
        self._set_bytes += sum(len(png_bytes(one)) for one in pictures if one is not None)
        self.rendered += 1
        for detector in self._detectors if self.rendered == 1 else ():
            answer = self._examiner.ask(detector, frames)
            if answer.outcome is not Outcome.ANSWERED:
                self._met("detector", f"{detector.name}: {answer.detection.reason}")
            left = stage_pictures(answer).values()
            self._stage_bytes += sum(len(png_bytes(picture)) for picture in left)


class ReachingHands:
    """The operator of ``twin``, whose arm stands at ``placed``. ``met`` gets what is out of reach;
    ``leans`` where a person touches, who may lean the stylus.
    """

    def __init__(self, twin: EmulatedRig, placed: Placed, met: Met, *, leans: bool) -> None:
        self._twin = twin
        self._arm_from_world = Motion.from_vectors(placed.om, placed.T).inverse()
        self._met = met
        self._leans = leans
        # to within a millimetre, how the stylus was held: nobody solves the same pose twice
        self._reached: dict[bytes, Floats] = {}

    def ask(self, request: Request, check: Callable[[], None] = no_check) -> Answer:
        """Raises OperatorAbort for a check point out of reach, OperatorSkip for a teat's end."""
        answer = self._twin.operator.ask(request, check)
        if isinstance(request, CheckPoint) and (why := self._out_of_reach("the check point")):
            raise OperatorAbort(why)
        if isinstance(request, Touch):
            name = self._twin.world.phantom().teats[request.teat - 1].name or request.teat
            if why := self._out_of_reach(f"the end of teat {name}"):
                raise OperatorSkip(why)
        return answer

    def _out_of_reach(self, what: str) -> str:
        """Empty where the arm gets there, leaning if need be; else the tip is let go of."""
        world, held = self._twin.world, self._twin.world.arm_target()
        if held is None:
            return ""
        point, axis = held
        key = np.round(point).tobytes() + axis.tobytes()
        if key not in self._reached:
            there, R = self._arm_from_world.apply(point), self._arm_from_world.R
            way = way_to(self._twin.arm.unit, there, R @ axis, upright_only=not self._leans)
            if way is None:
                world.hold(None)
                why = f"the arm doesn't reach {what} at {np.round(point).astype(int).tolist()} mm"
                self._met("reach", why)
                return why
            self._reached[key] = np.asarray(R.T @ way)
        world.hold(point, self._reached[key])
        return ""


class CountedAnswers(PromptedOperator):
    """Says "go on" to each prompt, or what ``answers`` say; ``asked`` counts prompts by kind."""

    def __init__(self, answers: PromptedOperator | None) -> None:
        self._answers = answers
        self.asked: Counter[str] = Counter()

    def answer(self, prompt: Prompt, check: Callable[[], None]) -> frozenset[int]:
        check()
        self.asked[prompt.kind] += 1
        return self._answers.answer(prompt, check) if self._answers else frozenset()

    def say(self, text: str) -> None:
        if self._answers:
            self._answers.say(text)

    def finish(self) -> None:
        if self._answers:
            self._answers.finish()

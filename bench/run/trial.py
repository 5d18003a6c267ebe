"""One trial: settle, move, set up, capture, touch, detect, score, store; and the truth source that
a script asks for. A trial is whole in the store, or not there at all.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import InitVar, dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bench.record.reader import RunRecord, TrialRecord
from bench.record.recording import TruthRow
from bench.record.schema import Row
from bench.record.writer import Store, release_memory
from bench.results.answers import Answer, Examiner, score_answers
from bench.results.cameras_agree import where_seen
from bench.results.doubts import out_of_sight
from bench.results.teats_seen import TEATS_FACT, teats_seen
from bench.rig.frame_capture import CAPTURE_S, FrameTaker
from bench.rig.model import StageTable
from bench.rig.move_check import MoveCheck
from bench.rig.reconnecting import diagnosis
from bench.run.cameras_so_far import CamerasSoFar
from bench.run.context import RunContext
from bench.run.events import RunState
from bench.run.recordings import Recorder
from bench.run.rows import detection_tables, stage_pictures
from bench.run.set_up_picture import write_set_up_picture
from bench.safety.stability import BathState
from bench.script.model import Rules
from bench.script.planned_trials import PlannedTrial, shared
from bench.truth.carrying import CarriedTruth, CarryState, fixed_key, resumed
from bench.truth.registration import (
    Registration,
    RegistrationError,
    as_facts,
    registration_from_facts,
    write_registration,
)
from bench.truth.stage_registration import PartialRegistration, around, ends_of, register, stands_at
from bench.truth.touching import (
    ASTRAY_MM,
    AstrayError,
    ExpectedScene,
    NoTruthError,
    SoFar,
    TouchedTruth,
    Toucher,
    TrialTruth,
    astray_text,
    truth_row,
)
from bench.truth.uncertainty import TrueEnd, TruthMethod
from detector.protocol import Detector, DetectorProcess
from instruments.camera.frame import FrameSet
from instruments.clock import wall_time
from instruments.drivers.protocols import Stage
from instruments.errors import DeviceError, InstrumentError, LimitError
from instruments.operators.operator import Arrangement, NextTrial, OperatorRepeat, OperatorSkip
from instruments.world.phantom import PlatePose

REGISTRATION_FILE = "stage-registration.toml"  # in the run's folder, where it was made at its start
URGENT = ("invalid", "registration")  # what the operator has to see, not only the record
KEPT_FOR_TRIALS = 10  # memory that a trial freed: all anew costs a third of drawing a frame set
Settled = Callable[[Sequence[str], bool], None]


def shown(trial: PlannedTrial, axes: str) -> ExpectedScene:
    """The scene of ``trial`` once the stage's ``axes`` (of "XYZA") have moved it."""
    _, by_hand = shared(trial.pose, axes)
    return ExpectedScene(
        trial.id,
        ends_of(trial.phantom.moved(trial.pose)),
        fixed_key(trial.phantom, by_hand, trial.pose.yaw_rad),
    )


def choose_truth(
    ctx: RunContext, settled: Settled, *, before: RunRecord | None = None
) -> TouchedTruth:
    """The truth source of a run. ``settled`` gets the carried trials that a check has confirmed
    (True) or invalidated; ``before``: the stopped run.
    """
    table, stage, settings = ctx.script.script.truth, ctx.devices.stage, ctx.rig.rig.stage

    def look() -> None:
        ctx.check()
        if ctx.devices.arm.touches:
            ctx.long("touching by itself", 600.0)

    toucher = Toucher(ctx.ask, ctx.tip, ctx.rig.rig.arm, ctx.clock, look, table.readings)
    if table.mode == "touch":
        return TouchedTruth(toucher, lambda: None if stage is None else stands_at(stage))
    if stage is None or settings is None:
        raise ValueError("a truth can't be carried without a stage; refuse_carry says so before")
    known, so_far = registration_from_facts(before.facts) if before else None, PartialRegistration()

    def report(kind: str, text: str) -> None:
        ctx.event(kind, text)
        (ctx.events.warn if kind in URGENT else ctx.events.state)(text)

    return CarriedTruth(
        toucher,
        lambda: stands_at(stage),
        lambda: known or _registration(ctx, stage, settings, toucher, so_far),
        ctx.store,
        settled,
        report,
        ctx.clock.now,
        every=table.check_every,
        limit_mm=table.check_limit_mm,
        state=resumed(before) if before else CarryState(),
    )


def _registration(
    ctx: RunContext,
    stage: Stage,
    settings: StageTable,
    toucher: Toucher,
    so_far: PartialRegistration,
) -> Registration:
    """The script's registration, from its file or made now, as a fact of the run. Raises LimitError
    where the file's doesn't hold, DeviceError where the touches give none.
    """
    # the world that it was made in has to be the one that the arm gives now
    made = ctx.rig.frame.made if ctx.rig.frame else None
    known = ctx.script.registration
    if known and (why := known.outdated(ctx.devices.arm.identity.serial_number, made)):
        what = f"its registration {ctx.script.script.truth.file} {why}"
        raise LimitError("stage", what, hint="Make it anew: 'teatbench calibrate stage'")
    found = known or _made(ctx, stage, settings, toucher, so_far)
    for key, value in as_facts(found).items():
        ctx.store.fact(key, value)
    return found


def _made(
    ctx: RunContext,
    stage: Stage,
    settings: StageTable,
    toucher: Toucher,
    so_far: PartialRegistration,
) -> Registration:
    planned, table = ctx.script.planned, ctx.script.script.truth
    phantom, teat = planned[0].phantom, table.registration_teat
    if teat > (there := len(phantom.teats)):
        what = f"registration_teat = {teat}, but the first trial's phantom has {there} teats"
        raise DeviceError("truth", what, hint="Name one of them in the script's [truth].")
    if not (so_far.stations or so_far.taken):  # else it stands there, and is not to be touched
        ctx.ask(planned[0].arrangement(settings.axes))
    poses = tuple(PlatePose(x, y) for x, y in table.registration_at_mm or ())
    poses = poses or around(shared(trial.pose, settings.axes)[0] for trial in planned)

    def report(text: str) -> None:
        ctx.note(text)
        ctx.long("moving the stage", 600.0)

    try:
        made = register(
            stage,
            settings,
            toucher,
            so_far,
            phantom,
            poses,
            teat=teat,
            report=report,
        )
    except RegistrationError as error:
        hint = "Name other places in the script's registration_at_mm."
        raise DeviceError("stage", str(error), hint=hint) from error
    write_registration(ctx.store.folder / REGISTRATION_FILE, made)
    return made


@dataclass(eq=False)
class Attempts:
    """Runs planned trials by ``once``, each until done or skipped. ``through`` repeats work that an
    instrument interrupts; ``poison``: trials not tried again, with the reason; ``each_s``: expected
    of a trial; ``settling_s``: until the bath lets trials go on.
    """

    ctx: RunContext
    once: Callable[[PlannedTrial], None]
    through: Callable[[str, Callable[[], None]], None] = lambda _, work: work()
    poison: Mapping[str, str] = field(default_factory=dict)
    each_s: float | None = None
    settling_s: Callable[[], float] = lambda: 0.0
    done: int = field(default=0, init=False)

    def __post_init__(self) -> None:
        self._planned = len(self.ctx.script.planned)
        self._started_s: float | None = None  # of the trial under way
        self._taken_s, self._timed = 0.0, -1  # of the trials but for the first

    def run(self, trial: PlannedTrial) -> None:
        """Until the trial is stored or skipped. Raises whatever else ``once`` raises."""
        started_s = self._started_s = self._working_s()
        self.ctx.ask(NextTrial(trial.number, self._planned, lambda: self.left_s))
        worked = 0
        try:
            if why := self.poison.get(trial.id):
                raise OperatorSkip(why)
            while not worked:  # one that was skipped says nothing of how long a trial takes
                try:
                    self.through(f"trial {trial.id}", lambda: self.once(trial))
                    worked = 1
                except OperatorRepeat as repeat:
                    why = f"{trial.id}: the operator asked for it again from its set-up"
                    why += f": {repeat.reason}" if repeat.reason else ""
                    self.ctx.event("repeated", why)
        except OperatorSkip as skip:
            by = "the bench" if trial.id in self.poison else "the operator"
            self._skipped(trial, skip.reason, f"{by} skipped it: ")
        except NoTruthError as none:
            self._skipped(trial, str(none))
            self.ctx.events.warn(f"Trial {trial.id} is skipped. {none}")
        self.done += 1
        self._started_s = None
        self._timed += worked
        self._taken_s += self._working_s() - started_s if worked and self._timed else 0.0

    @property
    def left_s(self) -> float | None:
        """By the mean of the trials but for the first, until then by what was expected; of a world
        that passes faster for who watches it, in his own time.
        """
        each_s = self._taken_s / self._timed if self._timed > 0 else self.each_s
        if each_s is None:
            return None
        under_way_s = self._working_s() - self._started_s if self._started_s is not None else 0.0
        trials_s = each_s * (self._planned - self.done) - min(each_s, under_way_s)
        return (trials_s + self.settling_s()) / float(getattr(self.ctx.clock, "speed", 1.0))

    def _skipped(self, trial: PlannedTrial, reason: str, by: str = "") -> None:
        row = {**_head(trial), "t_s": self.ctx.clock.now(), "reason": reason}
        self.ctx.store.skipped({"trial": row.pop("id"), **row})
        self.ctx.event("skipped", f"{trial.id}: {by}{reason}")

    def _working_s(self) -> float:
        """The time but for that which was no work at all."""
        return self.ctx.clock.now() - self.ctx.states.away_s


@dataclass(eq=False)
class TrialRun:
    """The trials of one run. ``exact_ends``: the exact truth, never scored against; ``recorder``
    gets each frame set; ``before``: earlier sessions. While ``rehearsing`` nothing is detected.
    """

    ctx: RunContext
    detectors: Sequence[Detector]
    truth: TouchedTruth
    exact_ends: Callable[[], NDArray[np.float64]] | None = None
    recorder: Recorder | None = None
    before: InitVar[RunRecord | None] = None
    rehearsing: bool = field(default=False, init=False)

    def __post_init__(self, before: RunRecord | None) -> None:
        ctx, rig = self.ctx, self.ctx.rig.rig
        self._rig = rig
        self._teats_unknown = ""
        self._homed_in_vain = False
        self._moves = MoveCheck()
        self._begun, self._so_far = "", SoFar()  # touches of a trial that was interrupted amid them
        self._homed_again = False  # the arm, since those touches
        # why they don't count then, or ""
        self.check_homing: Callable[[], str] = lambda: "the arm was homed again"
        self._teats_first_c: float | None = None  # as the thermal camera saw them
        self._before: Arrangement | None = None  # with a picture
        # what of a pose the stage does; the operator does the rest
        self._axes = rig.stage.axes if ctx.devices.stage and rig.stage else ""
        self._examiner = Examiner(ctx.rig.calibration, rig.limits.detection_timeout_s)
        self._cameras = CamerasSoFar(before.trials if before else ())

        def before_another_try(seconds: float) -> None:
            ctx.wait(seconds)
            ctx.long("capturing again", CAPTURE_S, silent=True)

        cameras = ctx.devices.cameras
        self._taker = FrameTaker(
            cameras, rig.cameras, ctx.rig.calibration, before_another_try, ctx.event
        )
        self.look = self._taker.look  # raises where the cameras give nothing usable
        self.frames_looked_at = self._taker.looked

    def run(self, trial: PlannedTrial) -> None:
        """From settling to the trial's rows; where anything raises, nothing is stored. Touches are
        kept for the next try where no person has interrupted it; of an arm that was homed again,
        where `check_homing` shows that they count.
        """
        so_far = self._so_far
        if self._begun != trial.id:
            so_far.clear()
        self._begun, kept_before = trial.id, sum(map(len, so_far.values()))
        self._homed_again &= kept_before > 0
        try:
            if self._homed_again:
                if why_not := self.check_homing():  # not shown to be that of before
                    so_far.clear()
                    said = f"{trial.id}: those kept so far are dropped: {why_not}"
                    self.ctx.event("touches", said)
                self._homed_again = False
            self._run(trial)
        except BaseException as why:
            lost, how = diagnosis(why) if isinstance(why, InstrumentError) else ("", "")
            self._homed_again |= lost == "arm"
            if isinstance(why.__cause__, AstrayError) or not (lost and how):
                so_far.clear()
                if kept_before:
                    self.ctx.event("touches", f"{trial.id}: those kept so far are dropped")
            elif count := sum(map(len, so_far.values())):
                self.ctx.event("touches", f"{trial.id}: {count} so far are kept")
            raise
        so_far.clear()

    def _run(self, trial: PlannedTrial) -> None:
        ctx, there = self.ctx, shown(trial, self._axes)
        ctx.store.refuse_gone()
        ctx.live.expect(there.ends)
        started_s = ctx.clock.now()
        self.truth.before(there)
        self._settle()
        ctx.states.to(RunState.RUNNING)
        settled_s = ctx.states.away_s
        self._move(trial)
        asked = replace(trial.arrangement(self._axes), unattended=self.truth.unattended(there))
        visible = ctx.ask(self._pictured(trial, asked)).visible
        ctx.wait(self._rig.cameras.settle_s)
        notes = list[str]()
        while True:
            frames = self._capture_settled(trial.id)
            captured_s = ctx.devices.answered_s["cameras"] = ctx.clock.now()
            if ctx.store.keeps_pictures:
                ctx.live.frames(frames)
            bath, bath_state = ctx.watch.last, ctx.watch.state
            ctx.events.state("taking the truth")
            truth, doubt = self._of_trial(there)
            notes += [doubt] if doubt else []
            ctx.check()
            # Wait for a sign of life of the bath's reading after the capture: the last value of a
            # sensor that stopped says nothing of the teats.
            while not (alive := ctx.watch.alive_since(captured_s)) and self._stable():
                ctx.events.state("waiting for a sign of life of the bath's sensor")
                ctx.wait(1.0)
            if alive or self._rig.cameras.recorded:
                break
        ends = [
            replace(end, situation=trial.situation, teat=str(teat), visible=visible[teat - 1])
            for teat, end in enumerate(truth.points, 1)
        ]
        self._refuse_astray(there, ends)
        if bath is not None and bath.external_c is None and not self._rig.cameras.recorded:
            self._look_at_teats(trial, frames, ends, bath.temp_c)
        truth_rows = self._truth_rows(trial.id, frames, ends)
        answers = self._detect(frames)
        away_s = ctx.states.away_s - settled_s
        if away_s > 0.0:
            notes.append(f"suspended for {away_s:.1f} s: the bath had left its band")
        head: Row = {
            **_head(trial),
            "started_s": started_s,
            "ended_s": ctx.clock.now(),
            "captured_s": captured_s,
            "bath_c": bath.temp_c if bath else None,
            "bath_state": bath_state.value,
            "note": "; ".join(notes) or None,
            "stage_mm": None if truth.stage_mm is None else json.dumps(truth.stage_mm),
            "wall_time": wall_time().isoformat(timespec="milliseconds"),
        }
        self._cameras.add(trial.name, truth_rows)
        ctx.long("writing the trial", 60.0, silent=True)
        script = ctx.script.script
        write_trial(ctx.store, script, head, frames, answers, ends, truth_rows, truth.touches)
        self.truth.stored(trial.id, truth)
        if self.recorder and not self.rehearsing:
            self.recorder.trial(trial.id, frames, ends, confirmed=truth.how is TruthMethod.TOUCHED)

    def _of_trial(self, there: ExpectedScene) -> tuple[TrialTruth, str]:
        """The truth, and why the stage's place is in doubt, or "". Raises DeviceError where a
        blocked carriage may have lost its place, once until there is a truth again.
        """
        stage, again, doubt = self.ctx.devices.stage, self._homed_in_vain, ""
        try:
            truth = self.truth.of_trial(there, self._so_far)
            ends_mm = np.array([end.xyz_mm for end in truth.points])
            moved = there.trial, there.fixed, there.ends.expected_mm, ends_mm
            if stage and truth.how is TruthMethod.TOUCHED and (doubt := self._moves.doubt(*moved)):
                if not again:
                    raise AstrayError("truth", doubt)
                known, self._moves = ", ".join(self._moves.trials), MoveCheck()
                self._moves.doubt(*moved)
                doubt += ", after homing too. Something blocked the stage before, or the phantom"
                doubt += f" was moved on it: in doubt is where the stage stood in {known}"
                self.ctx.event("stage", f"{there.trial}: {doubt}")
                self.ctx.events.warn(f"Trial {there.trial}: {doubt}.")
        except AstrayError as astray:
            self._homed_in_vain = True
            if stage is None or again:
                raise
            what = f"the phantom is not where the stage should have it: {astray.what}"
            raise DeviceError(stage.who, what, hint="It is homed again.") from astray
        self._homed_in_vain = False
        return truth, doubt

    def _refuse_astray(self, there: ExpectedScene, ends: Sequence[TrueEnd]) -> None:
        """Raises NoTruthError for an end that is nowhere near the script's place, or is called
        visible where no camera can show it: no detector is charged with it.
        """
        places = np.array([row.xyz_mm for row in ends]).reshape(-1, 3)
        off_mm = np.linalg.norm(places - there.ends.expected_mm, axis=1)
        found = [
            astray_text(there.ends.called(teat), off)
            for teat, off in enumerate(off_mm.tolist(), 1)
            if off > ASTRAY_MM
        ]
        named = ((there.trial, end) for end in ends)
        if why := next(iter(found or out_of_sight(named, self.ctx.rig.calibration)), None):
            raise NoTruthError("truth", why, hint="Is the rig's calibration of this table's frame?")

    def _stable(self) -> bool:
        return self.ctx.watch.state == BathState.STABLE

    def _look_at_teats(
        self, trial: PlannedTrial, frames: FrameSet, ends: Sequence[TrueEnd], bath_c: float
    ) -> None:
        """Where no sensor is at the teats, the thermal camera measures. Raises DeviceError for
        cold ones; why it can't is a fact of the run.
        """
        ctx, emulation = self.ctx, self._rig.emulation
        room_c = emulation.ambient_c if "cameras" in self._rig.emulated else self._rig.bath.room_c
        shown = [k for k, end in enumerate(ends) if end.visible]
        ends_mm = np.array([ends[k].xyz_mm for k in shown]).reshape(-1, 3)
        axes = trial.phantom.moved(trial.pose).axes[shown]
        seen = teats_seen(frames, ctx.rig.calibration, ends_mm, axes, bath_c=bath_c, room_c=room_c)
        if why := seen.cold(bath_c, room_c, self._teats_first_c):
            hint = "Does the pump turn, and does the water go through the teats? Is room_c right?"
            raise DeviceError("bath", why, asked="the level of the teats", hint=hint)
        if self._teats_first_c is None:
            self._teats_first_c = seen.level_c
        if seen.why_not and self._teats_unknown != seen.why_not:
            self._teats_unknown = seen.why_not
            ctx.store.fact(TEATS_FACT, seen.why_not)

    def _settle(self) -> None:
        """Wait until the stability gate is open. Raises DeviceError after the script's time."""
        ctx = self.ctx
        gate, start, watch = ctx.script.script.bath, ctx.clock.now(), ctx.watch
        if self._stable():
            return
        ctx.states.to(RunState.SETTLING)
        while not self._stable():
            ctx.events.state(f"waiting for the bath: {watch.why_not_stable}")
            ctx.wait(1.0)
            ctx.look_at_idle()
            if ctx.clock.now() - start > gate.timeout_s:
                why = f"not stable within {gate.timeout_s:g} s: {watch.why_not_stable}"
                hint = "Check level, lid and pump, or allow more time in the script."
                raise DeviceError("bath", why, hint=hint)
        ctx.event("stable", f"the bath is stable at {gate.set_point_c:g} degC")

    def _pictured(self, trial: PlannedTrial, asked: Arrangement) -> Arrangement:
        """With a picture for a person; the one before where nothing is to be changed by hand."""
        if not self._rig.by_person:
            return asked
        before = self._before
        if before is None or replace(before, unattended=asked.unattended) != asked:
            with suppress(OSError, ValueError):
                path = write_set_up_picture(self.ctx.store.folder, trial.name, asked, self.ctx.rig)
                before = replace(asked, picture=str(path))
        self._before = before
        return replace(asked, picture=before.picture) if before else asked

    def _capture_settled(self, trial_id: str) -> FrameSet:
        """Frames of a bath in its band: the trial is suspended until it is stable, and frames are
        taken again where it leaves its band (but for a recording's).
        """
        ctx, recorded = self.ctx, self._rig.cameras.recorded
        while True:
            while not self._stable():
                why = ctx.watch.why_not_stable
                ctx.event("suspended", f"{trial_id}: the bath left its band: {why}")
                self._settle()
                ctx.wait(self._rig.cameras.settle_s)
            ctx.states.to(RunState.RUNNING)
            ctx.check()
            ctx.events.state("capturing")
            ctx.long("capturing", CAPTURE_S, silent=True)
            try:
                frames = self._taker.take()
            finally:
                if self._taker.counts:
                    ctx.store.fact("camera faults", dict(self._taker.counts))
            if recorded or self._stable():
                return frames

    def _move(self, trial: PlannedTrial) -> None:
        """By way of the place from which the script has the pose reached, if it names one."""
        ctx, stage, there = self.ctx, self.ctx.devices.stage, self._rig.stage
        if stage is None or there is None:
            return
        ctx.events.state(f"moving the phantom: {trial.name}")
        for pose in (trial.approach, trial.pose):
            if pose is not None:
                ctx.check()  # nothing moves any more once an interlock has tripped
                ctx.long("moving the stage", 600.0)
                place = there.machine(shared(pose, self._axes)[0])
                stage.move_to(**place, feed_mm_min=there.feed_mm_per_min)
                at = (f"{axis.partition('_')[0]} {value:.1f}" for axis, value in place.items())
                ctx.last["stage"] = ", ".join(at)
                ctx.check()

    def _detect(self, frames: FrameSet) -> list[Answer]:
        answers, known = list[Answer](), self._cameras.context
        for detector in () if self.rehearsing else self.detectors:
            what = f"detecting with {detector.name}"
            self.ctx.events.state(what)
            patience_s = 2.0 * self._rig.limits.detection_timeout_s
            if isinstance(detector, DetectorProcess):
                patience_s = detector.patience_s
            self.ctx.long(what, 10.0 + patience_s, silent=True)
            answers.append(self._examiner.ask(detector, frames, known))
        return answers

    def _truth_rows(self, trial_id: str, frames: FrameSet, ends: Sequence[TrueEnd]) -> list[Row]:
        """What is stored of the true ends, with where the cameras show them."""
        self.ctx.long("looking for the true ends in the pictures", 60.0, silent=True)
        exact = self.exact_ends() if self.exact_ends else None
        places = [None] * len(ends) if exact is None else list(exact)
        looked = self.ctx.store.keeps_pictures and not self.rehearsing
        seen = where_seen(frames, self.ctx.rig.calibration, ends) if looked else {}
        return [
            truth_row(trial_id, end, place, seen.get(end.teat))
            for end, place in zip(ends, places, strict=True)
        ]


def write_trial(
    store: Store,
    rules: Rules,
    head: Row,
    frames: FrameSet,
    answers: Sequence[Answer],
    truth: Sequence[TruthRow],
    truth_rows: Sequence[Row],
    touches: Sequence[Row] = (),
) -> None:
    """Score ``answers`` by ``rules`` against ``truth`` and write the whole trial."""
    trial_id = str(head["id"])
    scores = score_answers(
        answers, truth, limit_mm=rules.visible_within_mm, time_limit_s=rules.time_limit_s
    )
    detections, found = detection_tables(trial_id, answers)
    pictures = store.frames(trial_id, frames.pictures | stage_pictures(answers), frames.exposed_s)
    store.finished(TrialRecord(head, pictures, touches, truth_rows, detections, found, scores))
    if store.keeps_pictures and int(str(head["number"])) % KEPT_FOR_TRIALS == 0:
        release_memory()


def _head(trial: PlannedTrial) -> dict[str, object]:
    return {name: getattr(trial, name) for name in ("id", "number", "name", "situation", "repeat")}

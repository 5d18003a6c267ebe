"""A trial as often as it takes: once, again from its set-up where somebody wants it or an
instrument dropped out, or not at all.

Tells the operator before each how far the run is. What is skipped leaves the counts and is kept
with its reason; a trial in flight is done again whole. May not know what a trial consists of.

One trial: settle, move, set up, capture, touch, detect, score, store. It is whole in the store, or
not there at all.

May not know how a run begins and ends, nor which instruments are emulated.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bench.record.writer import FinishedTrial, Row, Store
from bench.results.answers import Answer, Examiner, TruthRow
from bench.rig.devices import Devices
from bench.rig.frame_capture import FrameTaker
from bench.rig.loading import LoadedRig
from bench.run.context import Attention
from bench.run.rows import frame_rows, judged, truth_row
from bench.run.states import RunState, RunStates
from bench.run.truth_source import shown
from bench.safety.stability import State
from bench.script.model import Script
from bench.script.planned_trials import PlannedTrial, shared
from bench.truth.touching import NoTruthError, TrialTruth, TruthSource
from bench.truth.uncertainty import How
from detector.protocol import Detector, Served
from instruments.camera.frame import FrameSet
from instruments.clock import Clock, wall_time
from instruments.errors import DeviceError
from instruments.operators.operator import NextTrial, Operator, OperatorRepeat, OperatorSkip
from instruments.world.phantom import PlatePose


class Attempts:
    """Runs ``planned`` trials, one for each call of ``run``, by ``once``.

    ``through`` does a piece of work until no instrument has interrupted it; ``away_s`` tells the
    time that was no work at all. ``poison`` are trials that aren't tried again, with the reason;
    ``each_s`` is what a trial is expected to take, where that is known.
    """

    def __init__(
        self,
        once: Callable[[PlannedTrial], None],
        planned: int,
        operator: Operator,
        clock: Clock,
        store: Store,
        attention: Attention,
        *,
        through: Callable[[str, Callable[[], None]], None] = lambda _, work: work(),
        away_s: Callable[[], float] = lambda: 0.0,
        poison: Mapping[str, str] | None = None,
        each_s: float | None = None,
    ) -> None:
        self._once = once
        self._planned = planned
        self._operator = operator
        self._clock = clock
        self._store = store
        self._attention = attention
        self._through = through
        self._away_s = away_s
        self._poison = dict(poison or {})
        self._each_s = each_s
        self._done = 0
        self._started_s: float | None = None  # of the trial under way
        self._taken_s: list[float] = []

    def run(self, trial: PlannedTrial) -> None:
        """Until the trial is in the store or has been skipped. Raises whatever else ``once``
        raises.
        """
        started_s = self._started_s = self._working_s()
        self._operator.ask(NextTrial(trial.number, self._planned, self.left_s))
        try:
            if why := self._poison.get(trial.id):
                raise OperatorSkip(why)
            while self._again(trial):
                pass
        except OperatorSkip as skip:
            by = "the bench" if trial.id in self._poison else "the operator"
            self._skipped(trial, f"{by} skipped it: {skip.reason}", skip.reason)
        except NoTruthError as none:
            self._skipped(trial, str(none), str(none))
        self._done += 1
        self._started_s = None
        self._taken_s.append(self._working_s() - started_s)

    def passed(self) -> None:
        """A trial that needs nothing: it was done before this session."""
        self._done += 1

    @property
    def left_s(self) -> float | None:
        """By the mean of the trials so far, but for the first, and
        until then by what was expected.
        """
        seen = self._taken_s[1:]
        each_s = sum(seen) / len(seen) if seen else self._each_s
        if each_s is None:
            return None
        under_way_s = self._working_s() - self._started_s if self._started_s is not None else 0.0
        return each_s * (self._planned - self._done) - min(each_s, under_way_s)

    def _again(self, trial: PlannedTrial) -> bool:
        """Whether somebody wants what was just done once more."""
        try:
            self._through(f"trial {trial.id}", lambda: self._once(trial))
        except OperatorRepeat as wish:
            self._attention.event(
                "repeated",
                f"{trial.id}: the operator asked for it again from its set-up{_because(wish)}",
            )
            return True
        return False

    def _skipped(self, trial: PlannedTrial, told: str, reason: str) -> None:
        row = {
            "trial": trial.id,
            "number": trial.number,
            "name": trial.name,
            "situation": trial.situation,
            "repeat": trial.repeat,
        }
        self._store.skipped({**row, "t_s": self._clock.now(), "reason": reason})
        self._attention.event("skipped", f"{trial.id}: {told}")

    def _working_s(self) -> float:
        return self._clock.now() - self._away_s()


def _because(wish: OperatorRepeat) -> str:
    """The reason, where one was given."""
    return f": {wish.reason}" if wish.reason else ""


class FrameSink(Protocol):
    """Who else wants each frame set with its truth: the writer of a recording. Truth that isn't
    ``confirmed`` may still be taken back.
    """

    def trial(
        self,
        trial_id: str,
        situation: str,
        frames: FrameSet,
        truth: Sequence[TruthRow],
        *,
        confirmed: bool,
    ) -> None: ...
    def settled(self, trials: Sequence[str], good: bool) -> None: ...


class TrialRun:
    """The trials of one run. ``exact_ends`` gives the scene's exact truth where there is one; it is
    kept aside, never scored against.

    ``rehearsing``: all is done but the detection, for a trial that has its result already.
    """

    def __init__(
        self,
        rig: LoadedRig,
        script: Script,
        devices: Devices,
        store: Store,
        detectors: Sequence[Detector],
        truth: TruthSource,
        attention: Attention,
        *,
        exact_ends: Callable[[], NDArray[np.float64]] | None = None,
        sink: FrameSink | None = None,
        states: RunStates | None = None,
    ) -> None:
        self._rig = rig.rig
        self._calibration = rig.calibration
        self._script = script
        self._devices = devices
        self._store = store
        self._detectors = detectors
        self._truth = truth
        self._attention = attention
        self._progress = attention.progress
        self._watch = attention.watch
        self._exact_ends = exact_ends
        self._sink = sink
        self._states = states or RunStates(lambda _: None, devices.clock.now)
        self.rehearsing = False
        self._examiner = Examiner(rig.calibration, rig.rig.limits.detection_timeout_s)
        self._taker = FrameTaker(
            devices.cameras,
            rig.rig.cameras,
            rig.calibration,
            self._before_another_try,
            attention.event,
        )

    def run(self, trial: PlannedTrial) -> None:
        """From settling to the trial's rows. Raises what an instrument, an interlock or the
        operator raises; nothing is stored then.
        """
        self._store.refuse_gone()
        started_s = self._devices.clock.now()
        trial_id = trial.id
        there = shown(trial, self._axes)
        self._truth.before(there)
        self._settle()
        self._states.to(RunState.RUNNING)
        settled_s = self._states.away_s
        self._move(trial)
        asked = replace(trial.arrangement(self._axes), unattended=self._truth.unattended(there))
        placed = self._devices.operator.ask(asked, self._attention.look)
        self._attention.wait(self._rig.cameras.settle_s)
        frames = self._capture_settled(trial_id)
        captured_s = self._devices.clock.now()
        bath = self._watch.last
        bath_state = self._watch.state
        self._progress.state("taking the truth")
        truth = self._truth.of_trial(there)
        self._attention.check()
        answers = self._detect(frames)
        rows = [
            TruthRow(str(i), t.point_mm, placed.visible[i - 1], t.uncertainty.u_mm)
            for i, t in enumerate(truth.points, 1)
        ]
        head: Row = {
            "id": trial_id,
            "number": trial.number,
            "name": trial.name,
            "situation": trial.situation,
            "repeat": trial.repeat,
            "started_s": started_s,
            "ended_s": self._devices.clock.now(),
            "captured_s": captured_s,
            "bath_c": bath.temp_c if bath else None,
            "bath_state": bath_state.value,
            "note": _suspended_told(self._states.away_s - settled_s),
            "stage_mm": None if truth.stage_mm is None else json.dumps(truth.stage_mm),
            "wall_time": wall_time().isoformat(timespec="milliseconds"),
        }
        self._store_trial(head, frames, rows, truth, answers)
        self._truth.stored(trial_id, truth)
        if self._sink and not self.rehearsing:
            self._sink.trial(
                trial_id, trial.situation, frames, rows, confirmed=truth.how is How.TOUCHED
            )

    def look(self) -> None:
        """See whether the cameras work. Raises where they don't."""
        self._taker.look()

    def _settle(self) -> None:
        """Wait until the stability gate is open. Raises DeviceError where that takes longer than
        the script allows.
        """
        gate, start = self._script.bath, self._devices.clock.now()
        waited = False
        if self._watch.state != State.STABLE:
            self._states.to(RunState.SETTLING)
        while self._watch.state != State.STABLE:
            waited = True
            self._progress.state(f"waiting for the bath: {self._watch.why_not_stable}")
            self._attention.wait(1.0)
            if self._devices.clock.now() - start > gate.timeout_s:
                why = f"not stable within {gate.timeout_s:g} s: {self._watch.why_not_stable}"
                raise DeviceError(
                    "bath", why, hint="Check level, lid and pump, or allow more time in the script."
                )
        if waited:
            self._attention.event("stable", f"the bath is stable at {gate.set_point_c:g} degC")

    def _settle_again(self, trial_id: str) -> None:
        """Just before the cameras: where the bath has left its band meanwhile, the trial is
        suspended until it is stable again.
        """
        while self._watch.state != State.STABLE:
            self._attention.event(
                "suspended", f"{trial_id}: the bath left its band: {self._watch.why_not_stable}"
            )
            self._settle()
            self._attention.wait(self._rig.cameras.settle_s)
        self._states.to(RunState.RUNNING)

    def _capture_settled(self, trial_id: str) -> FrameSet:
        """Frames of a bath in its band, also where it leaves that while a camera lets us wait: they
        are taken again.

        A recording isn't asked twice; what the bath was then is in the trial's row.
        """
        while True:
            self._settle_again(trial_id)
            frames = self._capture()
            if self._watch.state == State.STABLE or self._rig.cameras.url.startswith("recording:"):
                return frames

    @property
    def _axes(self) -> str:
        """What of a pose the stage does; the operator does the rest."""
        return self._rig.stage.axes if self._devices.stage and self._rig.stage else ""

    def _move(self, trial: PlannedTrial) -> None:
        """By way of the place from which the pose is to be reached,
        where the script asks for one.
        """
        if not self._axes:
            return
        self._progress.state(f"moving the phantom: {trial.name}")
        for pose in (trial.approach, trial.pose):
            if pose is not None:
                self._move_to(shared(pose, self._axes)[0])

    def _move_to(self, pose: PlatePose) -> None:
        stage, there = self._devices.stage, self._rig.stage
        if stage is None or there is None:
            return
        self._attention.check()  # nothing moves any more once an interlock has tripped
        self._attention.long("moving the stage", 600.0)
        stage.move_to(**there.machine(pose), feed_mm_min=there.feed_mm_per_min)
        self._attention.check()

    def _before_another_try(self, seconds: float) -> None:
        self._attention.wait(seconds)
        self._attention.long("capturing again", 60.0, silent=True)

    def _capture(self) -> FrameSet:
        self._attention.check()
        self._progress.state("capturing")
        self._attention.long("capturing", 60.0, silent=True)
        try:
            return self._taker.take()
        finally:
            if self._taker.counts:
                self._store.fact("camera faults", dict(self._taker.counts))

    def _detect(self, frames: FrameSet) -> list[Answer]:
        answers: list[Answer] = []
        for detector in () if self.rehearsing else self._detectors:
            self._progress.state(f"detecting with {detector.name}")
            patience_s = (
                detector.patience_s
                if isinstance(detector, Served)
                else 2.0 * self._rig.limits.detection_timeout_s
            )
            self._attention.long(f"detecting with {detector.name}", 10.0 + patience_s, silent=True)
            answers.append(self._examiner.ask(detector, frames))
        return answers

    def _store_trial(
        self,
        head: Row,
        frames: FrameSet,
        rows: list[TruthRow],
        truth: TrialTruth,
        answers: list[Answer],
    ) -> None:
        self._attention.long("writing the trial", 60.0, silent=True)
        trial_id = str(head["id"])
        exact = self._exact_ends() if self._exact_ends else None
        ends = [None] * len(rows) if exact is None else list(exact)
        truth_rows = [
            truth_row(trial_id, row, end, point)
            for row, end, point in zip(rows, ends, truth.points, strict=True)
        ]
        detections, found, scores = judged(
            trial_id, answers, rows, self._script.visible_within_mm, self._script.time_limit_s
        )
        self._store.finished(
            FinishedTrial(
                head,
                frame_rows(self._store, trial_id, frames, answers),
                truth.touches,
                truth_rows,
                detections,
                found,
                scores,
            )
        )


def _suspended_told(seconds: float) -> str | None:
    """A note on time amid the trial that was no work."""
    return f"suspended for {seconds:.1f} s: the bath had left its band" if seconds > 0.0 else None

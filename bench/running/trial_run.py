"""One trial: settle, move, set up, capture, touch, detect, score, store. It is whole in the store, or not there at all.

May not know how a run begins and ends, nor which instruments are emulated.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bench.cameras.frame_taker import FrameTaker
from bench.detecting.examine import Answer, Examiner, TruthRow
from bench.devices import Devices
from bench.planning.trials import PlannedTrial, shared
from bench.rig import LoadedRig
from bench.rows import frame_rows, judged, truth_row
from bench.running.attention import Attention
from bench.running.run_state import RunState, RunStates
from bench.running.stability import State
from bench.script import Script
from bench.store import FinishedTrial, Row, Store
from bench.truth.choosing import shown
from bench.truth.point import How
from bench.truth.source import TrialTruth, TruthSource
from detector.protocol import Detector, Served
from instruments.camera.frame import FrameSet
from instruments.clock import wall_time
from instruments.errors import DeviceError
from instruments.world.phantom import PlatePose


class FrameSink(Protocol):
    """Who else wants each frame set with its truth: the writer of a recording. Truth that isn't ``confirmed`` may still be taken back."""

    def trial(self, trial_id: str, situation: str, frames: FrameSet, truth: Sequence[TruthRow], *, confirmed: bool) -> None: ...
    def settled(self, trials: Sequence[str], good: bool) -> None: ...


class TrialRun:
    """The trials of one run. ``exact_ends`` gives the scene's exact truth where there is one; it is kept aside, never scored against.

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
        self._taker = FrameTaker(devices.cameras, rig.rig.cameras, rig.calibration, self._before_another_try, attention.event)

    def run(self, trial: PlannedTrial) -> None:
        """From settling to the trial's rows. Raises what an instrument, an interlock or the operator raises; nothing is stored then."""
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
        placed = self._devices.operator.set_up(asked)
        self._attention.wait(self._rig.cameras.settle_s)
        frames = self._capture_settled(trial_id)
        captured_s = self._devices.clock.now()
        bath = self._watch.last
        bath_state = self._watch.state
        self._progress.state("taking the truth")
        truth = self._truth.of_trial(there)
        self._attention.check()
        answers = self._detect(frames)
        rows = [TruthRow(str(i), t.point_mm, placed.visible[i - 1], t.uncertainty.u_mm) for i, t in enumerate(truth.points, 1)]
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
            self._sink.trial(trial_id, trial.situation, frames, rows, confirmed=truth.how is How.TOUCHED)

    def look(self) -> None:
        """See whether the cameras work. Raises where they don't."""
        self._taker.look()

    def _settle(self) -> None:
        """Wait until the stability gate is open. Raises DeviceError where that takes longer than the script allows."""
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
                raise DeviceError("bath", why, hint="Check level, lid and pump, or allow more time in the script.")
        if waited:
            self._attention.event("stable", f"the bath is stable at {gate.set_point_c:g} degC")

    def _settle_again(self, trial_id: str) -> None:
        """Just before the cameras: where the bath has left its band meanwhile, the trial is suspended until it is stable again."""
        while self._watch.state != State.STABLE:
            self._attention.event("suspended", f"{trial_id}: the bath left its band: {self._watch.why_not_stable}")
            self._settle()
            self._attention.wait(self._rig.cameras.settle_s)
        self._states.to(RunState.RUNNING)

    def _capture_settled(self, trial_id: str) -> FrameSet:
        """Frames of a bath in its band, also where it leaves that while a camera lets us wait: they are taken again.

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
        """By way of the place from which the pose is to be reached, where the script asks for one."""
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
            patience_s = detector.patience_s if isinstance(detector, Served) else 2.0 * self._rig.limits.detection_timeout_s
            self._attention.long(f"detecting with {detector.name}", 10.0 + patience_s, silent=True)
            answers.append(self._examiner.ask(detector, frames))
        return answers

    def _store_trial(self, head: Row, frames: FrameSet, rows: list[TruthRow], truth: TrialTruth, answers: list[Answer]) -> None:
        self._attention.long("writing the trial", 60.0, silent=True)
        trial_id = str(head["id"])
        exact = self._exact_ends() if self._exact_ends else None
        ends = [None] * len(rows) if exact is None else list(exact)
        truth_rows = [truth_row(trial_id, row, end, point) for row, end, point in zip(rows, ends, truth.points, strict=True)]
        detections, found, scores = judged(trial_id, answers, rows, self._script.visible_within_mm, self._script.time_limit_s)
        self._store.finished(
            FinishedTrial(head, frame_rows(self._store, trial_id, frames, answers), truth.touches, truth_rows, detections, found, scores)
        )


def _suspended_told(seconds: float) -> str | None:
    """A note on time amid the trial that was no work."""
    return f"suspended for {seconds:.1f} s: the bath had left its band" if seconds > 0.0 else None

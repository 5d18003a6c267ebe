"""One trial: settle, move, set up, capture, touch, detect, score, store. It is whole in the store, or not there at all.

May not know how a run begins and ends, nor which instruments are emulated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bench.arm.tip import TipReader
from bench.attention import Attention
from bench.devices import Devices
from bench.examine import Answer, TruthRow, examine
from bench.rig import LoadedRig
from bench.rows import frame_rows, judged, truth_row
from bench.script import Script, Trial
from bench.stability import State
from bench.store import FinishedTrial, Row, Store
from bench.touching import touch_all
from bench.truth import TruthPoint
from detector.protocol import Detector
from instruments.camera.frame import FrameSet
from instruments.clock import wall_time
from instruments.errors import DeviceError, InstrumentError
from instruments.operators.operator import Arrangement


class FrameSink(Protocol):
    """Who else wants each frame set with its truth: the writer of a recording."""

    def trial(self, trial_id: str, situation: str, frames: FrameSet, truth: Sequence[TruthRow]) -> None: ...


class TrialRun:
    """The trials of one run. ``exact_ends`` gives the scene's exact truth where there is one; it is kept aside, never scored against."""

    def __init__(
        self,
        rig: LoadedRig,
        script: Script,
        devices: Devices,
        store: Store,
        detectors: Sequence[Detector],
        tip: TipReader,
        attention: Attention,
        *,
        exact_ends: Callable[[], NDArray[np.float64]] | None = None,
        sink: FrameSink | None = None,
    ) -> None:
        self._rig = rig.rig
        self._calibration = rig.calibration
        self._script = script
        self._devices = devices
        self._store = store
        self._detectors = detectors
        self._tip = tip
        self._attention = attention
        self._progress = attention.progress
        self._watch = attention.watch
        self._exact_ends = exact_ends
        self._sink = sink

    def run(self, number: int, trial: Trial, repeat: int) -> None:
        """From settling to the trial's rows. Raises what an instrument, an interlock or the operator raises; nothing is stored then."""
        started_s = self._devices.clock.now()
        trial_id = f"{number:03d}-{trial.name}-{repeat}"
        self._settle()
        self._move(trial)
        placed = self._devices.operator.set_up(self._arrangement(trial))
        self._attention.wait(self._rig.cameras.settle_s)
        frames = self._capture()
        captured_s = self._devices.clock.now()
        bath = self._watch.last
        bath_state = self._watch.state
        self._progress.state("touching the teat ends")
        truth, touches = touch_all(self._devices, self._tip, self._rig.arm, trial_id, len(placed.visible), self._attention.check)
        self._attention.check()
        answers = self._detect(frames)
        rows = [TruthRow(str(i), t.point_mm, placed.visible[i - 1], t.uncertainty.u_mm) for i, t in enumerate(truth, 1)]
        head: Row = {
            "id": trial_id,
            "number": number,
            "name": trial.name,
            "situation": trial.situation,
            "repeat": repeat,
            "started_s": started_s,
            "ended_s": self._devices.clock.now(),
            "captured_s": captured_s,
            "bath_c": bath.temp_c if bath else None,
            "bath_state": bath_state.value,
            "note": None,
            "wall_time": wall_time().isoformat(timespec="milliseconds"),
        }
        self._store_trial(head, frames, touches, rows, truth, answers)
        if self._sink:
            self._sink.trial(trial_id, trial.situation, frames, rows)

    def _settle(self) -> None:
        """Wait until the stability gate is open. Raises DeviceError where that takes longer than the script allows."""
        gate, start = self._script.bath, self._devices.clock.now()
        waited = False
        while self._watch.state != State.STABLE:
            waited = True
            self._attention.wait(1.0)
            if self._watch.last:
                self._progress.state(f"bath {self._watch.last.temp_c:.2f} degC, {self._watch.state.value}")
            if self._devices.clock.now() - start > gate.timeout_s:
                why = f"not stable within {gate.timeout_s:g} s: {self._watch.why_not_stable}"
                raise DeviceError("bath", why, hint="Check level, lid and pump, or allow more time in the script.")
        if waited:
            self._attention.event("stable", f"the bath is stable at {gate.set_point_c:g} degC")

    def _move(self, trial: Trial) -> None:
        stage = self._devices.stage
        if not stage or not self._rig.stage:
            return
        self._progress.state(f"moving the phantom: {trial.name}")
        self._attention.long("moving the stage", 600.0)
        (x, y), (dx, dy) = self._rig.stage.reference_mm, trial.stage_mm
        stage.move_to(x + dx, y + dy, feed_mm_min=self._rig.stage.feed_mm_per_min)
        self._attention.check()

    def _arrangement(self, trial: Trial) -> Arrangement:
        """What the operator sets up; without a stage that includes the phantom's place."""
        asked = trial.arrangement
        if self._devices.stage or trial.stage_mm == (0.0, 0.0):
            return asked
        dx, dy = trial.stage_mm
        return replace(asked, instruction=f"{asked.instruction} Move the plate to x {dx:+g} mm, y {dy:+g} mm from its reference place.")

    def _capture(self) -> FrameSet:
        self._attention.check()
        self._progress.state("capturing")
        self._attention.long("capturing", 60.0)
        frames = self._devices.cameras.capture()
        times = list(frames.exposed_s.values())
        skew_s = max(times) - min(times) if times else 0.0
        if skew_s > self._rig.cameras.max_skew_s:
            what = f"the frames of one set were exposed {skew_s:.3f} s apart, limit {self._rig.cameras.max_skew_s:g} s"
            raise InstrumentError("cameras", what, hint="Use a common trigger, or allow more skew in the rig file if nothing moves.")
        return frames

    def _detect(self, frames: FrameSet) -> list[Answer]:
        answers = []
        for detector in self._detectors:
            self._progress.state(f"detecting with {detector.name}")
            self._attention.long(f"detecting with {detector.name}", 10.0 + 2.0 * self._rig.limits.detection_timeout_s)
            answers.append(examine(detector, frames, self._calibration))
        return answers

    def _store_trial(
        self, head: Row, frames: FrameSet, touches: list[Row], rows: list[TruthRow], truth: list[TruthPoint], answers: list[Answer]
    ) -> None:
        self._attention.long("writing the trial", 60.0)
        trial_id = str(head["id"])
        exact = self._exact_ends() if self._exact_ends else None
        truth_rows = [truth_row(trial_id, row, None if exact is None else exact[int(row.teat) - 1]) for row in rows]
        detections, found, scores = judged(trial_id, answers, rows, self._script.visible_within_mm, self._script.time_limit_s)
        self._store.finished(
            FinishedTrial(head, frame_rows(self._store, trial_id, frames, answers), touches, truth_rows, detections, found, scores)
        )
        self._store.fact("truth budget", truth[-1].uncertainty.as_dict() if truth else None)

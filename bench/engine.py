"""Runs a script on a rig: prepare, settle, and for each trial set up, capture, touch, detect, score, store.

Every way out passes through safe. What the engine may not know: which instruments are emulated, who the operator
is, and what the report will say.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bench.arm.check import AFTER, BEFORE, CHECK_FACT, check_arm, told
from bench.arm.facts import write_arm_facts
from bench.arm.tip import TipReader
from bench.devices import Devices
from bench.examine import Answer, TruthRow, examine
from bench.exits import current, undisturbed
from bench.interlocks import InterlockTrip
from bench.keeper import Keeper
from bench.lifeline import Lifeline
from bench.pulse import AwaitedOperator, Pulse
from bench.rig import LoadedRig
from bench.rows import frame_rows, judged, truth_row
from bench.safing import start_bath
from bench.script import LoadedScript, Trial
from bench.showing import Progress, Unfailing
from bench.stability import StabilityGate, State
from bench.store import FinishedTrial, Row, Store
from bench.touching import touch_all
from bench.truth import TruthPoint
from detector.protocol import Detector
from instruments.camera.frame import FrameSet
from instruments.clock import wall_time
from instruments.errors import DeviceError, InstrumentError
from instruments.operators.operator import Arrangement, OperatorAbort

HOMING = "Put the arm's stylus on its peg, switch the arm on, and leave the stylus there."
LOOK_S = 1.0


class Ending(StrEnum):
    """How a run ended."""

    FINISHED = "finished"
    ABORTED = "aborted"
    FAULTED = "faulted"


class FrameSink(Protocol):
    """Who else wants each frame set with its truth: the writer of a recording."""

    def trial(self, trial_id: str, situation: str, frames: FrameSet, truth: Sequence[TruthRow]) -> None: ...


class Engine:
    """One run. ``exact_ends`` gives the scene's exact truth where there is one; it is kept aside, never scored against.

    ``pulse`` gets signs of life, ``lifeline`` is the guardian that looks at them where there is one.
    """

    def __init__(
        self,
        rig: LoadedRig,
        script: LoadedScript,
        devices: Devices,
        store: Store,
        detectors: Sequence[Detector],
        progress: Progress,
        *,
        exact_ends: Callable[[], NDArray[np.float64]] | None = None,
        sink: FrameSink | None = None,
        pulse: Pulse | None = None,
        lifeline: Lifeline | None = None,
    ) -> None:
        self._pulse = pulse or Pulse()
        self._rig = rig.rig
        self._calibration = rig.calibration
        self._script = script.script
        self._devices = replace(devices, operator=AwaitedOperator(devices.operator, self._pulse))
        self._store = store
        self._detectors = detectors
        self._progress = Unfailing(progress)
        self._tip = TipReader(devices.arm, rig.rig.arm, rig.frame)
        self._loaded = rig
        self._exact_ends = exact_ends
        self._sink = sink
        gate = self._script.bath
        limits = gate.model_dump(include={"set_point_c", "window_s", "mean_k", "half_range_k", "slope_k_per_min", "leave_k"})
        self._keeper = Keeper(rig, devices, StabilityGate(**limits), store, self._progress, self._pulse, lifeline)
        self._watch = self._keeper.watch
        self.bath_is_safe = False  # until the run has ended and made it so

    def run(self) -> Ending:
        """Everything, to the end or to safe. Faults of instruments and aborts are in the record, not raised."""
        exits, ending = current(), Ending.FAULTED
        exits.at_close = self._keeper.heater_off
        try:
            self._work()
        except BaseException as why:
            exits.hold()
            ending = self._ended_by(why)
        else:
            exits.hold()
            ending = Ending.FINISHED
        finally:  # from here nobody can be raised amid: each way in has called hold, or has just been raised itself
            with undisturbed():
                ending = self._finish(ending)
            exits.let_go()
            exits.at_close = None
        return ending

    def _work(self) -> None:
        self._prepare()
        planned = self._script.planned
        for number, (trial, repeat) in enumerate(planned, 1):
            self._progress.trial(number - 1, len(planned), trial.name)
            self._run_trial(number, trial, repeat)
        self._progress.trial(len(planned), len(planned), "")
        self._check_arm(AFTER)

    def _ended_by(self, why: BaseException) -> Ending:
        """The ending that ``why`` means, written down; raises it again when it is a mistake of the bench."""
        if isinstance(why, KeyboardInterrupt | OperatorAbort) and self._watch.tripped is None:
            self._event("aborted", str(why) or "the run was interrupted (Ctrl-C)")
            return Ending.ABORTED
        cause = self._watch.tripped or why  # a braked stage or an impatient operator may have come first
        if not isinstance(cause, InstrumentError | InterlockTrip):
            self._event("fault", f"a mistake of the bench: {type(cause).__name__}: {cause}")
            raise cause
        self._event("fault", str(cause))
        return Ending.FAULTED

    def _prepare(self) -> None:
        d = self._devices
        self._note("preparing")
        self._watch.start()
        self._long("signing on to the arm", 120.0)
        d.arm.sign_on()
        write_arm_facts(self._store, self._loaded)
        self._tip.refuse_other_arm()
        d.operator.confirm_homing(HOMING)
        d.arm.confirm_homed()
        self._check_arm(BEFORE)
        self._check()
        if d.stage:
            self._long("homing the stage", 600.0)
            d.stage.connect()
            d.stage.home()
            self._check()
        self._store.fact("identities", d.identities())
        self._store.fact("arm record", d.arm.record())
        self._note(f"heating the bath to {self._script.bath.set_point_c:g} degC")
        self._long("starting the bath", 60.0)
        start_bath(d.bath, self._script.bath.set_point_c, self._wait)
        self._watch.heating()

    def _finish(self, ending: Ending) -> Ending:
        """To safe first, whatever the disk, the terminal and the watch do."""
        self._long("going to safe", 300.0)
        told: list[str] = []
        asked = len(current().asked)
        self._watch.end()
        unsafe = self._devices.make_safe(told.append, lambda: len(current().asked) > asked)
        self.bath_is_safe = "bath" not in unsafe
        self._keeper.stop()
        if unsafe:
            self._progress.warn(f"NOT SAFE: {', '.join(unsafe)}. {' '.join(told)} SWITCH IT OFF BY HAND.")
        for text in told:
            self._event("safe", text)
        if unsafe and ending is Ending.FINISHED:
            ending = Ending.FAULTED
        self._event("end", ending.value)
        self._store.fact("ending", ending.value)
        self._store.fact("wall_ended", wall_time().isoformat(timespec="seconds"))
        self._store.flush()
        return ending

    def _run_trial(self, number: int, trial: Trial, repeat: int) -> None:
        started_s = self._devices.clock.now()
        trial_id = f"{number:03d}-{trial.name}-{repeat}"
        self._settle()
        self._move(trial)
        placed = self._devices.operator.set_up(self._arrangement(trial))
        self._wait(self._rig.cameras.settle_s)
        frames = self._capture()
        captured_s = self._devices.clock.now()
        bath = self._watch.last
        bath_state = self._watch.state
        self._progress.state("touching the teat ends")
        truth, touches = touch_all(self._devices, self._tip, self._rig.arm, trial_id, len(placed.visible), self._check)
        self._check()
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

    def _check_arm(self, when: str) -> None:
        """Touch the rig's check point, where it names one; what was found is a fact for the script's requirement."""
        arm, d = self._rig.arm, self._devices
        if arm.check_point_mm is None:
            return
        self._progress.state(f"checking the arm {when} the trials")
        fact = check_arm(d.operator, self._tip, arm, d.clock, self._check)
        self._store.fact(CHECK_FACT.format(when), fact)
        self._event("arm", told(fact, when))

    def _settle(self) -> None:
        """Wait until the stability gate is open. Raises DeviceError where that takes longer than the script allows."""
        gate, start = self._script.bath, self._devices.clock.now()
        waited = False
        while self._watch.state != State.STABLE:
            waited = True
            self._wait(1.0)
            if self._watch.last:
                self._progress.state(f"bath {self._watch.last.temp_c:.2f} degC, {self._watch.state.value}")
            if self._devices.clock.now() - start > gate.timeout_s:
                why = f"not stable within {gate.timeout_s:g} s: {self._watch.why_not_stable}"
                raise DeviceError("bath", why, hint="Check level, lid and pump, or allow more time in the script.")
        if waited:
            self._event("stable", f"the bath is stable at {gate.set_point_c:g} degC")

    def _move(self, trial: Trial) -> None:
        stage = self._devices.stage
        if not stage or not self._rig.stage:
            return
        self._progress.state(f"moving the phantom: {trial.name}")
        self._long("moving the stage", 600.0)
        (x, y), (dx, dy) = self._rig.stage.reference_mm, trial.stage_mm
        stage.move_to(x + dx, y + dy, feed_mm_min=self._rig.stage.feed_mm_per_min)
        self._check()

    def _arrangement(self, trial: Trial) -> Arrangement:
        """What the operator sets up; without a stage that includes the phantom's place."""
        asked = trial.arrangement
        if self._devices.stage or trial.stage_mm == (0.0, 0.0):
            return asked
        dx, dy = trial.stage_mm
        return replace(asked, instruction=f"{asked.instruction} Move the plate to x {dx:+g} mm, y {dy:+g} mm from its reference place.")

    def _capture(self) -> FrameSet:
        self._check()
        self._progress.state("capturing")
        self._long("capturing", 60.0)
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
            self._long(f"detecting with {detector.name}", 10.0 + 2.0 * self._rig.limits.detection_timeout_s)
            answers.append(examine(detector, frames, self._calibration))
        return answers

    def _store_trial(
        self, head: Row, frames: FrameSet, touches: list[Row], rows: list[TruthRow], truth: list[TruthPoint], answers: list[Answer]
    ) -> None:
        self._long("writing the trial", 60.0)
        trial_id = str(head["id"])
        exact = self._exact_ends() if self._exact_ends else None
        truth_rows = [truth_row(trial_id, row, None if exact is None else exact[int(row.teat) - 1]) for row in rows]
        detections, found, scores = judged(trial_id, answers, rows, self._script.visible_within_mm, self._script.time_limit_s)
        self._store.finished(
            FinishedTrial(head, frame_rows(self._store, trial_id, frames, answers), touches, truth_rows, detections, found, scores)
        )
        self._store.fact("truth budget", truth[-1].uncertainty.as_dict() if truth else None)

    def _wait(self, seconds: float) -> None:
        """Let time pass, with a look at the interlocks every second."""
        end_s = self._devices.clock.now() + seconds
        self._check()
        while (left_s := end_s - self._devices.clock.now()) > 0.0:
            self._devices.clock.sleep(min(LOOK_S, left_s))
            self._check()

    def _check(self) -> None:
        self._pulse.sign("going on")
        self._watch.check()

    def _long(self, what: str, at_most_s: float) -> None:
        """The guardian may take the bench for hung only when ``what`` takes longer than ``at_most_s``."""
        self._pulse.sign(what, at_most_s)

    def _note(self, text: str) -> None:
        self._progress.state(text)
        self._event("state", text)

    def _event(self, kind: str, text: str) -> None:
        self._store.event(self._devices.clock.now(), kind, text, wall_time())

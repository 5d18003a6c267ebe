"""Runs a script on a rig: prepare, settle, and for each trial set up, capture, touch, detect, score, store.

Every way out passes through safe. What the engine may not know: which instruments are emulated, who the operator
is, and what the report will say.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from bench.arm.check import AFTER, BEFORE, CHECK_FACT, check_arm, told
from bench.arm.facts import write_arm_facts
from bench.arm.tip import TipReader
from bench.attempts import Attempts
from bench.attention import Attention
from bench.devices import Devices
from bench.exits import current, undisturbed
from bench.interlocks import InterlockTrip
from bench.keeper import Keeper
from bench.lifeline import Lifeline
from bench.pulse import AwaitedOperator, Pulse
from bench.rig import LoadedRig
from bench.safing import start_bath
from bench.script import LoadedScript
from bench.showing import Progress, Unfailing
from bench.stability import StabilityGate
from bench.store import Store
from bench.trial_run import FrameSink, TrialRun
from bench.truth.choosing import choose_truth
from detector.protocol import Detector
from instruments.clock import wall_time
from instruments.errors import InstrumentError
from instruments.operators.operator import OperatorAbort, OperatorRepeat, OperatorSkip

HOMING = "Put the arm's stylus on its peg, switch the arm on, and leave the stylus there."


class Ending(StrEnum):
    """How a run ended."""

    FINISHED = "finished"
    ABORTED = "aborted"
    FAULTED = "faulted"


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
        pulse = pulse or Pulse()
        self._loaded = rig
        self._script = script.script
        self._planned = script.planned
        self._devices = replace(devices, operator=AwaitedOperator(devices.operator, pulse))
        self._store = store
        self._progress = Unfailing(progress)
        self._tip = TipReader(devices.arm, rig.rig.arm, rig.frame)
        gate = self._script.bath
        limits = gate.model_dump(include={"set_point_c", "window_s", "mean_k", "half_range_k", "slope_k_per_min", "teat_slope_k_per_min", "leave_k"})
        self._keeper = Keeper(rig, devices, StabilityGate(**limits), store, self._progress, pulse, lifeline)
        self._watch = self._keeper.watch
        self._attention = Attention(devices, store, self._progress, pulse, self._watch)
        settled = sink.settled if sink else lambda _trials, _good: None
        self._truth = choose_truth(rig, script, self._devices, self._tip, store, self._attention, settled)
        self._trials = TrialRun(
            rig, script.script, self._devices, store, detectors, self._truth, self._attention, exact_ends=exact_ends, sink=sink
        )
        self._attempts = Attempts(self._trials.run, len(self._planned), self._devices.operator, devices.clock, store, self._attention)
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
        self._truth.begin()
        planned = self._planned
        for trial in planned:
            self._progress.trial(trial.number - 1, len(planned), trial.name)
            self._attempts.run(trial)
        self._progress.trial(len(planned), len(planned), "")
        self._truth.end()
        self._check_arm(AFTER)
        self._devices.operator.finish()

    def _ended_by(self, why: BaseException) -> Ending:
        """The ending that ``why`` means, written down; raises it again when it is a mistake of the bench."""
        if isinstance(why, KeyboardInterrupt | OperatorAbort | OperatorSkip | OperatorRepeat) and self._watch.tripped is None:
            self._attention.event("aborted", str(why) or "the run was interrupted (Ctrl-C)")
            return Ending.ABORTED
        cause = self._watch.tripped or why  # a braked stage or an impatient operator may have come first
        if not isinstance(cause, InstrumentError | InterlockTrip):
            self._attention.event("fault", f"a mistake of the bench: {type(cause).__name__}: {cause}")
            raise cause
        self._attention.event("fault", str(cause))
        return Ending.FAULTED

    def _prepare(self) -> None:
        d = self._devices
        self._attention.note("preparing")
        self._watch.start()
        d.operator.heed(self._watch.check)
        self._attention.long("signing on to the arm", 120.0)
        d.arm.sign_on()
        write_arm_facts(self._store, self._loaded)
        self._tip.refuse_other_arm()
        d.operator.confirm_homing(HOMING)
        d.arm.confirm_homed()
        self._check_arm(BEFORE)
        self._attention.check()
        if d.stage:
            self._attention.long("homing the stage", 600.0)
            d.stage.connect()
            d.stage.home()
            self._attention.check()
        self._store.fact("identities", d.identities())
        self._store.fact("arm record", d.arm.record())
        self._attention.note(f"heating the bath to {self._script.bath.set_point_c:g} degC")
        self._attention.long("starting the bath", 60.0)
        start_bath(d.bath, self._script.bath.set_point_c, self._attention.wait)
        self._watch.heating()

    def _finish(self, ending: Ending) -> Ending:
        """To safe first, whatever the disk, the terminal and the watch do."""
        self._attention.long("going to safe", 300.0)
        told: list[str] = []
        asked = len(current().asked)
        self._watch.end()
        unsafe = self._devices.make_safe(told.append, lambda: len(current().asked) > asked)
        self.bath_is_safe = "bath" not in unsafe
        self._keeper.stop()
        if unsafe:
            self._progress.warn(f"NOT SAFE: {', '.join(unsafe)}. {' '.join(told)} SWITCH IT OFF BY HAND.")
        for text in told:
            self._attention.event("safe", text)
        if unsafe and ending is Ending.FINISHED:
            ending = Ending.FAULTED
        self._attention.event("end", ending.value)
        self._store.fact("ending", ending.value)
        self._store.fact("wall_ended", wall_time().isoformat(timespec="seconds"))
        self._store.flush()
        return ending

    def _check_arm(self, when: str) -> None:
        """Touch the rig's check point, where it names one; what was found is a fact for the script's requirement."""
        arm, d = self._loaded.rig.arm, self._devices
        if arm.check_point_mm is None:
            return
        self._progress.state(f"checking the arm {when} the trials")
        fact = check_arm(d.operator, self._tip, arm, d.clock, self._attention.check)
        self._store.fact(CHECK_FACT.format(when), fact)
        self._attention.event("arm", told(fact, when))

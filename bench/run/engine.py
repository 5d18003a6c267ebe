"""Runs a script on a rig: prepare, settle, and for each trial set up, capture, touch, detect,
score, store.

Every way out passes through safe. What the engine may not know: which instruments are emulated, who
the operator is, and what the report will say.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import StrEnum
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bench.record.writer import FolderGoneError, Store
from bench.rig.devices import Devices
from bench.rig.loading import LoadedRig
from bench.run.context import Attention
from bench.run.estimate import TimeEstimate, gate_of
from bench.run.lock import Reserve
from bench.run.preparation import Preparation
from bench.run.progress import Progress, SafeProgress, WatchedProgress
from bench.run.recovery import Recovery
from bench.run.requests import Pause, Requests
from bench.run.resume import RehearsedStore, ResumePoint
from bench.run.states import EVENT, RunState, RunStates
from bench.run.trial import Attempts, FrameSink, TrialRun
from bench.run.truth_source import choose_truth
from bench.safety.bath_monitor import TripHandler
from bench.safety.guardian_client import GuardianClient
from bench.safety.heartbeat import AwaitedOperator, Heartbeat
from bench.safety.interlocks import InterlockTrip
from bench.safety.signals import current, undisturbed
from bench.script.model import LoadedScript
from bench.script.planned_trials import PlannedTrial
from bench.truth.arm_check import AFTER
from bench.truth.arm_tip import TipReader
from detector.protocol import Detector
from instruments.clock import wall_time
from instruments.errors import InstrumentError
from instruments.operators.operator import (
    Finish,
    OperatorAbort,
    OperatorRepeat,
    OperatorSkip,
    time_left,
)

RECORD_FAULTS = (sqlite3.Error, OSError)


class Ending(StrEnum):
    """How a run ended."""

    FINISHED = "finished"
    ABORTED = "aborted"
    FAULTED = "faulted"


class Engine:
    """One run. ``exact_ends`` gives the scene's exact truth where there is one; it is kept aside,
    never scored against.

    ``pulse`` gets signs of life, ``lifeline`` is the guardian that looks at them where there is
    one. ``left`` is what the run's last session left, where it goes on; ``typed`` gives lines that
    somebody typed, None while there is none; ``expected`` is how long it takes.
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
        pulse: Heartbeat | None = None,
        guardian_client: GuardianClient | None = None,
        left: ResumePoint | None = None,
        typed: Callable[[], str | None] = lambda: None,
        expected: TimeEstimate | None = None,
    ) -> None:
        pulse = pulse or Heartbeat()
        self._script = script.script
        self._planned = script.planned
        self._left = left
        self._rehearsed = store if isinstance(store, RehearsedStore) else None
        self._devices = replace(devices, operator=AwaitedOperator(devices.operator, pulse))
        self._store = store
        self._progress = SafeProgress(progress, self._not_shown)
        tip = TipReader(devices.arm, rig.rig.arm, rig.frame)
        self._expected = expected
        self._trip_handler = TripHandler(
            rig, devices, gate_of(script), store, self._progress.warn, pulse, guardian_client
        )
        self._watch = self._trip_handler.watch
        self._attention = Attention(devices, store, self._progress, pulse, self._watch)
        if isinstance(progress, WatchedProgress):
            progress.fed_by(devices.clock.now, self._live, self._not_shown)
            self._attention.subscribe(progress.event)
            self._trip_handler.heard, self._trip_handler.seen = progress.event, progress.refresh
        self.states = RunStates(self._tell_state, devices.clock.now)
        self.recovery = Recovery(
            self._devices,
            self._attention,
            self.states,
            rig.rig.limits.away_s,
            lambda: self._trials.look(),
        )
        self._wishes = Requests(store.folder, typed, self._progress.warn)
        settled = sink.settled if sink else lambda _trials, _good: None
        before = left.run if left and not self._rehearsed else None
        self._truth = choose_truth(
            rig, script, self._devices, tip, store, self._attention, settled, before=before
        )
        self._trials = TrialRun(
            rig, script.script, self._devices, store, detectors, self._truth, self._attention,
            exact_ends=exact_ends, sink=sink, states=self.states,
        )  # fmt: skip
        self._attempts = Attempts(
            self._trials.run,
            len(self._planned),
            self._devices.operator,
            devices.clock,
            store,
            self._attention,
            through=self.recovery.run,
            away_s=lambda: self.states.away_s,
            poison=left.poison if left else {},
            each_s=expected.each_s(len(self._planned)) if expected else None,
        )
        session = store.session if left and not self._rehearsed else 1
        self._preparation = Preparation(
            rig, script.script, self._devices, store, tip, self._attention, self.recovery, session
        )
        self._pause = Pause(self._wishes, self.states, self._attention, devices.clock, store.folder)
        self._reserve = Reserve(store.folder)
        self.bath_is_safe = False  # until the run has ended and made it so

    def run(self) -> Ending:
        """Everything, to the end or to safe. Faults of instruments and aborts are in the record,
        not raised.
        """
        exits, ending = current(), Ending.FAULTED
        exits.at_close = self._trip_handler.heater_off
        try:
            self._reserve.keep()
            self._work()
        except BaseException as why:
            exits.hold()
            ending = self._ended_by(why)
        else:
            exits.hold()
            ending = Ending.FINISHED
        # from here nobody can be raised amid: each way in has called hold, or has just been raised
        # itself
        finally:
            with undisturbed():
                ending = self._finish(ending)
            exits.let_go()
            exits.at_close = None
        return ending

    def _work(self) -> None:
        self._wishes.forget()
        self._attention.check_interrupts = self._wishes.look_between
        self.states.to(RunState.PREPARING)
        self._preparation.run()
        self.recovery.run("preparing the truth", self._truth.begin)
        for trial in self._planned:
            self._progress.trial(trial.number - 1, len(self._planned), trial.name)
            self._one(trial)
        self._go_live()  # where all trials had their result, and only the end was missing
        self._progress.trial(len(self._planned), len(self._planned), "")
        self.recovery.run("confirming the truth", self._truth.end)
        self.recovery.run(
            "the arm check after the trials", lambda: self._preparation.check_arm(AFTER)
        )
        self._devices.operator.ask(Finish())

    def _one(self, trial: PlannedTrial) -> None:
        """A trial as it is due: run, gone through again, or passed over since it has its result."""
        if self._left and trial.id in self._left.done:
            if self._rehearsed and trial.id not in self._left.poison:
                self._trials.rehearsing = True
                self._attempts.run(trial)
            else:
                self._attempts.passed()
            return
        self._go_live()
        self._pause.if_asked()
        self._attention.check_interrupts = self._wishes.look
        self._attempts.run(trial)
        self._attention.check_interrupts = self._wishes.look_between

    def _go_live(self) -> None:
        """The first trial without a result is next: from here on all is new, and on record."""
        left, self._left = self._left, None
        self._trials.rehearsing = False
        if left is None:
            return
        told = f"session {self._store.session} goes on after {len(left.done)} trials"
        if self._rehearsed:
            self._rehearsed.go_live()
            seen = self._rehearsed.compared
            told += (
                f", gone through again on the emulated rig: {len(seen.same)} with the same touches"
            )
            if seen.differ:
                self._progress.warn(
                    "The emulated world is not the one that the run began in: touches differ in"
                    f" {', '.join(seen.differ)}."
                )
                told += (
                    f", other touches in {', '.join(seen.differ)}: WHAT FOLLOWS IS NOT WHAT AN"
                    " UNDISTURBED RUN WOULD GIVE"
                )
            self._attention.event(EVENT, self.states.current.value)
        self._attention.event("resumed", told)

    def _live(self) -> dict[str, str]:
        """What a line in the terminal says beside what is being done."""
        bath, left_s = self._watch.last, self._attempts.left_s
        if left_s is not None:
            left_s += self._watch.stable_in_s(self._expected.settling_s if self._expected else 0.0)
        told = (
            {}
            if bath is None
            else {"bath": f"bath {bath.temp_c:.2f} degC, {self._watch.state.value}"}
        )
        return told | ({} if left_s is None else {"left": time_left(left_s)})

    def _not_shown(self, why: str) -> None:
        """Whoever looks for what the screen had to say finds why it said nothing."""
        self._kept(lambda: self._attention.event("not shown", why))

    def _tell_state(self, state: RunState) -> None:
        self._attention.event(EVENT, state.value)

    def _ended_by(self, why: BaseException) -> Ending:
        """The ending that ``why`` means, written down; raises it again when it is a mistake of the
        bench.
        """
        self._reserve.give_back()
        if self._rehearsed:
            self._rehearsed.go_live()
        if (
            isinstance(why, KeyboardInterrupt | OperatorAbort | OperatorSkip | OperatorRepeat)
            and self._watch.tripped is None
        ):
            self._write_down("aborted", str(why) or "the run was interrupted (Ctrl-C)")
            return Ending.ABORTED
        # a braked stage or an impatient operator may have come first
        cause = self._watch.tripped or why
        if isinstance(cause, FolderGoneError):  # there is nothing that a report could be made of
            self._write_down("fault", str(cause))
            raise cause
        if isinstance(cause, RECORD_FAULTS):
            then = (
                "Make room or make the folder writable, then: teatbench resume"
                f" {self._store.folder}"
            )
            self._write_down(
                "fault",
                f"the record could not be written: {type(cause).__name__}: {cause}. {then}",
                aloud=True,
            )
            return Ending.FAULTED
        if not isinstance(cause, InstrumentError | InterlockTrip):
            self._write_down("fault", f"a mistake of the bench: {type(cause).__name__}: {cause}")
            raise cause
        self._write_down("fault", str(cause))
        return Ending.FAULTED

    def _finish(self, ending: Ending) -> Ending:
        """To safe first, whatever the disk, the terminal and the watch do."""
        self._reserve.give_back()
        self._attention.check_interrupts = lambda: None
        self._attention.long("going to safe", 300.0)
        told: list[str] = []
        asked = len(current().asked)
        self._watch.end()
        unsafe = self._devices.make_safe(told.append, lambda: len(current().asked) > asked)
        self.bath_is_safe = "bath" not in unsafe
        self._trip_handler.stop()
        if unsafe:
            self._progress.warn(
                f"NOT SAFE: {', '.join(unsafe)}. {' '.join(told)} SWITCH IT OFF BY HAND."
            )
        for text in told:
            self._write_down("safe", text)
        if unsafe and ending is Ending.FINISHED:
            ending = Ending.FAULTED
        self._end_states(ending)
        self._write_down("end", ending.value)
        self._kept(lambda: self._store.fact("retries", dict(self.recovery.counts)))
        self._kept(lambda: self._store.fact("ending", ending.value))
        self._kept(
            lambda: self._store.fact("wall_ended", wall_time().isoformat(timespec="seconds"))
        )
        self._kept(self._store.flush)
        return ending

    def _end_states(self, ending: Ending) -> None:
        for state in (RunState.SAFING, RunState(ending.value)):
            self._kept(partial(self.states.to, state))

    def _write_down(self, kind: str, text: str, *, aloud: bool = False) -> None:
        """An event, of which the run's end doesn't depend on whether it can be written."""
        if not self._kept(lambda: self._attention.event(kind, text)) or aloud:
            self._progress.warn(text)

    def _kept(self, write: Callable[[], None]) -> bool:
        try:
            write()
        except RECORD_FAULTS:
            return False
        return True

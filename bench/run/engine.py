"""Runs a script on a rig: prepare, each trial, the ends; every way out passes through safe."""

from __future__ import annotations

import sqlite3
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import KW_ONLY, asdict, dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.files import UNWRITTEN, unwritten
from bench.record.state import TRIP
from bench.record.writer import FolderGoneError
from bench.results.headline import MISTAKE, cure_of
from bench.results.stated_arm import unmoved_mm
from bench.results.status import ALL_SAFE, INSTRUMENTS_FACT
from bench.rig.by_hand import not_safe_text
from bench.rig.frame_capture import FRAMES_FACT
from bench.run.context import LOOK_S, RunContext
from bench.run.estimate import TimeEstimate
from bench.run.events import EVENT, FAILURES, NOT_SAFE, RunState
from bench.run.interruptions import Recovery, Requests
from bench.run.recordings import Recorder
from bench.run.reserve import Reserve
from bench.run.resume import RehearsedStore, ResumePoint
from bench.run.rows import write_arm_facts
from bench.run.trial import Attempts, TrialRun, choose_truth
from bench.safety.interlocks import InterlockTrip
from bench.safety.signals import current, in_own_thread, undisturbed
from bench.script.planned_trials import PlannedTrial
from bench.truth.arm_check import (
    AFTER,
    AMID,
    BEFORE,
    CHECK_FACT,
    check_arm,
    check_text,
    moved_mm,
)
from detector.protocol import Detector
from instruments.bath.sequence import start_bath
from instruments.clock import wall_time
from instruments.drivers.protocols import Stage
from instruments.errors import InstrumentError
from instruments.operators.operator import (
    Finish,
    Homing,
    OperatorAbort,
    OperatorRepeat,
    OperatorSkip,
)
from textfiles.text import named, plural

RECORD_FAULTS = (sqlite3.Error, OSError)
TRACEBACK = "mistake.txt"
BETWEEN_S = 120.0  # between two scripts of a queue, before the guardian takes the bench for hung
HOMED_AGAIN = "The arm was homed again. This touch shows whether those before still count."
HOME_RIGHT = (
    "Was its stylus on its peg? Where arm and table stand as before, end the run and resume."
)
STAYS_WARM = "nothing was made safe: the rig stays open, heated and watched for the next script"
REQUESTS = (KeyboardInterrupt, OperatorAbort, OperatorSkip, OperatorRepeat)


@dataclass(eq=False)
class Engine:
    """One run. ``exact_ends``: the scene's exact truth, never scored against; ``left``: of the last
    session; ``typed`` gives typed lines; ``expected``: how long it takes; ``more``: another script
    follows on this rig, which stays warm where this one finishes; ``between`` two trials gets how
    many have passed, and of how many.
    """

    context: RunContext
    detectors: Sequence[Detector]
    _: KW_ONLY
    exact_ends: Callable[[], NDArray[np.float64]] | None = None
    recorder: Recorder | None = None
    left: ResumePoint | None = None
    typed: Callable[[], str | None] = lambda: None
    expected: TimeEstimate | None = None
    more: bool = False
    between: Callable[[int, int], None] = lambda *_: None

    def __post_init__(self) -> None:
        ctx, left, recorder, expected = self.context, self.left, self.recorder, self.expected
        self.is_warm = False  # ended, with the rig open, heated and watched
        store = ctx.store
        planned = len(ctx.script.planned)
        self._rehearsed = store if isinstance(store, RehearsedStore) else None
        goes_on = left is not None and not self._rehearsed
        self._session = store.session if goes_on else 1
        self._requests = Requests(store.folder, self.typed, ctx.events.warn)
        settled = recorder.settled if recorder else lambda _trials, _good: None
        before = left.run if left and goes_on else None
        self._truth = choose_truth(ctx, settled, before=before)
        self._trials = TrialRun(ctx, self.detectors, self._truth, self.exact_ends, recorder, before)
        self._trials.check_homing = self._check_homing
        self._recovery = Recovery(ctx, self._trials.look)
        self._attempts = Attempts(
            ctx,
            self._trials.run,
            self._recovery.run,
            left.poison if left else {},
            expected.each_s(planned) if expected else None,
            lambda: ctx.watch.stable_in_s(self._settling_s),
        )
        self._attempts.done = len(left.done) if left and goes_on else 0
        self._reserve = Reserve(store.folder)
        self._ended = False
        self.mistaken = False  # ended by an error that a driver's thread may raise again
        self._checked: dict[str, Any] | None = None  # the arm, before the trials of this session
        self.bath_is_safe = False  # until the run has ended and made it so
        ctx.under_test = [one.name for one in self.detectors]
        ctx.progress = self._progress
        # for a person who looks for what the screen had to show
        ctx.events.not_shown = partial(self._kept, ctx.event, "not shown")
        if left:
            ctx.events.state(text := f"{plural(len(left.done), 'trial')} done before")
            ctx.events.replaying = f"{text}, gone through again" if self._rehearsed else ""

    def run(self) -> RunState:
        """Everything, to the end or to safe. Faults of instruments and aborts are recorded."""
        exits, ending = current(), RunState.FAULTED
        exits.at_close = self.context.trips.heater_off
        try:
            self._reserve.keep()
            self._work()
        except BaseException as why:
            exits.hold()
            ending = self._ended_by(why)
        else:
            exits.hold()
            ending = RunState.FINISHED
        finally:  # no request is raised from here on: each way in has called hold
            with undisturbed():
                finish = partial(self._finish, ending)
                ending = in_own_thread(finish) if self.mistaken else finish()
            exits.let_go()
            exits.at_close = self.context.trips.heater_off if self.is_warm else None
        return ending

    def let_go(self) -> None:
        """Make safe what the run left warm, since none follows."""
        with undisturbed():
            self.is_warm = False
            if unsafe := self._make_safe()[1]:
                self.context.events.warn(not_safe_text(unsafe))
                self.context.events.notify(NOT_SAFE)
        current().at_close = None

    def _make_safe(self) -> tuple[list[str], Mapping[str, str]]:
        """Bath, stage, arm and pump: what they said, and which are not safe."""
        ctx, said, asked = self.context, list[str](), len(current().asked)
        ctx.trips.end()
        unsafe = ctx.devices.make_safe(said.append, lambda: len(current().asked) > asked)
        self.bath_is_safe = "bath" not in unsafe
        ctx.trips.stop()
        return said, unsafe

    def _work(self) -> None:
        ctx, planned, again = self.context, self.context.script.planned, self._recovery.run
        set_point_c = ctx.script.script.bath.set_point_c
        ctx.check_interrupts = self._requests.look_between
        ctx.states.to(RunState.PREPARING)
        ctx.note("preparing")
        self._take_over()
        again("signing on to the arm", self._sign_on)
        again("the arm check", lambda: self._check_arm(BEFORE))
        ctx.check()
        if (stage := ctx.devices.stage) and not (ctx.before and stage.homed):
            again("homing the stage", lambda: self._home(stage))
        self._fact("identities", ctx.devices.identities())
        self._fact("arm record", ctx.devices.arm.record())
        ctx.note(f"heating the bath to {set_point_c:g} degC")

        def start() -> None:
            ctx.long("starting the bath", 60.0)
            start_bath(ctx.devices.bath, set_point_c, ctx.wait)

        if not ctx.is_warm:
            again("starting the bath", start)
        if (seconds := ctx.devices.bath.watchdog_s) is not None:
            self._fact("watchdog", seconds)
        ctx.watch.heating(anew=not ctx.is_warm)
        again("preparing the truth", self._truth.begin)
        for trial in planned:
            if self.left and trial.id not in self.left.done:
                self._go_live()
            if self.left:
                self._go_through_again(trial)
                continue
            ctx.events.trial(trial.number - 1, len(planned), trial.name)
            ctx.long("drawing for the report", 60.0, silent=True)
            self.between(trial.number - 1, len(planned))
            self._requests.pause_if_asked(self.context)
            self.context.check_interrupts = self._requests.look
            self._attempts.run(trial)
            self.context.check_interrupts = self._requests.look_between
        self._go_live()  # where all trials had their result, and only the end was missing
        ctx.events.trial(len(planned), len(planned), "")
        again("confirming the truth", self._truth.end)
        again("the arm check after the trials", lambda: self._check_arm(AFTER))
        ctx.ask(Finish())

    def _go_through_again(self, trial: PlannedTrial) -> None:
        """Replay a trial that has its result, where the emulated world ended with the bench."""
        if self._rehearsed and self.left:
            self.context.events.pose = trial.name
            self._trials.rehearsing = True
            if trial.id in self.left.poison:
                self._attempts.done += 1
            else:
                self._attempts.run(trial)

    def _take_over(self) -> None:
        """Watch the bath, on from the run before where that left it heated. Raises its trip."""
        ctx, before = self.context, self.context.before
        if before:
            ctx.watch.interlocks.heating(before.script.script.bath.set_point_c)
            before.trips.watch.stop()
        ctx.watch.start()
        if before and (trip := before.watch.tripped):
            if isinstance(trip, InterlockTrip):
                ctx.event(TRIP, str(trip))
            raise trip

    def _check_arm(self, when: str) -> None:
        """Touch the rig's check point, where it names one: a fact for the script's requirement."""
        ctx, arm = self.context, self.context.rig.rig.arm
        if arm.check_point_mm is None:
            return
        ctx.events.state(f"checking the arm {when} the trials")
        earlier = self._checked_before() if when == BEFORE else self._checked
        near_mm = unmoved_mm(ctx.script.script.requirements, arm)
        found = check_arm(ctx.ask, ctx.tip, arm, ctx.clock, ctx.check, earlier, near_mm)
        self._checked = found
        (self._fact if when == BEFORE else ctx.store.fact)(CHECK_FACT.format(when), found)
        ctx.event("arm", check_text(found, when))

    def _check_homing(self) -> str:
        """Touch the check point of an arm that has homed again: why what it touched before doesn't
        count; empty where it does.
        """
        ctx, arm, before = self.context, self.context.rig.rig.arm, self._checked
        if before is None:
            return "the arm was homed again, and the rig has no check point (docs/rig.md)"
        near_mm = unmoved_mm(ctx.script.script.requirements, arm)
        found = check_arm(ctx.ask, ctx.tip, arm, ctx.clock, ctx.check, before, near_mm, HOMED_AGAIN)
        ctx.event("arm", check_text(found, AMID))
        if (off_mm := moved_mm(before, found)) <= near_mm:
            return ""
        why = f"the check point is {off_mm:.2f} mm from where it was, limit {near_mm:.2f} mm"
        ctx.events.warn(f"The arm was homed again, and {why}. {HOME_RIGHT}")
        return why

    def _checked_before(self) -> dict[str, Any] | None:
        """The last check before the trials of earlier sessions; none while it is gone through."""
        if self.left is None or self._rehearsed:
            return None
        facts, key = self.left.run.facts, CHECK_FACT.format(BEFORE)
        later = [facts.get(f"{key}, session {n}") for n in range(self._session - 1, 1, -1)]
        return next((fact for fact in (*later, facts.get(key)) if fact), None)

    def _fact(self, key: str, value: object) -> None:
        """Write a fact by its name, in a later session with the session's number behind it."""
        session = "" if self._session == 1 else f", session {self._session}"
        self.context.store.fact(f"{key}{session}", value)

    def _sign_on(self) -> None:
        arm = self.context.devices.arm
        self.context.long("signing on to the arm", 120.0)
        homed = self.context.before is not None and arm.homed
        if not homed:
            arm.sign_on()
        write_arm_facts(self.context.store, self.context.rig)
        self.context.tip.refuse_other_arm()
        if homed:
            return
        self.context.ask(Homing(arm.homing))
        arm.confirm_homed()

    def _home(self, stage: Stage) -> None:
        self.context.long("homing the stage", 600.0)
        stage.connect()
        self.context.look()  # not check: what was announced goes on
        stage.home()
        self.context.check()

    def _go_live(self) -> None:
        """The first trial without a result is next: from here on all is new, and on record."""
        left, self.left = self.left, None
        self._trials.rehearsing = False
        if left is None:
            return
        text = (
            f"session {self.context.store.session} goes on after {plural(len(left.done), 'trial')}"
        )
        if self._rehearsed:
            self._end_replay()
            same, differ = self._rehearsed.same, ", ".join(self._rehearsed.differ)
            text += f", gone through again on the emulated rig: {len(same)} with the same touches"
            if differ:
                why = "The emulated world is not the one that the run began in: touches differ in"
                self.context.events.warn(f"{why} {differ}.")
                but = "WHAT FOLLOWS IS NOT WHAT AN UNDISTURBED RUN WOULD GIVE"
                text += f", other touches in {differ}: {but}"
            self.context.event(EVENT, self.context.states.current.value)
        self.context.event("resumed", text)

    def _end_replay(self) -> None:
        if self._rehearsed:
            self._rehearsed.silent = False
        self.context.events.replaying = ""

    @property
    def _left_s(self) -> float | None:
        """How long the trials take; None while it is open whether they go on."""
        watch = self.context.watch
        ending = self.context.safing or self.context.away or watch.tripped or watch.silence
        return None if ending else self._attempts.left_s

    @property
    def _settling_s(self) -> float:
        return self.expected.settling_s if self.expected else 0.0

    def _progress(self) -> dict[str, Any]:
        return {
            "done": len(self.left.done) if self.left else self._attempts.done,
            "left_s": self._left_s,
            "paused": self._requests.paused,
            "settling_s": self._settling_s,
        }

    def _ended_by(self, why: BaseException) -> RunState:
        """The ending that ``why`` means, recorded; raises again what leaves no run to show."""
        self._reserve.give_back()
        self._end_replay()
        tripped = self.context.watch.tripped
        if tripped is None and isinstance(why, REQUESTS):
            self._write_down("aborted", str(why) or "the run was interrupted (Ctrl-C)")
            return RunState.ABORTED
        # a braked stage or an impatient operator may have come first
        cause = tripped or why
        if isinstance(cause, FolderGoneError):  # there is nothing that a report could be made of
            self._write_down("fault", str(cause))
            raise cause
        if isinstance(cause, RECORD_FAULTS):
            reason = unwritten(cause)
            self._kept(self.context.event, "fault", reason)
            self.context.events.warn(f"{reason}. {cure_of(reason, self.context.store.folder)}")
        elif isinstance(cause, InstrumentError | InterlockTrip):
            self._write_down("fault", str(cause))
        else:
            said, self.mistaken = named(cause), True
            self._write_down("fault", f"{MISTAKE}: {said}")
            if isinstance(cause, MemoryError) or not isinstance(cause, FAILURES):
                raise cause
            # of the bench, or of a driver that raises in this thread from one of its own
            path = self.context.store.folder / TRACEBACK
            self._kept(path.write_text, "".join(traceback.format_exception(cause)), "utf-8")
            warned = f"A mistake of the bench: {said}. Please report it with {path}."
            self.context.events.warn(warned)
        return RunState.FAULTED

    def _finish(self, ending: RunState) -> RunState:
        """To safe first, whatever disk, terminal and watch do; not where the rig stays warm."""
        ctx = self.context
        self._reserve.give_back()
        ctx.check_interrupts = lambda: None
        said: list[str] = [STAYS_WARM]
        unsafe: Mapping[str, str] = {}
        self.is_warm = self.more and ending is RunState.FINISHED and not ctx.watch.tripped
        if self.is_warm:
            ctx.trips.watch_beyond()
            ctx.long("beginning the next script", BETWEEN_S)
        else:
            ctx.long("going to safe", 300.0)
            ctx.safing = True
            with suppress(*FAILURES):
                ctx.events.state("going to safe")
            self._show_safing()
            said, unsafe = self._make_safe()
            ctx.made_safe = True
            with suppress(*FAILURES):
                ctx.events.state(f"not safe: {', '.join(unsafe)}" if unsafe else ALL_SAFE)
        left: list[dict[str, Any]] = []
        with suppress(*FAILURES):
            ctx.show()
            left = [asdict(one) for one in ctx.status().at_end]
        self._ended = True
        if unsafe:
            ctx.events.warn(not_safe_text(unsafe))
            ctx.events.notify(NOT_SAFE)
        for text in said:
            self._write_down("safe", text)
        if unsafe and ending is RunState.FINISHED:
            ending = RunState.FAULTED
            self._write_down("fault", f"could not be made safe at its end: {', '.join(unsafe)}")
        tripped = ending is RunState.FAULTED and isinstance(ctx.watch.tripped, InterlockTrip)
        word = RunState.TRIPPED if tripped else ending
        for state in (RunState.SAFING, word):
            self._kept(ctx.states.to, state)
        self._write_down("end", word.value)
        self._kept(ctx.store.fact, "retries", dict(self._recovery.counts))
        if any(self._trials.frames_looked_at.values()):
            self._kept(self._fact, FRAMES_FACT, dict(self._trials.frames_looked_at))
        ending = self._write_end(ending, left)
        ctx.live.end()
        return ending

    def _write_end(self, ending: RunState, left: Sequence[Mapping[str, Any]]) -> RunState:
        """Into the record, or into the reserve where that takes nothing more: then it is faulted,
        if it was not before. ``left``: the instruments.
        """
        store, session = self.context.store, self.context.store.session
        facts = dict[str, Any]()
        if left:
            facts[INSTRUMENTS_FACT] = {"session": session, "instruments": left}
        facts |= {"ending": ending.value, "wall_ended": wall_time().isoformat(timespec="seconds")}
        for key, value in facts.items():
            self._kept(store.fact, key, value)
        if self._kept(store.flush):
            self._reserve.end()
            return ending
        if ending is RunState.FINISHED:
            ending = RunState.FAULTED
            self._kept(self.context.event, "fault", f"{UNWRITTEN}: its end")
            self._kept(store.fact, "ending", ending.value)
        end = {"session": session, "facts": {**facts, "ending": ending.value}}
        self._reserve.leave(end, store.unwritten)
        return ending

    def _show_safing(self) -> None:
        """Now and every second until all is safe."""
        clock = self.context.clock
        if not self._ended:
            with suppress(*FAILURES):
                self.context.show()
            clock.call_at(clock.now() + LOOK_S, self._show_safing)

    def _write_down(self, kind: str, text: str) -> None:
        """Record an event; where that fails, warn instead, and go on."""
        if not self._kept(self.context.event, kind, text):
            self.context.events.warn(text)

    def _kept(self, write: Callable[..., object], *what: object) -> bool:
        try:
            write(*what)
        except RECORD_FAULTS:
            return False
        return True

"""What every step of a run is given: the rig and its open instruments, the script, the record, the
events; with them signs of life for the guardian, looks at the interlocks, and the operator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import InitVar, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.record.state import State
from bench.record.writer import Store
from bench.results.headline import AFTER_RUN
from bench.results.status import (
    GOING_TO_SAFE,
    InstrumentStatus,
    LinkState,
    OpenPrompt,
    RunStatus,
    Safe,
)
from bench.rig.by_hand import BY_HAND
from bench.rig.devices import Devices, Evidence
from bench.rig.guardian_client import BRIEF_S, GuardianClient, Heartbeat
from bench.rig.loading import LoadedRig
from bench.run.estimate import gate_of
from bench.run.events import EVENT, FAILURES, Events, RunStates
from bench.run.live import Live, bath_state, interlock_states
from bench.safety.bath_monitor import LATE_S, BathMonitor, TripHandler
from bench.safety.interlocks import InterlockTrip
from bench.safety.stability import StabilityGate
from bench.script.model import LoadedScript
from bench.truth.stage_registration import stands_at
from bench.truth.touching import TipReader
from bench.truth.uncertainty import Triple
from instruments.clock import VirtualClock, sleep_looking, stopwatch_s, wall_time
from instruments.errors import DeviceError, InstrumentError
from instruments.operators.operator import KIND_OF, Answer, BoardTouch, Release, Request, Touch
from instruments.stage.driver import TOLERANCE_MM
from textfiles.text import in_command

LOOK_S = 1.0
STEPPED_S = 5.0  # time servers nudge a clock by less
STAGE_S = 2.0  # between two looks at stage and arm while they have nothing to do
SAFING = "Wait until all is safe, and for its report."
READ_S = 1.0  # both clocks are read within microseconds


@dataclass(eq=False)
class RunContext:
    """One run. Time passes through ``wait`` only, with a look at the interlocks each second. What a
    person requests is raised by ``check_interrupts``. ``before``: the run that left the rig warm.
    """

    rig: LoadedRig
    script: LoadedScript
    devices: Devices
    store: Store
    events: Events
    heartbeat: Heartbeat = field(default_factory=Heartbeat)
    guardian_client: InitVar[GuardianClient | None] = None
    before: RunContext | None = None

    def __post_init__(self, guardian_client: GuardianClient | None) -> None:
        rig, devices, events, before = self.rig, self.devices, self.events, self.before
        self.clock = devices.clock
        self.tip = TipReader(devices.arm, rig.rig.arm, rig.frame)
        self.check_interrupts: Callable[[], None] = lambda: None
        self.live = Live(self.store.folder)
        self.progress: Callable[[], Mapping[str, Any]] = dict
        self.safing = self.made_safe = False  # the run goes to safe; it has tried all of it
        self.away = self.away_how = ""  # the instrument that dropped out, and in what way
        self.check_away = self.readied = ""  # what a person does: while it is away, while it homes
        self.last: dict[str, str] = {}  # an instrument's last value, in words
        self.under_test: Sequence[str] = ()
        self._asked, self._asked_s = "", 0.0
        self._camera_gone = ""  # in what way, once it is known
        self._touching = self._touched = False
        self._stage_seen_s = 0.0
        self._stage_mm: Triple | None = None
        self._wall_behind_s: float | None = None
        gate: StabilityGate = before.watch.gate if before and self.is_warm else gate_of(self.script)
        self.trips = TripHandler(
            rig, devices, gate, self.store, events.warn, self.heartbeat, guardian_client
        )
        self.trips.on_event, self.trips.seen = events.event, self._seen
        self.watch: BathMonitor = self.trips.watch
        self.states = RunStates(lambda state: self.event(EVENT, state.value), self.clock.now)
        events.now_s, events.status = self.clock.now, self.status

    @property
    def is_warm(self) -> bool:
        """Whether the run before left the bath as this script wants it."""
        before = self.before
        return before is not None and before.script.script.bath == self.script.script.bath

    def ask(self, request: Request) -> Answer:
        """Have the operator do it; the interlocks are looked at meanwhile."""
        kind = KIND_OF.get(type(request))
        if kind is None:
            if isinstance(request, Release):
                self._touched = False
                self.events.asked("release")
            return self.devices.operator.ask(request, self.look)
        self.heartbeat.sign(f"waiting for the operator: {kind}", math.inf)
        self._asked, self._asked_s = kind, self.clock.now()
        self._touching = isinstance(request, Touch | BoardTouch)
        if not self._touching or not self._touched:
            self._stage_seen_s, self._stage_mm, self._camera_gone = self._asked_s, None, ""
        self._touched = self._touching
        self.events.asked(kind)
        try:
            return self.devices.operator.ask(request, self.look)
        finally:
            self._asked, self._touching = "", False
            self.events.asked("")
            self.heartbeat.sign("going on")

    def wait(self, seconds: float) -> None:
        """Let time pass. Raises InterlockTrip."""
        sleep_looking(self.clock, seconds, self.check, LOOK_S)

    def check(self) -> None:
        """Give a sign of life, and `look`."""
        self.heartbeat.sign("going on")
        self.look()

    def look(self) -> None:
        """Raises InterlockTrip, what ``check_interrupts`` raises, and while ends are touched or set
        up the faults of the stage. It is no heartbeat.
        """
        self.watch.check()
        self.check_interrupts()
        if self._touching and self.clock.now() - self._stage_seen_s >= STAGE_S:
            self._look_at_stage()
            if type(self.clock) is not VirtualClock:
                self._warn_of_cameras()
        elif self._asked == "set up":
            self.look_at_idle()
        if self.live.due:
            self.show()

    def look_at_idle(self) -> None:
        """Ask stage, arm and cameras, which have nothing to do, for a sign of life; not in virtual
        time, where a question changes what emulators answer later.
        """
        due = self.clock.now() - self._stage_seen_s >= STAGE_S
        if due and type(self.clock) is not VirtualClock:
            self._look_at_stage()
            if self.devices.arm.homed:
                self.devices.arm.glance()
            self._glance_at_cameras()

    def _glance_at_cameras(self) -> None:
        """Raises where one says that it is gone: not every kind of camera can, without a frame."""
        getattr(self.devices.cameras, "glance", lambda: None)()

    def _warn_of_cameras(self) -> None:
        """Once, while ends are touched: the trial has its frames and goes on."""
        gone, self._camera_gone = self._camera_gone, ""
        try:
            self._glance_at_cameras()
        except InstrumentError as fault:
            self._camera_gone = fault.what
            if not gone:
                then = "The trial has its frames and goes on; a next one needs the camera."
                self.events.warn(f"{fault}\n{then}")

    def _look_at_stage(self) -> None:
        """Raises as the stage, and DeviceError where it stands elsewhere than at the last look."""
        self._stage_seen_s, stage, before = self.clock.now(), self.devices.stage, self._stage_mm
        if stage is None:
            return
        self._stage_mm = here = stands_at(stage)
        if self._touching and before and not np.allclose(here, before, rtol=0.0, atol=TOLERANCE_MM):
            what = f"it was moved from {before} to {here} while ends were touched"
            raise DeviceError(stage.who, what, hint="Touch nothing but the ends.")

    def show(self) -> None:
        """The run as it is now, for a viewer; on the screen too where the bath says nothing."""
        if not self.live.ended:
            self.live.tip(self._tip_mm())
            self._publish()
        if self.safing or self.watch.silence:
            self.events.refresh()

    def _seen(self) -> None:
        """With each reading of the bath, on the thread of the watch. Raises nothing."""
        self.events.refresh()
        with suppress(*FAILURES):
            if self.live.due:
                self._publish()

    def _publish(self) -> None:
        settling_s = float(self.progress().get("settling_s", 0.0))
        bath = bath_state(self.watch, settling_s, float(getattr(self.clock, "speed", 1.0)))
        more = {"t_s": self.clock.now(), "bath": bath, "interlocks": interlock_states(self.watch)}
        self.live.write(self.status(), more)

    def status(self) -> RunStatus:
        """The run as it is now; may be asked on any thread."""
        progress, watch, events = self.progress(), self.watch, self.events
        tripped = str(watch.tripped) if isinstance(watch.tripped, InterlockTrip) else ""
        safing = self.safing or watch.tripped is not None
        there = {"arm": True, "bath": True, "stage": bool(self.devices.stage), "cameras": True}
        pump = self.devices.safed.get("pump")
        there["pump"] = bool(self.devices.bath.pump_url or (pump and not pump.is_safe))
        names = [name for name, one in there.items() if one]
        instruments, asked = tuple(map(self._instrument, names)), None
        if self._asked and self.rig.rig.by_person and not safing:
            asked = OpenPrompt(self._asked, waited_s=self.clock.now() - self._asked_s)
        status = RunStatus(
            run=self.store.folder.name,
            title=self.script.script.title,
            state=State.RUNNING,
            step=GOING_TO_SAFE if safing else self.states.current.value,
            verdicts=dict.fromkeys(self.under_test, State.RUNNING.value),
            doing=events.doing if self.made_safe or not safing else GOING_TO_SAFE,
            pose=events.pose,
            done=int(progress.get("done", 0)),
            planned=len(self.script.planned),
            left_s=None if watch.tripped else progress.get("left_s"),
            paused=bool(progress.get("paused")),
            asked=asked,
            instruments=instruments,
            tripped=tripped,
            last_error=events.error,
            emulated=self.rig.rig.partly_emulated,
            rig=self.rig.rig.name,
            wall_time=wall_time().isoformat(timespec="milliseconds"),
        )
        return replace(status, next=(*status.unsafe, *self._next(status)))

    def _next(self, status: RunStatus) -> Iterator[str]:
        """What a person does beside making safe what is not."""
        if status.step == GOING_TO_SAFE:
            yield SAFING
            if self._asked:
                yield "The open question needs no answer any more."
        elif self.away or any(one.trouble and one.name == "bath" for one in status.instruments):
            if self.watch.failing and self.away != "bath":  # it may heat: before all others
                cable = "Check the bath's power and its cable."
                yield f"{cable} Where it stays silent, an interlock trips."
            if self.away:
                yield self.check_away
        elif self._camera_gone:
            yield "Check the cameras' power and cables, before the next frames."
        elif status.asked:
            yield f"Answer what is asked: {status.asked.kind}."
        elif status.paused:
            yield f"Go on with: teatbench control {in_command(self.store.folder)} go on"
        elif self.readied:
            yield self.readied
        else:
            yield AFTER_RUN

    @property
    def _bath_fails(self) -> str:
        """As the watch's ``failing``, also once it has ended and the bath goes to standby."""
        stops, last = self.safing and "bath" in self.devices.active, self.watch.last
        late = stops and last is not None and self.clock.now() - last.t_s > LATE_S
        return self.watch.failing or ("no answer" if late else "")

    def _instrument(self, name: str) -> InstrumentStatus:
        devices, now_s = self.devices, self.clock.now()
        # an arm that moves by itself is made safe, and by hand too, as what it is
        acts = "robot" if name == "arm" and devices.arm.touches else name
        answered_s, found = devices.answered_s.get(name), devices.safed.get(acts)
        link, how, last, by_hand = LinkState.ANSWERS, "", self.last.get(name, ""), ""
        if name == self.away:
            link, how = LinkState.AWAY, self.away_how
        if name == "cameras" and self._camera_gone and link is LinkState.ANSWERS:
            link, how = LinkState.SILENT, self._camera_gone
        if name == "bath":
            if reading := self.watch.last:
                last, answered_s = f"{reading.temp_c:.2f} degC", reading.t_s
            if failing := self._bath_fails:
                link, how = (LinkState.AWAY if name == self.away else LinkState.SILENT), failing
            elif link is LinkState.ANSWERS and last and name in devices.active:
                last += f", {self.watch.course}"
        # a stop that was sent is asked for again on the way to safe: no person has to act before
        final = found and (self.made_safe or found.evidence is not Evidence.SENT)
        if found and final and not found.is_safe and acts in BY_HAND:
            how, by_hand = found.brief or found.evidence.value, BY_HAND[acts]
        safe = Safe.IN_USE if name in devices.active else Safe.AT_REST
        if found and (safe is Safe.AT_REST or not found.is_safe):
            safe = Safe(found.evidence.value)
        age_s = None if answered_s is None else max(0.0, now_s - answered_s)
        if acts == "arm" and found:
            safe = Safe.AT_REST  # nothing in it heats or moves, and a silent one read nothing back
        return InstrumentStatus(name, link, safe, last=last, age_s=age_s, how=how, by_hand=by_hand)

    def _tip_mm(self) -> NDArray[np.float64] | None:
        """The tip in the world while a touch is asked for in real time, else None: in virtual time
        a further poll would change what the emulated arm answers.
        """
        arm = self.devices.arm
        if not self._touching or type(self.clock) is VirtualClock or not arm.homed:
            return None
        seen = arm.glance()  # none where a point is there once it is touched
        return self.tip.in_world(seen).tip_mm if seen else None

    def long(self, what: str, at_most_s: float, *, silent: bool = False) -> None:
        """Allow ``what`` so long before the bench counts as hung; ``silent``: without heartbeat."""
        self.heartbeat.sign(what, at_most_s, silence_s=None if silent else BRIEF_S)

    def note(self, text: str) -> None:
        self.events.state(text)
        self.event("state", text)

    def event(self, kind: str, text: str) -> None:
        """Record an event and put it into the stream, behind one where the clock was set."""
        before_s = stopwatch_s()
        behind_s = wall_time().timestamp() - before_s
        if stopwatch_s() - before_s <= READ_S:  # else a busy computer let time pass between the two
            known_s, self._wall_behind_s = self._wall_behind_s, behind_s
            if known_s is not None and abs(behind_s - known_s) > STEPPED_S:
                was_set = f"the computer's clock was set {behind_s - known_s:+.0f} s"
                but = "wall times before and after don't compare, the bench's own do"
                self._write("clock", f"{was_set}; {but}")
        self._write(kind, text)

    def _write(self, kind: str, text: str) -> None:
        self.store.event(self.clock.now(), kind, text, wall_time())
        self.events.event(kind, text)

"""What every step of a run is given: the rig and its open instruments, the script, the record, the
events; with them signs of life for the guardian, looks at the interlocks, and the operator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.record.writer import Store
from bench.rig.devices import Devices
from bench.rig.guardian_client import BRIEF_S, GuardianClient, Heartbeat
from bench.rig.loading import LoadedRig
from bench.run.estimate import gate_of
from bench.run.events import EVENT, Events, RunState, RunStates
from bench.run.live import Live, bath_state, interlock_states
from bench.safety.bath_monitor import TripHandler
from bench.script.model import LoadedScript
from bench.truth.touching import TipReader
from instruments.clock import VirtualClock, stopwatch_s, wall_time
from instruments.operators.operator import KIND_OF, Answer, BoardTouch, Release, Request, Touch

LOOK_S = 1.0
STEPPED_S = 5.0  # time servers nudge a clock by less
READ_S = 1.0  # both clocks are read within microseconds


class RunContext:
    """One run. Time passes through ``wait`` only, which checks the interlocks every second;
    ``check_interrupts`` raises what a person requests.
    """

    def __init__(
        self,
        rig: LoadedRig,
        script: LoadedScript,
        devices: Devices,
        store: Store,
        events: Events,
        heartbeat: Heartbeat | None = None,
        guardian_client: GuardianClient | None = None,
    ) -> None:
        self.rig = rig
        self.script = script
        self.devices = devices
        self.store = store
        self.events = events
        self.clock = devices.clock
        self.tip = TipReader(devices.arm, rig.rig.arm, rig.frame)
        self.check_interrupts: Callable[[], None] = lambda: None
        self.live = Live(store.folder)
        self.progress: Callable[[], Mapping[str, Any]] = dict
        self.safing = False  # the run is on its way to safe
        self.away = ""  # the instrument that dropped out
        self._touching = False
        self._heartbeat = heartbeat or Heartbeat()
        self._wall_behind_s: float | None = None
        self.trips = TripHandler(
            rig, devices, gate_of(script), store, events.warn, self._heartbeat, guardian_client
        )
        self.trips.on_event, self.trips.seen = events.event, events.refresh
        self.watch = self.trips.watch
        self.states = RunStates(lambda state: self.event(EVENT, state.value), self.clock.now)
        events.now_s = self.clock.now

    def ask(self, request: Request) -> Answer:
        """Have the operator do it; the interlocks are looked at meanwhile."""
        kind = KIND_OF.get(type(request))
        if kind is None:
            if isinstance(request, Release):
                self.events.asked("release")
            return self.devices.operator.ask(request, self.look)
        self._heartbeat.sign(f"waiting for the operator: {kind}", math.inf)
        self.events.asked(kind)
        self._touching = isinstance(request, Touch | BoardTouch)
        try:
            return self.devices.operator.ask(request, self.look)
        finally:
            self._touching = False
            self.events.asked("")
            self._heartbeat.sign("going on")

    def wait(self, seconds: float) -> None:
        """Let time pass. Raises InterlockTrip."""
        end_s = self.clock.now() + seconds
        self.check()
        while (left_s := end_s - self.clock.now()) > 0.0:
            self.clock.sleep(min(LOOK_S, left_s))
            self.check()

    def check(self) -> None:
        """A sign of life, and a look."""
        self._heartbeat.sign("going on")
        self.look()

    def look(self) -> None:
        """Raises InterlockTrip and what ``check_interrupts`` raises. It is no heartbeat."""
        self.watch.check()
        self.check_interrupts()
        if self.live.due:
            self.show()

    def show(self) -> None:
        """The run as it is now, for a viewer; on the screen too where the bath says nothing."""
        self.live.write(self._state(), self._tip_mm())
        if self.safing or self.watch.silence:
            self.events.refresh()

    def _state(self) -> dict[str, Any]:
        """The run as it is now; units in the keys."""
        progress = dict(self.progress())
        settling_s = progress.pop("settling_s", 0.0)
        devices = self.devices
        there = {"arm": devices.arm, "bath": devices.bath, "stage": devices.stage}
        names = [*(name for name, one in there.items() if one), "cameras"]
        return {
            "t_s": self.clock.now(),
            "state": (RunState.SAFING if self.safing else self.states.current).value,
            **progress,
            "bath": bath_state(self.watch, settling_s),
            "interlocks": interlock_states(self.watch),
            "tripped": str(self.watch.tripped) if self.watch.tripped else None,
            "instruments": {name: self._health(name) for name in names},
        }

    def _health(self, name: str) -> str:
        if name == "bath" and (silence := self.watch.silence):
            return silence
        return "away" if name == self.away else "ok"

    def _tip_mm(self) -> NDArray[np.float64] | None:
        """The tip in the world while a touch is asked for in real time, else None: in virtual time
        a further poll would change what the emulated arm answers.
        """
        arm = self.devices.arm
        if not self._touching or isinstance(self.clock, VirtualClock) or not arm.homed:
            return None
        seen = arm.glance()  # none where a point is there once it is touched
        return self.tip.in_world(seen).tip_mm if seen else None

    def long(self, what: str, at_most_s: float, *, silent: bool = False) -> None:
        """Allow ``what`` ``at_most_s`` before the guardian takes the bench for hung; ``silent``:
        without a heartbeat meanwhile.
        """
        self._heartbeat.sign(what, at_most_s, silence_s=None if silent else BRIEF_S)

    def note(self, text: str) -> None:
        self.events.state(text)
        self.event("state", text)

    def event(self, kind: str, text: str) -> None:
        """Record an event and put it into the stream, after one where the computer's
        clock was set.
        """
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

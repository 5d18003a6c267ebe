"""Watches the bath through a run: reads it once a second through everything the bench
does, for the stability gate, the interlocks and the record, and makes safe when one trips.

It is planned on the clock, so with virtual time it runs as time moves and with real time on the
clock's own thread, which no prompt stops. A trip acts there and at once: heater off, stage braked,
then the record, the latch and the operator; again every few seconds until heater and stage are
safe. The engine learns of it with ``check``. Nothing is raised on the clock's thread.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Callable, Hashable, Sequence
from dataclasses import KW_ONLY, dataclass, replace

from bench.files import unwritten
from bench.record.schema import Row
from bench.record.state import TRIP
from bench.record.writer import Store
from bench.rig.devices import Devices, Evidence, Safing, attempt
from bench.rig.guardian_client import GuardianClient, Heartbeat
from bench.rig.loading import LoadedRig
from bench.safety.interlocks import GUARDIAN, Interlocks, InterlockTrip, rule_named
from bench.safety.latch import latch_path, set_latch
from bench.safety.liveness import Liveness
from bench.safety.stability import BathState, StabilityGate
from instruments.bath.reading import BathReading
from instruments.bath.sequence import heater_off, pump_on, pump_text
from instruments.clock import Clock, wall_time
from instruments.drivers.protocols import Stage
from instruments.errors import InstrumentError, LinkError
from instruments.stage.protocol import Status
from textfiles.text import full_stop
from textfiles.whole import refusal

PERIOD_S = 1.0
LATE_S = 3.0  # without a reading: shown as silent
AGAIN_S = 5.0  # between attempts to make safe
RATE_S, LEAST_S = 60.0, 10.0  # over which a rate is taken
ENDS = "The run ends; an open question needs no answer any more."


@dataclass(eq=False)
class BathMonitor:
    """Watches the bath that ``read`` polls. ``act`` gets the first trip, makes safe, and returns
    whether it has. ``also``: another reason to trip; ``moving``: what of a reading has to change
    while the controller works.
    """

    read: Callable[[], BathReading]
    clock: Clock
    gate: StabilityGate
    interlocks: Interlocks
    record: Callable[[Row], None]
    act: Callable[[Exception], bool]
    _: KW_ONLY
    pump_on: Callable[[BathReading], bool | None] = lambda _: None
    also: Callable[[], InterlockTrip | None] = lambda: None
    moving: Callable[[BathReading], Hashable] = lambda reading: reading.raw

    def __post_init__(self) -> None:
        self._lock = threading.RLock()
        self._gate_lock = threading.Lock()  # never held while the bath is waited for
        self._running = self._safe = False
        self._trip: Exception | None = None
        self._act_again_s = self._answered_s = self._planned_s = self.clock.now()
        self._heating_s: float | None = None
        self._failing = ""  # how the last reading failed
        self.last: BathReading | None = None

    @property
    def state(self) -> BathState:
        """Of the stability gate, after the last reading."""
        return self.gate.state

    @property
    def course(self) -> str:
        """The state in a word: ``cooling`` where it has to come down to the set point."""
        warmer = self.last is not None and self.last.temp_c > self.gate.set_point_c
        return "cooling" if warmer and self.state is BathState.HEATING else self.state.value

    @property
    def why_not_stable(self) -> str:
        with self._gate_lock:
            return "; ".join(self.gate.reasons)

    def alive_since(self, t_s: float) -> bool:
        """Whether the bath's reading has shown a sign of life after ``t_s``."""
        with self._lock:
            return self.gate.moved_s > t_s

    def stable_in_s(self, expected_s: float) -> float:
        """How long until the gate opens, expected ``expected_s`` after heating began."""
        if self.state is BathState.STABLE:
            return 0.0
        heated_s = 0.0 if self._heating_s is None else self.clock.now() - self._heating_s
        with self._gate_lock:
            return max(expected_s - heated_s, self.gate.at_least_s)

    @property
    def silence(self) -> str:
        """``no answer for 12 s``; empty while the bath answers, or is asked for nothing more."""
        silent_s = self.clock.now() - self._answered_s
        return f"{self.failing} for {silent_s:.0f} s" if self.failing else ""

    @property
    def failing(self) -> str:
        """``no answer`` or ``no usable reading``; empty as `silence`."""
        late = self._running and self.clock.now() - self._answered_s > LATE_S
        return self._failing or ("no answer" if late else "")

    @property
    def tripped(self) -> Exception | None:
        """What ``check`` would raise."""
        return self._trip

    def start(self) -> None:
        """Read now and then every second."""
        self._running = True
        self._answered_s = self._planned_s = self.clock.now()
        self._tick()

    def heating(self, *, anew: bool = True) -> None:
        """The bath has been started: what was read before is no evidence of stability, unless it
        has been kept at this set point all along (not ``anew``).
        """
        with self._lock, self._gate_lock:
            if anew:
                self.gate.restart()
            self._heating_s = self.clock.now()
            self.interlocks.heating(self.gate.set_point_c)

    def unrecorded(self) -> None:
        """From now on readings are in no record; returns once none is being written."""
        with self._lock:
            self.record = lambda _: None

    def end(self) -> None:
        """No further readings; doesn't wait for one that is under way, as ``stop`` does."""
        self._running = False

    def stop(self) -> None:
        """No further readings; returns once none is under way."""
        self.end()
        with self._lock:
            pass

    def check(self) -> None:
        """Raise what has tripped since: InterlockTrip, or a mistake of the bench's own."""
        if self._trip is not None:
            raise self._trip

    def _tick(self) -> None:
        with self._lock:
            if not self._running:
                return
            # while this process did not run, the bath was not silent
            self._answered_s += self.clock.now() - self._planned_s
            try:
                self._trip = self._trip or self.also()
                self._look()
            except Exception as error:
                self._trip = self._trip or error
            self._make_safe()
        # from start to start, however long a reading takes
        self._planned_s = max(self._planned_s + PERIOD_S, self.clock.now())
        self.clock.call_at(self._planned_s, self._tick)

    def _look(self) -> None:
        try:
            reading = self.read()
            pump_on = self.pump_on(reading)
        except InstrumentError as error:
            silent_s = self.clock.now() - self._answered_s
            answered = not isinstance(error, LinkError)
            self._failing = "no usable reading" if answered else "no answer"
            self._trip = self._trip or self.interlocks.silent(silent_s, error, answered=answered)
            return
        if not self._running:
            return  # the run has ended while we waited for it, and with it the heating
        self._answered_s, self._failing = reading.t_s, ""
        self.last = reading
        raw, teat_c = self.moving(reading), reading.external_c
        with self._gate_lock:
            state = self.gate.add(
                reading.t_s, reading.temp_c, raw=raw, alarm=bool(reading.alarm), teat_c=teat_c
            )
        self.record(
            {
                "t_s": reading.t_s,
                "temp_c": reading.temp_c,
                "external_c": reading.external_c,
                "power_percent": reading.power_percent,
                "state": state.value,
            }
        )
        trip = self.interlocks.add(reading, pump_on)
        self._trip = self._trip or trip

    def _make_safe(self) -> None:
        if self._trip is None or self._safe or self.clock.now() < self._act_again_s:
            return
        self._act_again_s = self.clock.now() + AGAIN_S
        try:
            self._safe = self.act(self._trip)
        except Exception as error:
            self._trip = error


class SafeAtOnce:
    """Holds the stage and switches the heater off, from any thread. A call gives whether both are
    done, and the steps; what is done is not done again.
    """

    def __init__(self, devices: Devices) -> None:
        self._devices, self._held = devices, False

    def __call__(self) -> tuple[bool, list[Safing]]:
        stage, steps = self._devices.stage, list[Safing]()
        # first, for it takes a byte, and a bath that doesn't answer half a minute
        braked = attempt("stage", stage.brake) if stage and not self._held else None
        heater = attempt("heater", lambda: heater_off(self._devices.bath), "is in standby")
        self._devices.safed["bath"] = replace(heater, name="bath")
        if stage and braked:
            steps.append(held(stage) if braked.is_safe else braked)
            self._devices.safed["stage"] = steps[-1]
        self._held = self._held or all(step.is_safe for step in steps)
        steps.append(heater)
        return heater.is_safe and self._held, steps


WATCH = "the watch"
WATCHING = "beside the bench"
NO_GUARDIAN = "none: under virtual time the emulated bath ends with the bench"
# a reading of a bath that has gone, with all attempts to reach it and to make it safe
READING_S = 60.0


class TripHandler:
    """Makes safe and reports a trip. ``on_event`` gets its event once it is recorded; ``seen`` is
    called after each reading.
    """

    def __init__(
        self,
        rig: LoadedRig,
        devices: Devices,
        gate: StabilityGate,
        store: Store,
        warn: Callable[[str], None],
        heartbeat: Heartbeat,
        guardian_client: GuardianClient | None,
    ) -> None:
        self._devices = devices
        self._store = store
        self._warn = warn
        self._heartbeat = heartbeat
        self._guardian_client = guardian_client
        self._latch = latch_path(rig)
        self._reported = self._beyond = False
        self._at_once = SafeAtOnce(devices)
        self.on_event: Callable[[str, str], None] = lambda _kind, _text: None
        self.seen: Callable[[], None] = lambda: None
        interlocks = self._interlocks = Interlocks(rig.rig.limits, devices.bath.profile)

        def record(reading: Row) -> None:
            store.bath(reading)
            self.seen()

        self.watch = BathMonitor(
            devices.bath.read,
            devices.clock,
            gate,
            interlocks,
            record,
            self._act,
            pump_on=lambda reading: pump_on(devices.bath, reading),
            also=self._also,
            moving=Liveness(rig.profile),
        )
        room_c = rig.rig.emulation.ambient_c if rig.rig.bath_emulated else rig.rig.bath.room_c
        accuracy = rig.rig.bath.model_dump(include={"accuracy_k", "external_accuracy_k"})
        facts = {
            "interlocks asleep": interlocks.inactive,
            "pump": pump_text(devices.bath),
            "comms loss": rig.profile.comms_loss,
            "cut-out tested": rig.rig.bath.cut_out_tested,
            "safe states": devices.safe_states(),
            "guardian": WATCHING if guardian_client else NO_GUARDIAN,
            "bath figures": {"room_c": room_c} | accuracy,
        }
        for key, value in facts.items():
            store.fact(key, value)

    def end(self) -> None:
        """End the readings and their signs of life: a pump may run on for longer than one takes."""
        self.watch.end()
        self._heartbeat.rest(WATCH)

    def stop(self) -> None:
        """End the watch."""
        self.watch.stop()
        self._heartbeat.rest(WATCH)

    def watch_beyond(self) -> None:
        """Go on after the run has ended and its record is closed: the rig stays warm."""
        self._beyond = True
        self.watch.unrecorded()
        self.on_event, self.seen = (lambda _kind, _text: None), (lambda: None)

    def heater_off(self) -> None:
        """Switch off the heater alone, for a thread that has no time for more."""
        heater_off(self._devices.bath)

    def _also(self) -> InterlockTrip | None:
        """With each reading: give a sign of life, and trip where the guardian is lost."""
        self._heartbeat.sign("reading the bath", READING_S, who=WATCH)
        lost = self._guardian_client.lost if self._guardian_client else None
        then = rule_named(GUARDIAN).then
        return InterlockTrip(GUARDIAN, lost, then, self._interlocks.values) if lost else None

    def _act(self, trip: Exception) -> bool:
        """Go to safe; True when heater and stage are. Called again until they are."""
        safe, steps = self._at_once()
        if not self._reported:
            self._reported = True
            self._report(trip, [text for step in steps for text in step.texts])
        return safe

    def _report(self, trip: Exception, said: list[str]) -> None:
        """To the operator first; the record and the latch may fail without the others. A record
        that can't be written is no trip: the run's end, for which room is kept, writes it down.
        """
        done = full_stop("; ".join(text.rstrip(".") for text in said))
        if isinstance(trip, sqlite3.Error):
            self._warn(f"{unwritten(trip)}\n{done} {ENDS}")
            return
        kind = TRIP if isinstance(trip, InterlockTrip) else "fault"
        whole = f"{full_stop(str(trip))} Then: {done}"
        self._warn(f"{trip}\n{done} {ENDS}")
        try:
            if isinstance(trip, InterlockTrip) and not self._beyond:
                self._store.fact(
                    "trip", trip.as_dict() | {"t_s": self._devices.clock.now(), "done": said}
                )
            if not self._beyond:
                self._store.event(self._devices.clock.now(), kind, whole, wall_time())
            self.on_event(kind, whole)
        except sqlite3.Error as error:
            self._warn(f"the trip could not be written down: {error}")
        try:
            if self._latch is not None:
                set_latch(self._latch, trip, str(self._store.folder.resolve()))
        except OSError as error:
            what = f"the trip could not be latched in {self._latch}: {refusal(error)}"
            self._warn(f"{what} Nothing but you keeps the next run from starting.")


def held(stage: Stage) -> Safing:
    """Whether a stage that has the order to brake stands, by its own report."""
    shown: list[Status | None] = []
    found = attempt("stage", lambda: shown.append(stage.stands()), "is held")
    if shown == [None]:  # amid a question of the run's own
        return replace(found, evidence=Evidence.SENT, detail="the order to brake was")
    return found


def seconds_to_stable(gate: StabilityGate, seen: Sequence[BathReading]) -> float | None:
    """At the least: the way at the rate of the last minute, ``seen``, and a window, or what is left
    of it. None where the bath doesn't approach its set point, or too little was read.
    """
    if not seen or gate.state is BathState.STABLE:
        return 0.0 if seen else None
    if gate.state is BathState.SETTLING:
        return max(0.0, gate.window_s - gate.near.span_s) or 1.0
    first, last = seen[0], seen[-1]
    away_k, way_k = gate.set_point_c - last.temp_c, last.temp_c - first.temp_c
    if last.t_s - first.t_s < LEAST_S or away_k * way_k <= 0.0:
        return None
    return (abs(away_k) - gate.leave_k) / abs(way_k) * (last.t_s - first.t_s) + gate.window_s

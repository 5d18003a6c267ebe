"""Keeps the bath out of trouble through a run: the watch with its interlocks, what a trip does, and the bench's signs of life.

A trip acts on the thread that saw it, at once: heater off, stage braked, then the record, the latch and the operator. The
engine only asks ``check``. May not know trials, cameras or detectors.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable

from bench.devices import Devices
from bench.rig import LoadedRig
from bench.running.showing import Progress
from bench.running.stability import StabilityGate
from bench.running.watch import Watch
from bench.safety.interlock_rules import GUARDIAN, rule_named
from bench.safety.interlocks import Interlocks, InterlockTrip, bath_of, moving_of
from bench.safety.latch import latch_path, set_latch
from bench.safety.lifeline import Lifeline
from bench.safety.pulse import Pulse
from bench.safety.safing import cause_of, heater_off, pump_on, pump_told
from bench.store import Row, Store
from instruments.bath.reading import BathReading
from instruments.clock import wall_time

WATCH = "the watch"
WATCHING = "beside the bench"
NO_GUARDIAN = "none: under virtual time the emulated bath ends with the bench"
READING_S = 60.0  # a reading of a bath that has gone, with all attempts to reach it and to make it safe


class Keeper:
    """``watch`` is to be started and stopped by the engine; ``lifeline`` is None where nothing needs a guardian.

    ``heard`` gets the event of a trip, its kind and text, once it is in the record; ``seen`` is called after each reading.
    """

    def __init__(
        self,
        rig: LoadedRig,
        devices: Devices,
        gate: StabilityGate,
        store: Store,
        progress: Progress,
        pulse: Pulse,
        lifeline: Lifeline | None,
    ) -> None:
        self._devices = devices
        self._store = store
        self._progress = progress
        self._pulse = pulse
        self._lifeline = lifeline
        self._latch = latch_path(rig)
        self._told = self._held = False
        self.heard: Callable[[str, str], None] = lambda _kind, _text: None
        self.seen: Callable[[], None] = lambda: None
        interlocks = self._interlocks = Interlocks(rig.rig.limits, bath_of(rig.profile))
        moving, pump_on, also = moving_of(rig.profile), self._pump_on, self._also
        self.watch = Watch(
            devices.bath, devices.clock, gate, interlocks, self._record, self._act, pump_on=pump_on, also=also, moving=moving
        )
        self._write_facts(rig, interlocks)

    def stop(self) -> None:
        """End the watch."""
        self.watch.stop()
        self._pulse.rest(WATCH)

    def heater_off(self) -> None:
        """For a thread that has no time for more: the heater, whatever else goes on."""
        heater_off(self._devices.bath)

    def _pump_on(self, reading: BathReading) -> bool | None:
        return pump_on(self._devices.bath, reading)

    def _record(self, reading: Row) -> None:
        self._store.bath(reading)
        self.seen()

    def _also(self) -> InterlockTrip | None:
        """With each reading: the watch is alive, and the guardian has to be too."""
        self._pulse.sign("reading the bath", READING_S, who=WATCH)
        lost = self._lifeline.lost if self._lifeline else None
        return InterlockTrip(GUARDIAN, lost, rule_named(GUARDIAN).then, self._interlocks.values) if lost else None

    def _act(self, trip: Exception) -> bool:
        """Go to safe; True when heater and stage are. Called again until they are."""
        said: list[str] = []
        stage = self._devices.stage  # first, for it takes a byte, and a bath that doesn't answer half a minute
        self._held = self._held or stage is None or _tried("stage", stage.brake, said, "is held")
        safe = _tried("heater", lambda: heater_off(self._devices.bath), said, "is in standby")
        if not self._told:
            self._told = True
            self._tell(trip, said)
        return safe and self._held

    def _tell(self, trip: Exception, said: list[str]) -> None:
        """To the operator first; the record and the latch may fail without the others."""
        done = "; ".join(said)
        self._progress.warn(f"{trip}\n{done}. The run ends; an open question needs no answer any more.")
        try:
            if isinstance(trip, InterlockTrip):
                self._store.fact("trip", trip.as_dict() | {"t_s": self._devices.clock.now(), "done": said})
            self._store.event(self._devices.clock.now(), "trip", f"{trip} ({done})", wall_time())
            self.heard("trip", f"{trip} ({done})")
        except sqlite3.Error as error:
            self._progress.warn(f"the trip could not be written down: {error}")
        try:
            if self._latch is not None:
                set_latch(self._latch, trip, str(self._store.folder.resolve()))
        except OSError as error:
            what = f"the trip could not be latched in {self._latch}: {error.strerror or error}"
            self._progress.warn(f"{what}. Nothing but you keeps the next run from starting.")

    def _write_facts(self, rig: LoadedRig, interlocks: Interlocks) -> None:
        self._store.fact("interlocks asleep", interlocks.asleep)
        self._store.fact("pump", pump_told(self._devices.bath))
        self._store.fact("comms loss", rig.profile.comms_loss)
        self._store.fact("cut-out tested", rig.rig.bath.cut_out_tested)
        self._store.fact("safe states", self._devices.safe_states())
        self._store.fact("guardian", WATCHING if self._lifeline else NO_GUARDIAN)
        room_c = rig.rig.emulation.ambient_c if rig.rig.emulated else rig.rig.bath.room_c
        self._store.fact("bath figures", {"room_c": room_c} | rig.rig.bath.model_dump(include={"accuracy_k", "external_accuracy_k"}))


def _tried(name: str, step: Callable[[], str | None], said: list[str], done: str) -> bool:
    try:
        more = step()
    except Exception as error:  # whatever it is, the next step is tried too
        said.append(f"{name} could not be made safe: {cause_of(error)}")
        return False
    said += [f"{name} {done}", *([more] if more else [])]
    return True

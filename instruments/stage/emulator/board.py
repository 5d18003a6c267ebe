"""The board on its cable: the device that a listener serves, and where its faults come from.

It may not know the driver, or who watches the carriage: the world asks ``position_mm`` whenever it likes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from instruments.clock import Clock
from instruments.listener import Connection
from instruments.stage.emulator.carriage import Carriage
from instruments.stage.emulator.controller import Controller
from instruments.stage.emulator.dialect import CLASSIC, Dialect
from instruments.stage.emulator.faults import IN_MOTION, NOISE, Fault
from instruments.stage.emulator.homing import Switch
from instruments.stage.emulator.phases import Vector
from instruments.stage.emulator.store import Store

_BROKEN = {Fault.NO_SWITCH: Switch.MISSING, Fault.STUCK_SWITCH: Switch.STUCK}


class StageEmulator:
    """The board. ``settings`` differ from the defaults by number ($130 is 130); ``start_mm`` is where the carriage
    stands at first, in machine coordinates (0 at the switches), in the middle if not given; with a
    ``fresh_eeprom`` the first words are an error and a dump of settings. Raises ValueError for settings that
    the board doesn't have.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        settings: Mapping[int, float] | None = None,
        start_mm: Vector | None = None,
        dialect: Dialect = CLASSIC,
        fresh_eeprom: bool = False,
    ) -> None:
        self._clock = clock
        store = Store(settings)
        x, y, z = (-travel / 2 for travel in store.travel_mm)
        self._carriage = Carriage(start_mm or (x, y, z))
        self._controller = Controller(clock, store, dialect, self._carriage, self._answer)
        self._first_words = ("error:7", *store.lines()) if fresh_eeprom else ()
        self._connection: Connection | None = None
        self._faults: dict[Fault, float] = {}
        self._starts_seen = 0
        self._wake_planned_s = math.inf

    def position_mm(self) -> NDArray[np.float64]:
        """Where the carriage stands now, (3,) mm in machine coordinates."""
        return np.array(self._carriage.place_mm(self._clock.now()), dtype=np.float64)

    def inject(self, fault: Fault, after_s: float = 0.0) -> None:
        """Make ``fault`` happen: one of a motion ``after_s`` into it, a late answer ``after_s`` late, others from now on."""
        self._faults[fault] = after_s
        self._tell_switches()
        if fault in IN_MOTION and self._controller.moving:
            self._arm()

    def cure(self, fault: Fault) -> None:
        """End a fault that lasts, or that hasn't struck yet."""
        self._faults.pop(fault, None)
        self._tell_switches()

    def lose_steps(self, lost_mm: Vector) -> None:
        """Shift the carriage against the count, as lost steps do."""
        self._carriage.lose_steps(lost_mm)

    def connect(self, connection: Connection) -> None:
        """A host opens the port, which resets the board. The newest host has it."""
        if self._connection:
            self._connection.hang_up()
        self._connection = connection
        self._wake_planned_s = math.inf
        self._controller.power_up(self._first_words)
        self._first_words = ()
        self._settle()

    def receive(self, connection: Connection, data: bytes) -> None:
        """Bytes came, cut anywhere."""
        if connection is self._connection:
            self._controller.take(data)
            self._settle()

    def disconnect(self, connection: Connection) -> None:
        """The cable is out. What is planned still runs to its end."""
        if connection is self._connection:
            self._connection = None

    def _settle(self) -> None:
        """After anything has happened: send what was said, plan when to look again, and plan faults of a new motion."""
        out, self._controller.out = bytes(self._controller.out), bytearray()
        if Fault.SILENT not in self._faults:
            self._send(out)
        if self._carriage.starts != self._starts_seen:
            self._starts_seen = self._carriage.starts
            self._arm()
        due = self._controller.due_s
        if due != self._wake_planned_s and due < math.inf:
            self._wake_planned_s = due
            self._later(due - self._clock.now(), self._wake)

    def _wake(self) -> None:
        self._wake_planned_s = math.inf
        self._controller.pump()
        self._settle()

    def _send(self, data: bytes) -> None:
        if self._connection:
            self._connection.send(data)

    def _later(self, seconds: float, action: Callable[[], None]) -> None:
        if self._connection:
            self._connection.after(max(0.0, seconds), action)

    def _answer(self, text: str) -> None:
        if self._faults.pop(Fault.GARBAGE, None) is not None:
            self._controller.out += NOISE
        if self._faults.pop(Fault.LOST_OK, None) is not None:
            return
        late = self._faults.pop(Fault.LATE_OK, None)
        if late is None:
            self._controller.say(text)
        else:
            self._later(late, lambda: self._send(text.encode("ascii") + b"\r\n"))

    def _tell_switches(self) -> None:
        broken = [switch for fault, switch in _BROKEN.items() if fault in self._faults]
        self._controller.broken_switches = {0: broken[0]} if broken else {}

    def _arm(self) -> None:
        """Plan the faults that strike in the motion that runs now."""
        ready = IN_MOTION & self._faults.keys() - ({Fault.LIMIT_HIT} if self._carriage.homing else set())  # homing is there to hit switches
        for fault in sorted(ready, key=lambda fault: fault.value):
            after = self._faults.pop(fault)
            self._later(after, partial(self._strike, fault))

    def _strike(self, fault: Fault) -> None:
        if not self._controller.moving:
            return
        if fault is Fault.DISCONNECT and self._connection:
            self._connection.hang_up()
        elif fault is Fault.STALL:
            self._carriage.stall(self._clock.now())
        elif fault is Fault.RESTART:
            self._controller.power_up()
        elif fault is Fault.LIMIT_HIT and not self._carriage.homing:
            self._controller.alarm(1, critical=True)
        self._settle()

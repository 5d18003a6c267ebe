"""The board on its cable: the device that a listener serves, with its faults."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from enum import StrEnum
from functools import partial

import numpy as np
from numpy.typing import NDArray

from instruments.clock import Clock
from instruments.faults import Amounts
from instruments.listener import Connection
from instruments.stage.emulator.carriage import Carriage, Switch
from instruments.stage.emulator.controller import Controller
from instruments.stage.emulator.grbl import GrblController
from instruments.stage.emulator.marlin import MarlinController
from instruments.stage.emulator.motion import Vector
from instruments.stage.emulator.store import CLASSIC, Firmware, Store
from instruments.stage.emulator.zaber import ZaberController

CONTROLLERS: dict[str, type[Controller]] = {"Marlin": MarlinController, "Zaber": ZaberController}

GLANCE_S = 1e-3  # over which a velocity is measured


class StageFault(StrEnum):
    """Faults by name. Those of a motion strike in the running motion, or in the next one."""

    SILENT = "silent"  # nothing is answered any more
    LOST_OK = "lost ok"  # the next answer to a line is swallowed
    LATE_OK = "late ok"  # the next answer to a line comes late
    GARBAGE = "garbage"  # noise on the line before the next answer to a line
    LIMIT_HIT = "limit hit"  # a limit switch closes in a motion
    DISCONNECT = "disconnect"  # the cable comes out in a motion
    # the motor stalls in a motion and the carriage stands; the controller counts on
    STALL = "stall"
    LOST_STEP = "lost step"  # the motor loses steps in a motion; the controller counts on
    RESTART = "restart"  # the power dips in a motion, and the controller starts anew
    NO_SWITCH = "no switch"  # X's homing switch never closes
    STUCK_SWITCH = "stuck switch"  # X's homing switch never opens again
    CROOKED_GANTRY = "crooked gantry"  # Y's two motors find their switches too far apart
    PROBE_CLOSED = "probe closed"  # the probe's contact is closed


IN_MOTION = frozenset(
    {
        StageFault.LIMIT_HIT,
        StageFault.DISCONNECT,
        StageFault.STALL,
        StageFault.LOST_STEP,
        StageFault.RESTART,
    }
)
# homing is there to hit switches, and heals lost steps
NOT_WHILE_HOMING = frozenset({StageFault.LIMIT_HIT, StageFault.LOST_STEP})
BROKEN_SWITCHES = {
    StageFault.NO_SWITCH: (0, Switch.MISSING),
    StageFault.STUCK_SWITCH: (0, Switch.STUCK),
    StageFault.CROOKED_GANTRY: (1, Switch.CROOKED),
}
NOISE = b"\xff\x00<Ru|\x1b\r\n"
LOST_MM = 1.0  # lost by a lost step of which no amount is said
AMOUNTS: Amounts = {
    **{fault: (0.0, "s into the motion") for fault in StageFault if fault in IN_MOTION},
    StageFault.LOST_STEP: (LOST_MM, "mm lost"),
    StageFault.LATE_OK: (3.0, "s late"),
}


class StageEmulator:
    """The board and its mechanics, of 3 ``axes`` or 4. ``settings`` by number ($130 is 130);
    ``play_mm``: backlash by axis. Raises ValueError for unknown settings or axes.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        settings: Mapping[int, float] | None = None,
        dialect: Firmware = CLASSIC,
        axes: int = 3,
        play_mm: Vector | None = None,
        high_mm: Vector | None = None,
    ) -> None:
        self._clock = clock
        self.dialect = dialect
        store = Store(settings, dialect=dialect, axes=axes, high_mm=high_mm)
        middle = tuple(-travel / 2 for travel in store.travel_mm)
        play = play_mm or (0.0,) * axes
        self._carriage = Carriage(middle, store.travel_mm, play, store.at_far_end)
        made = CONTROLLERS.get(dialect.name, GrblController)
        self._controller = made(clock, store, self._carriage, self._answer)
        self._origin_mm, self._resets = store.origin_mm, dialect.resets_on_open
        self._connection: Connection | None = None
        self._faults: dict[StageFault, float] = {}
        self._lost_mm = LOST_MM
        self._starts_seen = 0
        self._wake_planned_s = math.inf

    def position_mm(self) -> NDArray[np.float64]:
        """The carriage's place (3,) or (4,): mm in machine coordinates, degrees for A."""
        place = np.array(self._carriage.place_mm(self._clock.now()), dtype=np.float64)
        return np.add(place, self._origin_mm, dtype=np.float64)

    def velocity(self) -> NDArray[np.float64]:
        """The commanded speed of each axis per second, (3,) or (4,)."""
        now = self._clock.now()
        if not self._carriage.moving(now):
            return np.zeros_like(self.position_mm())
        motion = self._carriage.motion
        way = np.subtract(motion.position(now + GLANCE_S), motion.position(now))
        return np.asarray(way / GLANCE_S, dtype=np.float64)

    def inject(self, fault: StageFault, after_s: float = 0.0, *, lost_mm: float = LOST_MM) -> None:
        """Start ``fault``: one of a motion ``after_s`` into it, a late answer ``after_s`` late.
        Lost steps are ``lost_mm`` on the axis that goes furthest.
        """
        self._faults[fault] = after_s
        self._lost_mm = lost_mm if fault is StageFault.LOST_STEP else self._lost_mm
        self._set_switches()
        if fault in IN_MOTION and self._controller.moving:
            self._arm()

    def cure(self, fault: StageFault) -> None:
        """End a fault that lasts, or that hasn't struck yet."""
        self._faults.pop(fault, None)
        self._set_switches()

    def connect(self, connection: Connection) -> None:
        """A host opens the port, which resets most boards. The newest host has it."""
        if self._connection:
            self._connection.hang_up()
        self._connection = connection
        self._wake_planned_s = math.inf
        if self._resets:
            self._controller.power_up()
        self._settle()

    def receive(self, connection: Connection, data: bytes) -> None:
        """Take bytes from the host, cut anywhere."""
        if connection is self._connection:
            self._controller.take(data)
            self._settle()

    def disconnect(self, connection: Connection) -> None:
        """The host has gone. What is planned still runs to its end."""
        if connection is self._connection:
            self._connection = None

    def _settle(self) -> None:
        """After an event: send the output, plan the next look, plan faults of a new motion."""
        out, self._controller.out = bytes(self._controller.out), bytearray()
        if StageFault.SILENT not in self._faults:
            self._send(out)
        if self._carriage.starts != self._starts_seen:
            self._starts_seen = self._carriage.starts
            self._arm()
        due = self._controller.next_s
        if due != self._wake_planned_s and due < math.inf:
            self._wake_planned_s = due
            self._later(due - self._clock.now(), self._wake)

    def _wake(self) -> None:
        self._wake_planned_s = math.inf
        self._controller.check_limit_switches()
        self._controller.pump()
        self._settle()

    def _send(self, data: bytes) -> None:
        if self._connection:
            self._connection.send(data)

    def _later(self, seconds: float, action: Callable[[], None]) -> None:
        if self._connection:
            self._connection.after(max(0.0, seconds), action)

    def _answer(self, text: str) -> None:
        if self._faults.pop(StageFault.GARBAGE, None) is not None:
            self._controller.out += NOISE
        if self._faults.pop(StageFault.LOST_OK, None) is not None:
            return
        late = self._faults.pop(StageFault.LATE_OK, None)
        if late is None:
            self._controller.say(text)
        else:
            self._later(late, lambda: self._send(text.encode("ascii") + b"\r\n"))

    def _set_switches(self) -> None:
        self._controller.broken_switches = dict(
            switch for fault, switch in BROKEN_SWITCHES.items() if fault in self._faults
        )
        self._controller.probe_closed = StageFault.PROBE_CLOSED in self._faults

    def _arm(self) -> None:
        """Plan the faults that strike in the motion that runs now."""
        waits = NOT_WHILE_HOMING if self._carriage.homing else frozenset()
        for fault in sorted(IN_MOTION & self._faults.keys() - waits, key=lambda fault: fault.value):
            self._later(self._faults.pop(fault), partial(self._strike, fault))

    def _strike(self, fault: StageFault) -> None:
        if not self._controller.moving:
            return
        if fault is StageFault.DISCONNECT and self._connection:
            self._connection.hang_up()
        elif fault is StageFault.STALL:
            self._carriage.stall(self._clock.now())
        elif fault is StageFault.LOST_STEP and not self._carriage.homing:
            self._carriage.lose_steps(self._lost_mm, self._clock.now())
        elif fault is StageFault.RESTART:
            self._controller.power_up()
        elif fault is StageFault.LIMIT_HIT and not self._carriage.homing:
            self._controller.alarm(1, critical=True)
        self._settle()

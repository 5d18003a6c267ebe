"""An emulated arm of this process for trying the arm's commands (`--port emulator:`), and the hand
that holds it.

The hand goes where each step of a dialogue asks, while the person at the terminal presses Enter.
The table it works on has its origin elsewhere than the arm (`PLACED`), a block with a divot at
three distances, and a bar of the calibrated length.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.config import ConfigError
from bench.rig.arm_files import Triple
from detector.geometry import Motion
from instruments.clock import Clock
from instruments.listener import Listener
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.kinematics import OutOfReachError

Floats = NDArray[np.float64]

PLACED = Motion.from_vectors((0.01, -0.02, 0.5), (150.0, -150.0, 12.0))  # world_from_arm
FRAME_MM = {"origin": (0.0, 0.0, 0.0), "x axis": (300.0, 0.0, 0.0), "plane": (60.0, 200.0, 0.0)}
CHECK_MM = (180.0, 160.0, 0.0)
# in the arm's frame
DIVOTS_MM = {"near": (200.0, 0.0, 20.0), "middle": (330.0, 0.0, 20.0), "far": (450.0, 0.0, 20.0)}
BAR_MM = (330.0, 0.0, 170.0)
SPHERE_MM = 12.7  # radius of those at its ends, and of the tip
# as arm.DIRECTIONS
BARS = ((1, 0, 0), (0, 1, 0), (1, 1, 0), (1, -1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1))
LEAN_RAD = np.radians(38.0)


@dataclass(frozen=True, slots=True)
class TouchStep:
    """One touch at the place ``what``; ``off``: where on a sphere there, outwards."""

    what: str
    number: int
    text: str
    world_mm: Triple | None = None
    off: Triple = (0.0, 0.0, 0.0)


class SimulatedArm:
    """An emulated arm at ``url``, and the hand that holds its tip, at first on the peg."""

    def __init__(
        self,
        clock: Clock,
        *,
        seed: int = 0,
        accuracy_mm: float = 0.23,
        placed: Motion = PLACED,
        length_mm: float = 300.0,
    ) -> None:
        self.clock = clock
        self._held: tuple[Floats, Floats | None] | None = None
        self.emulator = ArmEmulator(self, clock, seed=seed, accuracy_mm=accuracy_mm)
        self._lock = threading.RLock()
        self._listener = Listener(self.emulator, clock, lock=self._lock, name="arm")
        self._placed = placed
        self._within: dict[tuple[float, ...], list[Floats]] = {}
        self._half_mm = 0.5 * length_mm
        self.url = self._listener.url

    def arm_target(self) -> tuple[Floats, Floats | None] | None:
        """Where the tip is held, in the arm's frame, and its axis; for the emulated arm."""
        return self._held

    def go(self, step: TouchStep) -> None:
        """Bring the tip where ``step`` asks. Raises ConfigError where it doesn't get there."""
        with self._lock:
            try:
                self._held = self._target(step)
            except OutOfReachError as error:
                raise ConfigError.plain(f"the emulated arm can't do this: {error}") from error

    def rest(self) -> None:
        """Put the stylus on its peg."""
        with self._lock:
            self._held = None

    def __enter__(self) -> SimulatedArm:
        return self

    def __exit__(self, *_: object) -> None:
        self._listener.close()

    def _target(self, step: TouchStep) -> tuple[Floats, Floats | None]:
        if step.what in DIVOTS_MM:
            # upright, then leaning another way each time, as far as the arm's joints allow
            point = np.array(DIVOTS_MM[step.what])
            key = tuple(point.tolist())
            if key not in self._within:
                turns = 2.4 * np.arange(8)
                across, up = np.sin(LEAN_RAD), np.full(8, np.cos(LEAN_RAD))
                leaning = np.column_stack([across * np.cos(turns), across * np.sin(turns), up])
                self._within[key] = []
                for axis in (np.array([0.0, 0.0, 1.0]), *leaning):
                    with suppress(OutOfReachError):
                        self.emulator.check_reach(point, axis)
                        self._within[key].append(axis)
            within = self._within[key]
            return point, within[step.number % len(within)]
        if step.what.startswith("length"):
            along = np.array(BARS[step.number % len(BARS)], dtype=np.float64)
            side = -1.0 if step.what == "length a" else 1.0
            point = np.array(BAR_MM) + side * self._half_mm * along / np.linalg.norm(along)
            point = point + SPHERE_MM * np.array(step.off)
        else:
            world = step.world_mm or FRAME_MM.get(step.what, CHECK_MM)
            point = self._placed.inverse().apply(world)
        self.emulator.check_reach(point, None)
        return point, None

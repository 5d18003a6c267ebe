"""Motion along one line in phases of constant acceleration, as a function of time. Nothing steps.

It may not know in which direction the line lies, or whose it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

Vector = tuple[float, ...]  # one number an axis: X Y Z, and A where the board has it; mm, and degrees for A
SOON_S = 1e-9  # two moments nearer than this are one: sums of times differ in their last bits


@dataclass(frozen=True, slots=True)
class Phase:
    """Constant acceleration along a line; times in s from any origin, places in mm along the line."""

    start_s: float
    seconds: float
    start_mm: float
    speed_mm_s: float
    accel_mm_s2: float

    @property
    def end_s(self) -> float:
        return self.start_s + self.seconds

    def place_mm(self, now_s: float) -> float:
        t = min(max(now_s - self.start_s, 0.0), self.seconds)
        return self.start_mm + self.speed_mm_s * t + self.accel_mm_s2 * t * t / 2

    def speed_at(self, now_s: float) -> float:
        return self.speed_mm_s + self.accel_mm_s2 * min(max(now_s - self.start_s, 0.0), self.seconds)


def profile(length_mm: float, entry: float, cruise: float, leave: float, accel: float) -> list[tuple[float, float, float]]:
    """The fastest way along ``length_mm`` from speed ``entry`` to ``leave`` at no more than ``cruise``.

    Phases as (seconds, speed at its start, acceleration); speeds in mm/s, ``accel`` in mm/s² and positive. An
    ``entry`` above ``cruise`` is braked first; where the length is too short to brake, the braking is harder.
    """
    if length_mm <= 0:
        return []
    if entry**2 - leave**2 >= 2 * accel * length_mm:
        return [(2 * length_mm / (entry + leave), entry, (leave**2 - entry**2) / (2 * length_mm))]
    peak = min(cruise, math.sqrt((2 * accel * length_mm + entry**2 + leave**2) / 2))
    first = accel if peak >= entry else -accel
    first_mm = (peak**2 - entry**2) / (2 * first)
    last_mm = max(0.0, (peak**2 - leave**2) / (2 * accel))
    phases = [
        ((peak - entry) / first, entry, first),
        (max(0.0, length_mm - first_mm - last_mm) / peak, peak, 0.0),
        (max(0.0, peak - leave) / accel, peak, -accel),
    ]
    return [phase for phase in phases if phase[0] > 0]


def lay(phases: Sequence[tuple[float, float, float]], start_s: float, start_mm: float = 0.0) -> tuple[Phase, ...]:
    """Phases one after the other from ``start_s`` and ``start_mm`` on."""
    laid = []
    for seconds, speed, accel in phases:
        laid.append(Phase(start_s, seconds, start_mm, speed, accel))
        start_s += seconds
        start_mm += speed * seconds + accel * seconds * seconds / 2
    return tuple(laid)

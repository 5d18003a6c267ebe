"""Whether a bath's reading is live, or the last one of a sensor or a controller that stopped.

A fine reading (steps up to `COARSE_K`) shows noise: the same raw value for minutes is no steady
bath. A coarse one repeats itself in the best of baths. There the controller's output is the sign: a
controller that sees its sensor's noise turns its output up and down, while one that sees a constant
error moves it one way only, or not at all. Where no output is reported, another sensor of the
bath that moves is taken. docs/safety.md argues it; pure.
"""

from __future__ import annotations

import math
from collections.abc import Hashable

from instruments.bath.profile import Profile
from instruments.bath.reading import BathReading

COARSE_K = 0.05  # a reading in steps of more than this stands still in the best of baths
# of the output: a sensor that stops makes it turn once, from its last jump to the integral's way
TURNS_WITHIN_S = 60.0
SAME_K = 1e-4  # two readings of a float that differ by less are one


class Liveness:
    """Called with each reading, gives a value that changes with each sign of life."""

    def __init__(self, profile: Profile) -> None:
        self._step_k = profile.row("temperature").step
        self._seen_k = math.inf  # the smallest change so far
        self._last: BathReading | None = None
        self._risen: bool | None = None  # the way that the output moved last
        self._turned_s = -math.inf
        self._signs = 0

    @property
    def coarse(self) -> bool:
        """By the smallest change seen, once there was one; a family's models differ in it."""
        step_k = self._step_k if math.isinf(self._seen_k) else self._seen_k
        return step_k > COARSE_K

    def __call__(self, now: BathReading) -> Hashable:
        before, self._last = self._last, now
        turned = before is not None and self._turned(before, now)
        if before is None or before.raw != now.raw:
            self._signs += 1
            change_k = abs(now.temp_c - before.temp_c) if before else 0.0
            if change_k > SAME_K:
                self._seen_k = min(self._seen_k, change_k)
        elif self.coarse and (turned or self._other_moved(before, now)):
            self._signs += 1
        return self._signs

    def _turned(self, before: BathReading, now: BathReading) -> bool:
        """Whether the output, which went one way, goes the other now, not for the first time."""
        was, output = before.power_percent, now.power_percent
        if was is None or output is None or output == was:
            return False
        risen, self._risen = self._risen, output > was
        if risen is None or risen is self._risen:
            return False
        last_s, self._turned_s = self._turned_s, now.t_s
        return now.t_s - last_s <= TURNS_WITHIN_S

    @staticmethod
    def _other_moved(before: BathReading, now: BathReading) -> bool:
        return now.power_percent is None and (before.external_c, before.safety_c) != (
            now.external_c,
            now.safety_c,
        )

"""The contacts of the emulated pedals: open, closed, or bouncing for a while after they were moved. It may not know a wire."""

from __future__ import annotations

import numpy as np

_CHANCE = 3  # this stream of chance


class Contacts:
    """Bit 0 is the single or right pedal, bit 1 the left one; 1 is pressed."""

    def __init__(self, seed: int) -> None:
        self._seed = seed
        self._moved = 0
        self._before = self._after = 0
        self._settled_s = 0.0

    @property
    def meant(self) -> int:
        """What the feet do."""
        return self._after

    def move(self, buttons: int, now_s: float, bounce_s: float) -> None:
        """The feet press or release; what changes bounces for ``bounce_s``."""
        self._before, self._after, self._settled_s = self._after, buttons, now_s + bounce_s
        self._moved += 1

    def at(self, now_s: float, look: int) -> int:
        """What the contacts show at the ``look``-th look: before they have settled, either."""
        if now_s >= self._settled_s:
            return self._after
        chance = np.random.default_rng([self._seed, _CHANCE, self._moved, look])
        return self._before if chance.random() < 0.5 else self._after

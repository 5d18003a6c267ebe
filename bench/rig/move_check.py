"""Whether touched ends moved as the stage was sent. A carriage that something blocks goes unnoticed
by its controller; the place that it reads back is then wrong.
"""

from __future__ import annotations

import numpy as np

from bench.scoring.errors import Floats

TOUCHED_MM = 5.0  # no touches of sound ends are off by more
SET_UP_MM = 50.0  # between two set-ups of a phantom by hand
SKEW_RAD = 0.1  # of the stage's axes to the world's


class MoveCheck:
    """Compares the ends' moves with the stage's; where the phantom stands doesn't matter."""

    def __init__(self) -> None:
        self.trials: list[str] = []  # that agree with one another
        self._before = "", np.zeros(3), np.zeros(3)

    def doubt(self, trial: str, fixed: str, expected_mm: Floats, touched_mm: Floats) -> str:
        """Why ends (n, 3) contradict the stage's move; "" where not: the next are held to them."""
        was_fixed, was_expected_mm, was_touched_mm = self._before
        now = fixed, expected_mm.mean(axis=0), touched_mm.mean(axis=0)
        sent_mm = now[1] - was_expected_mm
        off_mm = float(np.linalg.norm(now[2] - was_touched_mm - sent_mm))
        least_mm = TOUCHED_MM if fixed == was_fixed else SET_UP_MM
        if self.trials and off_mm > max(least_mm, SKEW_RAD * float(np.linalg.norm(sent_mm))):
            since = f"the stage's move since {self.trials[-1]}"
            return f"the ends are {off_mm:.0f} mm from where {since} should have taken them"
        self.trials += [] if trial in self.trials else [trial]
        self._before = now
        return ""

"""Whether the touched ends moved as the stage was sent. A carriage that something blocks goes
unnoticed by its controller; the place that it reads back is then wrong.

Ends are compared with those of the trial before, so that a phantom that stands elsewhere than the
script says is no fault. Axes that lie askew to the world's may turn a move by `SKEW_RAD`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from bench.scoring.errors import Floats
from bench.truth.touching import AstrayError, ExpectedScene
from bench.truth.uncertainty import TrueEnd

TOUCHED_MM = 5.0  # no touches of sound ends are off by more
SET_UP_MM = 50.0  # between two set-ups of a phantom by hand
SKEW_RAD = 0.1


@dataclass(slots=True)
class MoveCheck:
    """Of a run whose ends are touched at each pose."""

    _trials: list[str] = field(default_factory=list)  # that agree with one another
    _before: ExpectedScene | None = None
    _touched_mm: Floats = field(default_factory=lambda: np.zeros(3))

    def compare(self, shown: ExpectedScene, points: Sequence[TrueEnd], *, homed: bool) -> str:
        """Raises AstrayError where the stage did not do its move since the trial before. Where it
        was ``homed`` meanwhile the trial before is in doubt: gives back a sentence, else "".
        """
        before, before_mm = self._before, self._touched_mm
        touched_mm = np.mean([point.xyz_mm for point in points], axis=0)
        doubt = ""
        if before is not None:
            sent_mm = shown.ends.expected_mm.mean(axis=0) - before.ends.expected_mm.mean(axis=0)
            off_mm = float(np.linalg.norm(touched_mm - before_mm - sent_mm))
            least_mm = TOUCHED_MM if shown.fixed == before.fixed else SET_UP_MM
            if off_mm > max(least_mm, SKEW_RAD * float(np.linalg.norm(sent_mm))):
                doubt = (
                    f"the ends are {off_mm:.0f} mm from where the stage's move since"
                    f" {before.trial} should have taken them"
                )
        if doubt and not homed:
            raise AstrayError("truth", doubt)
        if doubt:
            doubt += (
                ", after homing too. Something blocked the stage before, or the phantom was"
                f" moved on it: in doubt is where the stage stood in {', '.join(self._trials)}"
            )
            self._trials.clear()
        self._trials.append(shown.trial)
        self._before, self._touched_mm = shown, touched_mm
        return doubt

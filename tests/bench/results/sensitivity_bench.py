"""A bench small enough for tests: detectors that need no picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from detector.calibration import Calibration
from detector.protocol import Detection, Frames, Teat


@dataclass(slots=True)
class Knowing:
    """Gives set points, off by ``error_mm``, and counts how often it is asked; with ``breaks`` it
    fails instead.
    """

    ends_mm: list[Any]
    error_mm: float = 0.0
    breaks: bool = False
    name: str = "knowing"
    told: list[Calibration] = field(default_factory=list)

    version = "7"

    @property
    def parameters(self) -> Mapping[str, Any]:
        return {}

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        assert frames.left.shape == (1024, 1360)
        self.told.append(calibration)
        if self.breaks:
            raise RuntimeError("no")
        return Detection(
            tuple(Teat(np.add(end, (0.0, self.error_mm, 0.0))) for end in self.ends_mm)
        )

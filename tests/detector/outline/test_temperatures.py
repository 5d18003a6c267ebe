"""Counts that no barn's picture has: the outline's limits are those of the cameras."""

from __future__ import annotations

import numpy as np
import pytest

from bench.config import read_calibration
from bench.rig.loading import RIGS
from detector.outline import pictures
from instruments.camera import frame


@pytest.mark.parametrize("off_c", [-0.011, 0.011], ids=["below", "above"])
@pytest.mark.parametrize("limit_c", frame.BARN_C)
def test_both_refuse_alike_on_either_side_of_each_limit(limit_c: float, off_c: float) -> None:
    camera = read_calibration(RIGS / "calibration.toml").thermal
    columns, rows = camera.sensor_size
    counts = np.full((rows, columns), round(100.0 * (limit_c + off_c + 273.15)), np.uint16)
    grey = np.zeros((4, 4), np.uint8)
    shown = frame.FrameSet(grey, grey, thermal_ck=counts)
    try:
        pictures.thermal(shown, camera)
        refused = ""
    except pictures.UnusableError as error:
        refused = str(error)
    assert bool(refused) == bool(frame.no_temperatures(counts))
    assert bool(refused) == ((limit_c < 0) == (off_c < 0)), "outside of the limits alone"


def test_the_limits_are_one_statement() -> None:
    assert pictures.BARN_C == frame.BARN_C

"""Has the operator touch each teat end, and reads the arm: the truth of a trial, as rows and as points with an uncertainty."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np

from bench.arm.tip import TipReader
from bench.devices import Devices
from bench.rig import Arm
from bench.store import Row
from bench.truth import TruthPoint, touched


def touch_all(
    devices: Devices, tip: TipReader, arm: Arm, trial_id: str, teats: int, check: Callable[[], None]
) -> tuple[list[TruthPoint], list[Row]]:
    """A truth for each of ``teats`` ends, and a row for each touch; ``check`` is called before each, and may raise."""
    points, rows = [], []
    for teat in range(1, teats + 1):
        touches = []
        for touch in range(1, arm.touches + 1):
            check()
            touches.append(_touch(devices, tip, trial_id, teat, touch, teats))
        tips = np.array([[row["x_mm"], row["y_mm"], row["z_mm"]] for row in touches])
        registration_mm = tip.u_registration_mm(tips.mean(axis=0))
        points.append(touched(tips, accuracy_mm=arm.accuracy_mm, definition_mm=arm.definition_mm, registration_mm=registration_mm))
        rows += touches
    devices.operator.release()
    return points, rows


def _touch(devices: Devices, tip: TipReader, trial_id: str, teat: int, touch: int, of: int) -> Row:
    devices.operator.touch(teat, of)
    reading = tip.read()
    x, y, z = (float(v) for v in reading.point_mm)
    return {
        "trial": trial_id,
        "teat": str(teat),
        "touch": touch,
        "t_s": devices.clock.now(),
        "x_mm": x,
        "y_mm": y,
        "z_mm": z,
        "spread_mm": reading.spread_mm,
        "packets": reading.n,
        "counts": json.dumps([int(count) for count in reading.counts]),
    }

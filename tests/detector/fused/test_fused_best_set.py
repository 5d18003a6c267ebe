"""What can't be given together: teats that pass through each other, and an end that another teat
hides from both optical cameras.
"""

from __future__ import annotations

import numpy as np
import pytest

from detector.calibration import Calibration
from detector.fused.decide import exclude, hidden_by
from detector.outline.prior import eyes_mm, right_from_teats

EYES = np.array([[-50.0, 0, 0], [50.0, 0, 0]])


def teat(x: float, along: float, z: float, radius: float = 11.0) -> list[float]:
    """An upright one; ``along``: how far its end is shifted in its axis."""
    return [x, along, z, 0.0, 0.0, radius, 0.0, 1.0]


@pytest.mark.parametrize(
    ("front", "hides"),
    [
        (teat(0, 0, 870), True),  # on both cameras' lines of sight
        (teat(0, -30, 870), True),  # its side is
        (teat(0, 30, 870), False),  # it ends before them
        (teat(0, 0, 700), False),  # each camera sees past it
        (teat(-10, 0, 800), False),  # on the left camera's alone
        (teat(25, 0, 870), False),  # beside them
        (teat(0, 0, 870, 5.0), False),  # narrower than what it would have to hide
        (teat(0, 0, 930), False),  # behind it
    ],
)
def test_an_end_behind_another_teat_was_seen_by_no_camera(front: list[float], hides: bool) -> None:
    teats = np.array([teat(0, 0, 900), front])
    assert hidden_by(teats, EYES)[0, 1] == hides
    both = exclude(teats, EYES)
    assert both[0, 1] == both[1, 0] == (hides or front[2] == 930)


def test_the_eyes_are_the_cameras_centres(rig: Calibration) -> None:
    left, right = right_from_teats(rig).apply(eyes_mm(rig))
    assert right == pytest.approx([0, 0, 0])
    assert rig.right_from_left.inverse().apply(left) == pytest.approx([0, 0, 0], abs=1e-9)

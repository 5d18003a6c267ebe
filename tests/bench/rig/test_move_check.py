"""Ends that did not move as the stage was sent, beside those of a sound stage."""

from __future__ import annotations

import numpy as np
import pytest

from bench.rig.move_check import MoveCheck
from tests.bench.truth.touches import ENDS_MM


@pytest.mark.parametrize(
    ("sent_mm", "gone_mm", "fixed", "seen"),
    [
        ((100.0, 0.0), (100.0, 0.0), "same", False),
        ((100.0, 0.0), (99.5, 9.0), "same", False),  # a stage that stands askew
        ((100.0, 0.0), (85.0, 0.0), "same", True),
        ((6.0, 0.0), (0.0, 0.0), "same", True),
        ((4.0, 0.0), (0.0, 0.0), "same", False),
        ((0.0, 40.0), (0.0, 0.0), "set up anew", False),
        ((0.0, 60.0), (0.0, 0.0), "set up anew", True),
    ],
)
def test_a_move_is_held_against_the_touched_ends(
    sent_mm: tuple[float, float], gone_mm: tuple[float, float], fixed: str, *, seen: bool
) -> None:
    """The phantom stands 40 mm beside its place all the time: that is nothing of the stage's."""
    check, stood_mm = MoveCheck(), ENDS_MM + np.array([40.0, 0.0, 0.0])
    assert check.doubt("001", "same", ENDS_MM, stood_mm) == ""
    moved = ENDS_MM + np.array([*sent_mm, 0.0]), stood_mm + np.array([*gone_mm, 0.0])
    assert ("the stage's move since 001" in check.doubt("002", fixed, *moved)) is seen
    assert check.trials == (["001"] if seen else ["001", "002"])

"""Ends that did not move as the stage was sent, beside those of a sound stage."""

from __future__ import annotations

import numpy as np
import pytest

from bench.truth.move_check import MoveCheck
from bench.truth.touching import AstrayError, Ends, ExpectedScene
from bench.truth.uncertainty import Component, TrueEnd, TruthUncertainty
from tests.bench.truth.touches import ENDS_MM, UP


def ends(places_mm: np.ndarray) -> list[TrueEnd]:
    known = TruthUncertainty((Component("arm", 0.3, "stated"),))
    return [TrueEnd.at(place, known) for place in places_mm]


@pytest.mark.parametrize(
    ("sent_mm", "gone_mm", "fixed", "seen"),
    [
        ([100.0, 0.0, 0.0], [100.0, 0.0, 0.0], "same", False),
        ([100.0, 0.0, 0.0], [99.5, 9.0, 0.0], "same", False),  # a stage that stands askew
        ([100.0, 0.0, 0.0], [85.0, 0.0, 0.0], "same", True),
        ([6.0, 0.0, 0.0], [0.0, 0.0, 0.0], "same", True),
        ([4.0, 0.0, 0.0], [0.0, 0.0, 0.0], "same", False),
        ([0.0, 40.0, 0.0], [0.0, 0.0, 0.0], "set up anew", False),
        ([0.0, 60.0, 0.0], [0.0, 0.0, 0.0], "set up anew", True),
    ],
)
def test_a_move_is_held_against_the_touched_ends(
    sent_mm: list[float], gone_mm: list[float], fixed: str, *, seen: bool
) -> None:
    """The phantom stands 40 mm beside its place all the time: that is nothing of the stage's."""
    check, stood_mm = MoveCheck(), ENDS_MM + np.array([40.0, 0.0, 0.0])
    first = ExpectedScene("001", Ends(ENDS_MM, UP), "same")
    second = ExpectedScene("002", Ends(ENDS_MM + np.array(sent_mm), UP), fixed)
    assert check.compare(first, ends(stood_mm), homed=False) == ""
    there = ends(stood_mm + np.array(gone_mm))
    if not seen:
        assert check.compare(second, there, homed=False) == ""
        return
    with pytest.raises(AstrayError, match="the stage's move since 001"):
        check.compare(second, there, homed=False)
    assert check.compare(second, there, homed=True).endswith("the stage stood in 001")
    assert check.compare(second, there, homed=False) == "", "it is the reference from then on"

"""The dialogue of touching: who is asked for what, again where needed, and not for ever."""

from __future__ import annotations

import numpy as np
import pytest

from bench.truth.touching import SPARE, Ends, NoTruthError
from instruments.microscribe.errors import ArmMovesError
from instruments.teat_end import ball_centre_mm
from tests.bench.truth.touches import ENDS_MM, UP, Hand, arm_settings, layout, table_5_1, toucher


def test_every_end_is_read_as_often_as_asked() -> None:
    hand = Hand(ENDS_MM)
    points, rows = toucher(hand, readings=2).touch_all(table_5_1())
    assert hand.asked == [(teat, number, 2) for teat in (1, 2, 3, 4) for number in (1, 2)]
    assert np.allclose([p.point_mm for p in points], ENDS_MM)
    assert [(row["teat"], row["touch"], row["refused"]) for row in rows] == [
        (str(t), n, None) for t in (1, 2, 3, 4) for n in (1, 2)
    ]
    assert hand.released == 1
    assert hand.again == []


def test_a_slip_is_asked_for_again_and_kept_with_its_reason() -> None:
    end = ENDS_MM[0]
    hand = Hand(ENDS_MM, [end, end + np.array([0.1, 0.0, 0.0]), end + np.array([2.0, 0.0, -1.0])])
    point, rows = toucher(hand, readings=3).touch_one(1, table_5_1())
    assert [row["refused"] is None for row in rows] == [True, True, False, True]
    assert "median" in rows[2]["refused"]
    assert hand.asked == [(1, 1, 3), (1, 2, 3), (1, 3, 3), (1, 3, 3)]
    assert hand.again[0].startswith("A touch of teat 1 is refused")
    assert np.linalg.norm(np.array(point.point_mm) - end) < 0.1


def test_the_wrong_teat_is_asked_for_again() -> None:
    hand = Hand(ENDS_MM, [ENDS_MM[0], ENDS_MM[2]])
    points, rows = toucher(hand, readings=1).touch_all(table_5_1())
    assert hand.again == [next(row["refused"] for row in rows if row["refused"]) + " Touch teat 2."]
    assert "looks like teat 3" in hand.again[0]
    assert np.allclose([p.point_mm for p in points], ENDS_MM)


def test_the_same_end_twice_is_asked_for_again() -> None:
    hand = Hand(ENDS_MM, [ENDS_MM[0], ENDS_MM[0] + 0.2])
    points, _ = toucher(hand, readings=1).touch_all(table_5_1())
    assert "teat 1 once more" in hand.again[0]
    assert np.allclose([p.point_mm for p in points], ENDS_MM)


def test_the_same_end_twice_is_asked_for_again_also_where_the_places_are_not_known() -> None:
    hand = Hand(ENDS_MM, [ENDS_MM[0], ENDS_MM[0] + 0.2])
    points, _ = toucher(hand, readings=1).touch_all(Ends(ENDS_MM, UP, known=False))
    assert "teat 1 once more (0.3 mm" in hand.again[0]
    assert np.allclose([p.point_mm for p in points], ENDS_MM)


def test_asking_again_has_an_end() -> None:
    hand = Hand(ENDS_MM, [ENDS_MM[1]] * 20)
    with pytest.raises(
        NoTruthError, match=r"teat 1.*could not be used.*looks like teat 2"
    ) as raised:
        toucher(hand, readings=3).touch_all(table_5_1())
    assert len(hand.asked) == 3 + SPARE
    assert "stand where the script says" in str(raised.value)


def test_an_arm_that_moves_is_read_again() -> None:
    hand = Hand(ENDS_MM, [None, ENDS_MM[0]])
    point, rows = toucher(hand, readings=1).touch_one(1, table_5_1())
    assert point.point_mm == pytest.approx(tuple(ENDS_MM[0]))
    assert len(rows) == 1, "nothing was read, so there is no row of it"
    assert "moved" in hand.again[0]
    with pytest.raises(NoTruthError, match="moved"):
        toucher(Hand(ENDS_MM, [None] * 20), readings=1).touch_one(1, table_5_1())
    assert issubclass(ArmMovesError, Exception)


def test_a_ball_tip_is_taken_off_along_each_teat_s_axis() -> None:
    phantom = layout("non-vertical")
    centres = [
        ball_centre_mm(end, axis, 3.0)
        for end, axis in zip(phantom.ends_mm, phantom.axes, strict=True)
    ]
    hand = Hand(phantom.ends_mm, centres)
    points, rows = toucher(hand, readings=1, arm=arm_settings(tip_radius_mm=3.0)).touch_all(
        Ends(phantom.ends_mm, phantom.axes)
    )
    assert np.allclose([p.point_mm for p in points], phantom.ends_mm)
    assert np.allclose([[row["x_mm"], row["y_mm"], row["z_mm"]] for row in rows], centres), (
        "the record keeps what the arm said"
    )
    plain, _ = toucher(Hand(phantom.ends_mm, centres), readings=1).touch_all(
        Ends(phantom.ends_mm, phantom.axes)
    )
    off = np.linalg.norm(np.array([p.point_mm for p in plain]) - phantom.ends_mm, axis=1)
    assert off == pytest.approx(3.0), "not corrected, the truth is a radius off"


def test_where_the_places_are_not_known_they_are_not_used() -> None:
    hand = Hand(ENDS_MM, [ENDS_MM[2]])
    point, _ = toucher(hand, readings=1).touch_one(1, Ends(ENDS_MM, UP, known=False))
    assert point.point_mm == pytest.approx(tuple(ENDS_MM[2]))
    assert hand.again == []

"""The dialogue of touching: who is asked for what, again where needed, and not for ever; when a
touch is refused, and what must not be refused.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from bench.truth.touching import (
    FAR,
    MEDIAN_LENGTH,
    SPARE,
    Ends,
    NoTruthError,
    SoFar,
    mistaken,
    outliers,
    reading_u_mm,
)
from tests.bench.truth.touches import (
    ENDS_MM,
    UP,
    Floats,
    Hand,
    arm_settings,
    layout,
    table_5_1,
    toucher,
)

ENDS = Ends(ENDS_MM, UP)


def test_every_end_is_read_as_often_as_asked() -> None:
    hand = Hand(ENDS_MM)
    points, rows = toucher(hand, readings=2).touch_all(table_5_1())
    assert hand.asked == [(teat, number, 2) for teat in (1, 2, 3, 4) for number in (1, 2)]
    assert np.allclose([p.xyz_mm for p in points], ENDS_MM)
    assert [(row["teat"], row["touch"], row["refused"]) for row in rows] == [
        (str(t), n, None) for t in (1, 2, 3, 4) for n in (1, 2)
    ]
    assert hand.released == 1
    assert hand.again == []


@pytest.mark.parametrize("shift_mm", [0.1, 3.0])
def test_touches_of_an_interrupted_pose_count_where_one_more_agrees(shift_mm: float) -> None:
    hand, so_far = Hand(ENDS_MM), SoFar()
    asking = toucher(hand, readings=2)
    asking.touch_all(table_5_1(), so_far)
    del so_far[2][1], so_far[3], so_far[4]
    hand.ends, hand.asked[:] = ENDS_MM + np.array([shift_mm, 0.0, 0.0]), []
    points, rows = asking.touch_all(table_5_1(), so_far)
    anew = shift_mm > 1.0
    missing = [(2, 2, 2), *((teat, n, 2) for teat in (3, 4) for n in (1, 2))]
    all_ends = [(teat, n, 2) for teat in (1, 2, 3, 4) for n in (1, 2)]
    assert hand.asked == [(1, 1, 1), *(all_ends if anew else missing)]
    assert hand.again[0].startswith("One touch of teat 1 shows whether the 3 of this pose")
    assert ("touched anew" in hand.again[-1]) is anew
    assert [row["touch"] for row in rows][:3] == ([1, 2, 1] if anew else [1, 2, 3])
    off_mm = np.linalg.norm(np.subtract([p.xyz_mm for p in points], hand.ends), axis=1)
    assert off_mm.max() < 0.11


def test_a_slip_is_asked_for_again_and_kept_with_its_reason() -> None:
    end = ENDS_MM[0]
    hand = Hand(ENDS_MM, [end, end + np.array([0.1, 0.0, 0.0]), end + np.array([2.0, 0.0, -1.0])])
    point, rows = toucher(hand, readings=3).touch_one(1, table_5_1())
    assert [row["refused"] is None for row in rows] == [True, True, False, True]
    assert "median" in rows[2]["refused"]
    assert hand.asked == [(1, 1, 3), (1, 2, 3), (1, 3, 3), (1, 3, 3)]
    assert hand.again[0].startswith("A touch of teat 1 is refused")
    assert np.linalg.norm(np.array(point.xyz_mm) - end) < 0.1


def test_the_wrong_teat_is_asked_for_again() -> None:
    hand = Hand(ENDS_MM, [ENDS_MM[0], ENDS_MM[2]])
    points, rows = toucher(hand, readings=1).touch_all(table_5_1())
    assert hand.again == [next(row["refused"] for row in rows if row["refused"]) + " Touch teat 2."]
    assert "looks like teat 3" in hand.again[0]
    assert np.allclose([p.xyz_mm for p in points], ENDS_MM)


@pytest.mark.parametrize(
    "moved",
    [
        np.add(ENDS_MM, [0.0, 0.0, 2000.0]),
        ENDS_MM / 1000.0,  # metres
        ENDS_MM[:, [2, 0, 1]],  # another frame's axes
        np.subtract(ENDS_MM, [0.0, 160.0, 0.0]),
    ],
)
def test_an_end_far_from_the_scripts_place_is_no_truth(moved: np.ndarray) -> None:
    hand = Hand(moved, [moved[0]] * 20)
    with pytest.raises(NoTruthError, match=r"teat 1: .* could not be used; the last one: That"):
        toucher(hand, readings=3).touch_all(table_5_1())
    near = np.add(ENDS_MM, [140.0, 0.0, 0.0])
    points, _ = toucher(Hand(near, [near[0]]), readings=1).touch_all(table_5_1())
    assert np.allclose([p.xyz_mm for p in points], near)


@pytest.mark.parametrize(("known", "says"), [(True, ""), (False, " (0.3 mm")])
def test_the_same_end_twice_is_asked_for_again(known: bool, says: str) -> None:
    """Also where the places are not known."""
    hand = Hand(ENDS_MM, [ENDS_MM[0], ENDS_MM[0] + 0.2])
    points, _ = toucher(hand, readings=1).touch_all(Ends(ENDS_MM, UP, known))
    assert f"teat 1 once more{says}" in hand.again[0]
    assert np.allclose([p.xyz_mm for p in points], ENDS_MM)


def test_asking_again_has_an_end() -> None:
    hand = Hand(ENDS_MM, [ENDS_MM[1]] * 20)
    why = r"teat 1.*could not be used.*looks like teat 2"
    with pytest.raises(NoTruthError, match=why) as raised:
        toucher(hand, readings=3).touch_all(table_5_1())
    assert len(hand.asked) == 3 + SPARE
    assert "stand where the script says" in str(raised.value)


def test_an_arm_that_moves_is_read_again() -> None:
    hand = Hand(ENDS_MM, [None, ENDS_MM[0]])
    point, rows = toucher(hand, readings=1).touch_one(1, table_5_1())
    assert point.xyz_mm == pytest.approx(tuple(ENDS_MM[0]))
    assert len(rows) == 1, "nothing was read, so there is no row of it"
    assert "moved" in hand.again[0]
    with pytest.raises(NoTruthError, match="moved"):
        toucher(Hand(ENDS_MM, [None] * 20), readings=1).touch_one(1, table_5_1())


def test_a_ball_tip_is_taken_off_along_each_teat_s_axis() -> None:
    phantom = layout("non-vertical")
    ends = Ends(phantom.ends_mm, phantom.axes)
    both = zip(phantom.ends_mm, phantom.axes, strict=True)
    centres = [end + 3.0 * axis for end, axis in both]
    ball = toucher(Hand(phantom.ends_mm, centres), readings=1, arm=arm_settings(tip_radius_mm=3.0))
    points, rows = ball.touch_all(ends)
    assert np.allclose([p.xyz_mm for p in points], phantom.ends_mm)
    # the record keeps what the arm said
    assert np.allclose([[row["x_mm"], row["y_mm"], row["z_mm"]] for row in rows], centres)
    plain, _ = toucher(Hand(phantom.ends_mm, centres), readings=1).touch_all(ends)
    off = np.linalg.norm(np.array([p.xyz_mm for p in plain]) - phantom.ends_mm, axis=1)
    assert off == pytest.approx(3.0), "not corrected, the truth is a radius off"


def test_where_the_places_are_not_known_they_are_not_used() -> None:
    hand = Hand(ENDS_MM, [ENDS_MM[2]])
    point, _ = toucher(hand, readings=1).touch_one(1, Ends(ENDS_MM, UP, known=False))
    assert point.xyz_mm == pytest.approx(tuple(ENDS_MM[2]))
    assert hand.again == []


S0 = reading_u_mm(arm_settings())


@pytest.mark.parametrize("n", [3, 5, 8])
def test_honest_readings_are_hardly_ever_refused(n: int) -> None:
    rng = np.random.default_rng(n)
    lost = sum(bool(outliers(rng.normal(0.0, S0, (n, 3)), S0)) for _ in range(2000))
    assert lost <= 6, f"{lost} of 2000 ends lost a reading that belonged to it"


def test_an_unsteady_hand_widens_its_own_limit() -> None:
    rng = np.random.default_rng(7)
    lost = sum(len(outliers(rng.normal(0.0, 5.0 * S0, (8, 3)), S0)) for _ in range(500))
    assert lost <= 0.03 * 8 * 500


def test_of_two_readings_neither_can_be_shown_to_be_wrong() -> None:
    apart = np.array([[0.0, 0.0, 0.0], [FAR * S0 * 1.5, 0.0, 0.0]])
    assert list(outliers(apart, S0)) == [0, 1]
    assert outliers(0.5 * apart, S0) == outliers(apart[:1], S0) == {}
    assert pytest.approx(scipy.stats.chi.median(3), abs=1e-4) == MEDIAN_LENGTH


@given(st.permutations([1, 2, 3, 4]), st.tuples(*[st.floats(-12.0, 12.0)] * 2))
def test_a_wrong_order_is_noticed_wherever_the_phantom_came_to_stand(
    order: list[int], shift: tuple[float, float]
) -> None:
    there = ENDS_MM + np.array([*shift, 0.0])
    done: dict[int, np.ndarray] = {}
    noticed = False
    for asked, touched in zip((1, 2, 3, 4), order, strict=True):
        reason = mistaken(there[touched - 1], asked, ENDS, done)
        if reason:
            noticed = True
            assert asked != touched
            assert f"teat {touched}" in reason
            break
        done[asked] = there[touched - 1]
    assert noticed == (order != [1, 2, 3, 4])


def test_near_teats_are_told_apart_and_a_place_between_is_left_to_the_operator() -> None:
    between = (ENDS_MM[0] + ENDS_MM[1]) / 2
    assert mistaken(between, 1, ENDS, {}) is mistaken(between, 2, ENDS, {}) is None
    # 22 mm: the layout "overlapping"
    near = np.array([[-95.0, 232.0, 136.0], [-117.0, 232.0, 134.0]])
    assert mistaken(near[0] + [3.0, 0.0, 0.0], 1, Ends(near, UP[:2]), {}) is None
    assert mistaken(near[1] + [3.0, 0.0, 0.0], 1, Ends(near, UP[:2]), {}) is not None


@dataclass
class Robot(Hand):
    """An arm that goes to the end by itself, ``off_mm`` beside where it is expected."""

    touches = True
    off_mm: float = 0.3

    def touch(self, point_mm: Floats, axis: Floats) -> None:
        assert float(np.linalg.norm(axis)) == pytest.approx(1.0)
        self._at = point_mm + np.array([self.off_mm, 0.0, 0.0])


def test_an_arm_that_touches_by_itself_is_told_where_and_nobody_is_asked() -> None:
    robot = Robot(ENDS_MM)
    points, rows = toucher(robot, readings=2).touch_all(table_5_1())
    assert robot.asked == []
    assert len(rows) == 2 * len(ENDS_MM)
    places = np.array([point.xyz_mm for point in points])
    assert places == pytest.approx(ENDS_MM + np.array([0.3, 0.0, 0.0]))

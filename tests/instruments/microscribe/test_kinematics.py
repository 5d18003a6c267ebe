"""Forward kinematics against the fact sheet's check values, and the way back."""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.microscribe.kinematics import (
    RANGES_RAD,
    Floats,
    OutOfReachError,
    inverse,
    surely_reached,
)
from tests.instruments.microscribe import rigs
from tests.instruments.microscribe.rigs import UNIT

ARM, TURNS, HOME = UNIT.geometry(), UNIT.maxima.turns, UNIT.home
SHEET = [
    ((0, 6238, 6868, 4098, 3193, 8416), (73.6746, 14.0353, 212.2005), (0.00842, -0.00297, 0.99996)),
    ((0, 0, 0, 0, 0, 0), (298.3763, 12.8422, -157.9246), (0, 0.00297, 1)),
    (
        (4096, 2048, 1024, 512, 256, 0),
        (19.6568, 563.1507, 438.6562),
        (-0.27183, -0.92310, -0.27201),
    ),
]


def test_check_values_of_the_sheet() -> None:
    tips, axes = ARM.forward([counts for counts, _, _ in SHEET])
    np.testing.assert_allclose(tips, [tip for _, tip, _ in SHEET], atol=1e-4)
    np.testing.assert_allclose(axes, [axis for _, _, axis in SHEET], atol=1e-5)


def test_counts_past_one_turn_are_the_same_pose_and_the_sixth_joint_is_none() -> None:
    once = np.array([100, 200, 300, 2, 400, 0])
    np.testing.assert_array_equal(
        ARM.forward(once)[0], ARM.forward(once + np.array([0, 0, 8192, 4096, 3 * 4096, 77]))[0]
    )


def test_rounding_alone_moves_the_tip_by_what_the_sheet_says() -> None:
    counts = np.random.default_rng(7).uniform(0, 16384, (20000, 6))
    moved = np.linalg.norm(ARM.forward(np.rint(counts))[0] - ARM.forward(counts)[0], axis=1)
    assert np.sqrt(np.mean(moved**2)) == pytest.approx(0.105, abs=0.003)
    assert moved.max() < 0.4


def test_the_jacobian_is_the_slope() -> None:
    counts = np.random.default_rng(1).uniform(0, 16384, (20, 6))
    slopes = ARM.jacobian(ARM.angles(counts)) * (2 * np.pi / np.array([*TURNS[:5], 1]))
    for joint in range(6):
        step = np.zeros(6)
        step[joint] = 1e-3
        (up, up_axis), (down, down_axis) = ARM.forward(counts + step), ARM.forward(counts - step)
        numeric = np.concatenate([up - down, up_axis - down_axis], axis=1) / 2e-3
        np.testing.assert_allclose(slopes[:, :, joint], numeric, atol=1e-8)
    assert not slopes[:, :, 5].any()


def tilted(tilt_deg: float, towards_deg: float) -> Floats:
    tilt, towards = np.radians([tilt_deg, towards_deg])
    return np.array([np.sin(tilt) * np.cos(towards), np.sin(tilt) * np.sin(towards), np.cos(tilt)])


@pytest.mark.slow
@given(
    st.floats(-260, -110),
    st.floats(190, 290),
    st.floats(120, 145),
    st.floats(0, 40),
    st.floats(0, 360),
)
def test_the_arm_reaches_the_teats_with_the_stylus_from_above(
    x: float, y: float, z: float, tilt: float, towards: float
) -> None:
    direction = tilted(tilt, towards)
    counts = inverse(ARM, (x, y, z), direction, start=HOME)
    tips, axes = ARM.forward(counts)
    np.testing.assert_allclose(tips, [(x, y, z)], atol=1e-6)
    assert np.linalg.norm(axes - direction) < 0.02
    turned = (counts - HOME)[:5] / TURNS[:5] * 2 * np.pi
    assert (turned >= RANGES_RAD[:5, 0]).all()
    assert (turned <= RANGES_RAD[:5, 1]).all()
    _, joints = ARM.frames(ARM.angles(counts))
    assert joints[0, 2, 2] > joints[0, 4, 2] + 50  # the elbow stands above the wrist
    assert counts[5] == HOME[5]
    assert np.linalg.norm(ARM.forward(np.rint(counts))[0] - tips) < 0.4


@pytest.mark.slow
def test_the_direction_is_met_exactly_outside_the_blind_cone() -> None:
    chance = np.random.default_rng(2)
    off = []
    for _ in range(40):
        point, direction = (
            chance.uniform((-260, 190, 120), (-110, 290, 145)),
            tilted(chance.uniform(0, 20), chance.uniform(0, 360)),
        )
        _, axes = ARM.forward(inverse(ARM, point, direction, start=HOME))
        off.append(np.linalg.norm(axes - direction))
    assert max(off) < 1e-8


def test_in_line_with_the_forearm_the_direction_gives_way_and_the_tip_does_not() -> None:
    # Found by a search for what 48 starts don't reach: the stylus is 0.4 degrees from the forearm's
    # line.
    point, direction = (-149.8, 251.4, 139.3), np.array([0.2059, -0.436, 0.8761])
    tips, axes = ARM.forward(inverse(ARM, point, direction, start=HOME))
    np.testing.assert_allclose(tips, [point], atol=1e-6)
    assert 1e-4 < np.linalg.norm(axes - direction / np.linalg.norm(direction)) < 0.02


def test_without_a_direction_any_pose_at_the_point_will_do() -> None:
    tip = ARM.forward(inverse(ARM, rigs.POINT, start=HOME))[0]
    np.testing.assert_allclose(tip, [rigs.POINT], atol=1e-6)


@pytest.mark.parametrize(
    ("point", "why"),
    [((2000, 0, 0), r"\(2000, 0, 0\) mm.*misses by 1\d\d\d"), ((0, 200, 100), "past its range")],
)
def test_what_is_out_of_reach_says_why(point: tuple[float, ...], why: str) -> None:
    with pytest.raises(OutOfReachError, match=why):
        inverse(ARM, point, (0, 0, -1), start=HOME)


def test_what_is_surely_reached_is_reached_and_that_is_most_of_it() -> None:
    """Tips of poses drawn from the joints' ranges, the stylus upright, which not all of them can be."""
    low, high = RANGES_RAD.T
    turned = np.random.default_rng(3).uniform(low, high, (90, 6)) * ARM.active
    points, _ = ARM.forward_angles(ARM.angles(HOME) + turned)
    up = np.array([0.0, 0.0, 2.0])
    sure, reached = surely_reached(ARM, points, up, start=HOME), np.zeros(90, dtype=bool)
    for at, point in enumerate(points):
        with suppress(OutOfReachError):
            reached[at] = inverse(ARM, point, up, start=HOME).any()
    assert not (sure & ~reached).any()
    assert 0.9 * reached.sum() < sure.sum() < reached.sum() < 80


@pytest.mark.parametrize("direction", [(0, 0, 0), (0, 1), (0, 0, float("nan"))])
def test_a_direction_that_is_none_is_refused(direction: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="direction"):
        inverse(ARM, (0, 200, 100), direction, start=HOME)


def test_four_counts_are_refused() -> None:
    with pytest.raises(ValueError, match=r"not \(n, 6\)"):
        ARM.forward([1, 2, 3, 4])

"""How near solids come: against a dense search, and by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from instruments.world.solids import Hull, ball, clearance_mm, cylinder, segments_apart_mm

coordinate = st.floats(-100, 100).map(lambda value: round(value, 3))
point = st.tuples(coordinate, coordinate, coordinate).map(np.array)
T = np.linspace(0.0, 1.0, 101)[:, None]


@given(a=point, b=point, c=point, d=point)
def test_segments_are_apart(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> None:
    apart = segments_apart_mm(a, b, c, d)
    searched = float(
        np.linalg.norm((a + T * (b - a))[:, None] - (c + T * (d - c))[None], axis=2).min()
    )
    grain = 0.01 * (float(np.linalg.norm(b - a)) + float(np.linalg.norm(d - c)))
    assert searched - grain - 1e-6 <= apart <= searched + 1e-6


def test_crossing_and_parallel_segments_by_hand() -> None:
    x = np.array([1.0, 0.0, 0.0])
    assert segments_apart_mm(
        -x, x, np.array([0.0, -1.0, 3.0]), np.array([0.0, 1.0, 3.0])
    ) == pytest.approx(3.0)
    assert segments_apart_mm(
        -x, x, np.array([5.0, 4.0, 0.0]), np.array([7.0, 4.0, 0.0])
    ) == pytest.approx(np.hypot(4.0, 4.0))
    assert segments_apart_mm(x, x, x, x) == 0.0


def test_clearance_is_from_surface_to_surface() -> None:
    assert clearance_mm(ball((0.0, 0.0, 0.0), 3.0), ball((10.0, 0.0, 0.0), 4.0)) == pytest.approx(
        3.0
    )
    teat = Hull((0.0, 0.0, 0.0), (0.0, 0.0, 100.0), 11.0, 11.0, flat_a=True)
    assert clearance_mm(
        teat, cylinder((20.0, 0.0, 0.0), (20.0, 0.0, 50.0), 5.0, 12.0)
    ) == pytest.approx(-3.0)


radius = st.floats(1, 60)


@pytest.mark.slow
@given(a=point, b=point, c=point, d=point, narrow=radius, wide=radius, other=radius)
def test_a_tapered_solid_is_as_near_as_the_nearest_of_its_slices(
    a: np.ndarray,
    b: np.ndarray,
    c: np.ndarray,
    d: np.ndarray,
    narrow: float,
    wide: float,
    other: float,
) -> None:
    assume(float(np.linalg.norm(b - a)) > 1.0)
    assume(float(np.linalg.norm(d - c)) > 1.0)
    cone = cylinder(tuple(a), tuple(b), narrow, wide)
    slices = [
        segments_apart_mm(a + t * (b - a), a + t * (b - a), c, d)
        - narrow
        - t * (wide - narrow)
        - other
        for t in T[:, 0]
    ]
    grain = 0.01 * (float(np.linalg.norm(b - a)) + abs(wide - narrow))
    gap = clearance_mm(cone, cylinder(tuple(c), tuple(d), other))
    assert gap <= min(slices) + 1e-3
    assert gap >= min(slices) - grain - 1e-3 or gap >= 0.0 <= min(slices)


def test_a_cup_that_widens_above_a_flange_leaves_it_alone() -> None:
    cup = cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 80.0), 20.0, 40.0)
    flange = cylinder((50.0, 0.0, 0.0), (50.0, 0.0, 8.0), 18.0)
    assert 8.0 < clearance_mm(cup, flange) <= 10.0, (
        "at the flange's top the cup has a radius of 22 mm: 10 mm are left"
    )
    assert clearance_mm(flange, cup) == clearance_mm(cup, flange)

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
    for start, end, apart in (((0, -1, 3), (0, 1, 3), 3.0), ((5, 4, 0), (7, 4, 0), np.hypot(4, 4))):
        found = segments_apart_mm(-x, x, np.array(start, float), np.array(end, float))
        assert found == pytest.approx(apart)
    assert segments_apart_mm(x, x, x, x) == 0.0


def test_clearance_is_from_surface_to_surface() -> None:
    balls = ball((0.0, 0.0, 0.0), 3.0), ball((10.0, 0.0, 0.0), 4.0)
    assert clearance_mm(*balls) == pytest.approx(3.0)
    teat = Hull((0.0, 0.0, 0.0), (0.0, 0.0, 100.0), 11.0, 11.0, flat_a=True)
    cup = cylinder((20.0, 0.0, 0.0), (20.0, 0.0, 50.0), 5.0, 12.0)
    assert clearance_mm(teat, cup) == pytest.approx(-3.0)


radius = st.floats(1, 60)


@pytest.mark.slow
@given(ends=st.tuples(point, point, point, point), radii=st.tuples(radius, radius, radius))
def test_a_tapered_solid_is_as_near_as_the_nearest_of_its_slices(
    ends: tuple[np.ndarray, ...], radii: tuple[float, float, float]
) -> None:
    (a, b, c, d), (narrow, wide, other) = ends, radii
    assume(min(float(np.linalg.norm(b - a)), float(np.linalg.norm(d - c))) > 1.0)
    middles = a + T * (b - a)
    away = np.array([segments_apart_mm(middle, middle, c, d) for middle in middles])
    nearest = float((away - narrow - T[:, 0] * (wide - narrow) - other).min())
    grain = 0.01 * (float(np.linalg.norm(b - a)) + abs(wide - narrow))
    cone = cylinder(tuple(a), tuple(b), narrow, wide)
    gap = clearance_mm(cone, cylinder(tuple(c), tuple(d), other))
    assert gap <= nearest + 1e-3
    assert gap >= nearest - grain - 1e-3 or gap >= 0.0 <= nearest


def test_a_cup_that_widens_above_a_flange_leaves_it_alone() -> None:
    cup = cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 80.0), 20.0, 40.0)
    flange = cylinder((50.0, 0.0, 0.0), (50.0, 0.0, 8.0), 18.0)
    assert 8.0 < clearance_mm(cup, flange) <= 10.0, (
        "at the flange's top the cup has a radius of 22 mm: 10 mm are left"
    )
    assert clearance_mm(flange, cup) == clearance_mm(cup, flange)

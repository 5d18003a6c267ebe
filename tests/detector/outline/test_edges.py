"""Edges to a part of a pixel: at known places, on shading paint, in noise, and where none is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from detector.outline import edges
from detector.outline.edges import CLEAR, LEAST_CLEAR, Profile, sample
from detector.outline.fit import OutlineEdges, weights
from detector.outline.views import OPTICAL_FINE

Lines = NDArray[np.float32]


def chance() -> np.random.Generator:
    """The same for each test, whichever ran before."""
    return np.random.default_rng(3)


@dataclass(frozen=True)
class Found:
    """Edges of outlines (views, m, n)."""

    offset_px: NDArray[np.float64]
    sd_px: NDArray[np.float64]
    clarity: NDArray[np.float64]
    limb_px: NDArray[np.float64]
    unlike_px: NDArray[np.float64]


def find_in(lines: Lines, profile: Profile, noise: float) -> Found:
    """Of lines (views, m, n, s)."""
    views, m, n, _ = lines.shape
    found = edges.find_edges(np.ascontiguousarray(lines), profile, np.full(views, noise))
    return Found(*(a.reshape(m, views, n).swapaxes(0, 1) for a in found))


def find_edges(lines: Lines, profile: Profile, noise: float) -> Found:
    """Of one view's outlines (m, n, s)."""
    found = find_in(lines[None], profile, noise)
    return Found(*(getattr(found, name)[0] for name in Found.__annotations__))


def steps(
    places: NDArray[np.float64], inner: float, outer: float, noise: float, limb: float = 0.0
) -> Lines:
    """Lines (1, n, s) with a blurred step at each place; the inside rises by ``limb`` in 4 px."""
    spread = np.linspace(-3.2, 3.2, 129)
    weight = np.exp(-0.5 * (spread / 0.8) ** 2)
    x = OPTICAL_FINE.offsets[None, :, None] - places[:, None, None] - spread
    sharp = np.where(x < 0, inner + limb * np.sqrt(np.clip(-x, 0, None) / 4.0), outer)
    blurred = sharp @ (weight / weight.sum())
    return np.asarray(blurred + chance().normal(0, noise, blurred.shape), dtype=np.float32)[None]


@pytest.mark.parametrize(("inner", "outer"), [(30, 190), (190, 30), (60, 90)])
def test_steps_are_found_at_every_phase(inner: float, outer: float) -> None:
    places = np.linspace(-1.2, 1.2, 49)
    found = find_edges(steps(places, inner, outer, 0.0), OPTICAL_FINE, 0.05)
    assert np.abs(found.offset_px[0] - places).max() < 0.06
    assert np.abs(found.offset_px[0] - places).mean() < 0.035
    assert (found.clarity > CLEAR).all()


def test_paint_that_shades_towards_the_limb_moves_the_edge_little() -> None:
    places = np.linspace(-1.0, 1.0, 41)
    found = find_edges(steps(places, 60.0, 20.0, 0.0, limb=60.0), OPTICAL_FINE, 0.05)
    plain = find_edges(
        steps(places, 60.0, 20.0, 0.0, limb=60.0),
        Profile(5.0, 0.5, 2.0, 0.25, 0.8, limb=False, pull_px=1.5),
        0.05,
    )
    assert np.abs(found.offset_px[0] - places).mean() < 0.08
    assert (
        np.abs(found.offset_px[0] - places).mean()
        < 0.5 * np.abs(plain.offset_px[0] - places).mean()
    )


def test_the_claimed_spread_is_honest() -> None:
    places = np.zeros(400)
    found = find_edges(steps(places, 40.0, 120.0, 3.0), OPTICAL_FINE, 3.0)
    alone = found.clarity[0] > CLEAR
    z = found.offset_px[0][alone] / found.sd_px[0][alone]
    # samples half a pixel apart count as independent here, as the noise of this test is
    assert 0.5 < z.std() < 1.6


def test_noise_alone_is_seldom_an_edge() -> None:
    found = find_edges(
        chance().normal(100, 3, (1, 600, len(OPTICAL_FINE.offsets))).astype(np.float32),
        OPTICAL_FINE,
        3.0,
    )
    assert (found.clarity > LEAST_CLEAR).mean() < 0.1


def test_faint_edges_are_found_together() -> None:
    """Seven grey levels in noise of two: a line alone misses many, neighbours hardly any."""
    lines = steps(np.full(200, 0.4), 50.0, 57.0, 2.0)
    together = find_edges(lines, OPTICAL_FINE, 2.0)
    usable = together.clarity[0] > LEAST_CLEAR
    assert usable.mean() > 0.9
    assert abs(np.median(together.offset_px[0][usable]) - 0.4) < 0.1


def test_lines_beyond_the_picture_have_no_edge() -> None:
    field = np.zeros((40, 40), dtype=np.float32)
    field[:, 20:] = 100.0
    middles = np.array([[19.5, 20.0], [1.0, 20.0], [np.nan, 3.0]])
    normals = np.tile([1.0, 0.0], (3, 1))
    lines = sample(field, middles, normals, OPTICAL_FINE.offsets)
    assert np.isfinite(lines[0]).all()
    assert np.isnan(lines[1:]).all()
    found = find_edges(lines[None], OPTICAL_FINE, 0.05)
    assert abs(found.offset_px[0, 0]) < 0.03
    assert np.isnan(found.offset_px[0, 1:]).all()
    assert (found.clarity[0, 1:] == 0).all()


def test_light_is_shared_by_views_and_neighbours() -> None:
    """A fall of brightness towards the limb is alike in both pictures, so the correction is one."""
    places = np.linspace(-0.5, 0.5, 60)
    shaded = [steps(places, 60.0, 20.0, 1.0, limb=60.0) for _ in range(2)]
    shaded[1] = shaded[1] + chance().normal(0.0, 1.0, shaded[1].shape).astype(np.float32)
    found = find_in(np.stack(shaded), OPTICAL_FINE, 1.0)
    np.testing.assert_array_equal(found.limb_px[0], found.limb_px[1])
    assert np.abs(found.limb_px).min() > 0.05
    plain = find_in(np.stack([steps(places, 60.0, 20.0, 1.0)] * 2), OPTICAL_FINE, 1.0)
    assert np.abs(plain.limb_px).mean() < 0.3 * np.abs(found.limb_px).mean()


def test_an_edge_whose_slope_is_unknown_has_no_weight() -> None:
    """As where it was behind a camera when slopes were taken."""
    one, two = np.ones((1, 2)), np.full((1, 2), 100.0)
    slopes = np.ones((1, 2, 8))
    slopes[0, 1] = np.nan
    none = np.zeros((1, 2, 2))
    seen = OutlineEdges(0.1 * one, one, two, one, slopes, none, none, one, one)
    assert (weights(seen, 2.0) > 0).tolist() == [[True, False]]

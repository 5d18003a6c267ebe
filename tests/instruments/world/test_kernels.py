"""The compiled loops against plain definitions, on drawn inputs."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.world import kernels
from instruments.world.compositing import cover, cover_outlines
from instruments.world.optics import CameraModel, Floats
from instruments.world.sensor import (
    Exposure,
    OpticalReadout,
    OpticalSensor,
    normal_noise,
)
from instruments.world.shading import Lamp, Lighting, irradiance, seen_light
from instruments.world.solids import Hull, Solids, ball, cylinder, intersect

SEEDS = st.integers(0, 2**32 - 1)
WIDE, TALL = 40, 30
PARTS = 200  # of a solid's axis
PLAIN = CameraModel(
    "plain", WIDE, TALL, np.array([1.0, 1.0]), np.zeros(2), 0.0, np.zeros(5), np.eye(3), np.zeros(3)
)


def clipped(polygon: Floats, low: Floats, high: Floats) -> float:
    """Area of a convex polygon (m, 2) within a rectangle: Sutherland and Hodgman, shoelace."""
    for axis, limit, sign in ((0, low, 1.0), (0, high, -1.0), (1, low, 1.0), (1, high, -1.0)):
        kept = list[Floats]()
        for here, there in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            inside, then = (sign * (p[axis] - limit[axis]) for p in (here, there))
            if inside >= 0.0:
                kept.append(here)
            if inside * then < 0.0:
                kept.append(here + inside / (inside - then) * (there - here))
        if not kept:
            return 0.0
        polygon = np.array(kept)
    x, y = polygon.T
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2.0)


@given(seed=SEEDS, count=st.integers(1, 4))
def test_a_pixels_share_is_the_area_of_the_outline_within_it(seed: int, count: int) -> None:
    """Pixel (0, 0) reaches from -0.5 to 0.5; outlines reach beyond the picture, and corners lie on
    borders of pixels.
    """
    rng, shapes = np.random.default_rng(seed), list[Floats]()
    for _ in range(count):
        points = rng.uniform(-6.0, 46.0, (8, 2)).astype(np.float32)
        points = np.where(rng.random((8, 2)) < 0.3, np.rint(points) + 0.5, points)
        shapes.append(cv2.convexHull(points.astype(np.float32))[:, 0].astype(np.float64))
    flat = [np.column_stack([100.0 * shape, np.full(len(shape), 100.0)]) for shape in shapes]
    found = cover_outlines(flat, PLAIN)
    assert found.share.max(initial=0.0) <= 1.0
    shares = np.zeros((count, TALL, WIDE))
    shares[found.solid, found.row, found.column] = found.share
    for shape, share in zip(shapes, shares, strict=True):
        for row, column in rng.integers(0, (TALL, WIDE), (60, 2)):
            low = np.array([column, row]) - 0.5
            assert share[row, column] == pytest.approx(clipped(shape, low, low + 1.0), abs=2e-4)


def test_a_balls_outline_has_the_area_of_its_limb() -> None:
    camera = replace(PLAIN, fc=np.full(2, 1000.0), cc=np.array([20.0, 15.0]))
    found = cover(Solids.from_hulls([ball((0.0, 0.0, 1000.0), 8.0)]), camera)
    limb_px = 1000.0 * 8.0 / math.sqrt(1000.0**2 - 8.0**2)
    assert found.share.sum() == pytest.approx(math.pi * limb_px**2, rel=2e-5)


def some_solids(rng: np.random.Generator) -> list[Hull]:
    a, b = rng.uniform((-30.0, -30.0, 270.0), (30.0, 30.0, 330.0), (2, 3))
    b += 40.0 * (b - a) / np.linalg.norm(b - a)
    start, end = tuple(a.tolist()), tuple(b.tolist())
    return [
        ball(start, 12.0), Hull(start, end, 9.0, 5.0), Hull(start, end, 6.0, 6.0, flat_b=True),
        cylinder(start, end, 7.0, 4.0),
    ]  # fmt: skip


def within(hull: Hull, points: Floats) -> Floats:
    """How far points (n, 3) are inside the hull, mm; below zero outside: from its definition, the
    convex hull of two round ends, as the largest ball or disc between them.
    """
    a, b = np.array(hull.a_mm), np.array(hull.b_mm)
    best = np.full(len(points), -np.inf)
    length = np.linalg.norm(b - a)
    for part in np.linspace(0.0, 1.0, PARTS + 1 if length else 1):
        centre = a + part * (b - a)
        radius = hull.radius_a_mm + part * (hull.radius_b_mm - hull.radius_a_mm)
        off = points - centre
        if hull.flat_a and hull.flat_b:
            axis = (b - a) / length
            along = off @ axis
            away = np.linalg.norm(off - along[:, None] * axis, axis=1)
            near = np.abs(along) <= 0.5 * length / PARTS + 1e-9
            between = np.abs(off @ axis + (part - 0.5) * length) <= 0.5 * length
            here = np.where(near & between, radius - away, -np.inf)
        else:
            here = radius - np.linalg.norm(off, axis=1)
            if hull.flat_b:
                beyond = (points - b) @ ((b - a) / length)
                here = np.where(beyond > 1e-9, -np.inf, here)
        best = np.maximum(best, here)
    return best


@given(seed=SEEDS)
def test_what_a_ray_meets_is_the_same_alone_and_among_any_others(seed: int) -> None:
    rng = np.random.default_rng(seed)
    solids = Solids.from_hulls(some_solids(rng))
    which = np.repeat(rng.integers(0, len(solids), 4), [1, 2500, 3, 40])
    x, y = rng.uniform(-0.15, 0.15, (2, len(which)))
    together = intersect(solids, which, x, y)
    order = rng.permutation(len(which))
    apart = intersect(solids, which[order], x[order], y[order])
    for found, other in zip(together, apart, strict=True):
        np.testing.assert_array_equal(found[..., order], other)


@pytest.mark.slow
@given(seed=SEEDS)
def test_a_ray_that_hits_ends_on_the_surface_and_nowhere_before_it_inside(seed: int) -> None:
    rng = np.random.default_rng(seed)
    hulls = some_solids(rng)
    which = np.repeat(np.arange(len(hulls)), 12)
    x, y = rng.uniform(-0.15, 0.15, (2, len(which)))
    depth, normal, hit = intersect(Solids.from_hulls(hulls), which, x, y)
    rays = np.column_stack([x, y, np.ones_like(x)])
    assert np.linalg.norm(normal, axis=0) == pytest.approx(np.ones(len(which)))
    for number, hull in enumerate(hulls):
        own = which == number
        met = own & hit
        assert np.all(within(hull, 0.5e-3 * rays[met] + depth[met, None] * rays[met]) > -0.05)
        assert np.all(np.sum(normal.T[met] * rays[met], axis=1) < 1e-6)
        missed = own & ~hit
        for away in np.linspace(220.0, 380.0, 9):
            assert np.all(within(hull, away * rays[missed]) < 0.05)
            before = met & (depth > away + 0.1)
            assert np.all(within(hull, away * rays[before]) < 0.05)


@given(seed=SEEDS, bits=st.sampled_from((8, 12)))
def test_a_frame_is_what_emva_1288_makes_of_light_and_the_same_noise(seed: int, bits: int) -> None:
    rng, shape = np.random.default_rng(seed), (24, 37)
    sensor = OpticalSensor(bits=bits, white_dn=2.0**bits - 1.0)
    rays = np.meshgrid(np.linspace(-0.4, 0.4, shape[1]), np.linspace(-0.3, 0.3, shape[0]))
    camera = OpticalReadout(sensor, (rays[0], rays[1]), np.random.SeedSequence(seed))
    light, shutter = rng.uniform(0.0, 1.3, shape).astype(np.float32), Exposure(0.018, 1.2)
    frame = camera.exposed(light, camera.noise(np.random.default_rng(seed)), shutter)
    mean, gain = camera.mean(light, shutter), np.float32(sensor.gain_dn_per_e * 1.2)
    electrons = (mean - np.float32(sensor.offset_dn)) / gain - camera._dark_e
    noise = normal_noise(np.random.default_rng(seed), shape)
    spread = gain * np.sqrt(electrons + np.float32(sensor.read_noise_e**2))
    plain = np.clip(mean + noise * spread, 0.0, 2.0**bits - 1.0)
    assert frame.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert np.abs(frame - plain).max() <= 0.51


def gap_mm(hull: Hull, point: Floats, lamp: Floats) -> tuple[float, float]:
    """Least distance of many points of a hull's axis from the ray to a lamp, less the radius there;
    and how far along the ray.
    """
    a, b, part = np.array(hull.a_mm), np.array(hull.b_mm), np.linspace(0.0, 1.0, 2001)
    way = (lamp - point) / np.linalg.norm(lamp - point)
    off = a + part[:, None] * (b - a) - point
    along = np.maximum(off @ way, 0.0)
    far = np.linalg.norm(off - along[:, None] * way, axis=1)
    i = int(far.argmin())
    radius = hull.radius_a_mm + part[i] * (hull.radius_b_mm - hull.radius_a_mm)
    return float(far[i] - radius), float(along[i])


@given(seed=SEEDS)
def test_a_lamps_share_is_that_of_the_nearest_of_all_things(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lamp, radius = np.array([450.0, -350.0, 1350.0]), 130.0
    hulls = [
        Hull(tuple(a.tolist()), tuple(np.add(a, (0.0, 5.0, 90.0)).tolist()), 14.0, 10.0)
        for a in rng.uniform((-50.0, -50.0, 15.0), (50.0, 50.0, 40.0), (3, 3))
    ]
    points = np.column_stack([*rng.uniform(-120.0, 120.0, (2, 6)), np.zeros(6)])
    left = np.ones(6, dtype=np.float32)
    table = np.array(
        [(*h.a_mm, *np.subtract(h.b_mm, h.a_mm), 14.0, -4.0) for h in hulls], dtype=np.float32
    )
    kernels.lamp_left(
        table, points.T.astype(np.float32).copy(), lamp.astype(np.float32), radius, left
    )
    for point, share in zip(points, left, strict=True):
        shares = [1.0]
        for gap, along in (gap_mm(hull, point, lamp) for hull in hulls):
            half_shade = max(along, 2.0) * radius / np.linalg.norm(lamp - point)
            shares.append(float(np.clip(0.5 + 0.5 * gap / half_shade, 0.0, 1.0)))
        assert share == pytest.approx(min(shares), abs=0.03)


@given(seed=SEEDS)
def test_light_without_gloss_is_lamberts_and_a_mirrors_highlight_is_whole(seed: int) -> None:
    rng, n = np.random.default_rng(seed), 20
    points = rng.uniform(-200.0, 200.0, (3, n)).astype(np.float32)
    normals = rng.standard_normal((3, n))
    normals = (normals / np.linalg.norm(normals, axis=0)).astype(np.float32)
    eye, lighting = np.array([0.0, -900.0, 500.0], dtype=np.float32), Lighting(0.8)
    albedo, dull = rng.uniform(0.1, 0.9, n).astype(np.float32), np.zeros(n, dtype=np.float32)
    seen = seen_light(lighting, points, normals, eye, albedo, dull)
    assert seen == pytest.approx(albedo * irradiance(lighting, points, normals), rel=1e-5)
    # each point's normal half-way between the lamp and the eye: the highlight's full strength
    lamp = Lamp((450.0, -350.0, 1350.0), 2.0)
    ways = [np.array(at)[:, None] - points for at in (lamp.at_mm, eye.tolist())]
    middle = sum(way / np.linalg.norm(way, axis=0) for way in ways)
    normals = (middle / np.linalg.norm(middle, axis=0)).astype(np.float32)
    only = Lighting(1.0, (lamp,), 0.0)
    seen = seen_light(only, points, normals, eye, dull, np.ones(n, dtype=np.float32))
    plain = 2e6 / np.sum(ways[0] ** 2, axis=0)
    assert seen == pytest.approx(plain, rel=1e-4)


def test_a_lens_that_folds_is_refused_also_where_the_iteration_divides_by_zero() -> None:
    """Radius r (1 - r^2 / 3) turns back at r = 1, where its slope is zero."""
    x, y, kc = np.array([0.9, 1.0]), np.zeros(2), np.array([-1.0 / 3.0, 0.0, 0.0, 0.0, 0.0])
    assert not kernels.undistort(x, y, kc, x.copy(), y.copy(), 12, 1e-13)
    lost = np.array([np.nan, 0.0])  # no step from there is small
    assert not kernels.undistort(np.zeros(2), y, kc, lost, y.copy(), 12, 1e-13)
    near = np.array([0.1, 0.2])
    found, other = near.copy(), np.zeros(2)
    assert kernels.undistort(near, np.zeros(2), kc, found, other, 12, 1e-13)
    assert found - found**3 / 3.0 == pytest.approx(near, abs=1e-14)
    assert math.isclose(float(np.abs(other).max()), 0.0)

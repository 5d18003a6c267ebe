"""Rendered solids against OpenCV, at every orientation and sub-pixel phase; MTF; focus."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from instruments.world.boards import Board, Pattern
from instruments.world.objects import SceneObject
from instruments.world.optical_camera import OpticalCamera
from instruments.world.optics import CameraModel, Floats
from instruments.world.sensor import Focus, Image, blurred, blurred_by_depth, kernel
from instruments.world.shading import Lighting, Paint
from instruments.world.solids import Hull, Ints, ball
from tests.instruments.world.scenes import NOBODY, by_opencv, centroid, empty, eye, renderer

pytestmark = pytest.mark.slow

BLACK = Paint(albedo=0.0)
PANEL = Pattern("plain", 6, 6, 25.0, 0.0)


def transfer(sigma_px: float, cycles_per_px: Floats) -> Floats:
    """Modulation of lens and square pixel at spatial frequencies (n,): the declared MTF."""
    return np.asarray(
        np.abs(np.sinc(cycles_per_px))
        * np.exp(sigma_px**2 * (np.cos(2.0 * np.pi * cycles_per_px) - 1.0))
    )


@cache
def covered(which: str) -> Image:
    """The frame before noise with the lights off: what the sensor gives of its own."""
    return eye(which).expected(replace(NOBODY, lighting=Lighting(brightness=0.0)))


def hidden_share(which: str, *hulls: Hull) -> Floats:
    """Share of the board's light that black solids take from each pixel, (h, w), before noise."""
    thing, dark = SceneObject("black", hulls, BLACK, "ambient"), covered(which)
    seen = eye(which).expected(replace(NOBODY, objects=(thing,)))
    return np.asarray(1.0 - (seen - dark) / (empty(which) - dark), dtype=np.float64)


def bounds(share: Floats, rows: Ints, columns: Ints) -> Floats:
    """Left and right edge (2, n) of what is covered in these rows, px."""
    profile = share[np.ix_(rows, columns)]
    width, centre = profile.sum(axis=1), profile @ columns / profile.sum(axis=1)
    return np.array([centre - width / 2.0, centre + width / 2.0])


def at_rows(limb: Floats, rows: Ints) -> Floats:
    """Columns of a limb (n, 2) px at these rows."""
    limb = limb[np.argsort(limb[:, 1])]
    return np.asarray(np.interp(rows, limb[:, 1], limb[:, 0]))


@pytest.mark.parametrize("which", ["left", "right"])
def test_small_balls_lie_where_opencv_projects_them(which: str) -> None:
    depths = ((150.0, 130.0), (700.0, 420.0))
    places = [(x, y, z) for x in (-620.0, -200.0, 250.0) for y, z in depths]
    share = hidden_share(which, *(ball(place, 4.0) for place in places))
    for u, v in by_opencv(eye(which).view.camera, np.array(places)):
        assert centroid(share, (round(u), round(v)), 14) == pytest.approx([u, v], abs=0.03)


@pytest.mark.parametrize("angle_deg", [0.0, 17.0, 45.0, 90.0])
def test_edges_of_every_orientation(angle_deg: float) -> None:
    """Both edges of a turned post: their mean place over each stretch, below 0.01 px."""
    camera = eye("left").view.camera
    angle = np.radians(angle_deg)
    way = np.array([np.cos(angle), 0.0, np.sin(angle)])
    middle, worst = np.array([-190.0, 420.0, 320.0]), 0.0
    for phase in np.linspace(0.0, 0.9, 5):
        a, b = middle - 65.0 * way + phase, middle + 65.0 * way + phase
        share = hidden_share("left", Hull(tuple(a), tuple(b), 9.0, 9.0))
        upright = angle_deg > 45.0
        flat = share if upright else share.T
        limbs = [
            by_opencv(camera, _limb(camera, a, b, 9.0, side))[:, :: 1 if upright else -1]
            for side in (-1.0, 1.0)
        ]
        along = 0.5 * (limbs[0][:, 1] + limbs[1][:, 1])
        rows = np.arange(int(np.quantile(along, 0.25)), int(np.quantile(along, 0.75)))
        expected = np.array(sorted((at_rows(limb, rows) for limb in limbs), key=np.mean))
        columns = np.arange(int(expected.min()) - 12, int(expected.max()) + 13)
        # A row's edge is a mean over the lens's blur of rows: a mean over many rows is the edge's.
        off = (bounds(flat, rows, columns) - expected).mean(axis=1)
        worst = max(worst, float(np.abs(off).max()))
    assert worst < 0.01, f"worst edge error {worst:.4f} px"


def _limb(camera: CameraModel, a: Floats, b: Floats, radius: float, side: float) -> Floats:
    """Points where rays touch a cylinder: the normal is square to the axis and to the ray."""
    axis = (b - a) / np.linalg.norm(b - a)
    away = a - camera.centre_mm
    away -= (away @ axis) * axis
    distance = float(np.linalg.norm(away))
    forward, across = away / distance, np.cross(away / distance, axis)
    touch = -radius / distance * forward + side * np.sqrt(1.0 - (radius / distance) ** 2) * across
    return np.asarray(a + np.linspace(0.0, 1.0, 400)[:, None] * (b - a) + radius * touch)


def test_the_rounded_end_reaches_its_apex() -> None:
    """The highest covered row is the hemisphere's limb."""
    camera = renderer().cameras[0]
    teat = Hull((-180.0, 230.0, 30.0), (-180.0, 230.0, 125.0), 11.0, 11.0, flat_a=True)
    share = hidden_share("left", teat)
    angle = np.linspace(0.0, 2.0 * np.pi, 4000)
    centre = np.array([-180.0, 230.0, 125.0])
    away = centre - camera.centre_mm
    distance = float(np.linalg.norm(away))
    forward = away / distance
    u = np.cross(forward, [0.0, 0.0, 1.0])
    u /= np.linalg.norm(u)
    v = np.cross(u, forward)
    rim = centre - 11.0**2 / distance * forward
    radius = 11.0 * np.sqrt(1.0 - (11.0 / distance) ** 2)
    ring = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    limb = by_opencv(camera, rim + radius * ring)
    outline = limb[np.abs(limb[:, 0] - limb[:, 0].mean()) < 13.0]
    top = outline[:, 1].min()
    column = round(float(outline[outline[:, 1].argmin(), 0]))
    rows = np.arange(round(top) - 8, round(top) + 12)
    covered = share[rows, column].sum()
    assert rows[-1] + 0.5 - covered == pytest.approx(top, abs=0.05)


def test_nothing_seen_beside_the_outline() -> None:
    share = hidden_share("left", ball((-180.0, 230.0, 200.0), 11.0))
    (u, v), radius = renderer().cameras[0].project(np.array([[-180.0, 230.0, 200.0]]))[0], 13.5
    away = np.hypot(*np.meshgrid(np.arange(share.shape[1]) - u, np.arange(share.shape[0]) - v))
    above_table = np.arange(share.shape[0])[:, None] < 540
    assert np.abs(share[(away > radius + 4.0) & above_table]).max() < 1e-3
    assert share[away < radius - 4.0].min() > 0.999


@pytest.mark.parametrize(("blur_px", "turned"), [(0.5, False), (0.9, True)])
def test_a_slanted_edge_has_the_declared_mtf(blur_px: float, turned: bool) -> None:
    """ISO 12233: the edge spread along the normal, finely binned; its derivative's spectrum."""
    eye = renderer(blur_px=blur_px, prnu=0.0, dsnu_e=0.0, vignetting=0.0).left
    angle = np.radians(5.0)
    across, along = (np.cos(angle), 0.0, np.sin(angle)), (np.sin(angle), 0.0, -np.cos(angle))
    panel = Board((-255.0, 600.0, 420.0), across, along, PANEL, light_albedo=0.0)
    dark = eye.expected(replace(NOBODY, boards=(panel,)))
    plain = eye.expected(NOBODY)
    black = eye.expected(replace(NOBODY, lighting=Lighting(brightness=0.0)))
    share = np.asarray((plain - dark) / (plain - black), dtype=np.float64)
    corners = by_opencv(eye.view.camera, panel.outline_mm)
    start, end = (corners[0], corners[1]) if turned else (corners[3], corners[0])
    middle, length = 0.5 * (start + end), float(np.linalg.norm(end - start))
    tangent = (end - start) / length
    normal = np.array([-tangent[1], tangent[0]])
    v, u = np.mgrid[0 : share.shape[0], 0 : share.shape[1]]
    off = (u - middle[0]) * normal[0] + (v - middle[1]) * normal[1]
    on = (u - middle[0]) * tangent[0] + (v - middle[1]) * tangent[1]
    # The lens bends the edge a little: straightened by what OpenCV says of points along it.
    points = by_opencv(eye.view.camera, _between(panel, turned)) - middle
    bend = np.polynomial.Polynomial.fit(points @ tangent, points @ normal, 2)
    near = (np.abs(on) < 0.4 * length) & (np.abs(off) < 20.0)
    distance, values = (off - bend(on))[near], share[near]
    fine = 0.1
    bins = np.round(distance / fine).astype(int)
    edge = np.array([values[bins == k].mean() for k in range(-160, 161)])
    line = np.diff(edge) * np.hanning(len(edge) - 1)
    line /= abs(line.sum())
    for f in (0.05, 0.1, 0.2, 0.3, 0.4, 0.5):
        spectrum = line @ np.exp(-2j * np.pi * f * fine * np.arange(len(line)))
        seen = abs(spectrum) / np.sinc(f * fine) ** 2
        declared = np.prod(transfer(blur_px, f * np.abs(normal)))
        assert seen == pytest.approx(declared, abs=0.01), f"{f} cycles a pixel"


def _between(panel: Board, turned: bool) -> Floats:
    part = np.linspace(0.05, 0.95, 19)[:, None]
    width, height = panel.pattern.size_mm
    return panel.placed(part * ([width, 0.0] if turned else [0.0, height]))


@pytest.mark.parametrize("sigma", [0.2, 0.5, 0.9, 2.0, 6.0])
def test_the_kernel_has_its_variance_and_its_transfer(sigma: float) -> None:
    weights = kernel(sigma).astype(np.float64)
    at = np.arange(len(weights)) - len(weights) // 2
    assert weights.sum() == pytest.approx(1.0, abs=1e-6)
    assert weights @ at**2 == pytest.approx(sigma**2, rel=2e-3)
    f = np.linspace(0.0, 0.5, 6)
    spectrum = np.abs(np.exp(-2j * np.pi * np.outer(f, at)) @ weights) * np.sinc(f)
    assert spectrum == pytest.approx(transfer(sigma, f), abs=1e-3)


def test_out_of_focus_widens_edges_as_the_thin_lens_says() -> None:
    """At twice the focused distance an edge spreads by the circle of confusion; in focus not."""
    focus = Focus(aperture_mm=8.0, distance_mm=1040.0)
    sharp = renderer(prnu=0.0, dsnu_e=0.0).left
    soft = renderer(prnu=0.0, dsnu_e=0.0, focus=focus).left
    spread_px = 0.25 * 8.0 * 1293.1 * abs(1.0 / 1799.5 - 1.0 / 1040.0)
    for y, expected_px in ((200.0, 0.0), (960.0, spread_px)):
        panel = Board((-200.0, y, 430.0), pattern=PANEL, light_albedo=0.0)
        widths = [_edge_width(eye, panel) for eye in (sharp, soft)]
        wider = np.sqrt(max(widths[1] ** 2 - widths[0] ** 2, 0.0))
        assert wider == pytest.approx(expected_px, abs=0.12)


def _edge_width(eye: OpticalCamera, panel: Board) -> float:
    """Standard deviation of the spread of a panel's left edge, px."""
    u, v = by_opencv(eye.view.camera, panel.placed(np.array([[0.0, 75.0]])))[0]
    rows, columns = slice(round(v) - 12, round(v) + 13), slice(round(u) - 20, round(u) + 21)
    dark = eye.expected(replace(NOBODY, boards=(panel,)))[rows, columns].astype(np.float64)
    lit = eye.expected(replace(NOBODY, boards=(replace(panel, light_albedo=0.3),)))[rows, columns]
    cover = (lit - dark) / (lit - dark)[:, -3:].mean()
    lines = np.diff(cover, axis=1)
    at = np.arange(lines.shape[1])
    means = lines @ at / lines.sum(axis=1)
    squares = (lines * (at - means[:, None]) ** 2).sum(axis=1) / lines.sum(axis=1)
    return float(np.sqrt(squares.mean()))


def test_a_blur_that_varies_agrees_with_even_ones() -> None:
    rng = np.random.default_rng(1)
    picture = rng.random((40, 60)).astype(np.float32)
    sigma = np.full((40, 60), 1.0, dtype=np.float32)
    sigma[:, 30:] = 2.0
    mixed = blurred_by_depth(picture, sigma)
    assert np.allclose(mixed[:, :30], blurred(picture, 1.0)[:, :30], atol=1e-6)
    assert np.allclose(mixed[:, 30:], blurred(picture, 2.0)[:, 30:], atol=1e-6)

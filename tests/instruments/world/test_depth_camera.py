"""The depth camera: exact on a sphere, its stated errors come back, and near and far mix where both
are in a pixel; the second path against a sum over fine cells; and it leaves other cameras alone.
"""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from instruments.world.depth_camera import (
    AMPLITUDE_COUNTS,
    LIGHT_MM_PER_S,
    DepthCamera,
    DepthSensor,
)
from instruments.world.objects import make_object
from instruments.world.optics import CameraModel, Floats, depth_from_calibration
from instruments.world.state import SceneState
from tests.instruments.world.scenes import NOBODY, PLAIN, ROOT, matrix, small
from tests.situations import situation

EXACT = DepthSensor(noise_mm=0.0, cyclic_mm=0.0, second_path=0.0, blur_px=0.0)
MIDDLE, RADIUS_MM = np.array([-190.0, 300.0, 200.0]), 60.0
DARK = replace(PLAIN, table_albedo=0.0, board_albedo=0.0)


def ball(**more: float) -> SceneState:
    """A white ball before the board."""
    x, y, z = MIDDLE.tolist()
    thing = make_object("ball", x_mm=x, y_mm=y, z_mm=z, radius_mm=RADIUS_MM, albedo=1.0, **more)
    return replace(NOBODY, objects=(thing,))


@cache
def model() -> CameraModel:
    text = (ROOT / "bench/rigs/depth-calibration.toml").read_text(encoding="utf-8")
    found = depth_from_calibration(tomllib.loads(text))
    assert found is not None
    return found


def depth_mm(state: SceneState, seed: int = 1, **sensor: float) -> tuple[Floats, Floats]:
    """Depth, NaN where none was measured, and amplitude (1: white, facing, at 1 m)."""
    camera = DepthCamera(model(), replace(EXACT, **sensor))
    tenths, counts = camera.expose(state, np.random.default_rng(seed))
    return np.where(tenths > 0, tenths / 10.0, np.nan), counts / AMPLITUDE_COUNTS


def rays() -> Floats:
    """Rays (h, w, 3) with z = 1, by OpenCV."""
    camera = model()
    u, v = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    plane = np.asarray(cv2.undistortPointsIter(
        pixels, matrix(camera), camera.kc, np.eye(3), np.eye(3), (3, 100, 1e-12)
    ))  # fmt: skip
    return np.dstack([plane.reshape(*u.shape, 2), np.ones(u.shape)])


def on_ball() -> tuple[Floats, Floats]:
    """Depth of the ball's near side (h, w), NaN beside it, and the distance of rays from its middle
    in radii, by the school's formula.
    """
    ray, middle = rays(), model().camera_from_world(MIDDLE[None])[0]
    foot = (ray @ middle) / np.sum(ray**2, axis=-1)
    off = np.linalg.norm(foot[..., None] * ray - middle, axis=-1)
    half = np.sqrt(np.where(off < RADIUS_MM, RADIUS_MM**2 - off**2, np.nan))
    return foot - half / np.linalg.norm(ray, axis=-1), off / RADIUS_MM


@pytest.mark.parametrize("blur_px", [0.0, 0.4])
def test_a_sphere_is_within_half_a_millimetre_without_noise(blur_px: float) -> None:
    truth, off = on_ball()
    seen, amplitude = depth_mm(ball(), blur_px=blur_px)
    inner = off < 0.9
    assert np.count_nonzero(inner) > 1000
    assert np.abs(seen - truth)[inner].max() < (0.06 if blur_px == 0.0 else 0.5)
    # white, and nearly facing: the light falls with the square of the distance
    at = np.unravel_index(np.argmin(off), off.shape)
    away_m = np.linalg.norm(rays()[at]) * truth[at] / 1000.0
    assert amplitude[at] == pytest.approx(1.0 / away_m**2, rel=0.01)


@pytest.mark.slow
def test_the_stated_noise_comes_back_and_goes_with_amplitude() -> None:
    off, noise_mm = on_ball()[1], 1.0
    frames = [depth_mm(ball(), seed, noise_mm=noise_mm)[0] for seed in range(12)]
    strength = depth_mm(ball())[1]
    sd_mm = np.std(frames, axis=0, ddof=1) * np.linalg.norm(rays(), axis=-1)
    for low, high in ((0.0, 0.5), (0.5, 0.9), (1.5, 2.0)):  # the last is the board behind
        here = (off >= low) & (off < high)
        stated = np.sqrt(np.mean((noise_mm / strength[here]) ** 2))
        assert np.sqrt(np.mean(sd_mm[here] ** 2)) == pytest.approx(stated, rel=0.1)


def test_the_stated_bias_comes_back_along_the_whole_range() -> None:
    plain, _ = depth_mm(NOBODY)
    stretch = np.linalg.norm(rays(), axis=-1)
    offset = (depth_mm(NOBODY, offset_mm=7.0)[0] - plain) * stretch
    assert np.nanmax(np.abs(offset - 7.0)) < 0.2
    cyclic = (depth_mm(NOBODY, cyclic_mm=5.0, modulation_mhz=60.0)[0] - plain) * stretch
    range_mm = LIGHT_MM_PER_S / 60e6 / 2.0
    stated = 5.0 * np.sin(4.0 * 2.0 * np.pi * plain * stretch / range_mm)
    near = plain * stretch < range_mm - 10.0
    # at the table's edges near and far mix, and otherwise so at another frequency
    assert np.quantile(np.abs(cyclic - stated)[near], 0.95) < 0.1
    assert np.quantile(cyclic[near], 0.99) == pytest.approx(5.0, rel=0.1)


def test_pixels_fly_between_near_and_far_only_where_both_are_seen() -> None:
    off = on_ball()[1]
    seen, _ = depth_mm(ball())
    far = float(np.nanmedian(seen[(off > 1.2) & (off < 1.6)]))
    near = float(seen[off < 0.95].max())
    flying = (seen > near + 40.0) & (seen < far - 40.0) & (off < 1.6)
    assert np.count_nonzero(flying) > 50
    pixel = model().camera_from_world(MIDDLE[None])[0, 2] / model().fc[0] / RADIUS_MM
    assert np.abs(off[flying] - 1.0).max() < pixel


@pytest.mark.slow
def test_the_second_path_is_that_of_fine_cells() -> None:
    """Its light on the ball's lowest pixels, against a sum over cells of 10 mm of the table."""
    state = replace(ball(), backdrop=replace(PLAIN, board_albedo=0.0))
    camera = DepthCamera(model(), replace(EXACT, second_path=1.0))
    plain = DepthCamera(model(), EXACT)
    second = camera.expected(state) - plain.expected(state)
    truth, off = on_ball()
    v, u = (int(i) for i in np.unravel_index(np.argmin(off), off.shape))
    v += int(np.count_nonzero(off[v:, u] < 0.8)) - 1
    ray = rays()[v, u]
    at = (ray * truth[v, u] - model().t_mm) @ model().R
    x, y = np.meshgrid(np.arange(-1040.0, 1100.0, 10.0), np.arange(-235.0, 1000.0, 10.0))
    cells = np.column_stack([x.ravel() + 5.0, y.ravel() + 5.0, np.zeros(x.size)])
    eye, normal = model().centre_mm, (at - MIDDLE) / RADIUS_MM
    first, on = np.linalg.norm(cells - eye, axis=1), np.linalg.norm(at - cells, axis=1)
    lit = 0.45 * eye[2] / first * (1000.0 / first) ** 2
    form = 100.0 * at[2] / on * np.maximum((cells - at) @ normal / on, 0.0) / (np.pi * on**2)
    path = (first + on + np.linalg.norm(at - eye)) / 2.0
    total = np.sum(lit * form * np.exp(1j * plain.sensor.rad_per_mm * path))
    assert abs(second[v, u] - total) < 0.1 * abs(total)
    # it draws the distance away, and is gone where table and board are black
    longer = depth_mm(state, second_path=1.0)[0] - depth_mm(state)[0]
    assert longer[v, u] > 0.5
    black = replace(state, backdrop=DARK)
    without, with_it = (depth_mm(black, second_path=share)[0] for share in (0.0, 1.0))
    assert np.array_equal(without, with_it, equal_nan=True)


def test_what_is_too_dark_or_too_far_is_not_measured() -> None:
    dark = replace(NOBODY, backdrop=replace(DARK, front_albedo=0.0, room_albedo=0.0))
    assert np.isnan(depth_mm(dark, least_amplitude=0.01)[0]).all()
    assert np.isnan(depth_mm(NOBODY, offset_mm=6000.0)[0]).any()


@pytest.mark.slow
def test_the_other_cameras_are_the_same_with_and_without_one() -> None:
    rigs = ROOT / "bench/rigs"
    plain, deep = (
        (rigs / name).read_text(encoding="utf-8").split("\n[", 1)[1].split("\n[")
        for name in ("calibration.toml", "depth-calibration.toml")
    )
    more = [block for block in deep if block not in plain]
    assert [block.split("]")[0] for block in more] == ["cameras.depth", "depth"]
    assert [block for block in deep if block not in more] == plain
    both, three = (
        one.render(situation("spurious_teat"), np.random.default_rng(0))
        for one in (small(depth=True), small())
    )
    for name in ("left", "right", "thermal_8bit", "thermal_ck"):
        assert np.array_equal(getattr(both, name), getattr(three, name))
    assert both.depth_dmm is not None
    assert three.depth_dmm is None

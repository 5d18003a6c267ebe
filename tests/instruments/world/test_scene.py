"""The rendered scene: geometry against OpenCV, edges against geometry, visibility, heat, and the same bytes twice."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from instruments.world.backdrop import Backdrop
from instruments.world.eyes import OpticalCamera
from instruments.world.objects import SceneObject, make_object
from instruments.world.optics import CameraModel, Floats
from instruments.world.phantom import Phantom, PlatePose, Teat, TeatShape, make_phantom
from instruments.world.scene import Renderer, SceneState
from instruments.world.sensor import Image
from instruments.world.shading import Lighting, Paint
from instruments.world.sheet import contact_sheet
from instruments.world.solids import Hull, ball
from instruments.world.state import Stage
from tests.situations import SITUATIONS, situation

ROOT = Path(__file__).resolve().parents[3]
BLACK = Paint(albedo=0.0)
PLAIN = Backdrop(board_texture=0.0, table_texture=0.0)
NOBODY = SceneState(Phantom(()), (), 20.0, 20.0, backdrop=PLAIN)


@cache
def renderer() -> Renderer:
    table = tomllib.loads((ROOT / "bench/rigs/calibration.toml").read_text(encoding="utf-8"))
    return Renderer.from_calibration(table, camera_seed=7)


@cache
def empty(which: str) -> Image:
    return _eye(which).expected(NOBODY)


@cache
def covered(which: str) -> Image:
    """The frame before noise with the lights off: what the sensor gives of its own."""
    return _eye(which).expected(replace(NOBODY, lighting=Lighting(brightness=0.0)))


def _eye(which: str) -> OpticalCamera:
    return {"left": renderer().left, "right": renderer().right}[which]


def hidden_share(which: str, *hulls: Hull) -> Floats:
    """Share of the board's light that black solids take from each pixel, (h, w), before noise."""
    thing = SceneObject("black", hulls, BLACK, "ambient")
    dark = covered(which)
    return np.asarray(1.0 - (_eye(which).expected(replace(NOBODY, objects=(thing,))) - dark) / (empty(which) - dark), dtype=np.float64)


def by_opencv(camera: CameraModel, points_mm: Floats) -> Floats:
    K = np.array([[camera.fc[0], 0.0, camera.cc[0]], [0.0, camera.fc[1], camera.cc[1]], [0.0, 0.0, 1.0]])
    pixels, _ = cv2.projectPoints(points_mm, cv2.Rodrigues(camera.R)[0], camera.t_mm, K, camera.kc)
    return np.asarray(pixels[:, 0], dtype=np.float64)


@pytest.mark.parametrize("which", ["left", "right"])
def test_small_balls_lie_where_opencv_projects_them(which: str) -> None:
    camera = _eye(which).view.camera
    places = [(x, y, z) for x in (-620.0, -200.0, 250.0) for y, z in ((150.0, 130.0), (700.0, 420.0))]
    share = hidden_share(which, *(ball(place, 4.0) for place in places))
    for u, v in by_opencv(camera, np.array(places)):
        rows, columns = slice(round(v) - 14, round(v) + 15), slice(round(u) - 14, round(u) + 15)
        patch = share[rows, columns]
        at = np.array(
            [(patch.sum(axis=0) @ np.arange(columns.start, columns.stop)), (patch.sum(axis=1) @ np.arange(rows.start, rows.stop))]
        )
        assert at / patch.sum() == pytest.approx([u, v], abs=0.03)


@pytest.mark.parametrize("which", ["left", "right"])
@pytest.mark.parametrize("lean_mm", [0.0, 20.0])
def test_edges_at_every_sub_pixel_phase(which: str, lean_mm: float) -> None:
    """Both edges of a post, in rows of pixels, against the limb of the post by `cv2.projectPoints`: below 0.01 px before noise."""
    camera, worst = _eye(which).view.camera, 0.0
    for phase in np.linspace(0.0, 0.85, 9):
        a, b = np.array([-180.0 + phase, 230.0, 60.0]), np.array([-180.0 + phase + lean_mm, 230.0, 180.0])
        share = hidden_share(which, Hull(tuple(a), tuple(b), 11.0, 11.0))
        middle = by_opencv(camera, 0.5 * (a + b)[None, :])[0]
        rows = np.arange(round(middle[1]) - 30, round(middle[1]) + 30)
        columns = np.arange(round(middle[0]) - 40, round(middle[0]) + 41)
        profile = share[np.ix_(rows, columns)]
        width, centre = profile.sum(axis=1), profile @ columns / profile.sum(axis=1)
        for side in (-1.0, 1.0):
            limb = by_opencv(camera, _limb(camera, a, b, 11.0, side))
            order = np.argsort(limb[:, 1])
            expected = np.interp(rows, limb[order, 1], limb[order, 0])
            worst = max(worst, float(np.abs(centre + side * width / 2.0 - expected).max()))
    assert worst < 0.01, f"worst edge error {worst:.4f} px"


def _limb(camera: CameraModel, a: Floats, b: Floats, radius: float, side: float) -> Floats:
    """Points where rays touch a cylinder on its left or right: the normal is square to the axis and to the ray."""
    axis = (b - a) / np.linalg.norm(b - a)
    away = a - camera.centre_mm
    away -= (away @ axis) * axis
    distance = float(np.linalg.norm(away))
    forward, across = away / distance, np.cross(away / distance, axis)
    touch = -radius / distance * forward + side * np.sqrt(1.0 - (radius / distance) ** 2) * across
    return np.asarray(a + np.linspace(0.0, 1.0, 400)[:, None] * (b - a) + radius * touch)


def test_the_rounded_end_reaches_its_apex() -> None:
    """The picture of a teat ends where its hemisphere's limb does: highest covered row against geometry."""
    camera = renderer().cameras[0]
    share = hidden_share("left", Hull((-180.0, 230.0, 30.0), (-180.0, 230.0, 125.0), 11.0, 11.0, flat_a=True))
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
    limb = by_opencv(camera, rim + radius * (np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v))
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


def test_the_nearer_thing_is_drawn_over_the_farther() -> None:
    white, black = Paint(albedo=1.0), Paint(albedo=0.0)
    near = SceneObject("near", (ball((-185.0, 100.0, 200.0), 10.0),), black, "ambient")
    far = SceneObject("far", (ball((-170.0, 500.0, 200.0), 60.0),), white, "ambient")
    u, v = renderer().cameras[0].project(np.array([[-185.0, 100.0, 200.0]]))[0].round().astype(int)
    for objects in ((near, far), (far, near)):
        seen = _eye("left").expected(replace(NOBODY, objects=objects))
        assert seen[v, u] < 10.0
        assert seen[v, u + 30] > 60.0


def warm(layout: str = "table-5-1", teat_c: float = 32.5, ambient_c: float = 20.0, **more: Any) -> SceneState:
    phantom = make_phantom(layout)
    return SceneState(phantom, (teat_c,) * len(phantom.teats), teat_c - 0.5, ambient_c, **more)


def test_same_state_and_seed_same_bytes() -> None:
    one, two = (renderer().render(situation("hot_body_at_base"), np.random.default_rng(5)) for _ in range(2))
    other = renderer().render(situation("hot_body_at_base"), np.random.default_rng(6))
    for name in ("left", "right", "thermal_8bit", "thermal_ck"):
        assert np.array_equal(getattr(one, name), getattr(two, name))
        assert not np.array_equal(getattr(one, name), getattr(other, name))


def test_what_was_drawn_before_leaves_no_trace() -> None:
    fresh = Renderer(renderer().cameras, camera_seed=7)
    for name in SITUATIONS:
        fresh.render(situation(name), np.random.default_rng(1))
    one = fresh.render(warm(), np.random.default_rng(2))
    two = Renderer(renderer().cameras, camera_seed=7).render(warm(), np.random.default_rng(2))
    assert np.array_equal(one.left, two.left)
    assert np.array_equal(one.thermal_ck, two.thermal_ck)


def test_another_camera_seed_is_another_camera() -> None:
    other = Renderer(renderer().cameras, camera_seed=8)
    assert not np.array_equal(other.left.expected(NOBODY), empty("left"))


def thermal_masks() -> tuple[Floats, Floats]:
    """Sensor pixels well inside the teats, and well outside of anything, from the warm scene before noise."""
    seen = renderer().thermal.expected_k(*_staged(warm()))
    return np.asarray(seen > 273.15 + 31.0), np.asarray(seen < 273.15 + 20.001)


def _staged(state: SceneState) -> tuple[SceneState, Stage]:
    return state, Stage.of(state)


def test_a_cold_phantom_is_invisible_in_the_thermal_picture() -> None:
    teat, room = thermal_masks()
    cold = replace(warm(teat_c=20.0), hose_temp_c=20.0)
    assert np.ptp(renderer().thermal.expected_k(*_staged(cold))) < 1e-6
    frames = [renderer().render(cold, np.random.default_rng(i)) for i in range(3)]
    kelvin = np.mean([frame.thermal_ck / 100.0 for frame in frames], axis=0)
    assert abs(kelvin[teat].mean() - kelvin[room].mean()) < 0.05
    picture = frames[0].thermal_8bit.astype(float)
    assert picture.std() < 6.0
    assert picture.min() > 180.0


def test_a_warm_phantom_stands_out_black_and_mirrored() -> None:
    state = warm()
    frame = renderer().render(state, np.random.default_rng(3))
    pixels = renderer().cameras[2].project(state.phantom.ends_mm - [0.0, 0.0, 30.0])
    for u, v in pixels.round().astype(int):
        assert frame.thermal_8bit[v, 639 - u] < 40
        assert frame.thermal_ck[v // 4, u // 4] / 100.0 - 273.15 == pytest.approx(0.95 * 32.5 + 0.05 * 20.0, abs=0.6)
    assert np.median(frame.thermal_8bit) > 200


def test_the_thermal_picture_follows_the_rig_file() -> None:
    table = tomllib.loads((ROOT / "bench/rigs/calibration.toml").read_text(encoding="utf-8"))
    table["cameras"]["thermal"]["mirrored"] = False
    table["cameras"]["thermal"]["polarity"] = "hot_is_white"
    frame = Renderer.from_calibration(table, 1).thermal.expose(*_staged(warm()), np.random.default_rng(1))[0]
    u, v = renderer().cameras[2].project(warm().phantom.ends_mm - [0.0, 0.0, 30.0])[0].round().astype(int)
    assert frame[v, u] > 200
    table["cameras"]["thermal"]["polarity"] = "hot"
    with pytest.raises(ValueError, match=r"polarity must be"):
        Renderer.from_calibration(table, 1)


def test_teats_have_their_own_temperatures() -> None:
    state = replace(warm(), teat_temps_c=(30.0, 31.0, 32.0, 33.0))
    seen = renderer().thermal.expected_k(*_staged(state))
    small = renderer().cameras[2].resized(160, 120)
    pixels = small.project(state.phantom.ends_mm - [0.0, 0.0, 40.0]).round().astype(int)
    assert [seen[v, u] - 273.15 for u, v in pixels] == pytest.approx([29.5, 30.45, 31.4, 32.35], abs=0.1)


def test_all_ends_of_the_plain_layout_are_visible() -> None:
    assert renderer().visible_ends(warm()).all()


@pytest.mark.parametrize("name", sorted(SITUATIONS))
def test_all_ends_of_the_six_situations_are_visible(name: str) -> None:
    assert renderer().visible_ends(situation(name)).all()


def test_a_post_before_a_teat_hides_it_from_the_cameras_behind_the_post_only() -> None:
    state = warm()
    camera, end = renderer().cameras[0], state.phantom.ends_mm[1]
    half = camera.centre_mm + 0.6 * (end - camera.centre_mm)
    post = make_object("rod", x_mm=float(half[0]), y_mm=float(half[1]), height_mm=200.0, radius_mm=10.0)
    visible = renderer().visible_ends(replace(state, objects=(post,)))
    assert not visible[1, 0]
    assert visible[1, 1]
    assert visible[[0, 2, 3]].sum() >= 8


def test_a_teat_behind_a_taller_one_is_hidden() -> None:
    camera = renderer().cameras[1]
    near = np.array([-180.0, 200.0])
    far = camera.centre_mm[:2] + (near - camera.centre_mm[:2]) * 1.08
    phantom = Phantom((Teat((near[0], near[1]), TeatShape(150.0, 12.0)), Teat((far[0], far[1]), TeatShape(130.0, 11.0))))
    visible = renderer().visible_ends(SceneState(phantom, (32.0, 32.0), 31.0, 20.0))
    assert visible[:, 1].tolist() == [True, False]


def test_an_end_outside_of_the_image_is_not_visible() -> None:
    state = replace(warm(), phantom=make_phantom("table-5-1", PlatePose(x_mm=-250.0)))
    visible = renderer().visible_ends(state)
    assert not visible[:, 2].any()
    assert visible[:, :2].all()


def test_dim_light_dims() -> None:
    dim = _eye("left").expected(replace(NOBODY, lighting=Lighting(brightness=0.3)))
    offset = _eye("left").readout.sensor.offset_dn
    assert (np.median(dim) - offset) / (np.median(empty("left")) - offset) == pytest.approx(0.3, rel=0.02)


def test_a_standing_thing_darkens_the_table_at_its_foot() -> None:
    cup = make_object("hot_cup", albedo=0.5)
    u, v = renderer().cameras[0].project(np.array([[-192.0, 205.0, 0.0]]))[0].round().astype(int)
    seen = _eye("left").expected(replace(NOBODY, objects=(cup,)))
    assert seen[v, u] < 0.95 * empty("left")[v, u]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"teat_temps_c": (30.0,)}, "4 teats, but there are 1 teat temperatures"),
        ({"ambient_c": float("nan")}, "temperature of the room must be"),
        ({"hose_temp_c": 900.0}, "temperature of the hoses must be"),
        ({"objects": (make_object("ball", z_mm=10.0),)}, "ball reaches below the table"),
        ({"objects": (make_object("ball", y_mm=1200.0),)}, "ball stands behind the board"),
    ],
)
def test_a_scene_that_makes_no_sense_is_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(warm(), **change)


def test_a_thing_in_a_camera_s_face_is_refused() -> None:
    state = replace(warm(), objects=(make_object("ball", x_mm=-200.0, y_mm=-800.0, z_mm=80.0, radius_mm=20.0),))
    with pytest.raises(ValueError, match=r"within -?\d+ mm of the left camera's plane"):
        renderer().render(state, np.random.default_rng(1))


def test_a_contact_sheet_has_a_row_for_each_state() -> None:
    one = contact_sheet({"a": warm()}, renderer())
    two = contact_sheet({"a": warm(), "b": situation("overlapping")}, renderer())
    assert two.shape == (2 * one.shape[0], one.shape[1])
    assert np.array_equal(two[: one.shape[0]], one)
    with pytest.raises(ValueError, match="at least one"):
        contact_sheet({}, renderer())

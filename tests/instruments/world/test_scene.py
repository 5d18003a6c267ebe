"""The rendered scene: what hides what, visibility, heat, light, and the same bytes twice."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any

import cv2
import numpy as np
import pytest

from bench.script.phantom import shipped_phantom
from instruments.world import backdrop, boards, optical_camera
from instruments.world import state as states_of
from instruments.world.objects import make_object
from instruments.world.optical_camera import OpticalCamera
from instruments.world.phantom import PlatePose
from instruments.world.scene import Renderer, contact_sheet
from instruments.world.shading import Lighting
from instruments.world.state import SceneState
from tests.instruments.world.scenes import NOBODY, calibration_table, empty, renderer, small
from tests.situations import SITUATIONS, situation


def warm(
    layout: str = "table-5-1", teat_c: float = 32.5, ambient_c: float = 20.0, **more: Any
) -> SceneState:
    phantom = shipped_phantom(layout)
    return SceneState(phantom, (teat_c,) * len(phantom.teats), teat_c - 0.5, ambient_c, **more)


def test_the_thermal_sensor_is_that_of_the_rig_file() -> None:
    table = calibration_table()
    table["cameras"]["thermal"]["polarity"] = "hot"
    with pytest.raises(ValueError, match=r"polarity must be"):
        Renderer.from_calibration(table, 1)


@pytest.mark.slow
def test_loops_are_compiled_when_a_renderer_is_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the first picture it would take longer than a bench may hang that heats."""
    made = list[str]()
    monkeypatch.setattr("instruments.world.scene.import_module", made.append)
    Renderer.from_calibration(calibration_table(), 7)
    assert made == ["instruments.world.kernels"]


def test_teats_have_their_own_temperatures() -> None:
    state = replace(warm(), teat_temps_c=(30.0, 31.0, 32.0, 33.0))
    seen = renderer().thermal.expected_k(state)
    small = renderer().cameras[2].resized(160, 120)
    pixels = small.project(state.phantom.ends_mm - [0.0, 0.0, 40.0]).round().astype(int)
    seen_c = [seen[v, u] - 273.15 for u, v in pixels]
    assert seen_c == pytest.approx([29.5, 30.45, 31.4, 32.35], abs=0.1)


def test_all_ends_of_the_plain_layout_and_the_six_situations_are_visible() -> None:
    for state in (warm(), *map(situation, SITUATIONS)):
        assert renderer().visible_ends(state).all()


def test_a_post_before_a_teat_hides_it_from_the_cameras_behind_the_post_only() -> None:
    state = warm()
    camera, end = renderer().cameras[0], state.phantom.ends_mm[1]
    half = camera.centre_mm + 0.6 * (end - camera.centre_mm)
    x, y, _ = half.tolist()
    post = make_object("rod", x_mm=x, y_mm=y, height_mm=200.0, radius_mm=10.0)
    visible = renderer().visible_ends(replace(state, objects=(post,)))
    assert not visible[1, 0]
    assert visible[1, 1]
    assert visible[[0, 2, 3]].sum() >= 8


def test_an_end_outside_of_the_image_is_not_visible() -> None:
    state = replace(warm(), phantom=shipped_phantom("table-5-1").moved(PlatePose(x_mm=-250.0)))
    visible = renderer().visible_ends(state)
    assert not visible[:, 2].any()
    assert visible[:, :2].all()


@pytest.mark.slow
def test_dim_light_dims_and_a_standing_thing_darkens_the_table_at_its_foot() -> None:
    left = renderer().left
    dim = left.expected(replace(NOBODY, lighting=Lighting(brightness=0.3)))
    seen, whole = (np.median(p) - left.readout.sensor.offset_dn for p in (dim, empty("left")))
    assert seen / whole == pytest.approx(0.3, rel=0.02)
    cup = make_object("hot_cup", albedo=0.5)
    u, v = renderer().cameras[0].project(np.array([[-192.0, 205.0, 0.0]]))[0].round().astype(int)
    state = replace(NOBODY, objects=(cup,))
    shaded = left.expected(state, renderer().shadows(state))
    assert shaded[v, u] < 0.95 * empty("left")[v, u]


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


@pytest.mark.slow
def test_a_thing_in_a_camera_s_face_is_refused() -> None:
    near = make_object("ball", x_mm=-200.0, y_mm=-800.0, z_mm=80.0, radius_mm=20.0)
    state = replace(warm(), objects=(near,))
    with pytest.raises(ValueError, match=r"within -?\d+ mm of the left camera's plane"):
        renderer().render(state, np.random.default_rng(1))


@pytest.fixture
def processors() -> Iterator[None]:
    """OpenCV's threads and Python's turns are put back."""
    threads, turn_s = cv2.getNumThreads(), sys.getswitchinterval()
    yield
    cv2.setNumThreads(threads)
    sys.setswitchinterval(turn_s)


@pytest.mark.slow
@pytest.mark.usefixtures("processors")
def test_a_picture_is_the_same_however_many_processors_draw_it() -> None:
    sys.setswitchinterval(1e-6)  # threads meet in all that they share
    states = [*map(situation, SITUATIONS), replace(warm(), velocity_mm_s=(40.0, 0.0, 0.0))]
    drawn = []
    for threads in (1, 2, 4, 4):
        cv2.setNumThreads(threads)
        for kept in (boards.woven, backdrop._seen, optical_camera._empty, states_of._stage):
            kept.cache_clear()
        eyes = small(depth=True)
        drawn.append([eyes.render(one, np.random.default_rng(3)) for one in states])
    for one, *others in zip(*drawn, strict=True):
        for part in fields(one):
            first = getattr(one, part.name)
            assert first is not None
            assert all(np.array_equal(first, getattr(other, part.name)) for other in others)


@pytest.mark.usefixtures("processors")
def test_both_optical_cameras_draw_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    cv2.setNumThreads(2)
    both, exposed = threading.Barrier(2, timeout=60.0), OpticalCamera.exposed

    def together(self: OpticalCamera, *given: Any) -> Any:
        both.wait()
        return exposed(self, *given)

    monkeypatch.setattr(OpticalCamera, "exposed", together)
    small().render(NOBODY, np.random.default_rng(1))  # one after the other would wait in vain


@pytest.mark.usefixtures("processors")
def test_nothing_draws_any_more_when_a_camera_can_t(monkeypatch: pytest.MonkeyPatch) -> None:
    cv2.setNumThreads(2)
    eyes, refused, over = small(), threading.Event(), list[str]()

    def exposed(self: OpticalCamera, *_: Any) -> None:
        if self is eyes.left:
            refused.set()
            raise ValueError("too near")
        refused.wait(60.0)
        eyes.shadows(warm())
        over.append("right")

    monkeypatch.setattr(OpticalCamera, "exposed", exposed)
    with pytest.raises(ValueError, match="too near"):
        eyes.render(NOBODY, np.random.default_rng(1))
    assert over == ["right"]


@pytest.mark.slow
def test_a_contact_sheet_has_a_row_for_each_state() -> None:
    eyes = small()
    one = contact_sheet({"a": warm()}, eyes)
    two = contact_sheet({"a": warm(), "b": situation("overlapping")}, eyes)
    assert two.shape == (2 * one.shape[0], one.shape[1])
    assert np.array_equal(two[: one.shape[0]], one)
    with pytest.raises(ValueError, match="at least one"):
        contact_sheet({}, eyes)

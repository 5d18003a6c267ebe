"""Heat of teats and backdrop; motion during exposure; the thermal camera's lag; exposure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from instruments.world.backdrop import Poster
from instruments.world.objects import make_object
from instruments.world.optics import Floats
from instruments.world.phantom import Phantom, PlatePose, Teat, TeatShape
from instruments.world.scene import Renderer
from instruments.world.sensor import Exposure, Image, OpticalSensor
from instruments.world.shading import (
    Lighting,
    Paint,
    directional_emissivity,
    kelvin_from_radiance,
    radiance_from_c,
)
from instruments.world.state import SceneState
from tests.instruments.world.scenes import NOBODY, PLAIN, by_opencv, renderer

UPRIGHT = Phantom((Teat((-150.0, 240.0), TeatShape(150.0, 13.0)),))
WARM = SceneState(UPRIGHT, (33.0,), 33.0, 20.0, backdrop=PLAIN)


def test_the_power_law_stands_for_the_band() -> None:
    """Against Planck's law over 8 to 13 um: within 0.1 K from 10 to 45 degC, room 20."""

    def band(k: float) -> float:
        return float(quad(lambda um: um**-5 / np.expm1(14387.77 / (um * k)), 8.0, 13.0)[0])

    for celsius in (10.0, 20.0, 33.0, 45.0):
        mixed = 0.95 * band(celsius + 273.15) + 0.05 * band(293.15)
        exact = brentq(lambda k, mixed=mixed: band(k) - mixed, 250.0, 340.0)
        ours = kelvin_from_radiance(0.95 * radiance_from_c(celsius) + 0.05 * radiance_from_c(20.0))
        assert float(ours) == pytest.approx(exact, abs=0.1)


def column_of_teat(state: SceneState) -> Floats:
    """degC up the middle of the teat, from near the base to below its rounded end."""
    seen = renderer().thermal.expected_k(state) - 273.15
    camera = renderer().cameras[2].resized(160, 120)
    ends = np.array([[-150.0, 240.0, 135.0], [-150.0, 240.0, 30.0]])
    (u, top), (_, foot) = by_opencv(camera, ends).round().astype(int)
    return np.asarray(seen[top:foot, u - 1 : u + 2].mean(axis=1)[::-1])


@pytest.mark.slow
def test_a_teat_is_warmer_at_its_base() -> None:
    """By `teat_fall` of what it is above the room: 13 K x 0.1; its mean stays."""
    along = column_of_teat(replace(WARM, teat_fall=0.1))
    flat = column_of_teat(replace(WARM, teat_fall=0.0))
    slope = np.polyfit(np.arange(len(along)) / len(along), along - flat, 1)[0]
    assert slope == pytest.approx(-0.95 * 1.3 * 105.0 / 142.0, rel=0.12)
    assert np.ptp(flat) < 0.1
    assert abs((along - flat).mean()) < 0.15


def test_emissivity_falls_off_at_grazing_angles() -> None:
    angles = np.radians([0.0, 30.0, 60.0, 75.0, 90.0])
    seen = directional_emissivity(np.full(5, 0.95), np.cos(angles))
    assert seen[0] == 0.95
    assert np.all(np.diff(seen) < 0.0)
    assert seen[2] == pytest.approx(0.95 * (1.0 - 0.5**5))
    assert seen[4] == pytest.approx(0.0)


@pytest.mark.slow
def test_a_shiny_thing_shows_the_room() -> None:
    """Bare aluminium, emissivity 0.07: 13 K above the room look like less than one."""
    place = {"x_mm": -150.0, "y_mm": 300.0, "z_mm": 90.0, "radius_mm": 50.0}
    ball = make_object("ball", **place, temperature=33.0, offset_k=0.0)
    thing = replace(ball, paint=Paint(0.5, 0.5, 0.07))
    seen = renderer().thermal.expected_k(replace(NOBODY, objects=(thing,))) - 273.15
    assert 20.3 < seen.max() < 21.2


@pytest.mark.slow
def test_board_and_table_have_temperatures_of_their_own() -> None:
    state = replace(NOBODY, backdrop=replace(PLAIN, board_k=0.5, table_k=-0.4))
    seen = renderer().thermal.expected_k(state) - 273.15
    assert seen[10].mean() == pytest.approx(20.5, abs=0.01)
    assert seen[-6].mean() == pytest.approx(19.6, abs=0.01)


@pytest.mark.slow
def test_posters_hang_where_they_are_put_in_both_cameras() -> None:
    poster = Poster(-300.0, 300.0, 90.0, 60.0, 0.0)
    for eye in (renderer().left, renderer().right):
        seen = eye.expected(replace(NOBODY, backdrop=replace(PLAIN, posters=(poster,))))
        gone = np.asarray(1.0 - seen / eye.expected(NOBODY), dtype=np.float64)
        corners = np.array([[-300.0, 1000.0, 360.0], [-210.0, 1000.0, 300.0]])
        low, high = by_opencv(eye.view.camera, corners)
        rows, columns = np.indices(gone.shape)
        at = np.array([(gone * columns).sum(), (gone * rows).sum()]) / gone.sum()
        assert at == pytest.approx(0.5 * (low + high), abs=0.1)


def profile(state: SceneState) -> Image:
    """A row across the teat, half-way up."""
    at = np.array([[-150.0, 240.0, 90.0]])
    u, v = by_opencv(renderer().cameras[0], at).round().astype(int)[0]
    return np.asarray(renderer().left.expected(state)[v - 5 : v + 6, u - 60 : u + 61].mean(axis=0))


@pytest.mark.slow
def test_a_moving_phantom_is_smeared_about_its_place_at_mid_exposure() -> None:
    """200 mm/s for 40 ms: 8 mm, some 9.6 px, evenly on both sides, with the same sum."""
    # In light that doesn't saturate: what is clipped has no smear to show.
    dim = replace(WARM, exposure=Exposure(0.04), lighting=Lighting(brightness=0.4))
    still = profile(dim)
    moving = profile(replace(dim, velocity_mm_s=(200.0, 0.0, 0.0)))
    shifted = [
        profile(replace(dim, phantom=UPRIGHT.moved(PlatePose(x))))
        for x in np.linspace(-3.9, 3.9, 40)
    ]
    assert np.abs(moving - np.mean(shifted, axis=0)).max() < 1.5
    taken = float(np.abs(still - still.max()).sum())
    assert (moving - still).sum() == pytest.approx(0.0, abs=0.02 * taken)
    assert np.abs(np.diff(moving)).max() < 0.35 * np.abs(np.diff(still)).max()


def test_the_thermal_picture_trails_behind() -> None:
    """A pixel of 12 ms lags by 12 ms: at 500 mm/s the teat's picture is 6 mm behind its place."""
    at, moving = (
        renderer().thermal.expected_k(replace(WARM, velocity_mm_s=(v, 0.0, 0.0))) - 293.15
        for v in (0.0, 500.0)
    )
    rows = slice(30, 60)
    columns = np.arange(160)
    places = [
        (picture[rows].sum(axis=0) @ columns) / picture[rows].sum() for picture in (at, moving)
    ]
    camera = renderer().cameras[2].resized(160, 120)
    pixel_mm = camera.camera_from_world(UPRIGHT.ends_mm)[0, 2] / camera.fc[0]
    assert (places[0] - places[1]) * pixel_mm == pytest.approx(6.0, rel=0.1)


@pytest.mark.slow
def test_longer_exposure_and_gain_brighten_and_saturate() -> None:
    eye = renderer(prnu=0.0, dsnu_e=0.0).left
    offset = OpticalSensor().offset_dn
    usual, half, loud = (
        eye.expected(replace(NOBODY, exposure=e)) - offset
        for e in (Exposure(), Exposure(0.01), Exposure(gain=1.5))
    )
    dim = usual < 120.0
    assert np.allclose(half[dim], 0.5 * usual[dim], rtol=0.01, atol=0.05)
    assert np.allclose(loud[dim], 1.5 * usual[dim], rtol=0.01, atol=0.05)
    state = replace(NOBODY, exposure=Exposure(0.2))
    flooded = Renderer(renderer().cameras, 7).render(state, np.random.default_rng(1)).left
    assert np.mean(flooded == 255) > 0.4


def test_drift_follows_the_scene_s_clock() -> None:
    camera, states = renderer().thermal, [replace(WARM, time_s=t) for t in (0.0, 299.0, 301.0)]
    frames = [
        camera.exposed(camera.expected_k(s), s.time_s, np.random.default_rng(3))[1].astype(float)
        for s in states
    ]
    assert np.abs(frames[1] - frames[0]).mean() > 3.0 * np.abs(frames[2] - frames[0]).mean()

"""The thermal sensor returns its parameters: noise, drift, flat-field events; the 8-bit picture."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from instruments.world.thermal_camera import Drift, ThermalReadout, ThermalSensor

STEADY = Drift(level_k_per_min=0.0, pattern_k_per_min=0.0)
# sigma, and how near it comes back: a spread from n values is known to 1 / sqrt(2 n), and there are
# 120 frames, 240 rows, 320 columns
NOISES = {
    "netd_k": (0.10, 0.01),
    "row_flicker_k": (0.05, 0.03),
    "column_flicker_k": (0.04, 0.03),
    "level_flicker_k": (0.03, 0.25),
    "fixed_k": (0.06, 0.01),
    "row_k": (0.07, 0.15),
    "column_k": (0.08, 0.15),
}
PUT_IN = {name: sigma for name, (sigma, _) in NOISES.items()}
NOTHING = dict.fromkeys(PUT_IN, 0.0)
ROOM = np.full((240, 320), 293.15)


def thermal(drift: Drift = STEADY, put_in: Mapping[str, float] = NOTHING) -> ThermalReadout:
    return ThermalReadout(
        replace(ThermalSensor(320, 240, drift=drift), **{**NOTHING, **put_in}),  # type: ignore[arg-type]
        np.random.SeedSequence(2),
    )


def clip(camera: ThermalReadout, count: int, time_s: float = 0.0) -> NDArray[np.float64]:
    """degC of so many frames, (count, h, w)."""
    frames = [camera.expose(ROOM, time_s, np.random.default_rng(i)) for i in range(count)]
    return np.array(frames) / 100.0 - 273.15


def three_d_noise(frames: NDArray[np.float64]) -> dict[str, float]:
    """The seven components of a clip (t, v, h), as spreads of means (Driggers et al.)."""
    t, v, h = frames.shape
    frames = frames - frames.mean()

    def mean_over(*axes: int) -> NDArray[np.float64]:
        return np.asarray(frames.mean(axis=axes, keepdims=True))

    level, row, column = mean_over(1, 2), mean_over(0, 2), mean_over(0, 1)
    row_flicker = mean_over(2) - level - row
    column_flicker = mean_over(1) - level - column
    fixed = mean_over(0) - row - column
    fresh = frames - level - row - column - row_flicker - column_flicker - fixed
    s_tvh = fresh.var()
    s_tv = row_flicker.var() - s_tvh / h
    s_th = column_flicker.var() - s_tvh / v
    s_vh = fixed.var() - s_tvh / t
    s_t = level.var() - s_tv / v - s_th / h
    s_v, s_h = row.var() - s_tv / t - s_vh / h, column.var() - s_th / t - s_vh / v
    named = zip(PUT_IN, (s_tvh, s_tv, s_th, s_t, s_vh, s_v, s_h), strict=True)
    return {name: float(np.sqrt(max(variance, 0.0))) for name, variance in named}


@pytest.mark.slow
def test_three_dimensional_noise_returns_every_sigma() -> None:
    seen = three_d_noise(clip(thermal(put_in=PUT_IN), 120))
    for name, (sigma, tolerance) in NOISES.items():
        assert seen[name] == pytest.approx(sigma, rel=tolerance), name


@pytest.mark.slow
def test_drift_grows_with_the_time_and_ends_at_a_flat_field_event() -> None:
    camera = thermal(Drift(level_k_per_min=0.5, pattern_k_per_min=0.1, every_s=300.0))
    assert not camera.drift_k(0.0).any()
    one, two = camera.drift_k(60.0), camera.drift_k(240.0)
    assert two == pytest.approx(4.0 * one)
    assert one.std() == pytest.approx(0.1, rel=0.02)
    assert not camera.drift_k(300.0).any()
    assert not np.allclose(camera.drift_k(360.0), one)
    seen = clip(camera, 1, 60.0)[0]
    assert seen - 20.0 == pytest.approx(one, abs=0.006)


@pytest.mark.slow
def test_level_drift_has_the_declared_spread_over_many_events() -> None:
    camera = thermal(Drift(level_k_per_min=0.3, pattern_k_per_min=0.0, every_s=60.0))
    ends = [camera.drift_k(60.0 * i + 30.0).mean() / 0.5 for i in range(200)]
    assert np.std(ends) == pytest.approx(0.3, rel=0.15)


def test_a_flat_field_event_shows_the_shutter() -> None:
    camera = thermal(Drift(0.0, 0.0, every_s=300.0, lasts_s=0.5, shutter_c=28.0))
    assert clip(camera, 1, 299.9).mean() == pytest.approx(20.0, abs=0.01)
    assert camera.shows_shutter(300.2)
    assert clip(camera, 1, 300.2).mean() == pytest.approx(28.0, abs=0.01)
    assert clip(camera, 1, 300.6).mean() == pytest.approx(20.0, abs=0.01)
    with pytest.raises(ValueError, match="before the next one"):
        Drift(every_s=1.0, lasts_s=1.0)


def hot_square() -> NDArray[np.uint16]:
    scene = np.full((120, 160), 29315, dtype=np.uint16)
    scene[30:60, 10:40] = 30515
    return scene


def usual(sensor: ThermalSensor | None = None) -> ThermalReadout:
    return ThermalReadout(sensor or ThermalSensor(), np.random.SeedSequence(2))


def test_delivered_is_mirrored_and_hot_is_black() -> None:
    picture = usual().delivered(hot_square(), 640, 480)
    assert picture.shape == (480, 640)
    assert picture[180, 639 - 100] < 20
    assert picture[180, 100] > 230
    plain = usual(ThermalSensor(mirrored=False, hot_is_black=False)).delivered(
        hot_square(), 640, 480
    )
    assert np.abs(plain[:, ::-1].astype(int) + picture - 255).max() <= 1


def test_a_flat_room_is_not_stretched() -> None:
    """The picture spans at least ten kelvin."""
    rng = np.random.default_rng(3)
    scene = (29315 + 10.0 * rng.standard_normal((120, 160))).astype(np.uint16)
    assert usual().delivered(scene, 640, 480).std() < 4.0


def test_the_thermal_edge_keeps_its_place() -> None:
    """Blur and pixels spread an edge, symmetrically: its integral stays."""
    fine = np.ones((240, 320))
    fine[:, 151:] = 2.0
    row = usual().gathered(fine)[60]
    assert (row - 1.0).sum() == pytest.approx((320 - 151) / 2.0, abs=1e-6)
    assert ((row > 1.02) & (row < 1.98)).sum() >= 2


def test_the_sensor_is_as_the_calibration_says() -> None:
    said = {"sensor_size": [320, 240], "mirrored": False, "polarity": "hot_is_white"}
    assert ThermalSensor.from_calibration({"cameras": {"thermal": said}}) == ThermalSensor(
        320, 240, mirrored=False, hot_is_black=False
    )
    usual = ThermalSensor.from_calibration({})
    assert (usual.width_px, usual.height_px) == (160, 120)
    with pytest.raises(ValueError, match="polarity must be"):
        ThermalSensor.from_calibration({"cameras": {"thermal": {"polarity": "hot"}}})
    with pytest.raises(ValueError, match="at least one pixel"):
        ThermalSensor(width_px=0)

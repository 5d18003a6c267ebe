"""The sensors give back the parameters that were put in: photon transfer, fixed patterns, NETD; and never wrap around."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from instruments.world.sensor import Image, OpticalReadout, OpticalSensor, ThermalReadout, ThermalSensor, celsius, normal_noise

FLAT = OpticalSensor(prnu=0.0, dsnu_dn=0.0, vignetting=0.0)
SHAPE = (240, 320)
WHOLE = (slice(None), slice(None))


def readout(sensor: OpticalSensor) -> OpticalReadout:
    return OpticalReadout(sensor, (np.zeros(SHAPE), np.zeros(SHAPE)), np.random.SeedSequence(1))


def frames(sensor: OpticalSensor, level: float, count: int) -> Image:
    camera = readout(sensor)
    expected = camera.expected(np.full(SHAPE, level, dtype=np.float32), *WHOLE)
    return np.array([camera.expose([expected], np.random.default_rng(i)) for i in range(count)], dtype=np.float32)


def test_noise_is_unit_normal() -> None:
    noise = normal_noise(np.random.default_rng(1), (1000, 1001)).ravel()
    assert noise.mean() == pytest.approx(0.0, abs=0.004)
    assert noise.std() == pytest.approx(1.0, abs=0.003)
    assert np.mean(noise**4) == pytest.approx(3.0, abs=0.03)
    for limit, outside in ((1.0, 0.3173), (2.0, 0.0455), (3.0, 0.0027)):
        assert np.mean(np.abs(noise) > limit) == pytest.approx(outside, rel=0.06)
    assert abs(np.corrcoef(noise[:-1], noise[1:])[0, 1]) < 0.004


def test_photon_transfer_gives_the_gain_and_the_dark_noise() -> None:
    """EMVA 1288: variance = K^2 sd_d^2 + 1/12 + K (mean - dark mean), from pairs of frames."""
    levels = np.linspace(0.05, 0.85, 9)
    pairs = [frames(FLAT, level, 2) for level in levels]
    mean = np.array([pair.mean() for pair in pairs])
    variance = np.array([np.var(pair[0] - pair[1]) / 2.0 for pair in pairs])
    slope, _ = np.polyfit(mean, variance, 1)
    assert slope == pytest.approx(255.0 / 13000.0, rel=0.03)
    # Pixels' offsets spread over a few levels, or rounding would see only one phase of the noise.
    dark = frames(replace(FLAT, dsnu_dn=1.0), 0.0, 2)
    assert dark.mean() == pytest.approx(4.0, abs=0.02)
    dark_variance = (255.0 / 13000.0 * 20.0) ** 2
    assert np.var(dark[0] - dark[1]) / 2.0 == pytest.approx(dark_variance + 1.0 / 12.0, rel=0.08)


def test_fixed_patterns_stay_and_have_the_declared_spread() -> None:
    stack = frames(replace(FLAT, prnu=0.02, dsnu_dn=0.0), 0.5, 40)
    pattern = stack.mean(axis=0)
    within = np.var(stack, axis=0).mean() / len(stack)
    assert np.sqrt(pattern.var() - within) / (pattern.mean() - 4.0) == pytest.approx(0.02, rel=0.05)
    dark = replace(FLAT, prnu=0.0, dsnu_dn=2.0, offset_dn=20.0)
    stack = frames(dark, 0.0, 40)
    assert np.sqrt(stack.mean(axis=0).var()) == pytest.approx(2.0, rel=0.05)


def test_bright_saturates_and_dark_stops_at_zero() -> None:
    bright = frames(FLAT, 5.0, 1)
    assert bright.min() > 244
    assert np.median(bright) == bright.max() == 255
    assert frames(replace(FLAT, offset_dn=0.0, read_noise_e=100.0), 0.0, 1).min() == 0
    assert frames(replace(FLAT, offset_dn=0.0, read_noise_e=100.0), 0.0, 1).max() < 20


def test_a_part_of_a_frame_lies_over_the_whole() -> None:
    camera = readout(FLAT)
    whole = camera.expected(np.full(SHAPE, 0.2, dtype=np.float32), *WHOLE)
    part = camera.expected(np.full((50, 60), 0.8, dtype=np.float32), slice(10, 60), slice(20, 80))
    picture = camera.expose([whole, part], np.random.default_rng(1)).astype(float)
    assert picture[10:60, 20:80].mean() == pytest.approx(4.0 + 0.8 * 255.0, abs=0.3)
    assert picture[60:].mean() == pytest.approx(4.0 + 0.2 * 255.0, abs=0.3)


def thermal(sensor: ThermalSensor) -> ThermalReadout:
    return ThermalReadout(sensor, np.random.SeedSequence(2))


def test_netd_and_fixed_pattern_come_back() -> None:
    camera = thermal(ThermalSensor(netd_k=0.1, fixed_k=0.06, line_k=0.0))
    room = np.full((120, 160), 293.15)
    stack = np.array([celsius(camera.expose(room, np.random.default_rng(i))) for i in range(60)])
    assert stack.mean() == pytest.approx(20.0, abs=0.01)
    assert stack.std(axis=0).mean() == pytest.approx(0.1, rel=0.04)
    assert stack.mean(axis=0).std() == pytest.approx(np.hypot(0.06, 0.1 / np.sqrt(60)), rel=0.04)


def test_rows_and_columns_have_a_pattern_of_their_own() -> None:
    camera = thermal(ThermalSensor(netd_k=0.0, fixed_k=0.0, line_k=0.1))
    seen = celsius(camera.expose(np.full((120, 160), 293.15), np.random.default_rng(1)))
    assert seen.mean(axis=0).std() == pytest.approx(0.1, rel=0.2)
    assert seen.mean(axis=1).std() == pytest.approx(0.1, rel=0.2)


def hot_square() -> np.ndarray[tuple[int, ...], np.dtype[np.uint16]]:
    scene = np.full((120, 160), 29315, dtype=np.uint16)
    scene[30:60, 10:40] = 30515
    return scene


def test_delivered_is_mirrored_and_hot_is_black() -> None:
    picture = thermal(ThermalSensor()).delivered(hot_square(), 640, 480)
    assert picture.shape == (480, 640)
    assert picture[180, 639 - 100] < 20
    assert picture[180, 100] > 230
    plain = thermal(ThermalSensor(mirrored=False, hot_is_black=False)).delivered(hot_square(), 640, 480)
    assert np.abs(plain[:, ::-1].astype(int) + picture - 255).max() <= 1


def test_a_flat_room_is_not_stretched() -> None:
    """Two tenths of a kelvin of noise stay within a few grey levels, for the picture spans at least ten kelvin."""
    rng = np.random.default_rng(3)
    scene = (29315 + 10.0 * rng.standard_normal((120, 160))).astype(np.uint16)
    picture = thermal(ThermalSensor()).delivered(scene, 640, 480)
    assert picture.std() < 4.0


def test_the_thermal_edge_keeps_its_place() -> None:
    """Blur and pixels spread an edge, symmetrically: its integral stays."""
    camera = thermal(ThermalSensor())
    fine = np.ones((240, 320))
    fine[:, 151:] = 2.0
    row = camera.gathered(fine)[60]
    assert (row - 1.0).sum() == pytest.approx((320 - 151) / 2.0, abs=1e-6)
    assert ((row > 1.02) & (row < 1.98)).sum() >= 2

"""The optical sensor returns its parameters: photon transfer, fixed patterns; and never wraps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from instruments.world.sensor import Image, OpticalReadout, OpticalSensor, normal_noise

FLAT = OpticalSensor(prnu=0.0, dsnu_e=0.0, vignetting=0.0)
SHAPE = (240, 320)


def readout(sensor: OpticalSensor) -> OpticalReadout:
    return OpticalReadout(sensor, (np.zeros(SHAPE), np.zeros(SHAPE)), np.random.SeedSequence(1))


def frames(sensor: OpticalSensor, level: float, count: int) -> Image:
    camera = readout(sensor)
    expected = camera.expected(np.full(SHAPE, level, dtype=np.float32))
    return np.array(
        [camera.expose(expected, np.random.default_rng(i)) for i in range(count)], dtype=np.float32
    )


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
    dark = frames(replace(FLAT, dsnu_e=51.0), 0.0, 2)
    assert dark.mean() == pytest.approx(4.0, abs=0.02)
    dark_variance = (255.0 / 13000.0 * 20.0) ** 2
    assert np.var(dark[0] - dark[1]) / 2.0 == pytest.approx(dark_variance + 1.0 / 12.0, rel=0.08)


@pytest.mark.slow
def test_fixed_patterns_stay_and_have_the_declared_spread() -> None:
    stack = frames(replace(FLAT, prnu=0.02, dsnu_e=0.0), 0.5, 40)
    pattern = stack.mean(axis=0)
    within = np.var(stack, axis=0).mean() / len(stack)
    assert np.sqrt(pattern.var() - within) / (pattern.mean() - 4.0) == pytest.approx(0.02, rel=0.05)
    dark = replace(FLAT, prnu=0.0, dsnu_e=102.0, offset_dn=20.0)
    stack = frames(dark, 0.0, 40)
    assert np.sqrt(stack.mean(axis=0).var()) == pytest.approx(2.0, rel=0.05)


def test_bright_saturates_and_dark_stops_at_zero() -> None:
    bright = frames(FLAT, 5.0, 1)
    assert bright.min() > 244
    assert np.median(bright) == bright.max() == 255
    assert frames(replace(FLAT, offset_dn=0.0, read_noise_e=100.0), 0.0, 1).min() == 0
    assert frames(replace(FLAT, offset_dn=0.0, read_noise_e=100.0), 0.0, 1).max() < 20

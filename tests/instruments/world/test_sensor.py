"""The optical sensor's noise is unit normal, and its counts never wrap."""

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
    light = np.full(SHAPE, level, dtype=np.float32)
    noises = (camera.noise(np.random.default_rng(i)) for i in range(count))
    return np.array([camera.exposed(light, noise) for noise in noises], dtype=np.float32)


def test_noise_is_unit_normal() -> None:
    noise = normal_noise(np.random.default_rng(1), (1000, 1001)).ravel()
    assert noise.mean() == pytest.approx(0.0, abs=0.004)
    assert noise.std() == pytest.approx(1.0, abs=0.003)
    assert np.mean(noise**4) == pytest.approx(3.0, abs=0.03)
    for limit, outside in ((1.0, 0.3173), (2.0, 0.0455), (3.0, 0.0027)):
        assert np.mean(np.abs(noise) > limit) == pytest.approx(outside, rel=0.06)
    assert abs(np.corrcoef(noise[:-1], noise[1:])[0, 1]) < 0.004


def test_bright_saturates_and_dark_stops_at_zero() -> None:
    bright = frames(FLAT, 5.0, 1)
    assert bright.min() > 244
    assert np.median(bright) == bright.max() == 255
    assert frames(replace(FLAT, offset_dn=0.0, read_noise_e=100.0), 0.0, 1).min() == 0
    assert frames(replace(FLAT, offset_dn=0.0, read_noise_e=100.0), 0.0, 1).max() < 20

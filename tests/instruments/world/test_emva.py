"""EMVA 1288's referee `emva1288` on rendered flat fields: it returns what the sensor was given."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from instruments.world.sensor import NORMAL_EXPOSURE_S, Exposure, OpticalReadout, OpticalSensor
from tests.instruments.bath.peers import foreign

pytestmark = pytest.mark.slow

SHAPE = (300, 400)
LEVELS = np.linspace(0.0, 1.1, 23)  # of what fills a pixel
# at level 1: the referee wants a scale, and K, noise and patterns don't depend on it
PHOTONS = 30000.0
SPATIAL_FRAMES = 40
# 12 bits resolve what noise there is
DEEP = replace(OpticalSensor(), bits=12, white_dn=3800.0, offset_dn=100.0, vignetting=0.0)


@pytest.fixture(autouse=True)
def _numpy_1(monkeypatch: pytest.MonkeyPatch) -> None:
    """emva1288 1.0.2 calls a function that NumPy 2 has no longer."""
    monkeypatch.setattr(
        np, "asfarray", lambda values: np.asarray(values, dtype=np.float64), raising=False
    )


class Bench:
    """Writes flat fields as files, which is how the referee takes them."""

    def __init__(self, sensor: OpticalSensor, folder: Path, exposure: Exposure) -> None:
        self._camera = OpticalReadout(
            sensor, (np.zeros(SHAPE), np.zeros(SHAPE)), np.random.SeedSequence(5)
        )
        self._folder, self._exposure = folder, exposure
        self._taken = 0

    def frames(self, level: float, count: int) -> list[str]:
        flat = np.full(SHAPE, level, dtype=np.float32)
        names = []
        for _ in range(count):
            self._taken += 1
            path = self._folder / f"{self._taken}.npy"
            fresh = self._camera.noise(np.random.default_rng(self._taken))
            np.save(path, self._camera.exposed(flat, fresh, self._exposure))
            names.append(str(path))
        return names


def measured(sensor: OpticalSensor, folder: Path, exposure: Exposure | None = None) -> Any:
    """The referee's results on a sensor's flat fields."""
    foreign("emva1288", "emva1288")
    load, data, results = (
        import_module(f"emva1288.process.{name}") for name in ("loader", "data", "results")
    )
    bench = Bench(sensor, folder, exposure or Exposure())
    pairs = {PHOTONS * level: bench.frames(level, 2) for level in LEVELS}
    spatial = {PHOTONS * level: bench.frames(level, SPATIAL_FRAMES) for level in (0.0, 0.5)}
    images = {"temporal": {NORMAL_EXPOSURE_S: pairs}, "spatial": {NORMAL_EXPOSURE_S: spatial}}
    return results.Results1288(data.Data1288(load.LoadImageData(images, fload=np.load).data).data)


def test_the_referee_returns_gain_dark_noise_and_patterns(tmp_path: Path) -> None:
    seen = measured(DEEP, tmp_path)
    assert pytest.approx(DEEP.gain_dn_per_e, rel=0.02) == seen.K
    assert seen.sigma_d == pytest.approx(
        np.sqrt(DEEP.read_noise_e**2 + DEEP.dark_e_per_s * NORMAL_EXPOSURE_S), rel=0.05
    )
    assert pytest.approx(DEEP.dsnu_e, rel=0.05) == seen.DSNU1288
    assert pytest.approx(100.0 * DEEP.prnu, rel=0.05) == seen.PRNU1288
    assert seen.u_e_sat == pytest.approx(DEEP.full_well_e, rel=0.05)


def test_gain_multiplies_the_gain_and_nothing_else(tmp_path: Path) -> None:
    quiet = replace(DEEP, white_dn=1900.0)
    seen = measured(quiet, tmp_path, Exposure(gain=2.0))
    assert pytest.approx(2.0 * quiet.gain_dn_per_e, rel=0.02) == seen.K
    assert seen.sigma_d == pytest.approx(quiet.read_noise_e, rel=0.05)
    assert pytest.approx(quiet.dsnu_e, rel=0.05) == seen.DSNU1288


def test_eight_bits_keep_gain_and_patterns(tmp_path: Path) -> None:
    """Its dark noise of 0.39 grey levels is below the 0.49 that EMVA 1288 (6.5) asks for."""
    sensor = replace(OpticalSensor(), vignetting=0.0)
    seen = measured(sensor, tmp_path)
    assert pytest.approx(sensor.gain_dn_per_e, rel=0.03) == seen.K
    assert pytest.approx(100.0 * sensor.prnu, rel=0.05) == seen.PRNU1288
    assert pytest.approx(sensor.dsnu_e, rel=0.05) == seen.DSNU1288

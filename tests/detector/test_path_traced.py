"""The thesis's detector on path-traced frames: it must answer every one, well or badly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from detector.calibration import load_calibration
from detector.registry import create
from tests.detector.conftest import recorded


@pytest.mark.slow
def test_every_frame_is_answered(path_traced: Path) -> None:
    calibration, detector = load_calibration(path_traced / "calibration.toml"), create("thesis")
    folders = sorted((path_traced / "frames").iterdir())
    assert len(folders) == 33
    for folder in folders:
        found = detector.detect(recorded(folder), calibration)
        assert found.teats or found.reason, folder.name
        assert len(found.teats) <= 4
        assert 0 <= found.hidden <= 4
        for teat in found.teats:
            assert np.isfinite(teat.world_mm).all()


@pytest.mark.slow
def test_radiometric_frames_alone_are_answered(path_traced: Path) -> None:
    calibration, detector = load_calibration(path_traced / "calibration.toml"), create("thesis")
    whole = recorded(path_traced / "frames" / "0000")
    found = detector.detect(replace(whole, thermal=None), calibration)
    assert found.teats or found.reason

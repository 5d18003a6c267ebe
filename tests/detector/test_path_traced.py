"""The thesis's detector on frames that another program rendered: it must answer every one, well or
badly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import load_calibration
from detector.registry import create


@dataclass(frozen=True)
class Recorded:
    """One folder of a recording."""

    left: NDArray[Any]
    right: NDArray[Any]
    thermal: NDArray[Any] | None
    thermal_k: NDArray[Any] | None


@pytest.fixture(scope="module")
def recording(shared: Path) -> Path:
    folder = shared / "data" / "path_traced"
    if not folder.is_dir():
        pytest.skip(f"needs ../shared/data/path_traced: absent on this machine ({folder})")
    return folder


@pytest.fixture(scope="module")
def read(recording: Path) -> Callable[[Path], Recorded]:
    def frame(folder: Path) -> Recorded:
        names = ("left", "right", "thermal", "thermal_radiometric")
        left, right, thermal, centikelvin = (
            cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_UNCHANGED) for name in names
        )
        assert left is not None
        assert right is not None
        return Recorded(left, right, thermal, None if centikelvin is None else centikelvin / 100.0)

    return frame


def test_every_frame_is_answered(recording: Path, read: Callable[[Path], Recorded]) -> None:
    calibration, detector = load_calibration(recording / "calibration.toml"), create("thesis")
    folders = sorted((recording / "frames").iterdir())
    assert len(folders) == 33
    for folder in folders:
        found = detector.detect(read(folder), calibration)
        assert found.teats or found.reason, folder.name
        assert len(found.teats) <= 4
        assert 0 <= found.hidden <= 4
        for teat in found.teats:
            assert np.isfinite(teat.world_mm).all()


def test_radiometric_frames_alone_are_answered(
    recording: Path, read: Callable[[Path], Recorded]
) -> None:
    calibration, detector = load_calibration(recording / "calibration.toml"), create("thesis")
    whole = read(recording / "frames" / "0000")
    found = detector.detect(Recorded(whole.left, whole.right, None, whole.thermal_k), calibration)
    assert found.teats or found.reason

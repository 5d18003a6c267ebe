"""Frame sets and files of the detector's tests: drawn with OpenCV, or read from ../shared."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import Calibration, load_calibration
from detector.external.serve import Pictures, read_pictures

ROOT = Path(__file__).resolve().parents[2]


Draw = Callable[..., Pictures]


@pytest.fixture(scope="session")
def rig_file() -> Path:
    return ROOT / "bench" / "rigs" / "calibration.toml"


@pytest.fixture(scope="session")
def rig(rig_file: Path) -> Calibration:
    return load_calibration(rig_file)


@pytest.fixture(scope="session")
def shared() -> Path:
    folder = ROOT.parent / "shared"
    if not folder.is_dir():
        pytest.skip(f"needs ../shared: absent on this machine ({folder})")
    return folder


@pytest.fixture(scope="session")
def path_traced(shared: Path) -> Path:
    folder = shared / "data" / "path_traced"
    if not folder.is_dir():
        pytest.skip(f"needs ../shared/data/path_traced: absent on this machine ({folder})")
    return folder


def recorded(folder: Path) -> Pictures:
    """One frame set of a recording."""
    return read_pictures({path.stem: str(path) for path in folder.glob("*.png")})


@pytest.fixture(scope="session")
def teats_mm() -> NDArray[np.float64]:
    """Four teat ends (4, 3) in the world, all well inside the thermal picture."""
    ends = (-255, 275, 132), (-205, 200, 137), (-140, 205, 136), (-80, 270, 134)
    return np.array(ends, dtype=np.float64)


@pytest.fixture(scope="session")
def draw(rig: Calibration) -> Draw:
    """Draws flat dark round-ended teats of 22 mm before a bright ground in all three cameras."""

    def pictures(ends_mm: NDArray[np.float64]) -> Pictures:
        assert rig.thermal.lens is not None
        assert rig.thermal_from_right is not None
        in_right = rig.world_from_right.inverse().apply(ends_mm)
        thermal_px = rig.thermal.lens.project(rig.thermal_from_right.apply(in_right))
        left, right, thermal = (
            teats_picture(camera.image_size, ends_px, 11 * camera.fc[0] / in_right[:, 2])
            for camera, ends_px in zip(
                (rig.left, rig.right, rig.thermal.lens),
                (*rig.project(ends_mm), thermal_px),
                strict=True,
            )
        )
        return Pictures(left, right, np.ascontiguousarray(thermal[:, ::-1]))

    return pictures


def teats_picture(
    size: tuple[int, int], ends_px: NDArray[np.float64], radii_px: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Dark upright strokes with round tops at ends (n, 2) px in a picture of (columns, rows)."""
    picture = np.full((size[1], size[0]), 210, dtype=np.uint8)
    for (x, y), radius in zip(ends_px, radii_px, strict=True):
        top, foot, wide = (round(x), round(y + radius)), round(y + 10 * radius), round(radius) + 1
        cv2.line(picture, top, (top[0], foot), 20, thickness=round(2 * radius))
        cv2.circle(picture, top, round(radius), 20, thickness=-1)
        cv2.rectangle(picture, (top[0] - wide, foot), (top[0] + wide, size[1]), 210, thickness=-1)
    return picture

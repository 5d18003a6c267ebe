"""What the scene's tests share: the emulated rig's cameras, an empty scene, OpenCV as referee."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from instruments.world.backdrop import Backdrop
from instruments.world.optics import CameraModel, Floats
from instruments.world.phantom import Phantom
from instruments.world.scene import Renderer
from instruments.world.sensor import OpticalSensor
from instruments.world.state import SceneState

ROOT = Path(__file__).resolve().parents[3]
PLAIN = Backdrop(board_texture=0.0, table_texture=0.0)
NOBODY = SceneState(Phantom(()), (), 20.0, 20.0, backdrop=PLAIN)


def calibration_table() -> dict[str, Any]:
    """The emulated rig's calibration."""
    return tomllib.loads((ROOT / "bench/rigs/calibration.toml").read_text(encoding="utf-8"))


@lru_cache(maxsize=2)  # some 100 MB each
def renderer(**changes: Any) -> Renderer:
    """Its cameras, the sensors with these changes."""
    return Renderer.from_calibration(
        calibration_table(), camera_seed=7, optical=replace(OpticalSensor(), **changes)
    )


def by_opencv(camera: CameraModel, points_mm: Floats) -> Floats:
    """Pixels (n, 2) of world points (n, 3), by `cv2.projectPoints`."""
    K = np.array(
        [[camera.fc[0], 0.0, camera.cc[0]], [0.0, camera.fc[1], camera.cc[1]], [0.0, 0.0, 1.0]]
    )
    pixels, _ = cv2.projectPoints(points_mm, cv2.Rodrigues(camera.R)[0], camera.t_mm, K, camera.kc)
    return np.asarray(pixels[:, 0], dtype=np.float64)

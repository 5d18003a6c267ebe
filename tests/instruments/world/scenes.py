"""What the scene's tests share: the emulated rig's cameras, an empty scene, OpenCV as referee."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from instruments.world.backdrop import Backdrop
from instruments.world.optical_camera import OpticalCamera
from instruments.world.optics import CameraModel, Floats
from instruments.world.phantom import Phantom
from instruments.world.scene import Renderer
from instruments.world.sensor import Image, OpticalSensor
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


def small(camera_seed: int = 7, *, depth: bool = False) -> Renderer:
    """A new one with pictures of a sixteenth of the pixels, which are drawn soon."""
    name = "depth-calibration.toml" if depth else "calibration.toml"
    table = tomllib.loads((ROOT / "bench/rigs" / name).read_text(encoding="utf-8"))
    for camera in table["cameras"].values():
        for key in ("image_size", "fc", "cc"):
            camera[key] = [value / 4 for value in camera[key]]
    return Renderer.from_calibration(table, camera_seed)


def eye(which: str, **changes: Any) -> OpticalCamera:
    """Its left or right camera."""
    eyes = renderer(**changes)
    return {"left": eyes.left, "right": eyes.right}[which]


@cache
def empty(which: str) -> Image:
    """The empty scene before noise."""
    return eye(which).expected(NOBODY)


def matrix(camera: CameraModel) -> Floats:
    """OpenCV's camera matrix."""
    (fx, fy), (cx, cy) = camera.fc, camera.cc
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def by_opencv(camera: CameraModel, points_mm: Floats) -> Floats:
    """Pixels (n, 2) of world points (n, 3), by `cv2.projectPoints`; Bouguet's skew, which OpenCV
    hasn't, is fc[0] alpha_c times the distorted y.
    """
    turn, K = cv2.Rodrigues(camera.R)[0], matrix(camera)
    pixels, _ = cv2.projectPoints(points_mm, turn, camera.t_mm, K, camera.kc)
    u, v = np.asarray(pixels[:, 0], dtype=np.float64).T
    skew = camera.fc[0] * camera.alpha_c * (v - camera.cc[1]) / camera.fc[1]
    return np.column_stack([u + skew, v])


def centroid(picture: Image | Floats, at: tuple[int, int], reach: int) -> Floats:
    """Column and row (2,) of what is bright within ``reach`` of (column, row)."""
    u, v = (np.arange(each - reach, each + reach + 1) for each in at)
    patch = picture[np.ix_(v, u)]
    return np.asarray(np.array([patch.sum(axis=0) @ u, patch.sum(axis=1) @ v]) / patch.sum())

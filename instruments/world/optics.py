"""The simulated scene's camera model, exact both ways; `cv2.projectPoints` is its referee.

Bouguet's model: two or three radial terms, two tangential, a skew. A converged Newton iteration
undoes distortion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instruments import world as package

Floats = NDArray[np.float64]

ROWS_AT_ONCE = 32  # a block of rows whose iteration stays in the processor's cache
NEWTON_STEPS = 12  # five are enough for any lens seen; the last ones only prove it
RAYS_KEPT = 4  # cameras: those of a rig, which commands and tests open again and again
CONVERGED = 1e-13  # of the normalised image plane: below 1e-9 px for any focal length in use


def rotation_from_vector(om: Floats) -> Floats:
    """Rotation matrix (3, 3) of a Rodrigues vector (3,), radians."""
    angle = float(np.linalg.norm(om))
    x, y, z = (om / angle if angle >= 1e-12 else om).tolist()
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-12:
        return np.asarray(np.eye(3) + k)
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k))


@dataclass(frozen=True, eq=False)
class CameraModel:
    """Lens and pose; equal by its values. ``fc``, ``cc`` (2,) px; ``alpha_c`` skew; ``kc`` (5,) k1
    k2 p1 p2 k3; X_camera = R X_world + t.
    """

    name: str
    width_px: int
    height_px: int
    fc: Floats
    cc: Floats
    alpha_c: float
    kc: Floats
    R: Floats
    t_mm: Floats

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, CameraModel) and self._values == other._values)

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash(self._values)

    @cached_property
    def _values(self) -> tuple[Any, ...]:
        values = (getattr(self, field.name) for field in fields(self))
        return tuple(one.tobytes() if isinstance(one, np.ndarray) else one for one in values)

    def sparse(self, every: int) -> CameraModel:
        """A camera that has of this one's pixels ``every`` so many in either direction."""
        size = {name: -(-getattr(self, name) // every) for name in ("width_px", "height_px")}
        return replace(self, **size, fc=self.fc / every, cc=self.cc / every)

    @property
    def centre_mm(self) -> Floats:
        """The projection centre in the world frame, (3,) mm."""
        return -self.R.T @ self.t_mm

    def camera_from_world(self, points_mm: Floats) -> Floats:
        """World points (n, 3) mm in this camera's frame, (n, 3) mm."""
        return np.asarray(points_mm @ self.R.T + self.t_mm)

    def project(self, points_mm: Floats) -> Floats:
        """World points (n, 3) mm to pixels (n, 2); nan for a point behind the camera."""
        seen = self.camera_from_world(np.asarray(points_mm, dtype=np.float64).reshape(-1, 3))
        depth = np.where(seen[:, 2] > 0.0, seen[:, 2], np.nan)
        return self.pixels_from_plane(seen[:, :2] / depth[:, None])

    def pixels_from_plane(self, plane: Floats) -> Floats:
        """Normalised image plane (n, 2), x = X/Z, to distorted pixels (n, 2)."""
        x, y = _distort(plane[:, 0], plane[:, 1], self.kc)
        return np.column_stack(
            [self.fc[0] * (x + self.alpha_c * y) + self.cc[0], self.fc[1] * y + self.cc[1]]
        )

    def plane_from_pixels(self, pixels: Floats) -> Floats:
        """Pixels (n, 2) to the normalised image plane (n, 2)."""
        y = (pixels[:, 1] - self.cc[1]) / self.fc[1]
        x = (pixels[:, 0] - self.cc[0]) / self.fc[0] - self.alpha_c * y
        return np.column_stack(_undistort(x, y, self.kc, self.name))

    def rays(self) -> tuple[Floats, Floats]:
        """The ray (x, y, 1) of every pixel centre, as two read-only arrays (height, width); kept
        for `RAYS_KEPT` cameras.
        """
        return _rays(self)

    def resized(self, width_px: int, height_px: int) -> CameraModel:
        """The same camera read out on another grid over the same sensor area."""
        scale = np.array([width_px / self.width_px, height_px / self.height_px])
        # The corner of the first pixel is at (-0.5, -0.5) on either grid.
        cc = (self.cc + 0.5) * scale - 0.5
        return replace(self, width_px=width_px, height_px=height_px, fc=self.fc * scale, cc=cc)


@lru_cache(RAYS_KEPT)
def _rays(camera: CameraModel) -> tuple[Floats, Floats]:
    x, y = np.empty((2, camera.height_px, camera.width_px))
    u = np.arange(camera.width_px, dtype=np.float64)
    for top in range(0, camera.height_px, ROWS_AT_ONCE):
        v = np.arange(top, min(top + ROWS_AT_ONCE, camera.height_px), dtype=np.float64)
        pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        block = camera.plane_from_pixels(pixels).reshape(len(v), -1, 2)
        x[top : top + len(v)], y[top : top + len(v)] = block[..., 0], block[..., 1]
    x.flags.writeable = y.flags.writeable = False
    return x, y


def _distort(x: Floats, y: Floats, kc: Floats) -> tuple[Floats, Floats]:
    k1, k2, p1, p2, k3 = kc
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


def _undistort(x_d: Floats, y_d: Floats, kc: Floats, name: str) -> tuple[Floats, Floats]:
    """Newton's iteration on both coordinates; raises ValueError where the lens model folds."""
    x, y = x_d.copy(), y_d.copy()
    if not np.any(kc) or package.kernels.undistort(x_d, y_d, kc, x, y, NEWTON_STEPS, CONVERGED):
        return x, y
    raise ValueError(
        f"camera {name}: the distortion kc = {kc.tolist()} can't be undone over the whole image;"
        " check kc in the calibration"
    )


def cameras_from_calibration(
    table: Mapping[str, Any],
) -> tuple[CameraModel, CameraModel, CameraModel]:
    """(left, right, thermal) from a parsed calibration file: X_right = R X_left + T, X_thermal = R
    X_left + T (un-mirrored), X_world = R X_right + T. Raises ValueError.
    """
    right = _inverse(_motion(table, "world"))
    left = _after(_inverse(_motion(table, "stereo")), right)
    thermal = _after(_motion(table, "thermal"), left)
    return (
        _camera(table, "left", left),
        _camera(table, "right", right),
        _camera(table, "thermal", thermal),
    )


def depth_from_calibration(table: Mapping[str, Any]) -> CameraModel | None:
    """The depth camera, None where there is none: X_depth = R X_left + T. Raises ValueError."""
    if "depth" not in table and "depth" not in table.get("cameras", {}):
        return None
    left = _after(_inverse(_motion(table, "stereo")), _inverse(_motion(table, "world")))
    return _camera(table, "depth", _after(_motion(table, "depth"), left))


Motion = tuple[Floats, Floats]


def _motion(table: Mapping[str, Any], block: str) -> Motion:
    om, t_mm = (_numbers(table, (block, key), 3) for key in ("om", "T"))
    return rotation_from_vector(om), t_mm


def _inverse(motion: Motion) -> Motion:
    R, t = motion
    return R.T, -R.T @ t


def _after(second: Motion, first: Motion) -> Motion:
    return second[0] @ first[0], second[0] @ first[1] + second[1]


def _camera(table: Mapping[str, Any], name: str, camera_from_world: Motion) -> CameraModel:
    at = ("cameras", name)
    width, height = (round(size) for size in _numbers(table, (*at, "image_size"), 2))
    if min(width, height) < 1:
        raise ValueError(
            f"calibration: cameras.{name}.image_size must be at least 1 x 1, is {width} x {height}"
        )
    fc = _numbers(table, (*at, "fc"), 2)
    if not np.all(fc > 0.0):
        raise ValueError(f"calibration: cameras.{name}.fc must be above zero, is {fc.tolist()}")
    skewed = name != "depth" or "alpha_c" in table["cameras"][name]
    alpha_c = float(_numbers(table, (*at, "alpha_c"), 1)[0]) if skewed else 0.0
    cc, kc = _numbers(table, (*at, "cc"), 2), _numbers(table, (*at, "kc"), 5)
    return CameraModel(name, width, height, fc, cc, alpha_c, kc, *camera_from_world)


def _numbers(table: Mapping[str, Any], path: tuple[str, ...], count: int) -> Floats:
    value: Any = table
    for key in path:
        if not isinstance(value, Mapping) or key not in value:
            raise ValueError(f"calibration: {'.'.join(path)} is missing")
        value = value[key]
    try:
        numbers = np.atleast_1d(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError):
        raise ValueError(
            f"calibration: {'.'.join(path)} must be {count} number(s), is {value!r}"
        ) from None
    if numbers.shape != (count,) or not np.all(np.isfinite(numbers)):
        raise ValueError(
            f"calibration: {'.'.join(path)} must be {count} finite number(s), is {value!r}"
        )
    return numbers

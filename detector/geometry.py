"""Rigid motions, the camera model, homographies and triangulation.

Vectorised closed forms, else Newton. Pixel centres at whole numbers from 0; mm. What has no answer
is NaN in its row only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_BLOCK = 4096  # points
_NEWTON_STEPS = 60
# normalised units; three decades under what is promised, so that the last step is beyond doubt
_NEWTON_TOLERANCE = 1e-13


def rotation_from_vector(om_rad: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,), radians, by Rodrigues' formula."""
    om = _vector(om_rad, 3, "a rotation vector")
    angle = float(np.linalg.norm(om))
    K = np.array([[0.0, -om[2], om[1]], [om[2], 0.0, -om[0]], [-om[1], om[0], 0.0]])
    # np.sinc is sin(pi x) / (pi x): finite at zero, so that no rotation needs no case of its own
    return np.asarray(
        np.eye(3) + np.sinc(angle / np.pi) * K + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (K @ K)
    )


def vector_from_rotation(R: ArrayLike) -> Array:
    """Rotation vector (3,), rad, length 0 to pi, of a rotation matrix (3, 3). By the unit
    quaternion from its largest component: full precision at every angle, pi included.
    """
    m = np.asarray(R, dtype=np.float64)
    squares = np.array([1 + m.trace(), *(1 + 2 * np.diag(m) - m.trace())])
    outer = np.array(
        [
            [squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], squares[1], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], squares[2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[3]],
        ]
    )
    q = outer[int(np.argmax(squares))]
    q = q / np.linalg.norm(q) * (1.0 if q[0] >= 0 else -1.0)
    sine = float(np.linalg.norm(q[1:]))
    return np.asarray(q[1:] * (2.0 if sine == 0 else 2 * np.arctan2(sine, q[0]) / sine))


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A rigid motion x -> R x + T; name it `b_from_a`. R (3, 3), T (3,) mm. Raises ValueError where
    R is no rotation, such as a mirror image or a scale.
    """

    R: Array
    T: Array

    def __post_init__(self) -> None:
        R, T = np.array(self.R, dtype=np.float64), _vector(self.T, 3, "a translation").copy()
        if (
            R.shape != (3, 3)
            or not (np.abs(R @ R.T - np.eye(3)) <= 1e-9 + 1e-5 * np.eye(3)).all()
            or np.linalg.det(R) < 0
        ):
            what = "not a rotation matrix (orthogonal, determinant +1)"
            raise ValueError(f"{what}: {R.tolist()}; fit it with `rigid_fit`")
        R.setflags(write=False)
        T.setflags(write=False)
        object.__setattr__(self, "R", R)
        object.__setattr__(self, "T", T)

    @classmethod
    def from_vectors(cls, om_rad: ArrayLike, T_mm: ArrayLike) -> Motion:
        """From rotation vector `om_rad` (3,) and translation `T_mm` (3,), as in the files."""
        return cls(rotation_from_vector(om_rad), _vector(T_mm, 3, "a translation"))

    @classmethod
    def identity(cls) -> Motion:
        """The motion that moves nothing."""
        return cls(np.eye(3), np.zeros(3))

    @property
    def om(self) -> Array:
        """Rotation vector (3,), radians."""
        return _om(self)

    def apply(self, points_mm: ArrayLike) -> Array:
        """Move points (n, 3) or one point (3,)."""
        return np.asarray(np.asarray(points_mm, dtype=np.float64) @ self.R.T + self.T)

    def shifted(self, step: Array) -> Motion:
        """With its rotation vector and translation changed by ``step`` (6,), rad and mm."""
        return Motion.from_vectors(self.om + step[:3], self.T + step[3:])

    def inverse(self) -> Motion:
        """`a_from_b` of a `b_from_a`."""
        return _inverse(self)

    def __matmul__(self, other: Motion) -> Motion:
        """`c_from_b @ b_from_a` is `c_from_a`."""
        return Motion(self.R @ other.R, self.R @ other.T + self.T)


@lru_cache(maxsize=64)
def _inverse(motion: Motion) -> Motion:
    return Motion(motion.R.T, -motion.R.T @ motion.T)


@lru_cache(maxsize=256)  # a bundle adjustment asks for those of its poses, camera by camera
def _om(motion: Motion) -> Array:
    om = vector_from_rotation(motion.R)
    om.setflags(write=False)
    return om


def rigid_fit(target_mm: ArrayLike, source_mm: ArrayLike) -> Motion:
    """`target_from_source`: least-squares motion of points (n, 3), Kabsch without reflections.
    Raises ValueError for fewer than 3 pairs or points on one line.
    """
    target, source = _rows(target_mm, 3, "target points"), _rows(source_mm, 3, "source points")
    if len(target) != len(source) or len(source) < 3:
        got = f"{len(source)} source and {len(target)} target points"
        raise ValueError(f"a rigid fit needs at least 3 pairs, got {got}")
    centre_t, centre_s = target.mean(axis=0), source.mean(axis=0)
    U, spread, Vt = np.linalg.svd((target - centre_t).T @ (source - centre_s))
    if spread[1] <= 1e-12 * max(float(spread[0]), np.finfo(float).tiny):
        raise ValueError("a rigid fit needs points that don't all lie on one line")
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return Motion(R, centre_t - R @ centre_s)


@dataclass(frozen=True, slots=True)
class Camera:
    """A camera as in Bouguet's toolbox ("Description of the calibration parameters") and OpenCV.

    image_size (columns, rows) px; fc, cc (x, y) px; alpha_c the skew; kc = (k1, k2, p1, p2, k3).
    """

    image_size: tuple[int, int]
    fc: tuple[float, float]
    cc: tuple[float, float]
    alpha_c: float = 0.0
    kc: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)

    @property
    def lens(self) -> Array:
        """fx, fy, cx, cy, k1, k2, p1, p2, k3, (9,)."""
        return np.array([*self.fc, *self.cc, *self.kc])

    def with_lens(self, values: Array) -> Camera:
        """The same camera with these numbers (9,) of `lens`."""
        fx, fy, cx, cy, k1, k2, p1, p2, k3 = values.tolist()
        return replace(self, fc=(fx, fy), cc=(cx, cy), kc=(k1, k2, p1, p2, k3))

    @property
    def matrix(self) -> Array:
        """The camera matrix (3, 3); OpenCV's functions pass over its skew."""
        (fx, fy), (cx, cy) = self.fc, self.cc
        return np.array([[fx, self.alpha_c * fx, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def project(self, points_mm: ArrayLike) -> Array:
        """Pixels (n, 2) of points (n, 3), camera's frame; NaN for a point not in front."""
        points = _rows(points_mm, 3, "points")
        depth = np.where(points[:, 2] > 0, points[:, 2], np.nan)
        u, v = distort(points[:, 0] / depth, points[:, 1] / depth, self.kc)
        pixels = np.empty((len(points), 2))
        pixels[:, 0] = self.fc[0] * (u + self.alpha_c * v) + self.cc[0]
        pixels[:, 1] = self.fc[1] * v + self.cc[1]
        return pixels

    def normalize(self, pixels_px: ArrayLike) -> Array:
        """Undistorted normalised coordinates (n, 2) of pixels (n, 2), exact to 1e-10, by Newton.
        NaN where the lens model has no inverse.
        """
        pixels = _rows(pixels_px, 2, "pixels")
        y = (pixels[:, 1] - self.cc[1]) / self.fc[1]
        x = (pixels[:, 0] - self.cc[0]) / self.fc[0] - self.alpha_c * y
        distorted = np.column_stack([x, y])
        if not any(self.kc):
            return distorted
        # in blocks that fit the processor's cache: twice as fast for a million points
        for start in range(0, len(distorted), _BLOCK):
            block = distorted[start : start + _BLOCK]
            block[:] = _undistorted(block, self.kc)
        return distorted

    def rays(self, pixels_px: ArrayLike) -> Array:
        """Unit viewing directions (n, 3) in this camera's frame of pixels (n, 2)."""
        ends = homogeneous(self.normalize(pixels_px))
        return np.asarray(ends / np.linalg.norm(ends, axis=1, keepdims=True))


def apply_homography(H: ArrayLike, pixels_px: ArrayLike) -> Array:
    """Pixels (n, 2) through (3, 3) with division; NaN where the third coordinate isn't positive."""
    mapped = homogeneous(_rows(pixels_px, 2, "pixels")) @ np.asarray(H, dtype=np.float64).T
    return np.asarray(mapped[:, :2] / np.where(mapped[:, 2:] > 0, mapped[:, 2:], np.nan))


def triangulate(
    left_px: ArrayLike, right_px: ArrayLike, left: Camera, right: Camera, right_from_left: Motion
) -> tuple[Array, Array]:
    """Points (n, 3) mm, right camera's frame, midway between rays of pixel pairs (n, 2), and gaps
    (n,) mm. Midpoint of the common perpendicular (thesis, appendix A.5). Parallel rays give NaN.
    """
    a = homogeneous(left.normalize(left_px)) @ right_from_left.R.T
    b = homogeneous(right.normalize(right_px))
    if len(a) != len(b):
        given = f"{len(a)} left and {len(b)} right pixels were given"
        raise ValueError(f"triangulation needs pairs: {given}")
    T = right_from_left.T
    aa, bb, ab = (np.einsum("ij,ij->i", u, v) for u, v in ((a, a), (b, b), (a, b)))
    aT, bT = a @ T, b @ T
    determinant = aa * bb - ab**2
    determinant = np.where(determinant > 1e-14 * aa * bb, determinant, np.nan)
    on_left = a * ((ab * bT - bb * aT) / determinant)[:, None] + T
    on_right = b * ((aa * bT - ab * aT) / determinant)[:, None]
    return 0.5 * (on_left + on_right), np.asarray(np.linalg.norm(on_left - on_right, axis=1))


def or_zero(values: Array) -> Array:
    """Values, and 0 for those that are no numbers, in a sixth of the time of numpy's own."""
    return np.where(np.isnan(values), 0.0, values)


def homogeneous(x: Array) -> Array:
    """Rows (n, 2) with a 1 behind, (n, 3)."""
    return np.column_stack([x, np.ones(len(x))])


def distort(u: Array, v: Array, kc: tuple[float, ...]) -> tuple[Array, Array]:
    """Where a lens ``kc`` draws the tangents u, v."""
    k1, k2, p1, p2, k3 = kc
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return (
        u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u),
        v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v,
    )


def distort_slopes(u: Array, v: Array, kc: tuple[float, ...]) -> tuple[Array, Array, Array]:
    """The symmetric Jacobian of `distort`: du/du, du/dv = dv/du, dv/dv."""
    k1, k2, p1, p2, k3 = kc
    r2 = u * u + v * v
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))
    return (
        radial + slope * u * u + 2 * p1 * v + 6 * p2 * u,
        slope * u * v + 2 * p1 * u + 2 * p2 * v,
        radial + slope * v * v + 6 * p1 * v + 2 * p2 * u,
    )


def _undistorted(distorted: Array, kc: tuple[float, ...]) -> Array:
    (u, v), wanted = distorted.T.copy(), distorted.T
    # rows without an answer run away, and are caught below
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for _ in range(_NEWTON_STEPS):
            miss_u, miss_v = np.subtract(distort(u, v, kc), wanted)
            a, b, d = distort_slopes(u, v, kc)
            determinant = a * d - b * b
            step_u = (d * miss_u - b * miss_v) / determinant
            step_v = (a * miss_v - b * miss_u) / determinant
            u, v = u - step_u, v - step_v
            if not np.any(np.abs([step_u, step_v]) > _NEWTON_TOLERANCE):
                break
        unsolved = ~np.all(np.abs(np.subtract(distort(u, v, kc), wanted)) < 1e-11, axis=0)
    u[unsolved] = v[unsolved] = np.nan
    return np.column_stack([u, v])


def _vector(value: ArrayLike, length: int, what: str) -> Array:
    vector = np.asarray(value, dtype=np.float64).reshape(-1)
    if vector.shape != (length,):
        raise ValueError(f"{what} has {length} numbers, got {vector.size}")
    return vector


def _rows(value: ArrayLike, width: int, what: str) -> Array:
    rows = np.asarray(value, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != width:
        raise ValueError(f"{what} must have the shape (n, {width}), got {rows.shape}")
    return rows

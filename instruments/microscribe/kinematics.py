"""Forward and inverse kinematics of the arm, vectorised over poses: modified (Craig)
Denavit-Hartenberg, as in the maker's SDK manual, chapter 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Counts = npt.NDArray[np.int64]

JOINTS = 6
COUNT_MODULUS = 1 << 14  # counts go on past one turn, modulo this
BETA_JOINT = 2  # the only joint with the extra angle
# how far each joint turns from the home pose, (6, 2) rad; the maker states none. The elbow goes
# from folded to nearly straight, so that it stays above the wrist
RANGES_RAD: Floats = np.radians(
    [(-180, 180), (-140, 30), (-25, 140), (-178, 178), (-150, 150), (-180, 180)]
)

_DIRECTION_MM = 100.0  # weighs the stylus direction against the tip: 0.01 mm is worth 0.1 mrad
_TOLERANCE_MM = 1e-7
_BLIND_RAD = 0.02
_STEPS = 60
_STARTS = 32  # with fewer, the pose nearest to home is missed in 1 of 1 000 drawn targets


class OutOfReachError(ValueError):
    """No pose of the arm, inside its joint ranges, holds the tip there."""


@dataclass(frozen=True, slots=True, eq=False)
class ArmGeometry:
    """alpha (6,) rad, a and d (6,) mm, beta rad, counts per turn (6,), 0 without an encoder."""

    alpha_rad: Floats
    a_mm: Floats
    d_mm: Floats
    beta_rad: float
    turns: Counts

    @property
    def active(self) -> npt.NDArray[np.bool_]:
        """(6,) which joints have an encoder."""
        return self.turns > 0

    def angles(self, counts: npt.ArrayLike) -> Floats:
        """Joint angles (n, 6) rad in [0, 2 pi) of counts (n, 6). Raises ValueError."""
        per_turn = np.where(self.active, self.turns, 1)
        turned = np.mod(_rows(counts), per_turn) * (2.0 * np.pi / per_turn)
        return np.where(self.active, turned, 0.0)

    def forward(self, counts: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Tips (n, 3) mm and unit axes (n, 3) up the stylus; counts as for ``angles``."""
        return self.forward_angles(self.angles(counts))

    def forward_angles(self, angles_rad: Floats) -> tuple[Floats, Floats]:
        """As ``forward``, for angles (n, 6) rad. A joint is RotX(alpha) TransX(a) RotY(beta)
        RotZ(theta) TransZ(d), beta on one joint only; moved from the tip inwards, faster than
        matrices.
        """
        n = len(angles_rad)
        tip: _Triple = (np.zeros(n), np.zeros(n), np.zeros(n))
        axis: _Triple = (np.zeros(n), np.zeros(n), np.ones(n))
        for joint in reversed(range(JOINTS)):
            (x, y, z), theta = tip, angles_rad[:, joint]
            tip = self._through(joint, theta, (x, y, z + self.d_mm[joint]), self.a_mm[joint])
            axis = self._through(joint, theta, axis, 0.0)
        return np.stack(tip, axis=1), np.stack(axis, axis=1)

    def _through(self, joint: int, theta: Floats, v: _Triple, shift_mm: float) -> _Triple:
        x, y, z = v
        if self.active[joint]:
            cos, sin = np.cos(theta), np.sin(theta)
            x, y = cos * x - sin * y, sin * x + cos * y
        if joint == BETA_JOINT:
            cos, sin = np.cos(self.beta_rad), np.sin(self.beta_rad)
            x, z = cos * x + sin * z, cos * z - sin * x
        cos, sin = np.cos(self.alpha_rad[joint]), np.sin(self.alpha_rad[joint])
        return x + shift_mm, cos * y - sin * z, sin * y + cos * z

    def frames(self, angles_rad: Floats) -> tuple[Floats, Floats]:
        """Rotations (n, 6, 3, 3) and origins (n, 6, 3) mm of the joints, for angles (n, 6) rad."""
        terms = np.ones((JOINTS, len(angles_rad), 3))
        np.cos(angles_rad.T, out=terms[..., 1])
        np.sin(angles_rad.T, out=terms[..., 2])
        frames = (terms @ _links(self)).reshape(JOINTS, -1, 4, 4)
        for joint in range(1, JOINTS):
            frames[joint] = frames[joint - 1] @ frames[joint]
        by_pose = frames.transpose(1, 0, 2, 3)
        return by_pose[..., :3, :3], by_pose[..., :3, 3]

    def jacobian(self, angles_rad: Floats) -> Floats:
        """(n, 6, 6) for angles (n, 6) rad: rows tip (mm/rad) then axis (1/rad), columns joints."""
        return self._slopes(*self.frames(angles_rad))

    def _slopes(self, rotations: Floats, origins: Floats, axis_weight: float = 1.0) -> Floats:
        # RotZ leaves a joint's own axis alone, so its frame's third column is that axis
        axes = rotations[..., 2] * self.active[:, None]
        levers = np.empty((2, *axes.shape))
        np.subtract(origins[:, -1:], origins, out=levers[0])
        np.multiply(rotations[:, -1:, :, 2], axis_weight, out=levers[1])
        slopes = np.empty((len(axes), 2, 3, JOINTS))
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # as np.cross, in a third of its time
            product = axes[..., j] * levers[..., k] - axes[..., k] * levers[..., j]
            slopes[:, :, i] = product.swapaxes(0, 1)
        return slopes.reshape(-1, 6, JOINTS)


_Triple = tuple[Floats, Floats, Floats]


@lru_cache(maxsize=8)
def _links(geometry: ArmGeometry) -> Floats:
    """Each joint's motion (4, 4) by its angle, as 1, cos and sin times (6, 3, 16)."""
    links = np.zeros((JOINTS, 3, 4, 4))
    links[:, 0, 2, 2] = links[:, 0, 3, 3] = links[:, 1, 0, 0] = links[:, 1, 1, 1] = 1.0
    links[:, 2, 1, 0], links[:, 2, 0, 1] = 1.0, -1.0
    links[:, 0, 2, 3] = geometry.d_mm
    still = ~geometry.active
    links[still, 0] += links[still, 1]
    links[still, 1:] = 0.0
    beta_rad = np.where(np.arange(JOINTS) == BETA_JOINT, geometry.beta_rad, 0.0)
    (ca, cb), (sa, sb) = (turn([geometry.alpha_rad, beta_rad]) for turn in (np.cos, np.sin))
    turned = [[cb, np.zeros(JOINTS), sb], [sa * sb, ca, -sa * cb], [-ca * sb, sa, ca * cb]]
    before = np.zeros((JOINTS, 4, 4))
    before[:, :3, :3] = np.array(turned).transpose(2, 0, 1)
    before[:, 0, 3], before[:, 3, 3] = geometry.a_mm, 1.0
    return (before[:, None] @ links).reshape(JOINTS, 3, 16)


def inverse(
    geometry: ArmGeometry,
    point_mm: npt.ArrayLike,
    direction: npt.ArrayLike | None = None,
    *,
    start: npt.ArrayLike,
) -> Floats:
    """The counts (6,), not rounded, that hold the tip at ``point_mm`` (3,), by damped least squares
    from many starts; of poses within `RANGES_RAD` the one nearest to home. ``direction`` (3,)
    points up the stylus; in line with the forearm it may be off by 0.02 rad. Raises
    OutOfReachError, ValueError.
    """
    goal, stylus = np.asarray(point_mm, dtype=np.float64), None
    if direction is not None:
        stylus = np.asarray(direction, dtype=np.float64)
        length = float(np.linalg.norm(stylus))
        if stylus.shape != (3,) or not np.isfinite(length) or length == 0.0:
            what = "a stylus direction is three numbers, not all zero"
            raise ValueError(f"{what}; got {direction!r}")
        stylus = stylus / length
    home = geometry.angles(start)[0]
    angles = _starts(geometry, goal, stylus, home)
    angles, misses_mm = _settle(geometry, angles, goal, stylus)
    if _TOLERANCE_MM < misses_mm.min() < _BLIND_RAD * _DIRECTION_MM:
        angles, misses_mm = _settle(
            geometry, angles[misses_mm < _BLIND_RAD * _DIRECTION_MM], goal, None
        )
    turned, fits = _fitting(geometry, angles, misses_mm, home)
    if not fits.any():
        where = f"out of reach: the tip at {_shown(goal)} mm"
        if stylus is not None:
            where += f" with the stylus along {_shown(stylus)}"
        if (miss_mm := float(misses_mm.min())) < _TOLERANCE_MM:
            what = f"{where} needs a joint past its range"
            raise OutOfReachError(f"{what}. Hold the stylus another way")
        what = f"{where}; the nearest pose misses by {miss_mm:.1f} mm"
        raise OutOfReachError(f"{what}. Move the target nearer to the arm")
    nearest = turned[fits][np.argmin(np.linalg.norm(turned[fits], axis=1))]
    counts: Floats = _rows(start)[0] + np.where(
        geometry.active, nearest / (2.0 * np.pi) * geometry.turns, 0.0
    )
    return counts


def surely_reached(
    geometry: ArmGeometry, points_mm: Floats, direction: Floats, *, start: npt.ArrayLike
) -> npt.NDArray[np.bool_]:
    """For which of the points (n, 3) `inverse` finds a pose by the first of its starts, all points
    beside each other; most that are within reach. The others need `inverse`.
    """
    home, stylus = geometry.angles(start)[0], direction / np.linalg.norm(direction)
    starts = np.array([_starts(geometry, point, stylus, home)[0] for point in points_mm])
    settled = _settle(geometry, starts, points_mm, stylus)
    return _fitting(geometry, *settled, home)[1]


def _fitting(
    geometry: ArmGeometry, angles: Floats, misses_mm: Floats, home: Floats
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Poses (n, 6) as turns from ``home``, and which of them are there and within `RANGES_RAD`."""
    turned = np.mod(angles - home + np.pi, 2.0 * np.pi) - np.pi
    within = (turned >= RANGES_RAD[:, 0]) & (turned <= RANGES_RAD[:, 1])
    return turned, (misses_mm < _TOLERANCE_MM) & within[:, geometry.active].all(axis=1)


def _starts(geometry: ArmGeometry, goal: Floats, stylus: Floats | None, home: Floats) -> Floats:
    """Home and the best poses of a lattice over the joint ranges, each base turned to the goal."""
    poses, azimuths, reached = _lattice(geometry, tuple(home))
    azimuth = np.arctan2(goal[1], goal[0])
    turned = None if stylus is None else _about_z(stylus, -azimuth)
    target = _target(_about_z(goal, -azimuth), turned)
    misses = target - reached[:, : len(target)]
    # the base turns a pose about z where its alpha is 0
    best = np.argpartition(_squares(misses[1:]), _STARTS - 2)[: _STARTS - 1] + 1
    chosen = np.concatenate([[0], best])
    starts: Floats = poses[chosen]
    starts[:, 0] += azimuth - azimuths[chosen]
    return starts


@lru_cache(maxsize=8)
def _lattice(geometry: ArmGeometry, home: tuple[float, ...]) -> tuple[Floats, Floats, Floats]:
    """Home and a lattice over the joint ranges, poses (n, 6) rad; the azimuths of their tips (n,),
    and what they reach (n, 6), as of `_target`, turned to azimuth 0.
    """
    low, high = RANGES_RAD.T
    between = np.linspace(low, high, 9)[1:-1] * geometry.active
    steps = [np.zeros(1), *between.T[1:-1], np.zeros(1)]
    lattice = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, JOINTS)
    poses: Floats = np.concatenate([np.zeros((1, JOINTS)), lattice]) + np.array(home)
    tips, axes = geometry.forward_angles(poses)
    azimuths = np.arctan2(tips[:, 1], tips[:, 0])
    return poses, azimuths, _target(*(_about_z(v, -azimuths) for v in (tips, axes)))


def _about_z(points: Floats, angles_rad: Floats) -> Floats:
    """Points (..., 3), each turned about z."""
    cos, sin, (x, y, z) = np.cos(angles_rad), np.sin(angles_rad), np.moveaxis(points, -1, 0)
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)


def _target(tip: Floats, axis: Floats | None) -> Floats:
    """(..., 3) or (..., 6) mm: the tip, then the weighted direction, which may be one for all."""
    if axis is None:
        return tip
    return np.concatenate([tip, np.broadcast_to(_DIRECTION_MM * axis, tip.shape)], axis=-1)


def _squares(misses: Floats) -> Floats:
    """Squared lengths (n,) of rows."""
    return np.asarray(np.einsum("ij,ij->i", misses, misses))


def _settle(
    geometry: ArmGeometry, angles: Floats, goal: Floats, stylus: Floats | None
) -> tuple[Floats, Floats]:
    """Levenberg-Marquardt on all rows (n, 6), each with its own damping; angles, misses (n,). The
    ``goal`` is (3,), or (n, 3).
    """
    target = _target(goal, stylus)
    rows = target.shape[-1]

    def seen(angles: Floats) -> tuple[Floats, Floats, Floats]:
        rotations, origins = geometry.frames(angles)
        misses = target - _target(origins[:, -1], rotations[:, -1, :, 2])[:, :rows]
        return misses, _squares(misses), geometry._slopes(rotations, origins, _DIRECTION_MM)

    misses, squares, slopes = seen(angles)
    damping = np.full(len(angles), 10.0)
    for _ in range(_STEPS):
        used = slopes[:, :rows]
        normal = used @ used.transpose(0, 2, 1)
        normal.reshape(-1, rows * rows)[:, :: rows + 1] += (damping**2)[:, None]
        steps = used.transpose(0, 2, 1) @ np.linalg.solve(normal, misses[..., None])
        tried = angles + steps[..., 0]
        new, new_squares, new_slopes = seen(tried)
        better = new_squares < squares
        angles = np.where(better[:, None], tried, angles)
        misses = np.where(better[:, None], new, misses)
        slopes = np.where(better[:, None, None], new_slopes, slopes)
        squares = np.where(better, new_squares, squares)
        damping = np.minimum(np.maximum(damping * np.where(better, 0.2, 4.0), 1e-3), 1e4)
        if squares.max() < _TOLERANCE_MM**2:
            break
    return angles, np.sqrt(squares)


def _rows(counts: npt.ArrayLike) -> Floats:
    rows = np.atleast_2d(np.asarray(counts, dtype=np.float64))
    if rows.ndim != 2 or rows.shape[1] != JOINTS:
        raise ValueError(f"counts have shape {np.shape(counts)}, not (n, {JOINTS})")
    return rows


def _shown(v: Floats) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in v) + ")"

"""Bundle adjustment: cameras, motions between them and poses of the board from all corners, with
covariance.

One Levenberg-Marquardt fit with masks for a camera, a stereo pair, or a thermal camera on the pair;
OpenCV's analytic derivatives; poses are eliminated by Schur complement. Sources: Triggs,
McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment, a modern synthesis" (2000); covariance: Hartley
and Zisserman, 2nd ed., section 5.2.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from detector.geometry import Array, Camera, Motion

LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
POSE = ("om1", "om2", "om3", "T1", "T2", "T3")


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """What ``camera`` saw of the board in pose number ``pose``: points (n, 3) mm, pixels (n, 2)."""

    camera: str
    pose: int
    board_mm: Array
    pixels_px: Array


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Cameras by name, and the motion of each from the first camera's frame."""

    cameras: Mapping[str, Camera]
    from_reference: Mapping[str, Motion]

    @property
    def reference(self) -> str:
        """The camera in whose frame all poses are."""
        return next(iter(self.cameras))


@dataclass(frozen=True, slots=True)
class FreeParameters:
    """What may move: each camera's ``lens`` parameters, motions; ``aspect``: fx / fy is fixed."""

    lens: Mapping[str, frozenset[str]]
    aspect: frozenset[str] = frozenset()
    motions: bool = True


class BundleError(ValueError):
    """Too few observations, a parameter that moves no corner, or a plane behind a camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """The fit; poses are reference_from_board. ``covariance`` (k, k) px, rad, mm of ``names`` such
    as ("left", "fx"), poses integrated out. ``residuals_px`` (n, 2) by sighting: seen minus
    predicted.
    """

    rig: Rig
    poses: tuple[Motion, ...]
    names: tuple[tuple[str, str], ...]
    covariance: Array
    sigma_px: float
    residuals_px: tuple[Array, ...]

    @property
    def rms_px(self) -> float:
        """The toolboxes' "reprojection error": rms distance of corners over all cameras."""
        squares = np.concatenate([np.sum(r**2, axis=1) for r in self.residuals_px])
        return float(np.sqrt(np.mean(squares)))

    def sd(self, camera: str, name: str) -> float | None:
        """Standard deviation of one parameter; None where it was held fixed."""
        sds = np.sqrt(np.diag(self.covariance)).tolist()
        return dict(zip(self.names, sds, strict=True)).get((camera, name))


_State = tuple[Rig, tuple[Motion, ...]]  # reference_from_board of each view


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """The Jacobian's columns: parameters of cameras and motions, then six a pose."""

    shared: tuple[tuple[str, str], ...]
    ratio: Mapping[str, float]  # fy / fx where it is held
    poses: int

    @classmethod
    def of(cls, start: Rig, poses: int, freedom: FreeParameters) -> _Layout:
        """The parameters that ``freedom`` leaves to ``poses`` views of the cameras of ``start``."""
        fc = {name: start.cameras[name].fc for name in freedom.aspect}
        shared = [
            (name, p)
            for name in start.cameras
            for p in LENS
            if p in freedom.lens.get(name, ()) and not (name in fc and p == "fy")
        ]
        others = [name for name in start.cameras if name != start.reference]
        shared += [(name, p) for name in others for p in POSE if freedom.motions]
        return cls(tuple(shared), {name: fy / fx for name, (fx, fy) in fc.items()}, poses)

    @property
    def size(self) -> int:
        return len(self.shared) + 6 * self.poses

    def columns(self, camera: str, names: Sequence[str]) -> tuple[list[int], list[int]]:
        """Free ones of a camera's parameters: places among ``names``, and columns."""
        places = [i for i, name in enumerate(names) if (camera, name) in self.shared]
        return places, [self.shared.index((camera, names[i])) for i in places]

    def moved(self, state: _State, step: Array) -> _State:
        """The state after a step (size,)."""
        rig, poses = state
        cameras, motions = dict(rig.cameras), dict(rig.from_reference)
        for name, camera in cameras.items():
            values = camera.lens
            places, columns = self.columns(name, LENS)
            values[places] += step[columns]
            if name in self.ratio:
                values[1] = values[0] * self.ratio[name]
            if not (values[:2] > 0).all():
                return state  # a step to nowhere: no better than before, so the damping grows
            cameras[name] = camera.with_lens(values)
            places, columns = self.columns(name, POSE)
            if places:
                motions[name] = motions[name].shifted(step[columns])
        tail = step[len(self.shared) :].reshape(-1, 6)
        poses = tuple(pose.shifted(part) for pose, part in zip(poses, tail, strict=True))
        return Rig(cameras, motions), poses

    def describe(self, column: int) -> str:
        if column < len(self.shared):
            camera, name = self.shared[column]
            return f"{name} of the {camera} camera"
        return f"where the board was in view {(column - len(self.shared)) // 6 + 1}"


STEPS = 100
CONVERGED = 1e-12  # relative decrease of the sum of squares
SINGULAR = 1e-14  # of the largest eigenvalue: less is rounding


def adjust(
    start: Rig, poses: Sequence[Motion], sightings: Sequence[Sighting], freedom: FreeParameters
) -> Adjustment:
    """The least-squares fit, with equal, independent noise of all corners. Raises BundleError."""
    layout = _Layout.of(start, len(poses), freedom)
    rows = sum(2 * len(s.board_mm) for s in sightings)
    if rows <= layout.size:
        what = f"{rows // 2} corners can't fix {layout.size} parameters"
        raise BundleError(f"{what}: more views, or fewer free parameters")
    state, normal = _descend((start, tuple(poses)), layout, sightings)
    variance = normal.cost / (rows - layout.size)
    k = len(layout.shared)
    scale = np.sqrt(np.diag(normal.shared))
    scaled = normal.reduced(0.0)[0] / np.outer(scale, scale)
    values, directions = np.linalg.eigh(scaled) if k else (np.ones(1), np.ones((1, 1)))
    if values[0] < SINGULAR * values[-1]:
        weakest = int(np.argmax(np.abs(directions[:, 0])))
        what = f"the views don't tell {layout.describe(weakest)} apart from the rest"
        raise BundleError(f"{what}: tilt the board more, or hold it fixed")
    covariance = np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale)) * variance
    sigma_px = float(np.sqrt(variance))
    return Adjustment(*state, layout.shared, covariance, sigma_px, normal.residuals_px)


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations: ``shared`` (k, k), ``own`` (poses, 6, 6), ``coupling`` (poses, k, 6)."""

    shared: Array
    own: Array
    coupling: Array
    slope: Array
    own_slope: Array
    residuals_px: tuple[Array, ...]

    @property
    def cost(self) -> float:
        """Sum of squares, px^2; infinite where a camera is turned inside out."""
        cost = sum(float(np.sum(r**2)) for r in self.residuals_px)
        return cost if np.isfinite(cost) else np.inf

    def reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """Without poses: matrix (k, k), slope (k,), and their recovery (poses, 6, k + 1)."""
        damped = self.own + damping * self.own * np.eye(6)
        sides = [self.coupling.transpose(0, 2, 1), self.own_slope[:, :, None]]
        back = np.asarray(np.linalg.solve(damped, np.concatenate(sides, axis=2)), dtype=np.float64)
        taken = np.einsum("pki,pij->kj", self.coupling, back)
        matrix = self.shared + damping * np.diag(np.diag(self.shared)) - taken[:, :-1]
        return matrix, self.slope - taken[:, -1], back

    def step(self, damping: float) -> Array:
        """Marquardt's step (size,) for a damping."""
        matrix, slope, back = self.reduced(damping)
        shared = np.linalg.solve(matrix, slope)
        poses = back[:, :, -1] - back[:, :, :-1] @ shared
        return np.concatenate([shared, poses.reshape(-1)])


def _descend(
    state: _State, layout: _Layout, sightings: Sequence[Sighting]
) -> tuple[_State, _Normal]:
    """Levenberg-Marquardt with Marquardt's scaling; ends where a step no longer helps."""
    normal, damping = _normal(state, layout, sightings), 1e-4
    own = np.diagonal(normal.own, axis1=1, axis2=2).reshape(-1)
    diagonal = np.concatenate([np.diag(normal.shared), own])
    if not diagonal.all():
        what = f"no corner determines {layout.describe(int(np.argmin(diagonal)))}"
        raise BundleError(f"{what}: hold it fixed, or add views")
    for _ in range(STEPS):
        better = False
        while damping < 1e12 and not better:
            tried = layout.moved(state, normal.step(damping))
            there = _normal(tried, layout, sightings)
            better = there.cost < normal.cost
            damping = damping / 10 if better else damping * 10
        if not better:
            break
        gain = (normal.cost - there.cost) / normal.cost
        state, normal = tried, there
        if gain < CONVERGED or normal.cost == 0.0:
            break
    return state, normal


def _normal(state: _State, layout: _Layout, sightings: Sequence[Sighting]) -> _Normal:
    k, poses = len(layout.shared), layout.poses
    shared, own, coupling = np.zeros((k, k)), np.zeros((poses, 6, 6)), np.zeros((poses, k, 6))
    slope, own_slope, residuals = np.zeros(k), np.zeros((poses, 6)), []
    for seen in sightings:
        by_shared, by_pose, residual = _linearised(state, layout, seen)
        shared += by_shared.T @ by_shared
        own[seen.pose] += by_pose.T @ by_pose
        coupling[seen.pose] += by_shared.T @ by_pose
        slope += by_shared.T @ residual
        own_slope[seen.pose] += by_pose.T @ residual
        residuals.append(residual.reshape(-1, 2))
    return _Normal(shared, own, coupling, slope, own_slope, tuple(residuals))


def _linearised(state: _State, layout: _Layout, seen: Sighting) -> tuple[Array, Array, Array]:
    """A sighting's derivatives by shared parameters (2n, k) and pose (2n, 6); residuals (2n,)."""
    rig, poses = state
    camera, motion = rig.cameras[seen.camera], rig.from_reference[seen.camera]
    pose = poses[seen.pose]
    # composed om and T, then their derivatives: of om by om1, T1, om2, T2, and the same of T
    om, T, *by_part = map(np.asarray, cv2.composeRT(pose.om, pose.T, motion.om, motion.T))
    by_pose, by_motion = (
        np.block([[by_part[i], by_part[i + 1]], [by_part[i + 4], by_part[i + 5]]]) for i in (0, 2)
    )
    board, kc = seen.board_mm.reshape(-1, 1, 3), np.array(camera.kc)
    predicted, by = cv2.projectPoints(board, om, T, camera.matrix, kc)
    residual = (seen.pixels_px - predicted.reshape(-1, 2)).reshape(-1)
    # its columns: rotation 0:3, translation 3:6, then f, c, k in the order of LENS
    by_whole, lens = (np.array(part, dtype=np.float64) for part in (by[:, :6], by[:, 6:15]))
    by_shared = np.zeros((len(residual), len(layout.shared)))
    places, columns = layout.columns(seen.camera, POSE)
    if places:
        by_shared[:, columns] = (by_whole @ by_motion)[:, places]
    if seen.camera in layout.ratio:
        lens[:, 0] += layout.ratio[seen.camera] * lens[:, 1]
    places, columns = layout.columns(seen.camera, LENS)
    by_shared[:, columns] = lens[:, places]
    return by_shared, by_whole @ by_pose, np.asarray(residual, dtype=np.float64)

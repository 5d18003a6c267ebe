"""Cameras from views of a board: each alone, then the pair with fixed and with joint lenses.
OpenCV's solver gives the start, the bundle adjustment the answer and its covariance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from detector.calibration.bundle import LENS, Adjusted, BundleError, Freedom, Rig, Sighting, adjust
from detector.geometry import Array, Camera, Motion

# two leave a family of lenses; three are the least that a planar board needs in practice (Zhang
# 2000, section 3.3)
LEAST_VIEWS = 3
# views that are all more parallel than this don't tell the focal length from the distance
LEAST_TILT_DEG = 10.0
PLAIN = frozenset({"fx", "fy", "cx", "cy"})
LENS_MODELS: dict[str, frozenset[str]] = {
    "k1": PLAIN | {"k1"},
    "k1 k2": PLAIN | {"k1", "k2"},
    "k1 k2 p1 p2": PLAIN | {"k1", "k2", "p1", "p2"},
    "k1 k2 p1 p2 k3": frozenset(LENS),
}


class TooFewViewsError(BundleError):
    """Views that can't fix a camera; the message is a sentence that says what is missing."""


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """A board's points (n, 3) mm at (n, 2) px; ``name``: the pose, in every camera."""

    name: str
    board_mm: Array
    pixels_px: Array


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """One adjustment: views in the order of their poses, and the sightings of each."""

    fit: Adjusted
    views: tuple[str, ...]
    sightings: tuple[Sighting, ...]

    def view_rms_px(self, camera: str) -> dict[str, float]:
        """Root mean square distance of corner from prediction by view, for one camera."""
        pairs = zip(self.sightings, self.fit.residuals_px, strict=True)
        return {
            self.views[s.pose]: float(np.sqrt(np.mean(np.sum(r**2, axis=1))))
            for s, r in pairs
            if s.camera == camera
        }


def calibrate_camera(
    name: str,
    views: Sequence[View],
    image_size: tuple[int, int],
    *,
    model: str = "k1 k2 p1 p2",
    square_pixels: bool = False,
) -> Calibrated:
    """A camera from its own views. ``model``: one of `LENS_MODELS`; ``square_pixels``: fx = fy.
    Raises TooFewViewsError, BundleError.
    """
    _refuse_too_few(name, views)
    camera, poses = _started(views, image_size, model, square_pixels)
    _refuse_all_alike(name, poses)
    freedom = Freedom(
        {name: LENS_MODELS[model]},
        frozenset({name}) if square_pixels else frozenset(),
        motions=False,
    )
    sightings = tuple(
        Sighting(name, i, view.board_mm, view.pixels_px) for i, view in enumerate(views)
    )
    fit = adjust(Rig({name: camera}, {name: Motion.identity()}), poses, sightings, freedom)
    return Calibrated(fit, tuple(view.name for view in views), sightings)


def join_cameras(
    alone: Mapping[str, Calibrated],
    *,
    joint_lenses: Sequence[str] = (),
    model: str = "k1 k2 p1 p2",
    square_pixels: bool = False,
) -> Calibrated:
    """The cameras of ``alone`` against each other, in the first one's frame.

    Lenses of ``joint_lenses`` are fitted again, others are held. All views take part; shared ones
    move a camera. Raises TooFewViewsError.
    """
    names = list(alone)
    first = alone[names[0]]
    motions = {names[0]: Motion.identity()}
    poses = dict(zip(first.views, first.fit.poses, strict=True))
    for name in names[1:]:
        motions[name] = _between(first, alone[name], names[0], name)
        for view, pose in zip(alone[name].views, alone[name].fit.poses, strict=True):
            poses.setdefault(view, motions[name].inverse() @ pose)
    order = {view: i for i, view in enumerate(poses)}
    sightings = tuple(
        Sighting(name, order[c.views[s.pose]], s.board_mm, s.pixels_px)
        for name, c in alone.items()
        for s in c.sightings
    )
    cameras = {name: c.fit.rig.cameras[name] for name, c in alone.items()}
    aspect = frozenset(joint_lenses) if square_pixels else frozenset()
    freedom = Freedom(dict.fromkeys(joint_lenses, LENS_MODELS[model]), aspect)
    return Calibrated(
        adjust(Rig(cameras, motions), list(poses.values()), sightings, freedom),
        tuple(poses),
        sightings,
    )


def place_board(name: str, views: Sequence[View], lens: Camera) -> Calibrated:
    """Where the board was before a camera whose lens is known and held. Raises TooFewViewsError."""
    _refuse_too_few(name, views)
    K = np.array([[lens.fc[0], 0.0, lens.cc[0]], [0.0, lens.fc[1], lens.cc[1]], [0.0, 0.0, 1.0]])
    poses = []
    for view in views:
        _, turn, shift = cv2.solvePnP(
            view.board_mm, view.pixels_px, K, np.array(lens.kc), flags=cv2.SOLVEPNP_IPPE
        )
        poses.append(Motion.from_vectors(turn.reshape(-1), shift.reshape(-1)))
    sightings = tuple(
        Sighting(name, i, view.board_mm, view.pixels_px) for i, view in enumerate(views)
    )
    fit = adjust(
        Rig({name: lens}, {name: Motion.identity()}), poses, sightings, Freedom({}, motions=False)
    )
    return Calibrated(fit, tuple(view.name for view in views), sightings)


def _started(
    views: Sequence[View], image_size: tuple[int, int], model: str, square_pixels: bool
) -> tuple[Camera, list[Motion]]:
    board = [view.board_mm.astype(np.float32) for view in views]
    seen = [view.pixels_px.astype(np.float32) for view in views]
    free, flags = LENS_MODELS[model], 0
    for name, flag in (
        ("k1", cv2.CALIB_FIX_K1),
        ("k2", cv2.CALIB_FIX_K2),
        ("k3", cv2.CALIB_FIX_K3),
        ("p1", cv2.CALIB_ZERO_TANGENT_DIST),
    ):
        flags |= 0 if name in free else flag
    guess = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) if square_pixels else None
    flags |= cv2.CALIB_FIX_ASPECT_RATIO if square_pixels else 0
    _, K, kc, turns, shifts = cv2.calibrateCamera(
        board, seen, image_size, guess, None, flags=flags
    )[:5]
    k1, k2, p1, p2, k3 = (float(v) for v in np.resize(kc.reshape(-1)[:5], 5))
    camera = Camera(
        image_size,
        (float(K[0, 0]), float(K[1, 1])),
        (float(K[0, 2]), float(K[1, 2])),
        0.0,
        (k1, k2, p1, p2, k3),
    )
    return camera, [
        Motion.from_vectors(turn.reshape(-1), shift.reshape(-1))
        for turn, shift in zip(turns, shifts, strict=True)
    ]


def _between(first: Calibrated, other: Calibrated, first_name: str, other_name: str) -> Motion:
    """other_from_first as a start: the median over the views that both saw."""
    there = dict(zip(first.views, first.fit.poses, strict=True))
    both = [
        pose @ there[view].inverse()
        for view, pose in zip(other.views, other.fit.poses, strict=True)
        if view in there
    ]
    if len(both) < LEAST_VIEWS:
        raise TooFewViewsError(
            f"{first_name} and {other_name} share {len(both)} views, at least {LEAST_VIEWS} are"
            " needed: show the board where both see all of it"
        )
    middle = np.median([motion.T for motion in both], axis=0)
    nearest = min(both, key=lambda motion: float(np.linalg.norm(motion.T - middle)))
    return Motion(nearest.R, middle)


def _refuse_too_few(name: str, views: Sequence[View]) -> None:
    if len(views) < LEAST_VIEWS:
        raise TooFewViewsError(
            f"{name} has {len(views)} usable views of the board, at least {LEAST_VIEWS} are needed,"
            " 15 to 30 are good"
        )


def _refuse_all_alike(name: str, poses: Sequence[Motion]) -> None:
    normals = np.array([pose.R[:, 2] for pose in poses])
    apart = np.degrees(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))).max()
    if apart < LEAST_TILT_DEG:
        raise TooFewViewsError(
            f"all views of {name} are from one side: the board was never tilted by more than"
            f" {apart:.1f} degrees between two views; tilt it by 20 to 40 degrees to each side"
        )

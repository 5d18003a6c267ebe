"""Cameras from views of a board: each alone, then the pair with fixed and with joint lenses; and
what a set of views covers. OpenCV's solver gives the start, the bundle adjustment the answer.

The split-half comparison tests the stated standard deviations: two calibrations, each from every
other view. Reprojection error can't: few views reproject better, and are worse.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from detector.calibration import bundle
from detector.calibration.bundle import LENS, POSE, BundleError, FreeParameters, Rig, Sighting
from detector.calibration.values import Pair
from detector.geometry import Array, Camera, Motion
from textfiles.text import plural

Floats = NDArray[np.floating]
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
# what keeps OpenCV's solver from a parameter
HELD = {"k1": cv2.CALIB_FIX_K1, "k2": cv2.CALIB_FIX_K2, "k3": cv2.CALIB_FIX_K3}
HELD["p1"] = cv2.CALIB_ZERO_TANGENT_DIST


class TooFewViewsError(BundleError):
    """Views that can't fix a camera; the message is a sentence that says what is missing."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """A board's points (n, 3) mm at (n, 2) px; ``name``: the pose, in every camera."""

    name: str
    board_mm: Array
    pixels_px: Array


@dataclass(frozen=True, slots=True, eq=False)
class CameraFit:
    """One adjustment: views in the order of their poses, and the sightings of each."""

    fit: bundle.Adjustment
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
    views: Sequence[BoardView],
    image_size: tuple[int, int],
    *,
    model: str = "k1 k2 p1 p2",
    square_pixels: bool = False,
) -> CameraFit:
    """A camera from its own views. ``model``: one of `LENS_MODELS`; ``square_pixels``: fx = fy.
    Raises TooFewViewsError, BundleError.
    """
    _refuse_too_few(name, views)
    free, flags = LENS_MODELS[model], cv2.CALIB_FIX_ASPECT_RATIO if square_pixels else 0
    flags += sum(flag for parameter, flag in HELD.items() if parameter not in free)
    board = [np.asarray(view.board_mm, dtype=np.float32) for view in views]
    seen = [np.asarray(view.pixels_px, dtype=np.float32) for view in views]
    guess = np.eye(3) if square_pixels else None
    _, K, kc, turns, shifts = cv2.calibrateCamera(
        board, seen, image_size, guess, None, flags=flags
    )[:5]
    lens = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *np.resize(kc.reshape(-1)[:5], 5)])
    poses = [Motion.from_vectors(turn, shift) for turn, shift in zip(turns, shifts, strict=True)]
    normals = np.array([pose.R[:, 2] for pose in poses])
    apart = np.degrees(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))).max()
    if apart < LEAST_TILT_DEG:
        raise TooFewViewsError(
            f"all views of {name} are from one side: the board was never tilted by more than"
            f" {apart:.1f} degrees between two views; tilt it by 20 to 40 degrees to each side"
        )
    camera = Camera(image_size, (1.0, 1.0), (0.0, 0.0)).with_lens(lens)
    aspect = frozenset({name}) if square_pixels else frozenset()
    return _alone(name, views, camera, poses, FreeParameters({name: free}, aspect, motions=False))


def place_board(name: str, views: Sequence[BoardView], lens: Camera) -> CameraFit:
    """Where the board was before a camera whose lens is known and held. Raises TooFewViewsError."""
    _refuse_too_few(name, views)
    poses = [flat_pose(view.board_mm, view.pixels_px, lens) for view in views]
    return _alone(name, views, lens, poses, FreeParameters({}, motions=False))


def flat_pose(board_mm: Floats, pixels_px: Floats, lens: Camera) -> Motion:
    """camera_from_board of a flat board's points (n, 3) at (n, 2) px."""
    K, kc = lens.matrix, np.array(lens.kc)
    _, turn, shift = cv2.solvePnP(board_mm, pixels_px, K, kc, flags=cv2.SOLVEPNP_IPPE)
    return Motion.from_vectors(turn, shift)


def _refuse_too_few(name: str, views: Sequence[BoardView]) -> None:
    if len(views) < LEAST_VIEWS:
        what = f"{name} has {plural(len(views), 'usable view')} of the board"
        raise TooFewViewsError(f"{what}, at least {LEAST_VIEWS} are needed, 15 to 30 are good")


def _alone(
    name: str,
    views: Sequence[BoardView],
    camera: Camera,
    poses: Sequence[Motion],
    freedom: FreeParameters,
) -> CameraFit:
    sightings = tuple(Sighting(name, i, v.board_mm, v.pixels_px) for i, v in enumerate(views))
    fit = bundle.adjust(Rig({name: camera}, {name: Motion.identity()}), poses, sightings, freedom)
    return CameraFit(fit, tuple(view.name for view in views), sightings)


def join_cameras(
    alone: Mapping[str, CameraFit],
    *,
    joint_lenses: Sequence[str] = (),
    model: str = "k1 k2 p1 p2",
    square_pixels: bool = False,
) -> CameraFit:
    """The cameras of ``alone`` in the first one's frame; ``joint_lenses`` are fitted again, others
    held. All views take part; shared ones move a camera. Raises TooFewViewsError.
    """
    first, *others = alone
    motions = {first: Motion.identity()}
    in_first = dict(zip(alone[first].views, alone[first].fit.poses, strict=True))
    poses = dict(in_first)
    for name in others:
        seen = dict(zip(alone[name].views, alone[name].fit.poses, strict=True))
        moves = {v: pose @ in_first[v].inverse() for v, pose in seen.items() if v in in_first}
        both = list(moves.values())
        if len(both) < LEAST_VIEWS:
            what = f"{first} and {name} share {len(both)} views, at least {LEAST_VIEWS} are needed"
            alike = f"{first} has {_named(in_first)}, {name} has {_named(seen)}"
            same = "the pictures of one pose have the same name"
            raise TooFewViewsError(
                f"{what}: show the board where both see all of it ({same}; {alike})"
            )
        _refuse_odd_pairs(alone, first, name, moves, in_first)
        # to start with, the median over the views that both saw
        middle = np.median([motion.T for motion in both], axis=0)
        nearest = min(both, key=lambda motion: float(np.linalg.norm(motion.T - middle)))
        motions[name] = Motion(nearest.R, middle)
        for view, pose in seen.items():
            poses.setdefault(view, motions[name].inverse() @ pose)
    order = {view: i for i, view in enumerate(poses)}
    sightings = tuple(
        Sighting(name, order[c.views[s.pose]], s.board_mm, s.pixels_px)
        for name, c in alone.items()
        for s in c.sightings
    )
    rig = Rig({name: c.fit.rig.cameras[name] for name, c in alone.items()}, motions)
    aspect = frozenset(joint_lenses) if square_pixels else frozenset()
    freedom = FreeParameters(dict.fromkeys(joint_lenses, LENS_MODELS[model]), aspect)
    fit = bundle.adjust(rig, list(poses.values()), sightings, freedom)
    return CameraFit(fit, tuple(poses), sightings)


# a view is odd whose motion between two cameras is farther from that of most than this turn, and
# than these shares of the motion and of the board's distance: no pose is known worse
ODD_DEG, ODD_OF_MOTION, ODD_OF_DISTANCE = 8.0, 0.5, 0.05


class OddPairError(BundleError):
    """Pictures that are no pair, by their names, and what would fit."""


def _refuse_odd_pairs(
    alone: Mapping[str, CameraFit],
    first: str,
    other: str,
    moves: Mapping[str, Motion],
    seen: Mapping[str, Motion],
) -> None:
    """Raise OddPairError for views whose motion between the cameras isn't that of most."""

    def apart(one: Motion, two: Motion, distance_mm: float) -> bool:
        off_mm = float(np.linalg.norm(one.T - two.T))
        most_mm = max(ODD_OF_MOTION * float(np.linalg.norm(two.T)), ODD_OF_DISTANCE * distance_mm)
        turned_rad = float(np.linalg.norm((one.inverse() @ two).om))
        return off_mm > most_mm or np.degrees(turned_rad) > ODD_DEG

    away = {view: float(np.linalg.norm(seen[view].T)) for view in moves}
    # the one that most agree with
    usual = max(
        moves.values(),
        key=lambda each: sum(not apart(move, each, away[v]) for v, move in moves.items()),
    )
    odd = [view for view, move in moves.items() if apart(move, usual, away[view])]
    if not odd or len(odd) > (len(moves) - 1) // 2:
        return
    sentences = []
    for view in odd:
        pair = f"{first} {view} and {other} {view}"
        if not apart(moves[view].inverse(), usual, away[view]):
            fits = "exchanged they fit the other pairs. Exchange them"
        elif any(
            not apart(pose @ seen[view].inverse(), usual, away[view])
            for pose in _turned_poses(alone[other], other, view)
        ):
            fits = f"turned by half a turn, {other} {view} fits. Turn it"
        elif any(
            not apart(moves[view] @ seen[view] @ pose.inverse(), usual, away[view])
            for pose in _turned_poses(alone[first], first, view)
        ):
            fits = f"turned by half a turn, {first} {view} fits. Turn it"
        else:
            fits = "the board was elsewhere in the one than in the other. Leave both out"
        sentences.append(f"{pair} are no pair like the {len(moves) - len(odd)} others: {fits}")
    raise OddPairError("; ".join(sentences))


def _turned_poses(alone: CameraFit, camera: str, view: str) -> Iterator[Motion]:
    """Of the board, had the picture been turned by half a turn; counted from either end."""
    lens = alone.fit.rig.cameras[camera]
    seen = next(s for s in alone.sightings if alone.views[s.pose] == view)
    turned = np.array(lens.image_size) - 1.0 - seen.pixels_px
    for board_mm in (seen.board_mm, seen.board_mm[::-1]):
        yield flat_pose(board_mm, turned, lens)


def _named(views: Mapping[str, object]) -> str:
    names = sorted(views)
    return ", ".join(names[:3]) + (f" to {names[-1]}" if len(names) > 3 else "") or "none"


def pair_of(joined: CameraFit) -> Pair:
    """The pair of an adjustment of left and right; its world is the right camera's frame."""
    cameras, motions = joined.fit.rig.cameras, joined.fit.rig.from_reference
    right_from_left = motions["right"] @ motions["left"].inverse()
    return Pair(cameras["left"], cameras["right"], right_from_left, Motion.identity())


@dataclass(frozen=True, slots=True, eq=False)
class Halves:
    """Two calibrations of one pair; ``differences`` of parameters in combined sd."""

    pairs: tuple[Pair, Pair]
    differences: Mapping[tuple[str, str], float]

    def disagree_mm(self, left_px: ArrayLike, right_px: ArrayLike) -> Array:
        """Distance (n,) mm of points that both triangulate from pixels (n, 2), right's frame."""
        first, second = (pair.in_right_mm(left_px, right_px) for pair in self.pairs)
        return np.asarray(np.linalg.norm(first - second, axis=1))


def split_half(
    views: Mapping[str, Sequence[BoardView]],
    image_size: tuple[int, int],
    *,
    model: str,
    square_pixels: bool = False,
) -> Halves:
    """Both halves of the shared views, alone and jointly. Raises TooFewViewsError."""
    in_right = {view.name for view in views["right"]}
    shared = [view.name for view in views["left"] if view.name in in_right]
    lens: dict[str, Any] = {"model": model, "square_pixels": square_pixels}
    fits, variances = [], []
    values: list[dict[tuple[str, str], float]] = []
    for half in (set(shared[::2]), set(shared[1::2])):
        seen = {name: [v for v in views[name] if v.name in half] for name in ("left", "right")}
        alone = {name: calibrate_camera(name, v, image_size, **lens) for name, v in seen.items()}
        found = join_cameras(alone, joint_lenses=("left", "right"), **lens)
        fits.append(found)
        values.append({})
        for n, camera in found.fit.rig.cameras.items():
            motion = found.fit.rig.from_reference[n]
            numbers = zip((*LENS, *POSE), (*camera.lens, *motion.om, *motion.T), strict=True)
            values[-1] |= {(n, p): v for p, v in numbers}
        variances.append(dict(zip(found.fit.names, np.diag(found.fit.covariance), strict=True)))
    differences = {
        at: float((values[0][at] - values[1][at]) / np.sqrt(variances[0][at] + variances[1][at]))
        for at in fits[0].fit.names
    }
    return Halves((pair_of(fits[0]), pair_of(fits[1])), differences)


COLUMNS, ROWS = 4, 3  # cells of the picture
LEAST_CORNERS = 12  # in a cell that counts as covered
TILT_DEG = 15.0  # from here on a view counts as tilted to a side
LEAST_TILTED = 2  # views a side
DISTANCE_RATIO = 1.3  # farthest over nearest view
ENOUGH_VIEWS = 12
# what a rough focal length is believed to be, in widths of the picture
FOCAL_OVER_WIDTH = (0.5, 8.0)
SIDES = tuple(
    f"its {side} edge towards the cameras" for side in ("left", "right", "upper", "lower")
)
_ROW_NAMES = ("top", "middle", "bottom")
_COLUMN_NAMES = ("far left", "left", "right", "far right")


def away_text(near_mm: float, far_mm: float) -> str:
    """``all views are 900 to 1100 mm away``"""
    return (
        f"all views are {' to '.join(dict.fromkeys((f'{near_mm:.0f}', f'{far_mm:.0f}')))} mm away"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Coverage:
    """``corners`` (ROWS, COLUMNS) by cell; ``tilted`` views by `SIDES`; nearest and farthest mm."""

    views: int
    corners: Array
    tilted: tuple[int, ...]
    distances_mm: tuple[float, float] | None

    @property
    def share(self) -> float:
        """Share of the picture's cells that are covered, 0 to 1."""
        return float(np.mean(self.corners >= LEAST_CORNERS))

    @property
    def missing(self) -> tuple[str, ...]:
        """What is still to be shown, as instructions; empty when nothing is."""
        found = []
        empty = np.argwhere(self.corners < LEAST_CORNERS)
        if cells := ", ".join(
            f"{_ROW_NAMES[row]} {_COLUMN_NAMES[column]}" for row, column in empty
        ):
            found.append(f"show the board in the picture's {cells}")
        for side, count in zip(SIDES, self.tilted, strict=True):
            if count < LEAST_TILTED:
                found.append(f"tilt the board by 20 to 40 degrees, {side}")
        if (span := self.distances_mm) and span[1] < DISTANCE_RATIO * span[0]:
            found.append(f"hold the board nearer and farther: {away_text(*span)}")
        if (more := ENOUGH_VIEWS - self.views) > 0:
            found.append(plural(more, "more view"))
        return tuple(found)


def coverage(
    pixels_px: Sequence[Array], image_size: tuple[int, int], poses: Sequence[Motion] = ()
) -> Coverage:
    """Of views with corners (n, 2) in (columns, rows) px; ``poses``: camera_from_board if known."""
    corners, cells = np.zeros((ROWS, COLUMNS)), np.array([COLUMNS, ROWS])
    for pixels in pixels_px:
        columns, rows = np.clip((pixels + 0.5) / image_size * cells, 0, cells - 1e-9).astype(int).T
        np.add.at(corners, (rows, columns), 1.0)
    # a normal (away from the camera) that points to the right: the left edge is farther away
    normals = np.array([pose.R[:2, 2] * np.copysign(1, pose.R[2, 2]) for pose in poses])
    x, y = np.degrees(np.arcsin(np.clip(normals.reshape(-1, 2), -1.0, 1.0))).T
    sides = (x < -TILT_DEG, x > TILT_DEG, y < -TILT_DEG, y > TILT_DEG)
    depths = [float(pose.T[2]) for pose in poses]
    tilted = tuple(int(side.sum()) for side in sides)
    return Coverage(len(pixels_px), corners, tilted, (min(depths), max(depths)) if depths else None)


def rough_poses(
    board_mm: Sequence[Array], pixels_px: Sequence[Array], image_size: tuple[int, int]
) -> list[Motion]:
    """camera_from_board of views, points (n, 3) mm at (n, 2) px, with a guessed lens: for a guide.

    Focal length by Zhang 2000, closed form; central principal point; no distortion.
    """
    if not board_mm:
        return []
    boards = [np.asarray(board, dtype=np.float32) for board in board_mm]
    seen = [np.asarray(pixels, dtype=np.float32) for pixels in pixels_px]
    guessed = float(cv2.initCameraMatrix2D(boards, seen, image_size, 1.0)[0, 0])
    low, high = (ratio * image_size[0] for ratio in FOCAL_OVER_WIDTH)
    focal = min(max(guessed, low), high) if np.isfinite(guessed) else float(image_size[0])
    middle = (image_size[0] - 1) / 2, (image_size[1] - 1) / 2
    lens = Camera(image_size, (focal, focal), middle)
    return [flat_pose(*each, lens) for each in zip(boards, seen, strict=True)]

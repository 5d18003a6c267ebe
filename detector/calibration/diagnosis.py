"""A board measured again in space with a calibrated pair (spacing, flatness, epipolar offset), and
what is wrong with a calibration, by that and by touched points.

The views are not those of the calibration. A wrong baseline or square scales all lengths; a column
shift scales them with distance; a row shift is an epipolar offset; a bent board has a raised
middle; swapped cameras see points behind them. A mark counts where significant and large enough.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

from detector.calibration.boards import Board
from detector.calibration.gate import UNITS
from detector.calibration.rigid import WorldFit, cross_matrix
from detector.calibration.values import Pair
from detector.geometry import Array, Motion, homogeneous

Ids = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class PairView:
    """A board seen by both cameras: points ``ids`` (n,) at left and right pixels (n, 2)."""

    name: str
    ids: Ids
    left_px: Array
    right_px: Array


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredView:
    """One view, mm and px. ``scale``: over printed lengths; ``off_plane_mm`` (n,): towards the
    cameras; ``epipolar_px`` (n,): positive downwards; ``spacing_mm`` (m,): neighbours' less the
    pitch.
    """

    name: str
    ids: Ids
    depth_mm: float
    scale: float
    spacing_mm: Array
    off_plane_mm: Array
    epipolar_px: Array


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredBoard:
    board: Board
    views: tuple[MeasuredView, ...]

    @property
    def scale(self) -> tuple[float, float]:
        """Mean over the views, and the standard deviation of that mean."""
        return _mean([view.scale for view in self.views])

    @property
    def grows_with_distance(self) -> bool:
        """Whether a scale error proportional to distance fits better than a constant one."""
        depth = np.array([view.depth_mm for view in self.views])
        off = np.array([view.scale - 1.0 for view in self.views])
        proportional = off - depth * float(depth @ off) / float(depth @ depth)
        return float(np.sum(proportional**2)) < float(np.sum((off - off.mean()) ** 2))

    @property
    def epipolar(self) -> tuple[float, float]:
        """Mean signed row offset in px over the views, and its standard deviation."""
        return _mean([float(np.mean(view.epipolar_px)) for view in self.views])

    @property
    def epipolar_rms_px(self) -> float:
        return _rms([view.epipolar_px for view in self.views])

    @property
    def spacing_rms_mm(self) -> float:
        """Of the distances between neighbours from the pitch."""
        return _rms([view.spacing_mm for view in self.views])

    @property
    def flatness_rms_mm(self) -> float:
        return _rms([view.off_plane_mm for view in self.views])

    @property
    def bend(self) -> tuple[float, float]:
        """Height of the middle over the edge, mm, by a paraboloid over all views, and its sd."""
        return _mean([_bend_mm(self.board, view) for view in self.views])


def remeasure(pair: Pair, board: Board, views: Sequence[PairView]) -> MeasuredBoard:
    """The board of each view in space. Raises ValueError where there is no view."""
    if not views:
        raise ValueError("there is no view of the board that both cameras saw")
    return MeasuredBoard(board, tuple(_measured(pair, board, view) for view in views))


def _measured(pair: Pair, board: Board, view: PairView) -> MeasuredView:
    points, printed = pair.in_right_mm(view.left_px, view.right_px), board.points_mm[view.ids]
    # distances to the next point in a row and in a column, where both were seen
    grid = np.full((board.rows, board.columns, 3), np.nan)
    grid.reshape(-1, 3)[view.ids] = points
    apart = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).ravel() for axis in (1, 0)]
    spacing = np.concatenate(apart) - board.pitch_mm
    spacing = spacing[np.isfinite(spacing)]
    centred, centred_printed = points - points.mean(axis=0), printed - printed.mean(axis=0)
    scale = float(np.sqrt(np.sum(centred**2) / np.sum(centred_printed**2)))
    normal = np.linalg.svd(centred, full_matrices=False)[2][2]
    off_plane = centred @ (normal if normal[2] < 0 else -normal)
    depth, epipolar = float(points[:, 2].mean()), epipolar_px(pair, view)
    return MeasuredView(view.name, view.ids, depth, scale, spacing, off_plane, epipolar)


def epipolar_px(pair: Pair, view: PairView) -> Array:
    """Signed distances (n,) px of right pixels from epipolar lines, positive downwards,
    undistorted, at the right focal length. Hartley and Zisserman, 2nd ed., section 9.6.
    """
    a = homogeneous(pair.left.normalize(view.left_px))
    b = homogeneous(pair.right.normalize(view.right_px))
    essential = cross_matrix(pair.right_from_left.T) @ pair.right_from_left.R
    lines = a @ essential.T
    lines *= np.where(lines[:, 1:2] < 0, -1.0, 1.0)
    off = np.sum(lines * b, axis=1) / np.linalg.norm(lines[:, :2], axis=1)
    return np.asarray(off * pair.right.fc[1])


def _bend_mm(board: Board, view: MeasuredView) -> float:
    printed = board.points_mm[view.ids, :2]
    half = 0.5 * np.array([board.columns - 1, board.rows - 1]) * board.pitch_mm
    x, y = ((printed - half) / np.linalg.norm(half)).T
    terms = np.column_stack([np.ones_like(x), x, y, x**2, x * y, y**2])
    found = np.linalg.lstsq(terms, view.off_plane_mm, rcond=None)[0]
    # at the corners x^2 + y^2 = 1; along the diagonal that bends most
    bends = np.linalg.eigvalsh(np.array([[found[3], found[4] / 2], [found[4] / 2, found[5]]]))
    return float(-bends[np.argmax(np.abs(bends))])


def _mean(values: Sequence[float]) -> tuple[float, float]:
    sd = float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else float("nan")
    return float(np.mean(values)), sd


def _rms(parts: Sequence[Array]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(parts) ** 2)))


# standard deviations of a normal distribution: several marks are looked at, and views are not quite
# independent
SIGNIFICANT = 4.0
SCALE_MATTERS = 0.002  # 2 mm a metre
ROWS_MATTER_PX = 0.2
TIMES = 1.5  # by so much or more too long, or too short, it is a wrong unit
UNIT_NEAR = 0.05  # share by which a scale may be off a unit's
BEND_MATTERS = 0.002  # of the board's diagonal
OUTLIER_RATIO = 2.5  # of a view's error to the median of all


@dataclass(frozen=True, slots=True)
class Finding:
    """``name`` for programs; ``sentence`` for people: what is seen, and its likely cause."""

    name: str
    sentence: str


def swapped(right_from_left: Motion) -> list[Finding]:
    """Whether what is called left stands on the right. The pair is taken to stand upright."""
    x = float(right_from_left.inverse().T[0])
    why = "the cameras' names, or their cables, are swapped"
    said = f"the right camera stands {-x:.0f} mm to the left of the left one: {why}"
    return [] if x > 0 else [Finding("swapped cameras", said)]


def outlier_views(rms_px: Mapping[str, float], camera: str) -> list[Finding]:
    """Views that fit far worse than the others: listed, never dropped."""
    middle = float(np.median(list(rms_px.values()))) if len(rms_px) >= 4 else np.inf
    text = "view {} of {} misses by {:.2f} px, the median view by {:.2f} px: look at it, and decide"
    return [
        Finding("outlier view", text.format(name, camera, value, middle))
        for name, value in rms_px.items()
        if value > OUTLIER_RATIO * middle
    ]


def measured_again(again: MeasuredBoard, pair: Pair) -> list[Finding]:
    """What a board measured again says of the calibration, or of the board."""
    if any(view.depth_mm <= 0 for view in again.views):
        said = "the board is measured behind the cameras: left and right pictures are swapped"
        return [Finding("swapped cameras", said)]
    offset = again.epipolar[0]
    said = (
        f"the right camera's rows are {abs(offset):.2f} px too {'low' if offset > 0 else 'high'}"
        " against the left's: pixel centres counted from 0 in one and 0.5 in the other, or a lens"
        " or camera that moved"
    )
    rows = _matters(again.epipolar, ROWS_MATTER_PX, again)
    shifted = [Finding("shifted rows", said)] if rows else []
    return [*bent(again), *_scale(again, pair), *shifted]


def against_the_arm(world: WorldFit) -> list[Finding]:
    """What the arm's points tell: its lengths are the reference."""
    off = world.scale - 1.0
    if not (abs(off) > SCALE_MATTERS and abs(off) > SIGNIFICANT * world.scale_sd):
        return []
    if not 1.0 / TIMES < world.scale < TIMES:
        return [Finding("wrong unit", _unit_sentence(world.scale))]
    said = (
        f"lengths come out {abs(100 * off):.2f} % too {'short' if off > 0 else 'long'} against the"
        f" arm: the board's squares are {world.scale:.4f} of what its file says, or the baseline is"
    )
    return [Finding("wrong square size", said)]


def _unit_sentence(scale: float) -> str:
    """Of lengths that are off by times, and whose unit may be another."""
    times, short = (scale, "short") if scale > 1.0 else (1.0 / scale, "long")
    near = [each for each in UNITS if abs(scale / each - 1.0) < UNIT_NEAR]
    times = max(near[0], 1.0 / near[0]) if near else times
    said = f"lengths come out {times:.4g} times too {short} against the arm"
    if not near:
        return f"{said}: the baseline, or the board's squares, are not in mm"
    return f"{said}: the baseline, or the board's squares, are in {UNITS[near[0]]} and not in mm"


def _matters(mean: tuple[float, float], least: float, again: MeasuredBoard) -> bool:
    """Whether a mean, with its sd, is above ``least`` and differs from 0 at `SIGNIFICANT`."""
    (value, sd), freedom = mean, len(again.views) - 1
    if freedom < 1 or not abs(value) > least:
        return False
    return abs(value) > -float(stdtrit(freedom, ndtr(-SIGNIFICANT))) * sd


def _scale(again: MeasuredBoard, pair: Pair) -> list[Finding]:
    scale, sd = again.scale
    off = scale - 1.0
    if not _matters((off, sd), SCALE_MATTERS, again):
        return []
    said = f"the board is measured {100 * abs(off):.2f} % too {'large' if off > 0 else 'small'}"
    if not again.grows_with_distance:
        why = "the baseline is wrong by that factor, or the board is not the one described"
        return [Finding("wrong baseline", f"{said} at every distance: {why}")]
    # a disparity wrong by d px makes lengths at the distance Z wrong by d Z / (f B)
    depth_mm = float(np.mean([view.depth_mm for view in again.views]))
    shift_px = off * pair.right.fc[0] * float(np.linalg.norm(pair.right_from_left.T)) / depth_mm
    said += (
        f", the more the farther, as by {abs(shift_px):.2f} px between the columns of the two"
        " cameras: pixel centres counted from 0 in one and 0.5 in the other, or a lens that moved"
    )
    return [Finding("shifted columns", said)]


def bent(again: MeasuredBoard) -> list[Finding]:
    """Whether the middle stands off the rim, beyond what the calibration's lenses took up."""
    bend, least = again.bend[0], BEND_MATTERS * float(np.hypot(*again.board.size_mm))
    side = "before" if bend > 0 else "behind"
    said = f"the board's middle stands {abs(bend):.2f} mm {side} its rim: it is bent"
    return [Finding("bent board", said)] if _matters(again.bend, least, again) else []

"""Do the cameras agree? The third view and the rows as witnesses of the calibration and of the
pictures' time.

Two numbers a frame, pooled over its teats: how far the right picture's edges lie off in rows, with
each teat free to move, and how far the thermal outlines lie off what the stereo fit predicts. A
column of the right picture's shifts nothing that two cameras could see; it moves the fit in depth,
and so in the thermal picture: by ``(f_t B_t) / (f B)`` sensor pixels a pixel of disparity, at any
depth (f: focal lengths, B: distances between centres, t: thermal). On the thesis's rig that is 0.2:
0.25 sensor pixels, the limit of the warning, are 1.2 pixels of disparity, or 12 mm at 1.1 m. What
is below widens the covariances.

Light that fades into the background hides one side of all teats from both optical pictures. Then
the thermal outline lies off on that side alone: it swells by as much as it shifts. That is none of
the cameras', and widens covariances across the sides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from detector.calibration import Calibration
from detector.calibration.bundle import LENS, POSE
from detector.fused.parameters import Parameters
from detector.geometry import Array
from detector.outline.fine import Fitted
from detector.outline.model import apexes
from detector.outline.offsets import row_offsets, thermal_offsets
from detector.outline.prior import right_from_teats, thermal_camera
from detector.outline.views import THERMAL
from detector.protocol import CamerasOff, Detection

# beyond these no calibration of a rig that is fit for use is off
_ROWS_PX = 0.4
_THERMAL_PX = np.array([0.25, 0.6])  # sensor px, columns and rows: an end is less sure than a side
_OF_FEW = 0.5  # one teat alone may have a warm neighbour: so much more for one, half for two
_LEAST_INFORMATION = 300.0  # of a teat's thermal outline: a standard deviation of 0.06 px
_SDS = 3.0  # of what the calibration states
# a thermal outline that shifts so far, and is wider by so much of that, is so on one side alone
_ONE_SIDE_PX, _ONE_SIDE = 0.15, 0.9


@dataclass(frozen=True, slots=True)
class Agreement:
    """How far the cameras disagree: right rows against left, px; thermal against optical
    columns and rows, sensor px, most teats by as much or more; NaN where no teat shows it.
    ``disparity_px``: what would explain the median of the thermal columns; 0 if unknown.
    ``ratio``: sensor px a px of disparity. ``swell_px``: the median of the thermal outlines'
    shifts that are of one side alone, px of the right picture.
    """

    teats: int
    rows_px: float
    thermal_px: tuple[float, float]
    disparity_px: float
    ratio: float
    swell_px: float = 0.0


def agreement(
    some: Fitted, far_px: Array, calibration: Calibration, p: Parameters, size: float
) -> Agreement:
    """Pooled over ``some`` fits: the accepted ones, else what only a witness speaks against. Where
    thermal outlines lie farther off than edges are looked for, by ``far_px`` (k, 2), over those.
    """
    lens, pose = thermal_camera(calibration)
    thermal_mm = abs(float((pose.R.T @ pose.T)[0]))
    optical = calibration.right.fc[0] * calibration.baseline_mm
    ratio = max(lens.fc[0] / size * thermal_mm / optical, 1e-3)
    nothing = Agreement(0, np.nan, (np.nan, np.nan), 0.0, ratio)
    if len(some.teats) + len(far_px) == 0:
        return nothing
    rows, row_weight = row_offsets(some, p.prior)
    moved, weight = thermal_offsets(some.seen, some.hidden)
    known = weight > _LEAST_INFORMATION
    shift, clear = moved[:, :2], known[:, 0]
    one_side = np.abs(shift[:, 0])
    one_side[(one_side < _ONE_SIDE_PX) | (moved[:, 2] < _ONE_SIDE * one_side)] = 0.0
    shift[one_side > 0, 0] = 0.0
    swell = float(np.median(one_side[clear])) if clear.any() else 0.0
    far = np.isfinite(far_px)
    if (np.abs(far_px) > THERMAL.search_px).any() and 2 * far[:, 0].sum() >= len(far):
        shift, known = far_px, far
    columns, down = (
        _middle(shift[known[:, i], i]) if known[:, i].any() else np.nan for i in range(2)
    )
    pooled = float(rows @ row_weight / max(row_weight.sum(), 1e-9))
    across = shift[known[:, 0], 0]
    disparity = abs(float(np.median(across))) / ratio if len(across) else 0.0
    swell *= calibration.right.fc[0] * size / lens.fc[0]
    return Agreement(len(shift), pooled, (columns, down), disparity, ratio, swell)


def _middle(shifts: Array) -> float:
    """The median; of an even number the middle one nearer to 0, or 0 between them: cameras that
    disagree shift more than half of the teats.
    """
    low, high = np.sort(shifts)[[(len(shifts) - 1) // 2, len(shifts) // 2]]
    return float(np.clip(0.0, low, high))


def disagreement(found: Agreement, fitted: Fitted, calibration: Calibration) -> str | None:
    """Why no end can be given, if the cameras differ by more than the limits and what the
    calibration states of itself allow; else None.
    """
    few = 1.0 + _OF_FEW / max(found.teats, 1)
    off = np.abs(np.nan_to_num([found.rows_px, *found.thermal_px]))
    limit = few * np.array([_ROWS_PX, *_THERMAL_PX])
    if (off <= limit).all():
        return None
    ends_mm = right_from_teats(calibration).apply(apexes(fitted.teats))
    limit = np.maximum(limit, _SDS * _stated_px(ends_mm, calibration))
    if (off <= limit).all():
        return None
    worst = int(np.argmax(off / limit))
    check = "check the calibration, and that all pictures are of one time"
    if worst == 0:
        return f"cameras disagree by {off[0]:.2g} px (rows of left and right): {check}"
    like = f", as by {off[1] / found.ratio:.1f} px of disparity" if worst == 1 else ""
    size = float(np.hypot(*off[1:]))
    return f"cameras disagree by {size:.2g} px (thermal against optical{like}): {check}"


def _stated_px(ends_mm: Array, calibration: Calibration) -> Array:
    """Standard deviations (3,) of row offset and thermal columns and rows (sensor px) by what the
    calibration states of its own parameters; zeros where it states nothing.
    """
    covariance = calibration.covariance
    if covariance is None or len(ends_mm) == 0:
        return np.zeros(3)
    middle = np.mean(ends_mm, axis=0, keepdims=True)
    left_px, right_px = calibration.project(calibration.world_from_right.apply(middle))
    size = calibration.thermal.image_size[0] / calibration.thermal.sensor_size[0]

    def seen(moved: Calibration) -> Array:
        place = moved.in_right_mm(left_px, right_px)
        left, right = moved.project(moved.world_from_right.apply(place))
        lens, pose = thermal_camera(moved)
        rows = ((right - right_px) - (left - left_px))[0, 1]
        return np.array([rows, *lens.project(pose.apply(place))[0] / size])

    columns = []
    for (owner, name), sd in covariance.sds.items():
        step = max(0.1 * sd, 1e-9)
        far, near = (seen(_moved(calibration, owner, name, s)) for s in (step, -step))
        columns.append((far - near) / (2 * step))
    slope = np.array(columns).reshape(-1, 3)
    return np.asarray(np.sqrt(np.einsum("ki,kl,li->i", slope, covariance.matrix, slope)))


def with_cameras_off(answer: Detection, known: CamerasOff, calibration: Calibration) -> Detection:
    """The answer of a run whose cameras are known to be off: its ends' covariances with the shift
    of depth that this makes, and the reason. One frame set shows nothing of it.
    """
    ends = np.array([teat.world_mm for teat in answer.teats]).reshape(-1, 3)
    sight = calibration.world_from_right.inverse().apply(ends)
    sight = (sight / sight[:, 2:]) @ calibration.world_from_right.R.T
    px = abs(known.disparity_px) + known.u_px
    moves = px * calibration.depth_per_disparity_px_mm(ends)[:, None] * sight
    teats = tuple(
        teat
        if teat.covariance_mm2 is None
        else replace(teat, covariance_mm2=teat.covariance_mm2 + np.outer(move, move))
        for teat, move in zip(answer.teats, moves, strict=True)
    )
    said = (
        f"cameras disagree by {abs(known.disparity_px):.2g} px (disparity, ends of {known.poses}"
        " poses of this run): check the calibration, and that all pictures are of one time"
    )
    return replace(answer, teats=teats, reason="; ".join(filter(None, [answer.reason, said])))


def _moved(calibration: Calibration, owner: str, name: str, step: float) -> Calibration:
    lens, pose = calibration.thermal.lens, calibration.thermal_from_left
    if owner == "thermal" and lens is not None:
        other = lens.with_lens(lens.lens + step * np.equal(LENS, name))
        return replace(calibration, thermal=replace(calibration.thermal, lens=other))
    if owner == "thermal pose" and pose is not None:
        return replace(calibration, thermal_from_left=pose.shifted(step * np.equal(POSE, name)))
    return calibration.moved(owner, name, step)


def disagreement_covariances(
    found: Agreement, ends_mm: Array, calibration: Calibration, p: Parameters
) -> Array:
    """(m, 3, 3) mm^2 of ends (m, 3), right camera's frame: as much of disparity as the thermal
    picture shows beyond its noise, half of what the rows are off, and what one side alone is.
    """
    shown = max(found.disparity_px - p.thermal_noise_px / found.ratio, 0.0)
    across_px = np.hypot(0.5 * shown, found.swell_px), 0.5 * np.nan_to_num(found.rows_px)
    return _shifted(shown, across_px, ends_mm, calibration)


def unstated_covariances(ends_mm: Array, calibration: Calibration, p: Parameters) -> Array:
    """The same where the calibration states nothing: a disparity wrong by ``p.calibration_px`` and
    each focal length by ``p.calibration_focal`` of it. 0 where it does.
    """
    if calibration.covariance is not None:
        return np.zeros((len(ends_mm), 3, 3))
    sight_mm, mm_a_px = _sights(ends_mm, calibration)
    in_left = calibration.right_from_left.inverse().apply(ends_mm)
    moves = []
    # pixels are off by a share of their distance from the axis
    for sign, points in ((-1.0, in_left), (1.0, ends_mm)):
        off_mm = p.calibration_focal * points * [1.0, 1.0, 0.0]
        off_px = sign * off_mm[:, :1] / mm_a_px[:, None]
        moves.append(0.5 * off_mm + sight_mm * off_px)
    px = p.calibration_px
    by_focal = sum(np.einsum("mi,mj->mij", move, move) for move in moves)
    return np.asarray(by_focal + _shifted(px, (0.5 * px, 0.0), ends_mm, calibration))


def _shifted(
    disparity_px: float, across_px: tuple[float, float], ends_mm: Array, calibration: Calibration
) -> Array:
    """(m, 3, 3) mm^2 of ends that are off by a disparity, along the line of sight, and across it by
    columns (half of the disparity, since either camera may be off) and rows.
    """
    sight_mm, mm_a_px = _sights(ends_mm, calibration)
    along = disparity_px * sight_mm
    across = np.diag([*np.square(across_px), 0.0])
    return np.asarray(np.einsum("mi,mj->mij", along, along) + (mm_a_px**2)[:, None, None] * across)


def _sights(ends_mm: Array, calibration: Calibration) -> tuple[Array, Array]:
    """How far ends (m, 3) move with a px of disparity (m, 3), and mm a px (m,)."""
    depth = ends_mm[:, 2]
    mm_a_px = depth / calibration.right.fc[0]
    sight = (ends_mm - 0.5 * calibration.right_from_left.T) / depth[:, None]
    return sight * (mm_a_px * depth / calibration.baseline_mm)[:, None], mm_a_px

"""A plain baseline on depth alone: what stands up narrow before something farther, and ends.

Rows are cut where depth jumps. A piece as wide as a teat, with something farther on both sides, is
a slice; slices that follow each other make a bar. The bar's middle, one radius behind its surface,
is the axis; its end is where the bar ends. Pixels that see near and far at once (flying) belong to
neither: an edge is in the middle of them. The depth camera's rows are about level, ends point up.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, field
from typing import Any, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.geometry import Array, Camera, homogeneous
from detector.protocol import Detection, Frames, Stage, Teat, depth_of

NO_DEPTH = "there is no depth picture, and this detector uses nothing else"
NO_CAMERA = "the calibration has no depth camera ([cameras.depth] and [depth])"
NOWHERE_MM = 1e5
FLYING_PX = 2  # pieces of a row as narrow as that are flying pixels
STEP_PX = 2.5  # between the middles of slices that follow each other
LAST = 5  # slices whose median says how deep a bar is
GAP_PX = 2  # rows without a slice that don't end a bar
LEAST_SLICES = 4
FRONT = 0.04  # of the radius: how far the middle half of a round surface lies behind its front


@dataclass(frozen=True, slots=True)
class DepthParameters:
    """mm. ``jump``: between neighbours, more is an edge; ``farther``: what is beside and above a
    teat; ``width``: of a teat; ``least_bar``: of a bar's height; ``used``: of a bar, from its end
    on; ``sd``: of an end across, up and along the camera's axis: what noise, pixels, wiggling and
    second paths leave (docs/detectors.md).
    """

    jump: float = 25.0
    farther: float = 40.0
    width: tuple[float, float] = (12.0, 40.0)
    least_bar: float = 30.0
    used: float = 70.0
    sd: tuple[float, float, float] = (0.9, 1.7, 3.2)


@dataclass(frozen=True, slots=True)
class DepthDetector:
    """Classical; all it knows is in `DepthParameters` and the calibration."""

    settings: DepthParameters = field(default_factory=DepthParameters)
    name: str = "depth"  # in the registry
    version: str = "1"  # counted up when an answer on any frame set changes

    covariance_leaves_out: ClassVar[str] = (
        "what one end differs from another: each has the same standard deviations in the depth"
        " camera's frame; the uncertainty of its lens and place; another make's errors; an end"
        " taken for what is none"
    )

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The settings by name."""
        return asdict(self.settings)

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        """Teat ends in the world frame; a frame set without usable depth gives a sentence."""
        lens, there = calibration.depth, calibration.depth_from_world
        if (given := depth_of(frames)[0]) is None or lens is None or there is None:
            return Detection((), 0, NO_DEPTH if given is None else NO_CAMERA)
        depth = np.asarray(given, dtype=np.float32)
        if depth.shape != lens.image_size[::-1]:
            seen, wanted = (" x ".join(map(str, s)) for s in (depth.shape[::-1], lens.image_size))
            return Detection((), 0, f"the depth picture is {seen}, the calibration is for {wanted}")
        depth = np.where(np.isfinite(depth), depth, np.float32(0.0))
        if not (depth > 0.0).any():
            return Detection((), 0, "the depth picture measured nothing anywhere")
        found = list(_ends(depth, lens, self.settings))
        world = there.inverse()
        spread = world.R @ np.diag(np.square(self.settings.sd)) @ world.R.T
        ends = np.array(found, dtype=np.float64).reshape(-1, 3)
        left, right = calibration.project(world.apply(ends))
        trace = (Stage("bars", {"depth_px": lens.project(ends)}),)
        teats = zip(world.apply(ends), left, right, strict=True)
        answer = tuple(Teat(end, spread, *pixels) for end, *pixels in teats)
        return Detection(answer, 0, None if answer else "nothing narrow stands up", trace)


@dataclass(frozen=True, slots=True)
class _Slice:
    """A bar in one row: middle column and width in px, depth of its front in mm."""

    row: int
    column: float
    width: float
    depth: float

    def follows(self, bar: Sequence[_Slice], p: DepthParameters) -> bool:
        """Whether it is the next of ``bar``."""
        depth = float(np.median([one.depth for one in bar[-LAST:]]))
        return abs(self.column - bar[-1].column) <= STEP_PX and abs(self.depth - depth) <= p.jump


def _ends(depth: NDArray[np.float32], lens: Camera, p: DepthParameters) -> Iterator[Array]:
    """Ends (3,) in the camera's frame."""
    smooth = np.where(depth > 0.0, cv2.medianBlur(depth, 3), np.float32(0.0))
    # what was not measured is taken for far away
    sharp, near = (np.where(one > 0.0, one, np.float32(NOWHERE_MM)) for one in (depth, smooth))
    growing: list[list[_Slice]] = []
    for v, row in enumerate([*near, np.full_like(near[0], NOWHERE_MM)]):
        bars: list[list[_Slice]] = []
        for one in _slices(v, row, lens, p):
            onto = next((bar for bar in growing if one.follows(bar, p)), None)
            bars.append([one] if onto is None else [*onto, one])
            growing = [bar for bar in growing if bar is not onto]
        for bar in growing:
            if v < len(near) and v - bar[-1].row <= GAP_PX:
                bars.append(bar)
            elif (end := _end(bar, sharp, lens, p)) is not None:
                yield end
        growing = bars


def _slices(v: int, row: NDArray[np.float32], lens: Camera, p: DepthParameters) -> Iterator[_Slice]:
    """Pieces of a row, cut where depth jumps, that are as wide as a teat before something farther
    on both sides. Flying pixels beside them count half.
    """
    cuts = np.flatnonzero(np.abs(np.diff(row)) > p.jump) + 1
    first, after = np.append(0, cuts), np.append(cuts, len(row))
    whole = np.flatnonzero(after - first > FLYING_PX)
    for before, i, behind in zip(whole, whole[1:], whole[2:], strict=False):
        left, right = 0.5 * (after[before] + first[i]), 0.5 * (after[i] + first[behind])
        quarter = (after[i] - first[i]) // 4
        front = float(np.median(row[first[i] + quarter : after[i] - quarter]))
        beside = min(row[after[before] - 1], row[first[behind]])
        wide = (right - left) * front / lens.fc[0]
        if beside > front + p.farther and p.width[0] <= wide <= p.width[1]:
            yield _Slice(v, 0.5 * (left + right - 1.0), right - left, front)


def _end(
    bar: Sequence[_Slice], sharp: NDArray[np.float32], lens: Camera, p: DepthParameters
) -> Array | None:
    """The apex: of the axis the point one radius below the bar's upper edge, and a radius on. None
    for a bar that is short or goes on at its upper edge.
    """
    mm_per_px = bar[0].depth / lens.fc[1]
    row, column, width, depth = np.array(
        [astuple(one) for one in bar if one.row - bar[0].row <= p.used / mm_per_px]
    ).T
    edge = _upper_edge(sharp, bar[0], p)
    if edge is None or len(bar) * mm_per_px < p.least_bar:
        return None
    radius = 0.5 * float(np.median(width[len(width) // 3 :])) * mm_per_px
    shaft = row - edge > radius / mm_per_px
    if np.count_nonzero(shaft) < LEAST_SLICES:
        return None
    middles = _line(row[shaft], column[shaft])
    depths = _line(row[shaft], depth[shaft] + (1.0 - FRONT) * radius)
    rows = np.array([edge + radius / mm_per_px, row[-1]])
    columns, deep = (at + slope * rows for slope, at in (middles, depths))
    plane = lens.normalize(np.column_stack([columns, rows]))
    middle, below = deep[:, None] * homogeneous(plane)
    way = middle - below
    return np.asarray(middle + radius * way / np.linalg.norm(way))


def _upper_edge(sharp: NDArray[np.float32], top: _Slice, p: DepthParameters) -> float | None:
    """The row where a bar ends above its first slice's middle; None where nothing is farther."""
    edges, far = [], top.depth + p.farther
    for column in round(top.column) + np.array([-1, 0, 1]):
        up = sharp[top.row :: -1, column]
        on = int(np.argmax(np.append(up > far, True)))  # the first pixel that isn't the bar's
        steps = np.abs(np.diff(up[on:])) > p.farther
        if on == len(up) or on > GAP_PX + 1:
            return None  # it goes on
        off = on + int(np.argmin(np.append(steps, False)))  # the first that isn't flying
        edges.append(top.row - 0.5 * (on - 1 + off))
    return float(np.median(edges))


def _line(x: Array, y: Array) -> tuple[float, float]:
    """Slope, and value at 0, of a line that a few outliers don't move (Theil and Sen)."""
    one, other = np.triu_indices(len(x), 1)
    slope = float(np.median((y[other] - y[one]) / (x[other] - x[one])))
    return slope, float(np.median(y - slope * x))

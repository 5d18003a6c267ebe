"""Candidates for ends of upright warm bars in the thermal picture, many rather than few.

A bar's outline (two sides, round top) is laid over the gradient at every pixel, for several widths
and leans. Gradients saturate at a few times their noise, so no temperature threshold is needed. A
bar may lack a side, where teats touch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.geometry import Array, Camera, Motion
from detector.outline import kernels
from detector.outline.model import Rows
from detector.outline.pictures import median, steepness
from detector.outline.prior import Prior

Field = NDArray[np.float32]
_LEANS = (-0.7, -0.48, -0.28, -0.14, 0.0, 0.14, 0.28, 0.48, 0.7)
_ARC = np.radians([-65.0, -40.0, -15.0, 15.0, 40.0, 65.0])
_BELOW_PX = np.array([1.0, 4.0, 7.0, 10.0, 13.0, 16.0])
_BAR_LEANS = (-0.66, -0.44, -0.22, 0.0, 0.22, 0.44, 0.66)
_WIDER, _MOST_TIPS = 1.31, 250  # from one width that is tried to the next
ROOM_PX = 48  # of zeros about the gradients, for outlines beyond the picture
_APART_PX, _NARROWEST_PX = 4.0, 1.6
# strengths, 0 to 1
_STEEP, _LEAST_END, _LEAST_BAR = 0.35, 0.25, 0.45


@dataclass(frozen=True, slots=True)
class TeatTemplate:
    """Upright teats in a thermal picture: unit vector from end to base, half widths, sensor px."""

    down: tuple[float, float]
    half_widths_px: tuple[float, ...]

    @classmethod
    def of(
        cls, camera: Camera, camera_from_teats: Motion, depths_mm: tuple[float, float], prior: Prior
    ) -> Self:
        """By a camera of the sensor's pixels, teats ``depths_mm`` (2,) from it."""
        middle = float(np.sqrt(depths_mm[0] * depths_mm[1])) * np.array([0.0, 0.0, 1.0])
        way = camera_from_teats.R @ np.array([0.0, 1.0, 0.0])
        start, stop = camera.project(np.stack([middle, middle + 20.0 * way]))
        down = (stop - start) / np.linalg.norm(stop - start)
        least = max(camera.fc[0] * prior.radii_mm[0] / depths_mm[1], _NARROWEST_PX)
        most = max(camera.fc[0] * prior.radii_mm[1] / depths_mm[0], least)
        count = 1 + round(float(np.log(most / least) / np.log(_WIDER)))
        widths = np.geomspace(least, most, count)
        return cls((float(down[0]), float(down[1])), tuple(widths.tolist()))

    def turned(self, places: Array) -> Array:
        """Places (..., 2) across and along."""
        x, y = self.down
        return np.asarray(places @ np.array([[y, x], [-x, y]]))

    @property
    def rough(self) -> tuple[float, ...]:
        """Two widths and more that come near to all."""
        return self.half_widths_px[1::2]


@dataclass(frozen=True, slots=True, eq=False)
class Nominations(Rows):
    """Ends, sensor px: middle (n, 2), radius, lean (px across a px downwards), score, (n,) each."""

    centre_px: Array
    radius_px: Array
    lean: Array
    score: Array

    def __len__(self) -> int:
        return len(self.score)


_NONE = Nominations(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros(0))


def levels(temperature: Field) -> Array:
    """Of the surroundings, and of the warmest (2,): a fifth of a picture is cold at the least."""
    return np.asarray(np.percentile(temperature, [20, 99]))


def nominate(gradients: Field, most: int, sought: TeatTemplate) -> Nominations:
    """At most ``most`` ends, best first, by `strengths` of a picture in which warm is high, with a
    border of `ROOM_PX`.
    """
    inner, (x, y) = gradients[ROOM_PX:-ROOM_PX, ROOM_PX:-ROOM_PX], sought.down
    steep = np.abs(np.float32(x) * inner[..., 0] + np.float32(y) * inner[..., 1])
    beside = np.zeros((3, 3), dtype=np.uint8)
    column, row = round(x), round(y)
    beside[[1, 1 + row, 1 - row], [1, 1 + column, 1 - column]] = 1
    v, u = np.nonzero((steep > _STEEP) & (steep >= cv2.dilate(steep, beside) - 1e-6))
    if len(u) == 0:
        return _NONE
    tips = np.column_stack([u, v]).astype(np.float32)
    rough = _scores(True, gradients, tips, sought.rough, _BAR_LEANS, sought.down).max(axis=0)
    tips = tips[np.argsort(-rough, kind="stable")[:_MOST_TIPS]]
    scores = _scores(True, gradients, tips, sought.half_widths_px, _LEANS, sought.down)
    found = _best(tips, scores, sought.half_widths_px, _LEANS)
    down = bar_ways(found.lean, sought.down)[0]
    inside = replace(found, centre_px=tips + found.radius_px[:, None] * down)
    return inside.take(_peaks(tips, found.score, most, 3.0, _LEAST_END))


def bars(
    temperature: Field,
    gradients: Field,
    between: Array,
    ends: Nominations,
    most: int,
    sought: TeatTemplate,
    clear_end: float,
) -> Nominations:
    """At most ``most`` upright warm bars without an end of ``ends`` above ``clear_end``, by a
    picture, its `strengths` with a border of `ROOM_PX`, and its `levels`; `centre_px` is on the
    bar. For ends before something as warm, where only sides show.
    """
    low, high = between
    flat = abs(sought.down[0]) > abs(sought.down[1])
    every = np.s_[:, ::4] if flat else np.s_[::4]
    rows, columns = np.nonzero(temperature[every] > low + 0.4 * (high - low))
    if len(rows) == 0 or high <= low:
        return _NONE
    at = np.column_stack([columns, rows]).astype(np.float32)
    at[:, 0 if flat else 1] *= 4
    middles = sought.turned(ends.centre_px)
    clear = [(middles[i], ends.lean[i]) for i in np.flatnonzero(ends.score > clear_end)]
    for middle, lean in clear:
        at = at[_beside(sought.turned(at.astype(np.float64)).T, 0.0, middle, lean) > _APART_PX]
    if len(at) == 0:
        return _NONE
    scores = _scores(False, gradients, at, sought.half_widths_px, _BAR_LEANS, sought.down)
    found = _best(at, scores, sought.half_widths_px, _BAR_LEANS)
    centres = sought.turned(found.centre_px)
    order = np.argsort(-found.score, kind="stable")
    order = order[found.score[order] > _LEAST_BAR]

    def beside(middle: Array, lean: float) -> NDArray[np.intp]:
        """Of the order, what is beside such a bar."""
        apart = _beside(centres[order].T, found.lean[order], middle, lean)
        return order[apart > _APART_PX]

    for middle, lean in clear:
        order = beside(middle, lean)
    kept: list[int] = []
    while len(order) and len(kept) < most:
        kept.append(int(order[0]))
        order = beside(centres[kept[-1]], found.lean[kept[-1]])
    return found.take(np.array(kept, dtype=np.intp))


def unexplained(
    temperature: Field,
    between: Array,
    ends: Nominations,
    feet_px: Array,
    tips_px: Array,
    sought: TeatTemplate,
    least: float,
) -> Array:
    """Which ends (k, 2) above ``least`` lie on no bar from ``tips_px`` to ``feet_px`` (k, 2)."""
    feet_px, tips_px = sought.turned(feet_px), sought.turned(tips_px)
    way = tips_px - feet_px
    bars_seen = list(zip(0.5 * (tips_px + feet_px), (way[:, 0] / way[:, 1]).tolist(), strict=True))
    low, high = between
    places = ends.centre_px + 8.0 * bar_ways(ends.lean, sought.down)[0]
    rows, columns = np.rint(places).astype(int).T[::-1]
    size = temperature.shape
    warm = temperature[rows.clip(0, size[0] - 1), columns.clip(0, size[1] - 1)]
    middles, found = sought.turned(places), list[Array]()
    # the gap between two teats below an arm has a bar's outline too
    for i in np.flatnonzero((ends.score > least) & (warm >= low + 0.6 * (high - low))):
        middle, lean = middles[i], ends.lean[i]
        if all(
            _beside(middle, lean, other, slope) > 1.2 * ends.radius_px[i]
            for other, slope in bars_seen
        ):
            bars_seen.append((middle, lean))
            found.append(ends.centre_px[i])
    return np.array(found).reshape(-1, 2)


def _beside(a: Array, lean_a: Array | float, b: Array, lean_b: float) -> Array:
    """Distance across two bars half way between their middles, px; ``a`` may be many, (2, n)."""
    half = 0.5 * (b[1] - a[1])
    return np.asarray(np.abs((a[0] + lean_a * half) - (b[0] - lean_b * half)))


def _best(
    at: Field, scores: Array, widths: tuple[float, ...], leans: tuple[float, ...]
) -> Nominations:
    """The best of the shapes (width by lean, n) at each place."""
    shape = scores.argmax(axis=0)
    width, lean = np.repeat(widths, len(leans))[shape], np.tile(leans, len(widths))[shape]
    return Nominations(
        at.astype(np.float64), width, lean, np.asarray(scores.max(axis=0), dtype=np.float64)
    )


def strengths(picture: Field, blur_px: float = 0.8, noises: float = 4.0, border: int = 0) -> Field:
    """Gradients (rows, columns, 2), each length squeezed below 1; one half at ``noises`` times the
    noise's. With a ``border`` of zeros.
    """
    smooth: Field = np.asarray(cv2.GaussianBlur(picture, (0, 0), blur_px), dtype=np.float32)
    steep = steepness(smooth)
    rows, columns = smooth.shape
    found = np.zeros((rows + 2 * border, columns + 2 * border, 2), dtype=np.float32)
    kernels.squeezed(smooth, np.float32(max(noises * median(steep), 1e-6)), border, found)
    return found


def _scores(
    end: bool,
    gradients: Field,
    at: Field,
    widths: tuple[float, ...],
    leans: tuple[float, ...],
    down: tuple[float, float],
) -> Array:
    """Scores (shapes, n) of bars of each half width px and lean with their tips, for ``end``, or
    above their sides at whole pixels ``at`` (n, 2).
    """
    columns, every = gradients.shape[1], gradients.reshape(-1, 2)
    whole = at.astype(np.intp) + ROOM_PX
    start = whole[:, 1] * columns + whole[:, 0]
    found = []
    for width in widths:
        off, normals = _shapes(end, width, leans, down)
        flat = off[..., 1] * columns + off[..., 0]
        found.append(np.zeros((*off.shape[:2], len(start)), dtype=np.float32))
        kernels.along_shapes(every, start, flat, normals, end, found[-1])
    left, right, *top = np.concatenate(found).swapaxes(0, 1)
    if not end:
        return np.asarray(np.minimum(-left, -right))
    # a bar may lack a side, but not its end
    return np.asarray(top[0] * (0.7 * np.maximum(left, right) + 0.3 * np.minimum(left, right)))


def bar_ways(lean: Array | float, down: tuple[float, float]) -> tuple[Array, Array]:
    """Unit vectors (..., 2) down bars of such leans, and to their right."""
    x, y = down
    columns, rows = x + lean * y, y - lean * x
    way = np.stack([columns, rows], axis=-1)
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    return way, np.stack([way[..., 1], -way[..., 0]], axis=-1)


@cache
def _shapes(
    end: bool, width: float, leans: tuple[float, ...], upright: tuple[float, float]
) -> tuple[NDArray[np.intp], Field]:
    """Places (leans, parts, 6, 2), whole px from a bar's tip or middle, and the outward normals
    there, of its two sides and for ``end`` of its round end.
    """
    down, right = (way[:, None] for way in bar_ways(np.array(leans), upright))
    below = ((width if end else 0.0) + _BELOW_PX)[:, None] * down
    normals = [np.repeat(s * right, 6, axis=1) for s in (-1.0, 1.0)]
    places = [below + s * width * right for s in (-1.0, 1.0)]
    if end:
        arc = -np.cos(_ARC)[:, None] * down + np.sin(_ARC)[:, None] * right
        normals, places = [*normals, arc], [*places, width * (down + arc)]
    return np.rint(np.stack(places, 1)).astype(np.intp), np.stack(normals, 1).astype(np.float32)


def _peaks(tips: Field, score: Array, most: int, apart_px: float, least: float) -> NDArray[np.intp]:
    """Indices of at most ``most`` tips, best first, none within ``apart_px`` of a better one."""
    order = np.argsort(-score, kind="stable")
    order = order[score[order] > least]
    kept: list[int] = []
    while len(order) and len(kept) < most:
        kept.append(int(order[0]))
        order = order[np.hypot(*(tips[order] - tips[order[0]]).T) > apart_px]
    return np.array(kept, dtype=np.intp)

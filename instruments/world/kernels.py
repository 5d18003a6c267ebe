"""The renderer's hot loops, compiled by numba when this module is imported, and kept on disk.

They are written out in numpy's order of operations, and without fast mathematics: a picture is the
same to the bit wherever it is drawn. What is kept is as old as this file, so one file has all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Ints = NDArray[np.intp]
Loop = TypeVar("Loop", bound=Callable[..., Any])


def _compiled(signature: str) -> Callable[[Loop], Loop]:
    def compiled(loop: Loop) -> Loop:
        how: dict[str, Any] = {"error_model": "numpy", "nogil": True}
        try:
            return cast("Loop", numba.njit(signature, cache=True, **how)(loop))
        except RuntimeError:  # no folder for it may be written: each process compiles anew
            return cast("Loop", numba.njit(signature, **how)(loop))

    return compiled


STEP_PX = 8.0  # longest straight piece of an outline: the lens bends it by less than 1e-4 px
MARGIN_PX = 16.0  # beyond the image, where outlines are cut off; more than STEP_PX
NEARLY_ALL = 1.0 - 1e-9
NOTHING = 1e-4  # less cover than this is no cover


@_compiled("Tuple((i8[::1], f8[:, ::1]))(i8[::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[::1])")
def distorted(
    counts: Ints, corners: Floats, lens: Floats, window: Floats, size: Floats
) -> tuple[Ints, Floats]:
    """Closed outlines of ``counts`` corners (n, 2) in the ideal plane, in pieces of STEP_PX, those
    near the image kept: how many pieces each, and their starts (m, 2) as the lens puts them, from
    the first pixel's corner, px.
    """
    fx, fy, cx, cy, skew, k1, k2, p1, p2, k3 = lens
    pieces = np.empty(len(corners), np.int64)
    parts = np.empty(len(counts), np.int64)
    first = 0
    for i in range(len(counts)):
        stop, parts[i] = first + counts[i], 0
        for j in range(first, stop):
            after = j + 1 if j + 1 < stop else first
            x = (corners[after, 0] - corners[j, 0]) * fx
            y = (corners[after, 1] - corners[j, 1]) * fy
            pieces[j] = int(max(np.ceil(np.sqrt(x * x + y * y) / STEP_PX), 1.0))
            parts[i] += pieces[j]
        first = stop
    points = np.empty((parts.sum(), 2))
    first, at = 0, 0
    for i in range(len(counts)):
        stop = first + counts[i]
        for j in range(first, stop):
            after = j + 1 if j + 1 < stop else first
            step_x = (corners[after, 0] - corners[j, 0]) / pieces[j]
            step_y = (corners[after, 1] - corners[j, 1]) / pieces[j]
            for part in range(pieces[j]):
                x = min(max(corners[j, 0] + part * step_x, window[0, 0]), window[1, 0])
                y = min(max(corners[j, 1] + part * step_y, window[0, 1]), window[1, 1])
                r2 = x * x + y * y
                radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
                v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
                u, v = fx * (u + skew * v) + cx, fy * v + cy
                points[at, 0] = min(max(u + 0.5, -MARGIN_PX), size[0] + MARGIN_PX)
                points[at, 1] = min(max(v + 0.5, -MARGIN_PX), size[1] + MARGIN_PX)
                at += 1
        first = stop
    return parts, points


@_compiled("Tuple((i8[:, ::1], f8[::1]))(i8[::1], f8[:, ::1], i8, i8)")
def areas(counts: Ints, points: Floats, wide: int, tall: int) -> tuple[Ints, Floats]:
    """Which share of each pixel closed outlines of ``counts`` points (n, 2) cover: (3, m) outline,
    row, column, and shares (m,), by outline. Signed areas in windows; their rows sum to zero.
    """
    runs = np.empty((len(counts), 4), np.int64)
    cells, first = 0, 0
    for i in range(len(counts)):
        low_x = low_y = np.inf
        high_x = high_y = -np.inf
        for j in range(first, first + counts[i]):
            low_x, high_x = min(low_x, points[j, 0]), max(high_x, points[j, 0])
            low_y, high_y = min(low_y, points[j, 1]), max(high_y, points[j, 1])
        first += counts[i]
        left, top = int(np.floor(low_x)), int(np.floor(low_y))
        runs[i, 0], runs[i, 1] = left, top
        runs[i, 2] = int(np.floor(high_x)) - left + 2
        runs[i, 3] = int(np.floor(high_y)) - top + 1
        cells += runs[i, 2] * runs[i, 3]
    change, spill = np.zeros(cells + 1), np.zeros(cells + 1)
    offset, first = 0, 0
    for i in range(len(counts)):
        stop, width = first + counts[i], runs[i, 2]
        base = offset - runs[i, 1] * width - runs[i, 0]
        for j in range(first, stop):
            after = j + 1 if j + 1 < stop else first
            x, y = points[j, 0], points[j, 1]
            way_x, way_y = points[after, 0] - x, points[after, 1] - y
            # lines between pixels that it crosses, in its order, with where along it, 0 to 1
            low_x, low_y = np.floor(min(x, points[after, 0])), np.floor(min(y, points[after, 1]))
            left_x = int(max(np.ceil(max(x, points[after, 0])) - low_x - 1.0, 0.0))
            left_y = int(max(np.ceil(max(y, points[after, 1])) - low_y - 1.0, 0.0))
            turn_x, turn_y = 1.0 if way_x > 0.0 else -1.0, 1.0 if way_y > 0.0 else -1.0
            line_x = low_x + (1.0 if way_x > 0.0 else left_x)
            line_y = low_y + (1.0 if way_y > 0.0 else left_y)
            here_x, here_y, last = x, y, False
            while not last:
                part_x = min((line_x - x) / way_x, NEARLY_ALL) if left_x else np.inf
                part_y = min((line_y - y) / way_y, NEARLY_ALL) if left_y else np.inf
                if left_x and part_x <= part_y:
                    part, left_x, line_x = part_x, left_x - 1, line_x + turn_x
                elif left_y:
                    part, left_y, line_y = part_y, left_y - 1, line_y + turn_y
                else:
                    part, last = 1.0, True
                part = (j + part) - j  # as exact as numbers that order all crossings by outline
                there_x = points[after, 0] if last else x + part * way_x
                there_y = points[after, 1] if last else y + part * way_y
                middle = 0.5 * (here_x + there_x)
                column = np.floor(middle)
                row = np.floor(0.5 * (here_y + there_y))
                cell = base + int(row) * width + int(column)
                rise = there_y - here_y
                right = rise * (middle - column)
                change[cell] += rise - right
                spill[cell + 1] += right
                here_x, here_y = there_x, there_y
        offset += width * runs[i, 3]
        first = stop
    share, count = 0.0, 0
    for cell in range(cells):
        share += change[cell] + spill[cell]
        change[cell] = min(abs(share), 1.0)
        count += change[cell] > NOTHING
    places, shares = np.empty((3, count), np.int64), np.empty(count)
    cell, at = 0, 0
    for i in range(len(counts)):
        for row in range(runs[i, 1], runs[i, 1] + runs[i, 3]):
            for column in range(runs[i, 0], runs[i, 0] + runs[i, 2]):
                inside = 0 <= row < tall and 0 <= column < wide
                if inside and change[cell] > NOTHING:
                    places[0, at], places[1, at], places[2, at] = i, row, column
                    shares[at] = change[cell]
                    at += 1
                cell += 1
    return places[:, :at].copy(), shares[:at].copy()

"""Ends of vertical lines (section 4.1.5, appendix A.2.2): segments of the vertical order filter become at most eight lines.

Strategy: the original merges columns pair by pair, in place, in an order that matters. The same steps are taken here on runs of equal
columns instead of single pixels, which gives the same outcome in a hundredth of the time. Pixels are counted from 0; every step is
unchanged by that shift. The module may not know what comes of the lines.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from detector.geometry import Array
from detector.thesis.canny import Mask
from detector.thesis.parameters import Parameters

Run = tuple[int, int]  # a column, and how many successive points have it


def half_up(value: float) -> int:
    """Matlab's round() for what isn't negative: halves go up."""
    return int(np.floor(value + 0.5))


def vertical_ends(mask: Mask, p: Parameters) -> Array:
    """Upper ends (n, 2) px (column, row) of the vertical lines in the order-filtered mask, by column; the highest eight at most.

    A line is a merged column with at least 35 points; its end is its highest point. None gives (0, 2), where the original stopped
    with an error. The original's `countelement` is lost: it is taken to count each value, in rising order.
    """
    columns, rows = np.nonzero(mask.T)  # by column, then by row, as Matlab's find()
    merged = np.array(merge_columns(columns.tolist(), p.vertical_merge_px), dtype=np.int64)
    values, counts = np.unique(merged, return_counts=True)
    lines = values[counts >= p.vertical_least_points]
    if len(lines) == 0:
        return np.empty((0, 2))
    ends = np.column_stack([lines, [rows[merged == line].min() for line in lines]])
    highest = ends[np.argsort(ends[:, 1], kind="stable")][: p.vertical_most_lines]
    return highest[np.argsort(highest[:, 0], kind="stable")].astype(np.float64)


def window_centre(ends: Array) -> tuple[int, int]:
    """The rounded mean (column, row) of the vertical ends (n, 2): where the teat ends are looked for (appendix A.1)."""
    x, y = ends.mean(axis=0)
    return half_up(float(x)), half_up(float(y))


def merge_columns(columns: Sequence[int], reach: int) -> list[int]:
    """The columns once each point in turn has drawn those within `reach` of it to the rounded mean of both, and moved there itself.

    The listing's double loop: for each i, for each j: if |x_i - x_j| <= reach, both become round((x_i + x_j) / 2).
    """
    runs = list(_runs(columns))
    done = 0
    while done < len(columns):
        at, offset = _locate(runs, done)
        column, count = runs[at]
        if any(0 < abs(other - column) <= reach for other, _ in runs):
            runs = _draw(runs, at, offset, reach)
            done += 1
        else:
            done += count - offset  # nothing is in reach of this column: its other points change nothing either
    return [column for column, count in runs for _ in range(count)]


def _draw(runs: list[Run], at: int, offset: int, reach: int) -> list[Run]:
    """One turn of the outer loop, for the point `offset` points into run `at`."""
    here, count = runs[at]
    mine = here
    before: list[Run] = []
    after: list[Run] = []
    for column, many in [*runs[:at], (here, offset)]:
        mine = _meet(before, mine, column, many, reach)
    for column, many in [(here, count - offset - 1), *runs[at + 1 :]]:
        mine = _meet(after, mine, column, many, reach)
    result: list[Run] = []
    for column, many in [*before, (mine, 1), *after]:
        _append(result, column, many)
    return result


def _meet(result: list[Run], mine: int, column: int, many: int, reach: int) -> int:
    """Let `many` points of one column pass the point at `mine`; appends where they end up, returns where the point does."""
    while many and column != mine and abs(column - mine) <= reach:
        middle = (mine + column + 1) // 2
        taken = many if middle == mine else 1  # once the point no longer moves, all the others follow it
        _append(result, middle, taken)
        mine, many = middle, many - taken
    _append(result, column, many)
    return mine


def _append(runs: list[Run], column: int, count: int) -> None:
    if count and runs and runs[-1][0] == column:
        runs[-1] = (column, runs[-1][1] + count)
    elif count:
        runs.append((column, count))


def _locate(runs: list[Run], point: int) -> tuple[int, int]:
    for at, (_, count) in enumerate(runs):
        if point < count:
            return at, point
        point -= count
    raise IndexError(f"point {point} lies beyond the last run")


def _runs(columns: Sequence[int]) -> Iterator[Run]:
    start = 0
    for i in range(1, len(columns) + 1):
        if i == len(columns) or columns[i] != columns[start]:
            yield columns[start], i - start
            start = i

"""Shares as bars with their counts, and slopes with intervals. A share of nothing is "not
measured".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from reports.figures.drawing import (
    COLOURS,
    HALF_INCHES,
    WIDE_INCHES,
    draw,
    legend,
    not_measured,
    plain,
)


def found_bars(
    situations: Sequence[str],
    found: Sequence[int],
    present: Sequence[int],
    thesis_found: Sequence[int | None],
    *,
    thesis_present: int = 4,
    name: str = "found-bars",
) -> str:
    """Share found in each situation, ours over the thesis's (None: no figure), with counts."""
    if not len(situations) == len(found) == len(present) == len(thesis_found):
        lengths = (
            f"{len(situations)} situations, {len(found)} found, {len(present)} present,"
            f" {len(thesis_found)} of the thesis"
        )
        raise ValueError(f"found_bars: {lengths}; the lengths differ")
    inches = (HALF_INCHES, 0.9 + 0.52 * max(len(situations), 3))
    if not situations:
        return not_measured(name, inches, "no situation was run")

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot()
        for row, (ours, of, theirs) in enumerate(zip(found, present, thesis_found, strict=True)):
            _share_bar(axes, row - 0.2, ours, of, "ours")
            if theirs is not None:
                _share_bar(axes, row + 0.2, theirs, thesis_present, "theirs")
        axes.set(
            xlim=(0, 1.28),
            xlabel="share of visible teats found",
            ylim=(len(situations) - 0.45, -0.55),
        )
        axes.set_yticks(range(len(situations)), [plain(text) for text in situations])
        axes.set_xticks([0, 0.25, 0.5, 0.75, 1])
        axes.xaxis.set_major_formatter(PercentFormatter(1))
        axes.tick_params(axis="y", length=0)
        axes.grid(visible=False, axis="y")
        legend(figure, [("this run", "ours", "patch"), ("thesis, section 5.2", "theirs", "patch")])

    return draw(name, inches, plot)


def _share_bar(axes: Axes, y: float, found: int, of: int, role: str) -> None:
    if of:
        axes.barh(y, found / of, height=0.36, color=COLOURS[role])
    text = f"{found} of {of}" if of else "not measured"
    axes.text((found / of if of else 0) + 0.02, y, text, va="center", color=COLOURS[role])


@dataclass(frozen=True, slots=True)
class Slope:
    """A line: quantity, response, effect over the range, interval; ``shown``: significant."""

    against: str
    response: str
    value: float
    low: float
    high: float
    shown: bool


def slope_intervals(
    slopes: Sequence[Slope], unit: str = "mm", *, name: str = "slope-intervals"
) -> str:
    """A panel a response, a row a question, with intervals. Raises ValueError if not finite."""
    bad = [
        slope.against
        for slope in slopes
        if not all(map(isfinite, (slope.value, slope.low, slope.high)))
    ]
    if bad:
        raise ValueError(
            f"slope_intervals: {bad[0]} is not finite; leave out what was not measured"
        )
    rows = list(dict.fromkeys(slope.against for slope in slopes))
    panels = list(dict.fromkeys(slope.response for slope in slopes))
    if not rows:
        return not_measured(name, (WIDE_INCHES, 2.0), "no line was drawn through the errors")

    def plot(figure: Figure) -> None:
        reach = 1.1 * max(1e-6, *(max(abs(slope.low), abs(slope.high)) for slope in slopes))
        for axes, panel in zip(
            figure.subplots(1, len(panels), sharey=True, squeeze=False)[0], panels, strict=True
        ):
            axes.axvline(0, color=COLOURS["muted"], linewidth=0.8)
            for slope in (one for one in slopes if one.response == panel):
                y, colour = rows.index(slope.against), COLOURS["limit" if slope.shown else "ours"]
                axes.plot([slope.low, slope.high], [y, y], color=colour, linewidth=1.4)
                axes.plot(
                    [slope.value],
                    [y],
                    color=colour,
                    marker="D" if slope.shown else "o",
                    markersize=4.5,
                    markeredgewidth=0,
                )
            axes.set(
                xlim=(-reach, reach),
                ylim=(len(rows) - 0.5, -0.5),
                xlabel=f"{plain(panel)} ({unit})",
            )
            axes.set_yticks(np.arange(len(rows)), [plain(row) for row in rows])
            axes.tick_params(axis="y", length=0)
            axes.grid(visible=False, axis="y")
        legend(
            figure, [("no trend shown, 95 % interval", "ours", "o"), ("trend shown", "limit", "D")]
        )

    return draw(name, (WIDE_INCHES, 0.9 + 0.28 * max(len(rows), 3)), plot)

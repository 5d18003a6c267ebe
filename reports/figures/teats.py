"""Errors teat by teat, as boxes, and in the order of time. Knows only millimetres, minutes and names."""

from collections.abc import Sequence

import numpy as np
from matplotlib import cbook
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from reports.figures.arrays import finite, together
from reports.figures.drawing import COLOURS, HALF_INCHES, LegendEntry, draw, legend, not_measured, plain
from reports.figures.thinning import telling

_HIGH = 3.6
_MOST_BEYOND = 60  # points beyond the whiskers of a box


def teat_boxes(teats: Sequence[str], errors_mm: Sequence[ArrayLike], limit_mm: float, *, name: str = "teat-boxes") -> str:
    """Radial errors of each teat, (n_k,): quartiles and median as a box, whiskers to 1.5 quartile ranges, points beyond; counts below."""
    if len(teats) != len(errors_mm):
        raise ValueError(f"teat_boxes: {len(teats)} teats for {len(errors_mm)} arrays; give one array a teat")
    arrays = [finite("teat_boxes", f"errors_mm[{k}]", errors).ravel() for k, errors in enumerate(errors_mm)]
    if not any(array.size for array in arrays):
        return not_measured(name, (HALF_INCHES, _HIGH), "no teat end was paired with a truth")

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot()
        places = [k for k, array in enumerate(arrays) if array.size]
        line = {"color": COLOURS["ours"], "linewidth": 1.1}
        boxes = [cbook.boxplot_stats(arrays[k])[0] for k in places]
        for box in boxes:
            box["fliers"] = box["fliers"][telling(box["fliers"], _MOST_BEYOND)]
        axes.bxp(
            boxes, positions=places, widths=0.5, patch_artist=True,
            boxprops={"facecolor": COLOURS["span"], "edgecolor": COLOURS["ours"], "linewidth": 1.1}, whiskerprops=line, capprops=line,
            medianprops={"color": COLOURS["ink"], "linewidth": 1.6},
            flierprops={"marker": "o", "markersize": 3, "markerfacecolor": COLOURS["ours"], "markeredgewidth": 0},
        )  # fmt: skip
        axes.axhline(limit_mm, color=COLOURS["limit"], linewidth=1.2)
        axes.set(xlim=(-0.6, len(teats) - 0.4), ylim=(0, None), ylabel="distance to the teat end (mm)")
        axes.set_xticks(range(len(teats)), [f"{plain(teat, 12)}\nn = {array.size}" for teat, array in zip(teats, arrays, strict=True)])
        axes.grid(visible=False, axis="x")
        entries: list[LegendEntry] = [("middle half", "span", "patch"), ("median", "ink", "-"), (f"limit {limit_mm:g} mm", "limit", "-")]
        legend(figure, entries)

    return draw(name, (HALF_INCHES, _HIGH), plot)


def error_drift(
    time_min: ArrayLike, error_mm: ArrayLike, limit_mm: float, *, links: Sequence[str] | None = None, name: str = "error-drift"
) -> str:
    """Radial errors (n,) over the time of their capture (n,), with the line of least squares; `links` as of the scatter."""
    time, errors = together("error_drift", time_min=time_min, error_mm=error_mm)
    if links is not None and len(links) != time.size:
        raise ValueError(f"error_drift: {len(links)} links for {time.size} points; give one a point")
    if not time.size:
        return not_measured(name, (HALF_INCHES, _HIGH), "no teat end was paired with a truth")

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot()
        drawn = telling(errors)
        points = axes.scatter(time[drawn], errors[drawn], s=16, color=COLOURS["ours"], alpha=0.7, linewidths=0)
        if links is not None:
            points.set_urls([links[index] for index in drawn])
        entries: list[LegendEntry] = [("one teat end", "ours", "o")]
        if np.ptp(time) > 0:
            slope, level = np.polyfit(time - time.mean(), errors, 1)
            ends = np.array([time.min(), time.max()])
            axes.plot(ends, level + slope * (ends - time.mean()), color=COLOURS["ink"], linewidth=1.4)
            entries.append((f"line: {slope * np.ptp(time):+.2f} mm over the run", "ink", "-"))
        axes.axhline(limit_mm, color=COLOURS["limit"], linewidth=1.2)
        axes.set(ylim=(0, 1.1 * max(limit_mm, float(errors.max()))), xlabel="time of the capture (min)", ylabel="distance (mm)")
        legend(figure, [*entries, (f"limit {limit_mm:g} mm", "limit", "-")])

    return draw(name, (HALF_INCHES, _HIGH), plot)

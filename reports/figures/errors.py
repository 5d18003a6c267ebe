"""Errors as plots: two runs against each other, the cloud with its limit circle, the histogram,
strips of each axis, boxes by teat, and drift. In millimetres and minutes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import cbook
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, PercentFormatter
from numpy.typing import ArrayLike

from reports.figures.drawing import (
    COLOURS,
    HALF_INCHES,
    MOST_POINTS,
    MOST_STEPS,
    NO_PAIR,
    THIRD_INCHES,
    WIDE_INCHES,
    Floats,
    LegendEntry,
    Plot,
    circle,
    count_text,
    cross_and_circle,
    detector_look,
    finite,
    legend,
    limits,
    linked,
    marks,
    plain,
    plotted,
    row_names,
    subsample,
    together,
)

_SQUARE = (HALF_INCHES, 4.2)
_FLAT = (HALF_INCHES, 3.6)
_THIRD = (THIRD_INCHES, 3.5)
_MOST_BEYOND = 60  # points beyond the whiskers of a box


@plotted
def change_scatter(
    old_mm: ArrayLike, new_mm: ArrayLike, limit_mm: float, *, name: str = "change-scatter"
) -> Plot:
    """Errors of the same scenes before and now (n,); above the diagonal it grew worse."""
    old, new = together("change_scatter", old_mm=old_mm, new_mm=new_mm)
    figure = yield name, _SQUARE, "" if old.size else "no scene was found in both"
    axes = figure.add_subplot(aspect="equal")
    reach = 1.08 * max(limit_mm, float(old.max()), float(new.max()))
    axes.set(xlim=(0, reach), ylim=(0, reach), xlabel="baseline (mm)", ylabel="this run (mm)")
    axes.plot([0, reach], [0, reach], color=COLOURS["muted"], linewidth=0.8)
    axes.axhline(limit_mm, color=COLOURS["limit"], linewidth=1)
    axes.axvline(limit_mm, color=COLOURS["limit"], linewidth=1)
    drawn = subsample(np.abs(new - old))
    for grown, role in ((new > old, "limit"), (new <= old, "good")):
        linked(axes, old, new, drawn[grown[drawn]], role=role, alpha=0.75)
    grew: list[LegendEntry] = [("grew", "limit", "o"), ("not grown", "good", "o")]
    legend(figure, [*grew, ("no change", "muted", "-"), *limits(limit_mm)])


@plotted
def change_by_situation(
    situations: Sequence[str],
    right: Sequence[tuple[int, int, int]],
    change_mm: Sequence[tuple[float, float, float] | None],
    margin_mm: float,
    *,
    called: tuple[str, str],
    who: tuple[int, int],
    name: str = "change-by-situation",
) -> Plot:
    """Of each situation the poses right (old, new, of) as shares, and beside it the change of the
    mean distance (mean, low, high) with the margin; None where no teat was found by both. ``who``:
    the places of both detectors; of two versions of one, the old one is grey.
    """
    known = finite("change_by_situation", "change_mm", [c for c in change_mm if c is not None])
    inches = (WIDE_INCHES, 1.1 + 0.28 * max(len(situations), 2))
    looks = [*map(detector_look, who)]
    if who[0] == who[1]:
        looks[0] = ("muted", looks[0][1])
    figure = yield name, inches, ""
    poses, distance = figure.subplots(1, 2, sharey=True)
    for y, (old, new, of) in enumerate(right):
        shares = [old / of, new / of] if of else []
        poses.plot(shares, [y] * len(shares), color=COLOURS["grid"], linewidth=3)
        for share, (role, form), size in zip(shares, looks, (6.5, 4.5), strict=False):
            marks(poses, [share], [y], role, size, form)
    poses.set(xlim=(-0.03, 1.03), xlabel="poses right")
    poses.xaxis.set_major_formatter(PercentFormatter(1, decimals=0, symbol=" %"))
    distance.axvline(0, color=COLOURS["muted"], linewidth=0.8)
    distance.axvline(margin_mm, color=COLOURS["limit"], linewidth=1, linestyle="--")
    for y, change in enumerate(change_mm):
        if change is None:
            distance.annotate(
                "no teat found by both", (0.02, y), xycoords=("axes fraction", "data"),
                va="center", color=COLOURS["muted"],
            )  # fmt: skip
            continue
        mean, low, high = change
        distance.plot([low, high], [y, y], color=COLOURS["ink"], linewidth=1.4)
        marks(distance, [mean], [y], "ink", 4.5)
    reach = 1.1 * max([4 * margin_mm, 1e-3, *np.abs(known).ravel()])
    distance.set(xlim=(-reach, reach), xlabel="change of the mean distance (mm); left: nearer")
    for axes in (poses, distance):
        row_names(axes, situations)
    sides: list[LegendEntry] = [
        (plain(text, 40), *look) for text, look in zip(called, looks, strict=True)
    ]
    legend(figure, [*sides, ("change", "ink", "o"), ("margin", "limit", "--")])


@plotted
def error_scatter(
    lateral_mm: ArrayLike,
    depth_mm: ArrayLike,
    limit_mm: float,
    *,
    accept_mm: float | None = None,
    links: Sequence[str] | None = None,
    who: int = 0,
    name: str = "error-scatter",
) -> Plot:
    """Error across (n,) against error along the viewing axis (n,), equal scales, with both limits
    as circles. `links` open on a click; `who`: the detector's place.
    """
    across, along = together("error_scatter", lateral_mm=lateral_mm, depth_mm=depth_mm)
    figure = yield name, _THIRD, "" if across.size else NO_PAIR
    axes = figure.add_subplot(aspect="equal")
    reach = 1.12 * max(limit_mm, float(np.abs(across).max()), float(np.abs(along).max()))
    axes.set(xlabel="lateral error (mm)", ylabel="depth error (mm)")
    cross_and_circle(axes, reach, limit_mm, 1.4)
    if accept_mm is not None:
        circle(axes, accept_mm, "accept", linewidth=1, linestyle="--")
    drawn = subsample(np.hypot(across, along))
    role, form = detector_look(who)
    linked(axes, across, along, drawn, links, role=role, marker=form, alpha=0.7)
    legend(figure, [("one teat end", role, form), *limits(limit_mm, accept_mm)])
    if len(drawn) < across.size:
        left_out = count_text(len(drawn), across.size)
        axes.set_title(left_out, loc="left", color=COLOURS["muted"])


@plotted
def error_histogram(
    errors_mm: ArrayLike,
    limit_mm: float,
    *,
    accept_mm: float | None = None,
    who: int = 0,
    name: str = "error-histogram",
) -> Plot:
    """Radial errors (n,) in bins of at most a tenth of the limit, cumulative share, limit."""
    errors = finite("error_histogram", "errors_mm", errors_mm)
    figure = yield name, _SQUARE, "" if errors.size else NO_PAIR
    axes = figure.add_subplot()
    reach = 1.12 * max(limit_mm, float(errors.max()))
    bins = np.linspace(0, reach, 23).tolist()
    axes.hist(errors, bins, color=COLOURS[detector_look(who)[0]], edgecolor=COLOURS["grid"])
    axes.set(xlim=(0, reach), xlabel="radial error (mm)", ylabel="teat ends")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    share = axes.twinx()
    ordered = np.sort(errors)
    at = np.unique(np.linspace(0, errors.size - 1, MOST_STEPS).round().astype(np.intp))
    steps = (np.r_[0, ordered[at], reach], np.r_[0, (at + 1) / errors.size, 1])
    share.step(*steps, where="post", color=COLOURS["ink"])
    share.set(ylim=(0, 1.1), ylabel="share at or below")
    share.yaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
    share.grid(visible=False)
    share.axvline(limit_mm, color=COLOURS["limit"], linewidth=1.2)
    if accept_mm is not None:
        share.axvline(accept_mm, color=COLOURS["accept"], linestyle="--", linewidth=1)
    bars: LegendEntry = ("teat ends", detector_look(who)[0], "patch")
    legend(figure, [bars, ("cumulative", "ink", "-"), *limits(limit_mm, accept_mm)])


@plotted
def per_axis_errors(
    situations: Sequence[str],
    errors_mm: Sequence[ArrayLike],
    limit_mm: float,
    *,
    point: str = "one teat end",
    bound: str = "limit",
    who: int = 0,
    name: str = "per-axis-errors",
) -> Plot:
    """Signed errors of each situation (n_k, 3) mm: points, mean, limits; a panel an axis. `point`
    and `bound` are what the legend calls a point and the limit.
    """
    arrays = [finite("per_axis_errors", "errors_mm", one).reshape(-1, 3) for one in errors_mm]
    inches = (WIDE_INCHES, 0.9 + 0.3 * max(len(situations), 3))
    figure = yield name, inches, "" if any(array.size for array in arrays) else NO_PAIR
    panels = figure.subplots(1, 3, sharex=True, sharey=True)
    reach = 1.1 * max(limit_mm, *(float(np.abs(array).max()) for array in arrays if array.size))
    each = max(20, MOST_POINTS // (len(arrays) + 1))
    for axis, panel in enumerate(panels):
        panel.axvline(0, color=COLOURS["muted"], linewidth=0.6)
        for side in (-limit_mm, limit_mm):
            panel.axvline(side, color=COLOURS["limit"], linewidth=1)
        for row, array in enumerate(arrays):
            _strip(panel, row, array[:, axis], each, who)
        panel.set(xlim=(-reach, reach), xlabel=f"{'xyz'[axis]} error (mm)")
        row_names(panel, situations)
    every = all(len(array) <= each for array in arrays)
    points = f"teat ends, at most {each} drawn, the worst among them"
    shown: LegendEntry = (point if every else points, *detector_look(who))
    limit: LegendEntry = (f"{bound} ± {limit_mm:.3g} mm", "limit", "-")
    legend(figure, [shown, ("mean", "ink", "-"), limit])


def _strip(axes: Axes, row: int, values: Floats, most: int, who: int) -> None:
    """Points of one situation in a fixed zigzag, so equal values stay apart, and their mean."""
    if not values.size:
        muted = COLOURS["muted"]
        axes.text(0, row, "not measured", ha="center", va="center", color=muted, fontsize=7.5)
        return
    drawn = values[subsample(np.abs(values), most)]
    role, form = detector_look(who)
    y = row + 0.11 * (np.arange(drawn.size) % 5 - 2)
    marks(axes, drawn, y, role, 3, form, alpha=0.6)
    mean = float(values.mean())
    axes.plot([mean, mean], [row - 0.36, row + 0.36], color=COLOURS["ink"], linewidth=1.6)


@plotted
def teat_boxes(
    teats: Sequence[str],
    errors_mm: Sequence[ArrayLike],
    limit_mm: float,
    *,
    who: int = 0,
    name: str = "teat-boxes",
) -> Plot:
    """Radial errors of each teat (n_k,) as box plots (whiskers 1.5 quartile ranges)."""
    arrays = [finite("teat_boxes", "errors_mm", one).ravel() for one in errors_mm]
    figure = yield name, _FLAT, "" if any(array.size for array in arrays) else NO_PAIR
    axes = figure.add_subplot()
    places = [k for k, array in enumerate(arrays) if array.size]
    role, form = detector_look(who)
    line = {"color": COLOURS[role], "linewidth": 1.1}
    boxes = [cbook.boxplot_stats(arrays[k])[0] for k in places]
    for box in boxes:
        box["fliers"] = box["fliers"][subsample(box["fliers"], _MOST_BEYOND)]
    fliers = {"marker": form, "markersize": 3, "markerfacecolor": COLOURS[role]}
    axes.bxp(
        boxes,
        positions=places,
        widths=0.5,
        patch_artist=True,
        boxprops={"facecolor": COLOURS["span"], "edgecolor": COLOURS[role], "linewidth": 1.1},
        whiskerprops=line,
        capprops=line,
        medianprops={"color": COLOURS["ink"], "linewidth": 1.6},
        flierprops=fliers | {"markeredgewidth": 0},
    )
    axes.axhline(limit_mm, color=COLOURS["limit"], linewidth=1.2)
    axes.set(xlim=(-0.6, len(teats) - 0.4), ylim=(0, None))
    axes.set(ylabel="distance to the teat end (mm)")
    pairs = zip(teats, arrays, strict=True)
    counted = [f"{plain(teat, 12)}\nn = {array.size}" for teat, array in pairs]
    axes.set_xticks(range(len(teats)), counted)
    axes.grid(visible=False, axis="x")
    boxed: list[LegendEntry] = [("middle half", "span", "patch"), ("median", "ink", "-")]
    boxed.append(("within 1.5 times that", role, "-"))
    legend(figure, [*boxed, ("far from it", role, form), *limits(limit_mm)])


@plotted
def error_drift(
    time_min: ArrayLike,
    error_mm: ArrayLike,
    limit_mm: float,
    *,
    links: Sequence[str] | None = None,
    who: int = 0,
    name: str = "error-drift",
) -> Plot:
    """Radial errors (n,) over capture times (n,), with their line."""
    time, errors = together("error_drift", time_min=time_min, error_mm=error_mm)
    figure = yield name, _FLAT, "" if time.size else NO_PAIR
    axes = figure.add_subplot()
    role, form = detector_look(who)
    drawn = subsample(errors)
    linked(axes, time, errors, drawn, links, role=role, marker=form, size=16, alpha=0.7)
    entries: list[LegendEntry] = [("one teat end", role, form)]
    if np.ptp(time) > 0:
        slope, level = np.polyfit(time - time.mean(), errors, 1)
        ends = np.array([time.min(), time.max()])
        line = level + slope * (ends - time.mean())
        axes.plot(ends, line, color=COLOURS["ink"], linewidth=1.4)
        entries.append((f"line: {slope * np.ptp(time):+z.2f} mm over the run", "ink", "-"))
    axes.axhline(limit_mm, color=COLOURS["limit"], linewidth=1.2)
    axes.set(ylim=(0, 1.1 * max(limit_mm, float(errors.max()))))
    axes.set(xlabel="time of the capture (min)", ylabel="distance (mm)")
    legend(figure, [*entries, *limits(limit_mm)])

"""Detectors beside each other, a row a situation or family: each teat end's error; what was found,
missed and false; failure rates with their intervals; the spread of errors. And where in two
parameters failures lie.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, NullLocator
from numpy.typing import ArrayLike

from reports.figures.drawing import (
    COLOURS,
    HALF_INCHES,
    MOST_POINTS,
    NO_PAIR,
    LegendEntry,
    Marker,
    Plot,
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
)
from reports.frames import places_of

T = TypeVar("T")
Counts = tuple[int, int, int]  # found, missed, false
Rate = tuple[float, float, float]  # a share and its interval
Spread = Sequence[float]  # quantiles: 5, 25, 50, 75, 95 %
OUTCOMES = {"found": "good", "missed": "muted", "false": "limit"}  # and their colours
_WIDTH = 0.8  # of a row, shared by its detectors
_NARROW = 0.62  # of a row of intervals
_LONGEST = 24  # letters of a row's name
_RATES = (0.0, 0.001, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0)
_ERRORS_MM = (0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
_DARKEST = 0.5  # of a cell, so that its numbers are read in both colour schemes


@plotted
def error_strips(
    situations: Sequence[str],
    errors_mm: Mapping[str, Sequence[ArrayLike]],
    limit_mm: float,
    *,
    links: Mapping[str, Sequence[Sequence[str]]] | None = None,
) -> Plot:
    """Radial errors (n_k,) of each situation by detector; `links` open on a click."""
    arrays = {
        detector: [finite("error_strips", f"{detector}[{k}]", one) for k, one in enumerate(each)]
        for detector, each in errors_mm.items()
    }
    inches = _inches(situations, len(arrays))
    largest = [float(one.max()) for each in arrays.values() for one in each if one.size]
    figure = yield "error-strips", inches, "" if largest else NO_PAIR
    most = max(20, MOST_POINTS // (len(arrays) * len(situations)))
    step = _WIDTH / len(arrays)
    opened = [of for detector in arrays for of in links[detector]] if links else []
    axes = figure.add_subplot()
    for at, (y, one, (role, form)) in enumerate(_each(arrays, _WIDTH)):
        if not one.size:
            _muted(axes, 0, y, "none found")
            continue
        rows = y + step * 0.13 * (np.arange(one.size) % 5 - 2).astype(np.float64)
        of, drawn = opened[at] if opened else None, subsample(one, most)
        linked(axes, one, rows, drawn, of, role=role, size=11, alpha=0.7, marker=form)
    axes.axvline(limit_mm, color=COLOURS["limit"], linewidth=1.4)
    axes.set(xlim=(0, 1.06 * max(limit_mm, *largest)), xlabel="distance to the teat end (mm)")
    row_names(axes, situations, _LONGEST)
    legend(figure, [*_key(arrays), *limits(limit_mm)])


@plotted
def outcome_bars(situations: Sequence[str], counts: Mapping[str, Sequence[Counts]]) -> Plot:
    """Teats found and missed, and false answers, in each situation by detector; with counts."""
    inches, several = _inches(situations, len(counts)), len(counts) > 1
    most = max((sum(one) for each in counts.values() for one in each), default=0)
    figure = yield "outcome-bars", inches, "" if most else "no teat was to be found"
    axes = figure.add_subplot()
    height, colours = _WIDTH / len(counts) * 0.78, [COLOURS[role] for role in OUTCOMES.values()]
    for y, one, (role, form) in _each(counts, _WIDTH):
        left = np.cumsum((0, *one))
        axes.barh(y, one, left=left[:-1], height=height, color=colours)
        if several:
            marks(axes, -0.03 * most, y, role, 4, form, clip_on=False)
        text = " · ".join(map(str, one)) if any(one[1:]) else str(one[0])
        axes.text(left[-1] + 0.02 * most, y, text, va="center", fontsize=7.5)
    axes.set(xlim=(-0.06 * most, 1.3 * most), xlabel="teats, and answers where there is none")
    row_names(axes, situations, _LONGEST)
    entries: list[LegendEntry] = [(what, role, "patch") for what, role in OUTCOMES.items()]
    legend(figure, [*entries, *(_key(counts) if several else ())])


@plotted
def rate_intervals(families: Sequence[str], rates: Mapping[str, Sequence[Rate | None]]) -> Plot:
    """Each family's failure rate (rate, low, high) by detector, 0 to 1; None where no scene was
    scored. The scale grows with the square root, so that small rates have room.
    """
    known = [rate for each in rates.values() for rate in each if rate]
    figure = yield (
        "rate-intervals",
        _low_inches(families, rates),
        "" if known else "no scene was scored",
    )
    reach = min(1.0, 1.15 * max(high for _, _, high in known))
    ticks: list[float] = []  # those that stand clear of each other
    for tick in _RATES:
        if tick <= reach and (not ticks or tick**0.5 - ticks[-1] ** 0.5 > 0.09 * reach**0.5):
            ticks.append(tick)
    axes = figure.add_subplot()
    root = lambda values: np.sign(values) * np.sqrt(np.abs(values))  # noqa: E731
    axes.set_xscale("function", functions=(root, np.square))
    axes.set(xlim=(-0.0008 * reach, reach), xlabel="scenes that failed, with 95 % interval")
    _ticks(axes, ticks, lambda value: f"{100 * value:g} %")
    for y, rate, (role, form) in _each(rates, _NARROW):
        if rate is None:
            _muted(axes, 0.0, y, "not measured")
            continue
        axes.plot(rate[1:], [y, y], color=COLOURS[role], linewidth=1.6)
        marks(axes, rate[:1], [y], role, 5, form, clip_on=False)
    row_names(axes, families, _LONGEST)
    legend(figure, _key(rates))


@plotted
def error_spreads(
    families: Sequence[str], spreads: Mapping[str, Sequence[Spread | None]], limit_mm: float
) -> Plot:
    """Errors in mm of each family by detector: 90 % of them as a thin line, half as a thick one,
    the median marked, and the limit; None where nothing was found.
    """
    for detector, each in spreads.items():
        finite("error_spreads", detector, [one for one in each if one])
    known = [value for each in spreads.values() for one in each if one for value in one]
    figure = yield "error-spreads", _low_inches(families, spreads), "" if known else NO_PAIR
    low, high = 0.8 * max(0.01, min(known)), 1.3 * max(limit_mm, *known)
    axes = figure.add_subplot()
    axes.set(xscale="log", xlim=(low, high), xlabel="largest error of a scene (mm)")
    _ticks(axes, [tick for tick in _ERRORS_MM if low <= tick <= high], "{:g}".format)
    axes.axvline(limit_mm, color=COLOURS["limit"], linewidth=1.2)
    for y, one, (role, form) in _each(spreads, _NARROW):
        if one is None:
            _muted(axes, low, y, "none found")
            continue
        axes.plot([one[0], one[4]], [y, y], color=COLOURS[role], linewidth=1)
        axes.plot([one[1], one[3]], [y, y], color=COLOURS[role], linewidth=3.2)
        marks(axes, [one[2]], [y], "ink", 4, form)
    row_names(axes, families, _LONGEST)
    legend(figure, [*_key(spreads), *limits(limit_mm)])


@plotted
def failure_map(
    labels: tuple[str, str],
    ranges: tuple[tuple[float, float], tuple[float, float]],
    scenes: ArrayLike,
    failures: ArrayLike,
    *,
    name: str = "failure-map",
) -> Plot:
    """Scenes and failures (rows, columns) in cells of two parameters, the first along columns."""
    all_of, failed = (
        np.atleast_2d(finite("failure_map", what, values)).astype(np.intp)
        for what, values in (("scenes", scenes), ("failures", failures))
    )
    inches = (HALF_INCHES, 3.9)
    figure = yield name, inches, "" if all_of.sum() else "no scene was scored"
    x, y = (
        np.linspace(*ends, count + 1).tolist()
        for ends, count in zip(ranges, reversed(all_of.shape), strict=True)
    )
    most = max(1e-9, float((failed / np.maximum(all_of, 1)).max()))
    axes = figure.add_subplot()
    cell: dict[str, Any] = {"facecolor": COLOURS["limit"], "edgecolor": "none", "linewidth": 0}
    for (row, column), n in np.ndenumerate(all_of):
        share = float(failed[row, column] / n) if n else 0.0
        left, low, wide, high = (x[column], y[row], x[column + 1] - x[column], y[row + 1] - y[row])
        look = {**cell, "alpha": _DARKEST * share / most}
        axes.add_patch(Rectangle((left, low), wide, high, **look))
        text = f"{100 * share:.0f} %\n{failed[row, column]} of {n}" if n else "–"
        middle, ink = (left + wide / 2, low + high / 2), COLOURS["ink" if n else "muted"]
        axes.text(*middle, text, ha="center", va="center", fontsize=7, color=ink)
    axes.set(xlim=ranges[0], ylim=ranges[1], xlabel=plain(labels[0]), ylabel=plain(labels[1]))
    axes.set_xticks(x, [f"{value:.3g}" for value in x])
    axes.set_yticks(y, [f"{value:.3g}" for value in y])
    axes.grid(visible=False)


def _each(
    by_detector: Mapping[str, Sequence[T]], width: float
) -> Iterator[tuple[float, T, tuple[str, Marker]]]:
    """Height in the drawing, value, and the detector's colour and mark, detector by detector."""
    of, places = len(by_detector), places_of(by_detector)
    for place, (name, each) in enumerate(by_detector.items()):
        for row, one in enumerate(each):
            yield row + (place - (of - 1) / 2) * (width / of), one, detector_look(places[name])


def _key(detectors: Mapping[str, object]) -> list[LegendEntry]:
    places = places_of(detectors)
    return [(plain(name, 20), *detector_look(who)) for name, who in places.items()]


def _muted(axes: Axes, x: float, y: float, text: str) -> None:
    """A note in place of a mark, clear of the axis's line."""
    muted = COLOURS["muted"]
    axes.annotate(
        text, (x, y), (4, 0), textcoords="offset points", va="center", color=muted, fontsize=7
    )


def _ticks(axes: Axes, ticks: Sequence[float], text: Callable[[float], str]) -> None:
    axes.set_xticks(ticks)
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: text(value)))


def _inches(situations: Sequence[str], detectors: int) -> tuple[float, float]:
    each = 0.34 if detectors < 2 else 0.2 * detectors
    return HALF_INCHES, min(1.1 + each * max(len(situations), 3), 6.0)


def _low_inches(families: Sequence[str], detectors: Mapping[str, object]) -> tuple[float, float]:
    each = 0.25 + 0.06 * len(detectors)
    return HALF_INCHES, min(1.0 + each * max(len(families), 3), 6.0)

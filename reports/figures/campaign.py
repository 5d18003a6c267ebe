"""Many scenes as plots: failure rates with their intervals, the spread of errors, and where in two
parameters the failures lie.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TypeVar

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, NullLocator
from numpy.typing import ArrayLike

from reports.figures.drawing import (
    COLOURS,
    HALF_INCHES,
    LegendEntry,
    detector_look,
    draw,
    finite,
    legend,
    marks,
    not_measured,
    plain,
)
from reports.figures.situations import family_rows

T = TypeVar("T")
Rate = tuple[float, float, float]  # a share and its interval
Spread = Sequence[float]  # quantiles: 5, 25, 50, 75, 95 %

_STEP = 0.62  # of a family's height, shared by its detectors
_RATES = (0.0, 0.001, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0)
_ERRORS_MM = (0.01, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
_DARKEST = 0.5  # of a cell, so that its numbers are read in both colour schemes


def rate_intervals(
    families: Sequence[str],
    rates: Mapping[str, Sequence[Rate | None]],
    *,
    name: str = "rate-intervals",
) -> str:
    """Each family's failure rate (rate, low, high) by detector, 0 to 1; None where no scene was
    scored. The scale grows with the square root, so that small rates have room.
    """
    for detector, each in rates.items():
        _one_a_family("rate_intervals", families, detector, each)
    known = [rate for each in rates.values() for rate in each if rate]
    if not known:
        return not_measured(name, _inches(families, rates), "no scene was scored")
    most = max(high for _, _, high in known)

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.set_xscale("function", functions=(_root, np.square))
        reach = min(1.0, 1.15 * most)
        axes.set(xlim=(-0.0008 * reach, reach), xlabel="scenes that failed, with 95 % interval")
        axes.set_xticks(_apart([tick for tick in _RATES if tick <= reach], reach))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g} %"))
        for y, rate, place in _each(rates):
            if rate is None:
                axes.text(0.0, y, " not measured", va="center", color=COLOURS["muted"], fontsize=7)
                continue
            role, form = detector_look(place, len(rates))
            value, low, high = rate
            axes.plot([low, high], [y, y], color=COLOURS[role], linewidth=1.6)
            marks(axes, [value], [y], role, 5, form, clip_on=False)
        family_rows(axes, families)
        _key(figure, rates)

    return draw(name, _inches(families, rates), plot)


def error_spreads(
    families: Sequence[str],
    spreads: Mapping[str, Sequence[Spread | None]],
    limit_mm: float,
    *,
    name: str = "error-spreads",
) -> str:
    """Errors in mm of each family by detector: 90 % of them as a thin line, half as a thick one,
    the median marked, and the limit; None where nothing was found.
    """
    for detector, each in spreads.items():
        _one_a_family("error_spreads", families, detector, each)
        finite("error_spreads", detector, [one for one in each if one])
    known = [value for each in spreads.values() for one in each if one for value in one]
    if not known:
        return not_measured(name, _inches(families, spreads), "no teat end was paired with a truth")

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.set_xscale("log")
        low = max(0.01, min(known))
        axes.set(xlim=(0.8 * low, 1.3 * max(limit_mm, *known)))
        axes.set_xlabel("largest error of a scene (mm)")
        axes.set_xticks([tick for tick in _ERRORS_MM if 0.8 * low <= tick <= axes.get_xlim()[1]])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.axvline(limit_mm, color=COLOURS["limit"], linewidth=1.2)
        for y, one, place in _each(spreads):
            if one is None:
                axes.text(
                    axes.get_xlim()[0], y, " none found", va="center", color=COLOURS["muted"],
                    fontsize=7,
                )  # fmt: skip
                continue
            role, form = detector_look(place, len(spreads))
            axes.plot([one[0], one[4]], [y, y], color=COLOURS[role], linewidth=1)
            axes.plot([one[1], one[3]], [y, y], color=COLOURS[role], linewidth=3.2)
            marks(axes, [one[2]], [y], "ink", 4, form)
        family_rows(axes, families)
        _key(figure, spreads, (f"limit {limit_mm:g} mm", "limit", "-"))

    return draw(name, _inches(families, spreads), plot)


def failure_map(
    labels: tuple[str, str],
    ranges: tuple[tuple[float, float], tuple[float, float]],
    scenes: ArrayLike,
    failures: ArrayLike,
    *,
    name: str = "failure-map",
) -> str:
    """Scenes and failures (rows, columns) counted in cells of two parameters: the first of
    ``labels`` and ``ranges`` goes along the columns. The redder a cell, the more of it failed,
    beside the worst.
    """
    all_of, failed = (
        np.atleast_2d(finite("failure_map", what, values)).astype(np.intp)
        for what, values in (("scenes", scenes), ("failures", failures))
    )
    if all_of.shape != failed.shape or (failed > all_of).any() or (failed < 0).any():
        raise ValueError(
            f"failure_map: {failed.shape} counts of failures for {all_of.shape} of scenes; give one"
            " a cell, none larger than its scenes"
        )
    inches = (HALF_INCHES, 3.9)
    if not all_of.sum():
        return not_measured(name, inches, "no scene was scored")

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot()
        x, y = (
            np.linspace(*ends, count + 1).tolist()
            for ends, count in zip(ranges, reversed(all_of.shape), strict=True)
        )
        most = max(1e-9, float((failed / np.maximum(all_of, 1)).max()))
        for (row, column), n in np.ndenumerate(all_of):
            share = failed[row, column] / n if n else 0.0
            at = x[column], y[row], x[column + 1] - x[column], y[row + 1] - y[row]
            axes.add_patch(_cell(at, _DARKEST * float(share) / most))
            text = f"{100 * share:.0f} %\n{failed[row, column]} of {n}" if n else "–"
            axes.text(at[0] + at[2] / 2, at[1] + at[3] / 2, text, ha="center", va="center",
                      fontsize=7, color=COLOURS["ink" if n else "muted"])  # fmt: skip
        axes.set(xlim=ranges[0], ylim=ranges[1], xlabel=plain(labels[0]), ylabel=plain(labels[1]))
        axes.set_xticks(x, [f"{value:.3g}" for value in x])
        axes.set_yticks(y, [f"{value:.3g}" for value in y])
        axes.grid(visible=False)

    return draw(name, inches, plot)


def _cell(at: tuple[float, float, float, float], share: float) -> Rectangle:
    x, y, wide, high = at
    return Rectangle(
        (x, y), wide, high, facecolor=COLOURS["limit"], alpha=share, edgecolor="none", linewidth=0
    )


def _root(values: ArrayLike) -> ArrayLike:
    return np.sign(values) * np.sqrt(np.abs(values))


def _apart(ticks: Sequence[float], reach: float) -> list[float]:
    """Those ticks that stand clear of each other, the largest first."""
    kept: list[float] = []
    for tick in sorted(ticks, reverse=True):
        if not kept or (kept[-1] ** 0.5 - tick**0.5) > 0.11 * reach**0.5:
            kept.append(tick)
    return kept[::-1]


def _one_a_family(
    function: str, families: Sequence[str], detector: str, given: Sequence[object]
) -> None:
    if len(given) != len(families):
        raise ValueError(
            f"{function}: {len(families)} families, {len(given)} values of {detector}; give one a"
            " family"
        )


def _each(by_detector: Mapping[str, Sequence[T]]) -> Iterator[tuple[float, T, int]]:
    """Height of the row, value and the detector's place."""
    step = _STEP / len(by_detector)
    for place, each in enumerate(by_detector.values()):
        for k, one in enumerate(each):
            yield k + (place - (len(by_detector) - 1) / 2) * step, one, place


def _inches(families: Sequence[str], detectors: Mapping[str, object]) -> tuple[float, float]:
    each = 0.25 + 0.06 * len(detectors)
    return HALF_INCHES, min(1.0 + each * max(len(families), 3), 6.0)


def _key(figure: Figure, detectors: Mapping[str, object], *more: LegendEntry) -> None:
    entries: list[LegendEntry] = [
        (plain(detector, 20), *detector_look(place, len(detectors)))
        for place, detector in enumerate(detectors)
    ]
    legend(figure, [*entries, *more])

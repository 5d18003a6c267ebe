"""Detectors beside each other, situation by situation: each teat end's error, and what was found,
missed and false.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from reports.figures.drawing import (
    COLOURS,
    HALF_INCHES,
    MOST_POINTS,
    LegendEntry,
    detector_look,
    draw,
    finite,
    legend,
    linked,
    marks,
    not_measured,
    one_each,
    plain,
    telling,
)

OUTCOMES = ("good", "muted", "limit")  # colours of found, missed, false
_WIDTH = 0.8  # of the rows of a situation
Floats = NDArray[np.float64]
Counts = tuple[int, int, int]  # found, missed, false


def error_strips(
    situations: Sequence[str],
    errors_mm: Mapping[str, Sequence[ArrayLike]],
    limit_mm: float,
    *,
    links: Mapping[str, Sequence[Sequence[str]]] | None = None,
    name: str = "error-strips",
) -> str:
    """Radial errors (n_k,) of each situation by detector, with the limit.

    `links`: for each error the `#id` that a click opens.
    """
    arrays = {
        detector: [finite("error_strips", f"{detector}[{k}]", one) for k, one in enumerate(each)]
        for detector, each in errors_mm.items()
    }
    for detector, each in arrays.items():
        if len(each) != len(situations):
            raise ValueError(
                f"error_strips: {len(situations)} situations, {len(each)} arrays of {detector};"
                " give one array a situation"
            )
        for k, one in enumerate(each):
            one_each("error_strips", links[detector][k] if links else None, one.size)
    inches = _inches(situations, len(arrays))
    largest = [float(one.max()) for each in arrays.values() for one in each if one.size]
    if not largest:
        return not_measured(name, inches, "no teat end was paired with a truth")
    most = max(20, MOST_POINTS // (len(arrays) * len(situations)))

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot()
        for place, (detector, each) in enumerate(arrays.items()):
            role, form = detector_look(place, len(arrays))
            step = _WIDTH / len(arrays)
            for k, one in enumerate(each):
                y = k + (place - (len(arrays) - 1) / 2) * step
                if not one.size:
                    axes.text(0, y, " none found", va="center", color=COLOURS["muted"], fontsize=7)
                    continue
                rows: Floats = y + step * 0.13 * (np.arange(one.size) % 5 - 2).astype(np.float64)
                of = links[detector][k] if links else None
                drawn = telling(one, most)
                linked(axes, one, rows, drawn, of, role=role, size=11, alpha=0.7, marker=form)
        axes.axvline(limit_mm, color=COLOURS["limit"], linewidth=1.4)
        axes.set(xlim=(0, 1.06 * max(limit_mm, *largest)), xlabel="distance to the teat end (mm)")
        family_rows(axes, situations)
        entries: list[LegendEntry] = [
            (plain(detector, 20), *detector_look(place, len(arrays)))
            for place, detector in enumerate(arrays)
        ]
        legend(figure, [*entries, (f"limit {limit_mm:g} mm", "limit", "-")])

    return draw(name, inches, plot)


def outcome_bars(
    situations: Sequence[str],
    counts: Mapping[str, Sequence[Counts]],
    *,
    name: str = "outcome-bars",
) -> str:
    """Teats found and missed, and false answers, in each situation by detector; with counts."""
    for detector, each in counts.items():
        if len(each) != len(situations):
            raise ValueError(
                f"outcome_bars: {len(situations)} situations, {len(each)} counts of {detector};"
                " give one a situation"
            )
    inches = _inches(situations, len(counts))
    most = max((sum(one) for each in counts.values() for one in each), default=0)
    if not most:
        return not_measured(name, inches, "no teat was to be found")
    step = _WIDTH / len(counts)

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot()
        for place, each in enumerate(counts.values()):
            for k, one in enumerate(each):
                y = k + (place - (len(counts) - 1) / 2) * step
                left = np.cumsum((0, *one))
                colours = [COLOURS[role] for role in OUTCOMES]
                axes.barh(y, one, left=left[:-1], height=step * 0.78, color=colours)
                if len(counts) > 1:
                    role, form = detector_look(place, len(counts))
                    marks(axes, -0.03 * most, y, role, 4, form, clip_on=False)
                text = " · ".join(map(str, one))
                axes.text(left[-1] + 0.02 * most, y, text, va="center", fontsize=7.5)
        axes.set(xlim=(-0.06 * most, 1.3 * most), xlabel="teats, and answers where there is none")
        family_rows(axes, situations)
        entries: list[LegendEntry] = [
            *(("found", "good", "patch"), ("missed", "muted", "patch")),
            ("false", "limit", "patch"),
        ]
        if len(counts) > 1:
            for place, detector in enumerate(counts):
                entries.append((plain(detector, 20), *detector_look(place, len(counts))))
        legend(figure, entries)

    return draw(name, inches, plot)


def _inches(situations: Sequence[str], detectors: int) -> tuple[float, float]:
    each = 0.34 if detectors < 2 else 0.2 * detectors
    return HALF_INCHES, min(1.1 + each * max(len(situations), 3), 6.0)


def family_rows(axes: Axes, situations: Sequence[str]) -> None:
    """A row each, the first above."""
    axes.set_yticks(range(len(situations)), [plain(text, 24) for text in situations])
    axes.set_ylim(len(situations) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)

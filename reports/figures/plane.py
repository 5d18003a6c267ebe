"""The error over places, from above and from the front: a disc's area is the error, a triangle a
miss. Several teats are small multiples on one scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from reports.figures.drawing import (
    COLOURS,
    MOST_POINTS,
    WIDE_INCHES,
    Floats,
    LegendEntry,
    draw,
    finite,
    legend,
    not_measured,
    plain,
    telling,
)

_INCHES = (WIDE_INCHES, 5.6)
_MARK = 90.0  # points squared, of an error at the limit; the area grows with the error
_LEAST, _MOST = 6.0, 360.0
# of a disc's diameter, in points: each size is an outline of its own in the file, and in every
# panel
_STEP, _COARSE_STEP = 1.0, 3.0
_MOST_MARKS = 240  # discs, and as many triangles, of all panels together
_ACROSS = 4  # columns; more teats begin another row
# places that differ less in height are one plane, and a front view of it would be a line
_APART_MM = 10.0
_VIEWS = {"above": (1, "y (mm)"), "front": (2, "z (mm)")}
_LEAST_SPAN_MM = 40.0


@dataclass(frozen=True, slots=True, eq=False)
class TeatPlaces:
    """One teat: radial errors (n,) mm at places (n, 3) mm, and the places (m, 3) where it was
    missed.

    ``links`` (n) and ``missed_links`` (m): the `#id` that a click on the mark opens.
    """

    name: str
    places_mm: ArrayLike
    error_mm: ArrayLike
    missed_mm: ArrayLike = ()
    links: tuple[str, ...] = ()
    missed_links: tuple[str, ...] = ()

    def checked(self) -> _Marks:
        """As arrays. Raises ValueError for what isn't finite or doesn't fit."""
        places = finite("error_map", "places_mm", self.places_mm).reshape(-1, 3)
        errors = finite("error_map", "error_mm", self.error_mm).ravel()
        missed = finite("error_map", "missed_mm", self.missed_mm).reshape(-1, 3)
        counts = {"error_mm": len(errors), "links": len(self.links) or len(places)}
        wrong = [f"{what} {n}" for what, n in counts.items() if n != len(places)]
        wrong += (
            []
            if len(self.missed_links) in {0, len(missed)}
            else [f"missed_links {len(self.missed_links)} for {len(missed)} missed"]
        )
        if wrong:
            raise ValueError(
                f"error_map: teat {self.name}: lengths differ: places_mm {len(places)},"
                f" {', '.join(wrong)}"
            )
        return _Marks(places, errors, missed, np.array(self.links), np.array(self.missed_links))


@dataclass(frozen=True, slots=True, eq=False)
class _Marks:
    places: Floats
    errors: Floats
    missed: Floats
    links: NDArray[np.str_]
    missed_links: NDArray[np.str_]

    @property
    def everywhere(self) -> Floats:
        return np.concatenate([self.places, self.missed])

    def thinned(self, most: int) -> _Marks:
        """At most so many discs and so many triangles."""
        found, gone = telling(self.errors, most), telling(np.zeros(len(self.missed)), most)
        links, missed_links = (
            of[at] if len(of) else of for of, at in ((self.links, found), (self.missed_links, gone))
        )
        return _Marks(
            self.places[found], self.errors[found], self.missed[gone], links, missed_links
        )


def error_map(teat: TeatPlaces, limit_mm: float, *, name: str = "error-map") -> str:
    """One teat's radial errors over a plane, from above, as discs whose area is the error, one
    colour within the limit and one beyond it; a triangle where it was missed. Equal scales.
    """
    marks = teat.checked()
    if not len(marks.everywhere):
        return not_measured(name, _INCHES, "no place had a truth")
    drawn = marks.thinned(MOST_POINTS)

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot(aspect="equal")
        _view(axes, "above", drawn, limit_mm, _STEP)
        axes.set(xlabel="x (mm)", ylabel="y (mm), away from the cameras")
        axes.margins(0.06)
        _told(figure, [marks], [drawn], limit_mm)

    return draw(name, _INCHES, plot)


def error_maps(teats: Sequence[TeatPlaces], limit_mm: float, *, name: str = "error-maps") -> str:
    """The same for each teat, on one scale; a front view too where the places differ in height."""
    columns = [teat.checked() for teat in teats]
    if not sum(len(marks.everywhere) for marks in columns):
        return not_measured(name, _INCHES, "no place had a truth")
    spans = np.max(
        [np.ptp(marks.everywhere, axis=0) for marks in columns if len(marks.everywhere)], axis=0
    )
    views = ["above", "front"] if spans[2] > _APART_MM else ["above"]
    half = 0.5 * np.maximum(1.25 * spans, _LEAST_SPAN_MM)
    across = min(_ACROSS, len(columns))
    bands = -(-len(columns) // across)
    drawn = [marks.thinned(_MOST_MARKS // (len(columns) * len(views))) for marks in columns]

    def plot(figure: Figure) -> None:
        grid = figure.add_gridspec(
            bands * len(views),
            across,
            height_ratios=[half[_VIEWS[view][0]] for view in views] * bands,
        )
        for row, view in enumerate(views):
            for k, (teat, marks) in enumerate(zip(teats, columns, strict=True)):
                band, column = divmod(k, across)
                axes = figure.add_subplot(grid[band * len(views) + row, column], aspect="equal")
                _view(axes, view, drawn[k], limit_mm, _COARSE_STEP)
                _centre(axes, view, marks.everywhere, half)
                if row == 0:
                    axes.set_title(
                        f"teat {plain(teat.name, 12)}\n{len(marks.places)} found,"
                        f" {len(marks.missed)} missed",
                        loc="left",
                    )
                axes.set(
                    xlabel="x (mm)" if row == len(views) - 1 else "",
                    ylabel=_VIEWS[view][1] if column == 0 else "",
                )
        _told(figure, columns, drawn, limit_mm)

    high = sum(
        0.62 + 2.0 * half[_VIEWS[view][0]] / (2.0 * half[0]) * (WIDE_INCHES / across - 0.55)
        for view in views
    )
    return draw(name, (WIDE_INCHES, float(min(0.35 + bands * high, 14.0))), plot)


def _view(axes: Axes, view: str, marks: _Marks, limit_mm: float, step: float) -> None:
    """Discs in steps of size: the discs of one size share their outline in the file."""
    flat = [0, _VIEWS[view][0]]
    across = np.sqrt(np.clip(_MARK * marks.errors / limit_mm, _LEAST, _MOST))
    area = (np.maximum(np.round(across / step), 1.0) * step) ** 2
    for within, role in ((marks.errors <= limit_mm, "good"), (marks.errors > limit_mm, "limit")):
        for size in np.unique(area[within]):
            alike = within & (area == size)
            x, y = marks.places[alike][:, flat].T
            discs = axes.scatter(x, y, s=size, color=COLOURS[role], alpha=0.75, linewidths=0)
            if len(marks.links):
                discs.set_urls(marks.links[alike].tolist())
    x, y = marks.missed[:, flat].T
    missed = axes.scatter(x, y, s=22, marker="v", color=COLOURS["muted"], linewidths=0)
    if len(marks.missed_links):
        missed.set_urls(marks.missed_links.tolist())


def _centre(axes: Axes, view: str, places: Floats, half: Floats) -> None:
    """Of one size in every panel; a teat that was nowhere has an empty one."""
    middle = (places.min(axis=0) + places.max(axis=0)) / 2.0 if len(places) else np.zeros(3)
    up = _VIEWS[view][0]
    axes.set(
        xlim=(middle[0] - half[0], middle[0] + half[0]),
        ylim=(middle[up] - half[up], middle[up] + half[up]),
    )


def _told(
    figure: Figure, all_of: Sequence[_Marks], drawn: Sequence[_Marks], limit_mm: float
) -> None:
    """The legend, and what isn't drawn where that is so."""
    entries: list[LegendEntry] = [
        (f"within {limit_mm:g} mm", "good", "o"),
        ("beyond", "limit", "o"),
        ("not found", "muted", "v"),
    ]
    legend(figure, entries)
    (found, missed), (of_found, of_missed) = (
        (sum(len(marks.places) for marks in part), sum(len(marks.missed) for marks in part))
        for part in (drawn, all_of)
    )
    if (found, missed) != (of_found, of_missed):
        left_out = (
            f"{found} of {of_found} found ends drawn, the worst among them, and {missed} of"
            f" {of_missed} missed"
        )
        figure.supxlabel(left_out, fontsize=8.5, color=COLOURS["muted"])

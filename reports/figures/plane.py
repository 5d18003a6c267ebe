"""The error over places, from above and from the front (a disc's area is the error, a triangle a
miss), and errors as clouds with their 95 % ellipsoids. Several teats are small multiples on one
scale, or a colour and a marker each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from reports.figures.drawing import (
    COLOURS,
    MOST_POINTS,
    NO_PAIR,
    WIDE_INCHES,
    Floats,
    LegendEntry,
    Marker,
    Plot,
    count_text,
    cross_and_circle,
    finite,
    legend,
    limits,
    linked,
    plain,
    plotted,
    subsample,
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


class TeatPlaces:
    """One teat: radial errors (n,) mm at ``places`` (n, 3) mm, and the places (m, 3) where it was
    missed; ``links`` (n) and ``missed_links`` (m) are the `#id` that a click on each mark opens.
    """

    def __init__(
        self,
        name: str,
        places_mm: ArrayLike,
        error_mm: ArrayLike,
        missed_mm: ArrayLike = (),
        links: Sequence[str] = (),
        missed_links: Sequence[str] = (),
    ) -> None:
        self.name = name
        self.places = finite("error_map", "places_mm", places_mm).reshape(-1, 3)
        self.errors = finite("error_map", "error_mm", error_mm).ravel()
        self.missed = finite("error_map", "missed_mm", missed_mm).reshape(-1, 3)
        self.links, self.missed_links = links, missed_links

    @property
    def everywhere(self) -> Floats:
        return np.concatenate([self.places, self.missed])

    def thinned(self, most: int) -> TeatPlaces:
        """At most so many discs and so many triangles."""
        found, gone = subsample(self.errors, most), subsample(np.zeros(len(self.missed)), most)
        return TeatPlaces(
            self.name,
            self.places[found],
            self.errors[found],
            self.missed[gone],
            [self.links[k] for k in found] if self.links else (),
            [self.missed_links[k] for k in gone] if self.missed_links else (),
        )


@plotted
def error_map(teat: TeatPlaces, limit_mm: float, *, name: str = "error-map") -> Plot:
    """One teat's radial errors over a plane, from above, as discs whose area is the error, one
    colour within the limit and one beyond it; a triangle where it was missed. Equal scales.
    """
    figure = yield name, _INCHES, "" if len(teat.everywhere) else "no place had a truth"
    drawn = teat.thinned(MOST_POINTS)
    axes = figure.add_subplot(aspect="equal")
    _view(axes, "above", drawn, limit_mm, _STEP)
    axes.set(xlabel="x (mm)", ylabel="y (mm), away from the cameras")
    axes.margins(0.06)
    _describe(figure, [teat], [drawn], limit_mm)


@plotted
def error_maps(teats: Sequence[TeatPlaces], limit_mm: float, *, name: str = "error-maps") -> Plot:
    """The same for each teat, on one scale; a front view too where the places differ in height."""
    there = [teat.everywhere for teat in teats if len(teat.everywhere)]
    if not there:
        yield name, _INCHES, "no place had a truth"
    spans = np.max([np.ptp(places, axis=0) for places in there], axis=0)
    views = ["above", "front"] if spans[2] > _APART_MM else ["above"]
    half = 0.5 * np.maximum(1.25 * spans, _LEAST_SPAN_MM)
    heights = [half[_VIEWS[view][0]] for view in views]
    across = min(_ACROSS, len(teats))
    bands = -(-len(teats) // across)
    drawn = [teat.thinned(_MOST_MARKS // (len(teats) * len(views))) for teat in teats]
    width = WIDE_INCHES / across - 0.55
    high = sum(0.62 + height / half[0] * width for height in heights)
    figure = yield name, (WIDE_INCHES, float(min(0.35 + bands * high, 14.0))), ""
    grid = figure.add_gridspec(bands * len(views), across, height_ratios=heights * bands)
    for row, view in enumerate(views):
        for k, teat in enumerate(teats):
            band, column = divmod(k, across)
            axes = figure.add_subplot(grid[band * len(views) + row, column], aspect="equal")
            _view(axes, view, drawn[k], limit_mm, _COARSE_STEP)
            _centre(axes, view, teat.everywhere, half)
            if row == 0:
                counts = f"{len(teat.places)} found, {len(teat.missed)} missed"
                axes.set_title(f"teat {plain(teat.name, 12)}\n{counts}", loc="left")
            axes.set(
                xlabel="x (mm)" if row == len(views) - 1 else "",
                ylabel=_VIEWS[view][1] if column == 0 else "",
            )
    _describe(figure, teats, drawn, limit_mm)


def _view(axes: Axes, view: str, of: TeatPlaces, limit_mm: float, step: float) -> None:
    """Discs in steps of size: the discs of one size share their outline in the file."""
    flat = [0, _VIEWS[view][0]]
    across = np.sqrt(np.clip(_MARK * of.errors / limit_mm, _LEAST, _MOST))
    area = (np.maximum(np.round(across / step), 1.0) * step) ** 2
    x, y = of.places[:, flat].T
    for within, role in ((of.errors <= limit_mm, "good"), (of.errors > limit_mm, "limit")):
        for size in np.unique(area[within]):
            alike = np.flatnonzero(within & (area == size))
            linked(axes, x, y, alike, of.links, role=role, size=size, alpha=0.75)
    x, y = of.missed[:, flat].T
    linked(axes, x, y, np.arange(len(x)), of.missed_links, role="muted", size=22, marker="v")


def _centre(axes: Axes, view: str, places: Floats, half: Floats) -> None:
    """Of one size in every panel; a teat that was nowhere has an empty one."""
    middle = (places.min(axis=0) + places.max(axis=0)) / 2.0 if len(places) else np.zeros(3)
    low, high, up = middle - half, middle + half, _VIEWS[view][0]
    axes.set(xlim=(low[0], high[0]), ylim=(low[up], high[up]))


def _describe(
    figure: Figure, all_of: Sequence[TeatPlaces], drawn: Sequence[TeatPlaces], limit_mm: float
) -> None:
    """The legend, and what isn't drawn where that is so."""
    within: LegendEntry = (f"within {limit_mm:g} mm", "good", "o")
    legend(figure, [within, ("beyond", "limit", "o"), ("not found", "muted", "v")])
    (found, missed), (of_found, of_missed) = (
        (sum(len(of.places) for of in part), sum(len(of.missed) for of in part))
        for part in (drawn, all_of)
    )
    if (found, missed) != (of_found, of_missed):
        left_out = (
            f"{found} of {of_found} found ends drawn, the worst among them, and {missed} of"
            f" {of_missed} missed"
        )
        figure.supxlabel(left_out, fontsize=8.5, color=COLOURS["muted"])


_REGIONS = (WIDE_INCHES, 3.5)
# so many times as far as the errors a panel reaches at most: the ellipsoid of few poses may run out
# of it
_BEYOND = 2.0
_ROLES = ("ours", "theirs", "accept", "good", "ink", "muted")
MOST_GROUPS = len(_ROLES)
_MARKERS: tuple[Marker, ...] = get_args(Marker)


@dataclass(frozen=True, slots=True, eq=False)
class ErrorGroup:
    """The errors of one teat: points (n, 2) mm a view, its ellipsoid's outline (m, 2) mm a view, or
    none, and the `#id` that a click on each error opens.
    """

    name: str
    points_mm: Sequence[ArrayLike]
    outlines_mm: Sequence[ArrayLike] = ()
    links: tuple[str, ...] = ()


@plotted
def error_regions(
    groups: Sequence[ErrorGroup],
    views: Sequence[tuple[str, str]],
    limit_mm: float,
    *,
    name: str = "error-regions",
) -> Plot:
    """A panel a view, with the names of its two axes: each group's errors, its ellipsoid, and the
    limit as a circle. Equal scales; at most `MOST_GROUPS` groups.
    """
    clouds = [_flat(group.points_mm) for group in groups]
    outlines = [_flat(group.outlines_mm) for group in groups]
    counts = [len(cloud[0]) for cloud in clouds]
    figure = yield name, _REGIONS, "" if sum(counts) else NO_PAIR
    ends = np.concatenate([part.ravel() for cloud in clouds for part in cloud])
    lines = [part.ravel() for of_group in outlines for part in of_group]
    farthest = max(limit_mm, float(np.abs(ends).max()))
    everything = np.abs(np.concatenate([ends, *lines])).max()
    reach = 1.08 * min(max(float(everything), farthest), _BEYOND * farthest)
    each = _MOST_MARKS // (len(groups) * len(views))
    drawn = [
        subsample(np.max([np.hypot(*flat.T) for flat in cloud], axis=0), each) for cloud in clouds
    ]
    for panel, axes in enumerate(figure.subplots(1, len(views), squeeze=False)[0]):
        across, up = (f"{plain(axis)} error (mm)" for axis in views[panel])
        axes.set(aspect="equal", xlabel=across, ylabel=up)
        cross_and_circle(axes, reach, limit_mm, 1.2)
        for k, cloud in enumerate(clouds):
            x, y = cloud[panel].T
            role, links = _ROLES[k], groups[k].links
            look: dict[str, Any] = {"size": 20, "marker": _MARKERS[k], "alpha": 0.75}
            linked(axes, x, y, drawn[k], links, role=role, **look)
            if outlines[k]:
                axes.plot(*outlines[k][panel].T, color=COLOURS[role], linewidth=1.3)
    entries: list[LegendEntry] = []
    for k, (group, n) in enumerate(zip(groups, counts, strict=True)):
        few = "" if group.outlines_mm else " (too few)"
        entries.append((f"{plain(group.name, 14)}, n = {n}{few}", _ROLES[k], _MARKERS[k]))
    legend(figure, [*entries, *limits(limit_mm)])
    shown = sum(map(len, drawn))
    if shown < sum(counts):
        left_out = count_text(shown, sum(counts))
        figure.axes[0].set_title(left_out, loc="left", fontsize=8.5, color=COLOURS["muted"])


def _flat(views: Sequence[ArrayLike]) -> list[Floats]:
    """Points (n, 2) of each view."""
    return [finite("error_regions", "points", view).reshape(-1, 2) for view in views]

"""Errors as clouds with their 95 % ellipsoids, along two axes: a colour and a marker a teat. An
ellipsoid is given as its outline in each view.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import ArrayLike, NDArray

from reports.figures.drawing import (
    COLOURS,
    WIDE_INCHES,
    Floats,
    LegendEntry,
    Marker,
    draw,
    finite,
    legend,
    not_measured,
    plain,
    telling,
    told,
)

_HIGH = 3.5
_MOST_MARKS = 240  # in all views together
# so many times as far as the errors a panel reaches at most: the ellipsoid of few poses may run out
# of it
_BEYOND = 2.0
_ROLES = ("ours", "theirs", "accept", "good", "ink", "muted")
MOST_GROUPS = len(_ROLES)
_MARKERS: tuple[Marker, ...] = get_args(Marker)


@dataclass(frozen=True, slots=True, eq=False)
class ErrorGroup:
    """The errors of one teat as each view has them: points (n, 2) mm a view, and its ellipsoid's
    outline (m, 2) mm a view, or none.

    ``links``: for each error the `#id` that a click opens.
    """

    name: str
    points_mm: Sequence[ArrayLike]
    outlines_mm: Sequence[ArrayLike] = ()
    links: tuple[str, ...] = ()

    def checked(self, views: int) -> tuple[list[Floats], list[Floats]]:
        """Points and outlines by view. Raises ValueError for what isn't finite or doesn't fit."""
        points, outlines = (
            [
                finite("error_regions", f"{what} of {self.name}", part).reshape(-1, 2)
                for part in given
            ]
            for what, given in (("points_mm", self.points_mm), ("outlines_mm", self.outlines_mm))
        )
        if (
            len(points) != views
            or len(outlines) not in {0, views}
            or len({len(part) for part in points}) > 1
        ):
            raise ValueError(
                f"error_regions: {self.name}: {len(points)} clouds and {len(outlines)} outlines for"
                f" {views} views"
            )
        if self.links and len(self.links) != len(points[0]):
            raise ValueError(
                f"error_regions: {self.name}: {len(self.links)} links for {len(points[0])} points;"
                " give one a point"
            )
        return points, outlines


def error_regions(
    groups: Sequence[ErrorGroup],
    views: Sequence[tuple[str, str]],
    limit_mm: float,
    *,
    name: str = "error-regions",
) -> str:
    """A panel a view, with the names of its two axes: each group's errors, its ellipsoid, and the
    limit as a circle. Equal scales.

    Raises ValueError for more groups than can be told apart, and for arrays that don't fit.
    """
    if len(groups) > MOST_GROUPS:
        raise ValueError(
            f"error_regions: {len(groups)} groups; at most {MOST_GROUPS} can be told apart, so pool"
            " some"
        )
    clouds = [group.checked(len(views)) for group in groups]
    counts = [len(points[0]) for points, _ in clouds]
    if not sum(counts):
        return not_measured(name, (WIDE_INCHES, _HIGH), "no teat end was paired with a truth")
    everything = np.concatenate(
        [part.ravel() for points, outlines in clouds for part in (*points, *outlines)]
    )
    farthest = max(
        limit_mm, *(float(np.abs(flat).max(initial=0.0)) for points, _ in clouds for flat in points)
    )
    reach = 1.08 * min(float(np.abs(everything).max(initial=farthest)), _BEYOND * farthest)
    each = _MOST_MARKS // (len(groups) * len(views))
    drawn = [
        telling(np.max([np.hypot(*flat.T) for flat in points], axis=0), each)
        for points, _ in clouds
    ]

    def plot(figure: Figure) -> None:
        for panel, axes in enumerate(figure.subplots(1, len(views), squeeze=False)[0]):
            _frame(axes, views[panel], reach, limit_mm)
            for k, (points, outlines) in enumerate(clouds):
                _cloud(axes, points[panel], drawn[k], groups[k].links, k)
                if outlines:
                    axes.plot(*outlines[panel].T, color=COLOURS[_ROLES[k]], linewidth=1.3)
        legend(figure, _entries(groups, counts, limit_mm))
        if sum(map(len, drawn)) < sum(counts):
            figure.supxlabel(
                told(sum(map(len, drawn)), sum(counts)).strip(" ()"),
                fontsize=8.5,
                color=COLOURS["muted"],
            )

    return draw(name, (WIDE_INCHES, _HIGH), plot)


def _cloud(
    axes: Axes, flat: Floats, drawn: NDArray[np.intp], links: Sequence[str], number: int
) -> None:
    points = axes.scatter(
        flat[drawn, 0],
        flat[drawn, 1],
        s=20,
        marker=_MARKERS[number],
        color=COLOURS[_ROLES[number]],
        alpha=0.75,
        linewidths=0,
    )
    if links:
        points.set_urls([links[index] for index in drawn])


def _frame(axes: Axes, names: tuple[str, str], reach: float, limit_mm: float) -> None:
    axes.set(aspect="equal", xlim=(-reach, reach), ylim=(-reach, reach))
    axes.set(xlabel=f"{plain(names[0])} error (mm)", ylabel=f"{plain(names[1])} error (mm)")
    axes.axhline(0, color=COLOURS["muted"], linewidth=0.6)
    axes.axvline(0, color=COLOURS["muted"], linewidth=0.6)
    axes.add_patch(Circle((0, 0), limit_mm, fill=False, edgecolor=COLOURS["limit"], linewidth=1.2))


def _entries(
    groups: Sequence[ErrorGroup], counts: Sequence[int], limit_mm: float
) -> list[LegendEntry]:
    entries: list[LegendEntry] = [
        (
            f"{plain(group.name, 14)}, n = {n}{'' if group.outlines_mm else ' (too few)'}",
            _ROLES[k],
            _MARKERS[k],
        )
        for k, (group, n) in enumerate(zip(groups, counts, strict=True))
    ]
    return [*entries, (f"limit {limit_mm:g} mm", "limit", "-")]

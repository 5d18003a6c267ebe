"""The error over a plane, seen from above: a disc at each place, its area the error; what was missed stands out. Knows only millimetres."""

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from reports.figures.arrays import together
from reports.figures.drawing import COLOURS, WIDE_INCHES, LegendEntry, draw, legend, not_measured
from reports.figures.thinning import telling, told

_INCHES = (WIDE_INCHES, 5.6)
_MARK = 90.0  # points squared, of an error at the limit; the area grows with the error
_LEAST, _MOST = 6.0, 360.0


def error_map(
    x_mm: ArrayLike, y_mm: ArrayLike, error_mm: ArrayLike, limit_mm: float, *,
    missed_x_mm: ArrayLike = (), missed_y_mm: ArrayLike = (), name: str = "error-map",
) -> str:  # fmt: skip
    """Radial errors (n,) at places (n,) of a plane as discs whose area is the error, one colour within the limit and one beyond it.

    ``missed_x_mm``, ``missed_y_mm`` (m,): where nothing was found. Equal scales.
    """
    x, y, errors = together("error_map", x_mm=x_mm, y_mm=y_mm, error_mm=error_mm)
    drawn, of = telling(errors), errors.size
    x, y, errors = x[drawn], y[drawn], errors[drawn]
    missed_x, missed_y = together("error_map", missed_x_mm=missed_x_mm, missed_y_mm=missed_y_mm)
    if not x.size and not missed_x.size:
        return not_measured(name, _INCHES, "no place had a truth")

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot(aspect="equal")
        area = np.round(np.sqrt(np.clip(_MARK * errors / limit_mm, _LEAST, _MOST))) ** 2
        for within, role in ((errors <= limit_mm, "good"), (errors > limit_mm, "limit")):
            for size in np.unique(area[within]):  # one size at a time: the discs of a size share their outline in the file
                alike = within & (area == size)
                axes.scatter(x[alike], y[alike], s=size, color=COLOURS[role], alpha=0.75, linewidths=0)
        axes.scatter(missed_x, missed_y, s=22, marker="v", color=COLOURS["muted"], linewidths=0)
        axes.set(xlabel="x (mm)", ylabel="y (mm), away from the cameras")
        axes.margins(0.06)
        legend(figure, entries)

    entries: list[LegendEntry] = [
        (f"within {limit_mm:g} mm{told(len(drawn), of)}", "good", "o"),
        ("beyond", "limit", "o"),
        ("not found", "muted", "v"),
    ]
    return draw(name, _INCHES, plot)

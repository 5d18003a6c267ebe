"""Two runs of the same scenes, drawn against each other. Knows only millimetres."""

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from reports.figures.arrays import together
from reports.figures.drawing import COLOURS, HALF_INCHES, LegendEntry, draw, legend, not_measured
from reports.figures.thinning import telling

_SQUARE = (HALF_INCHES, 4.2)


def change_scatter(old_mm: ArrayLike, new_mm: ArrayLike, limit_mm: float, *, name: str = "change-scatter") -> str:
    """Errors of the same scenes before (n,) and now (n,): above the diagonal it grew worse; the limit on both axes."""
    old, new = together("change_scatter", old_mm=old_mm, new_mm=new_mm)
    if not old.size:
        return not_measured(name, _SQUARE, "no scene was found in both")

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot(aspect="equal")
        reach = 1.08 * max(limit_mm, float(old.max()), float(new.max()))
        axes.set(xlim=(0, reach), ylim=(0, reach), xlabel="baseline (mm)", ylabel="this run (mm)")
        axes.plot([0, reach], [0, reach], color=COLOURS["muted"], linewidth=0.8)
        axes.axhline(limit_mm, color=COLOURS["limit"], linewidth=1)
        axes.axvline(limit_mm, color=COLOURS["limit"], linewidth=1)
        drawn = telling(np.abs(new - old))
        for grown, role in ((new > old, "limit"), (new <= old, "good")):
            shown = drawn[grown[drawn]]
            axes.scatter(old[shown], new[shown], s=18, color=COLOURS[role], alpha=0.75, linewidths=0)
        entries: list[LegendEntry] = [("grew", "limit", "o"), ("not grown", "good", "o"), ("no change", "muted", "-")]
        legend(figure, entries)

    return draw(name, _SQUARE, plot)

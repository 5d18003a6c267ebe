"""What a rig can reach: a calibration's corners with their residuals, its precision by distance."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reports.figures.drawing import (
    COLOURS,
    HALF_INCHES,
    WIDE_INCHES,
    LegendEntry,
    Plot,
    legend,
    plotted,
    together,
)

_MOST_ARROWS = 1500  # more says no more, and makes the page heavy


@plotted
def residual_field(
    x_px: ArrayLike,
    y_px: ArrayLike,
    dx_px: ArrayLike,
    dy_px: ArrayLike,
    image_size: tuple[int, int],
    *,
    name: str,
) -> Plot:
    """Corners (n,) in the picture's frame, each with its residual, enlarged."""
    x, y, dx, dy = together("residual_field", x_px=x_px, y_px=y_px, dx_px=dx_px, dy_px=dy_px)
    inches = (HALF_INCHES, HALF_INCHES * image_size[1] / image_size[0] + 0.5)
    every = max(1, -(-len(x) // _MOST_ARROWS))
    rms = float(np.sqrt(np.mean(dx**2 + dy**2)))
    factor = 0.03 * image_size[0] / max(rms, 1e-9)
    figure = yield name, inches, ""
    axes = figure.add_subplot(aspect="equal")
    arrows = [values[::every] for values in (x, y, dx, dy)]
    look: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "width": 0.0022}
    axes.quiver(*arrows, **look, scale=1.0 / factor, color=COLOURS["ours"])
    axes.set(xlim=(-0.5, image_size[0] - 0.5), ylim=(image_size[1] - 0.5, -0.5))
    axes.set(xlabel="column (px)", ylabel="row (px)")
    legend(figure, [(f"misses, {factor:.0f} times enlarged; rms {rms:.2f} px", "ours", "-")])


@plotted
def precision_by_distance(
    depth_m: ArrayLike, good_to_mm: ArrayLike, seen_m: tuple[float, float]
) -> Plot:
    """Precision (n,) mm over distance (n,) m; the board's distances are shaded."""
    depth, good = together("precision_by_distance", depth_m=depth_m, good_to_mm=good_to_mm)
    figure = yield "precision", (WIDE_INCHES, 2.8), ""
    axes = figure.add_subplot()
    axes.axvspan(*seen_m, color=COLOURS["span"], linewidth=0)
    axes.plot(depth, good, color=COLOURS["ours"])
    axes.set(xlabel="distance from the cameras (m)", ylabel="good to (mm)", ylim=(0, None))
    good_to: LegendEntry = ("expanded uncertainty, k = 2, worst direction", "ours", "-")
    legend(figure, [good_to, ("the board was here", "span", "patch")])

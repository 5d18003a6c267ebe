"""What a rig can reach: a calibration's corners with their residuals, its precision by distance,
and how errors grow with one quantity: a curve a method, the physical bound, and the share found.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator, PercentFormatter
from numpy.typing import ArrayLike

from reports.figures.drawing import (
    COLOURS,
    HALF_INCHES,
    WIDE_INCHES,
    Floats,
    LegendEntry,
    draw,
    legend,
    marks,
    not_measured,
    plain,
    together,
)

_INCHES = (WIDE_INCHES, 5.0)
_ROLES = ("ours", "theirs", "accept", "muted")  # of methods, in their order
MOST_CURVES = len(_ROLES)
_TICKS_MM = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """One method: median and p95 errors (n,) mm at ``x`` (n,); share found (m,) at ``share_x``."""

    name: str
    x: ArrayLike
    median_mm: ArrayLike
    p95_mm: ArrayLike
    share_x: ArrayLike
    share: ArrayLike


@dataclass(frozen=True, slots=True, eq=False)
class Bound:
    """What physics allows: median errors (n,) mm by noise, and for a disparity good to so many
    pixels; the share (m,) that can be found.
    """

    x: ArrayLike
    median_mm: ArrayLike
    disparity_mm: ArrayLike
    disparity_px: float
    share_x: ArrayLike = ()
    share: ArrayLike = ()


def sensitivity(
    curves: Sequence[Curve],
    bound: Bound,
    label: str,
    *,
    logarithmic: bool = False,
    name: str = "sensitivity",
) -> str:
    """Errors over the quantity ``label``, medians and p95, with bounds; shares found below. Raises
    ValueError for what has no place on a logarithmic scale.
    """
    errors = [
        together("sensitivity", x=c.x, median_mm=c.median_mm, p95_mm=c.p95_mm) for c in curves
    ]
    shares = [together("sensitivity", share_x=c.share_x, share=c.share) for c in curves]
    limit_x, limit_mm, disparity = together(
        "sensitivity", x=bound.x, median_mm=bound.median_mm, disparity_mm=bound.disparity_mm
    )
    share_x, share = together("sensitivity", share_x=bound.share_x, share=bound.share)
    columns = [limit_mm, disparity, *(column for _, *two in errors for column in two)]
    if any((column <= 0.0).any() for column in columns):
        raise ValueError(
            "sensitivity: an error that is not above 0 mm has no place on a logarithmic scale"
        )
    if not any(x.size for x, _ in shares):
        return not_measured(name, _INCHES, "no value was measured")

    def plot(figure: Figure) -> None:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1.2))
        for role, (x, median, p95), (at, found) in zip(_ROLES, errors, shares, strict=False):
            marks(above, x, median, role, line="-")
            marks(above, x, p95, role, form="v", line="--", linewidth=1)
            marks(below, at, found, role, line="-")
        above.plot(limit_x, limit_mm, color=COLOURS["limit"], linewidth=1.2)
        above.plot(limit_x, disparity, color=COLOURS["good"], linestyle="--", linewidth=1)
        below.plot(share_x, share, color=COLOURS["limit"], linewidth=1.2)
        _scales(above, below, label, np.concatenate([x for x, _ in shares]), logarithmic)
        entries: list[LegendEntry] = [
            (plain(curve.name), role, "-") for role, curve in zip(_ROLES, curves, strict=False)
        ]
        entries += [("p95", "ink", "v"), ("limit by noise", "limit", "-")]
        legend(figure, [*entries, (f"disparity to {bound.disparity_px:g} px", "good", "--")])

    return draw(name, _INCHES, plot)


def _scales(above: Axes, below: Axes, label: str, x: Floats, logarithmic: bool) -> None:
    """Errors on a logarithmic scale with round numbers; the quantity's own values as its ticks."""
    above.set(yscale="log", ylabel="3-D error of found ends (mm)")
    low, high = above.get_ylim()
    above.set_yticks([tick for tick in _TICKS_MM if low <= tick <= high])
    above.yaxis.set_minor_locator(NullLocator())
    above.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    below.set(ylim=(-0.05, 1.08), ylabel="found of visible", xlabel=label)
    below.yaxis.set_major_formatter(PercentFormatter(1))
    if logarithmic:
        below.set_xscale("log")
        below.xaxis.set_minor_locator(NullLocator())
    below.set_xticks(np.unique(x))
    below.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


_MOST_ARROWS = 1500  # more says no more, and makes the page heavy


def residual_field(
    x_px: ArrayLike,
    y_px: ArrayLike,
    dx_px: ArrayLike,
    dy_px: ArrayLike,
    image_size: tuple[int, int],
    *,
    name: str,
) -> str:
    """Corners (n,) in the picture's frame, each with its residual, enlarged."""
    x, y, dx, dy = together("residual_field", x_px=x_px, y_px=y_px, dx_px=dx_px, dy_px=dy_px)
    inches = (HALF_INCHES, HALF_INCHES * image_size[1] / image_size[0] + 0.5)
    every = max(1, -(-len(x) // _MOST_ARROWS))
    rms = float(np.sqrt(np.mean(dx**2 + dy**2)))
    factor = 0.03 * image_size[0] / max(rms, 1e-9)

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot(aspect="equal")
        arrows = [values[::every] for values in (x, y, dx, dy)]
        look: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "width": 0.0022}
        axes.quiver(*arrows, **look, scale=1.0 / factor, color=COLOURS["ours"])
        axes.set(xlim=(-0.5, image_size[0] - 0.5), ylim=(image_size[1] - 0.5, -0.5))
        axes.set(xlabel="column (px)", ylabel="row (px)")
        legend(figure, [(f"misses, {factor:.0f} times enlarged; rms {rms:.2f} px", "ours", "-")])

    return draw(name, inches, plot)


def precision_by_distance(
    depth_m: ArrayLike,
    good_to_mm: ArrayLike,
    seen_m: tuple[float, float],
    *,
    name: str = "precision",
) -> str:
    """Precision (n,) mm over distance (n,) m; the board's distances are shaded."""
    depth, good = together("precision_by_distance", depth_m=depth_m, good_to_mm=good_to_mm)

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.axvspan(*seen_m, color=COLOURS["span"], linewidth=0)
        axes.plot(depth, good, color=COLOURS["ours"])
        axes.set(xlabel="distance from the cameras (m)", ylabel="good to (mm)", ylim=(0, None))
        good_to: LegendEntry = ("expanded uncertainty, k = 2, worst direction", "ours", "-")
        legend(figure, [good_to, ("the board was here", "span", "patch")])

    return draw(name, (WIDE_INCHES, 2.8), plot)

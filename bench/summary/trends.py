"""The report's part on trends: does the error depend on place, time, bath temperature or the teat's tilt, and how much could be hidden.

May not judge: a trend is no requirement. It says where to look, and what the data leave open.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from bench.dependence import ErrorRows, run_trends
from bench.scoring.trends import LEAST, Trend
from bench.summary.anchors import id_of
from bench.summary.wording import NOT_MEASURED
from reports.figures import Slope, slope_intervals
from reports.page import Cell, Column, Figure, Paragraph, Part, Table

# A quantity of the rows: what it is called, its unit in the report, and how many of its own units that is.
QUANTITIES = {
    "x_mm": ("x", "mm", 1.0),
    "y_mm": ("y", "mm", 1.0),
    "z_mm": ("z", "mm", 1.0),
    "time_s": ("time", "h", 3600.0),
    "bath_c": ("bath temperature", "K", 1.0),
    "tilt_deg": ("tilt of the teat", "°", 1.0),
}
NOTE = (
    "Errors of one pose are not independent, so the slope's error is the jackknife over poses; where poses are repeated, time and bath are "
    "asked within them. All p-values of the table are adjusted together (Holm).\n"
    "“No trend shown” doesn't say that there is none: it says that chance alone explains what was seen. As far as these poses tell, a "
    "trend may still make, over the whole range, as much as the column “could be up to” says; more poses over a wider range narrow it."
)


def trend_parts(rows: ErrorRows, detector: str) -> Iterator[Part]:
    """A figure and a table of all lines; a sentence where there are too few poses for any."""
    poses = len(set(rows.of_found(rows.poses)))
    if poses < LEAST:
        yield Paragraph(f"Trends, {detector}: {NOT_MEASURED}; teats were found in {poses} poses, and {LEAST} are the least.")
        return
    lines = run_trends(rows)
    slopes = [_slope(line) for line in lines if line.slope is not None]
    shown = [f"{slope.response} with {slope.against}" for slope in slopes if slope.shown]
    told = f"Trend shown: {', '.join(shown)}." if shown else "No trend is shown."
    caption = f"What each trend makes of its quantity's whole range, {detector}. {told}"
    yield Figure(slope_intervals(slopes, name=f"trends-{id_of(detector)}"), caption, told, wide=True)
    measured = (_row(line) for line in lines if line.slope is not None)
    columns = (
        Column("error"), Column("against"), Column("n", "right"), Column("poses", "right", hint="independent units; within poses: trials"),
        Column("range", "right", "of the unit"), Column("slope", "right", "mm per unit"), Column("95 % interval", "right", "mm per unit"),
        Column("over the range", "right", "mm"), Column("could be up to", "right", "mm", hint="over the range, either way, 95 %"),
        Column("p (Holm)", "right"), Column("trend"),
    )  # fmt: skip
    yield Table(f"Trends of the error, {detector}", columns, (*measured, *_not_measured(lines)), NOTE)


def _slope(line: Trend) -> Slope:
    slope, low, high = _figures(line)
    return Slope(QUANTITIES[line.quantity][0], _response(line), slope * line.span, low * line.span, high * line.span, line.significant)


def _row(line: Trend) -> tuple[str | Cell, ...]:
    name, unit, factor = QUANTITIES[line.quantity]
    start = (_response(line), f"{name} ({unit})", str(line.n), str(line.groups), f"{line.span / factor:.3g}")
    slope, low, high = _figures(line)
    most = max(abs(low), abs(high)) * line.span
    p = line.p_value if line.p_holm is None else line.p_holm
    told = Cell("trend shown", "warn") if line.significant else Cell("no trend shown", "muted")
    interval = f"{low * factor:+.3g} to {high * factor:+.3g}"
    return (*start, f"{slope * factor:+.3g}", interval, f"{slope * line.span:+.2f}", f"{most:.2f}", "" if p is None else f"{p:.3g}", told)


def _not_measured(lines: Sequence[Trend]) -> Iterator[tuple[str | Cell, ...]]:
    """One row for each quantity that no line could be drawn against."""
    for quantity, line in {line.quantity: line for line in lines if line.slope is None}.items():
        name, unit, factor = QUANTITIES[quantity]
        span = f"{line.span / factor:.3g}" if line.n else ""
        why = Cell(f"{NOT_MEASURED}: {_why_not(line)}", "muted")
        yield ("any error", f"{name} ({unit})", str(line.n), str(line.groups), span, "", "", "", "", "", why)


def _figures(line: Trend) -> tuple[float, float, float]:
    """Slope, low and high of a line that was measured: where there is a slope there are the others."""
    slope, low, high = line.slope, line.low, line.high
    if slope is None or low is None or high is None:
        raise ValueError(f"the trend of {line.response} with {line.quantity} has no slope")
    return slope, low, high


def _response(line: Trend) -> str:
    return line.response if line.response == "distance" else f"{line.response} error"


def _why_not(line: Trend) -> str:
    if not line.n:
        return "it isn't known in this run"
    return f"in {line.groups} poses, {LEAST} are the least" if line.groups < LEAST else "it hardly varied"

"""What went on over time (the bath's temperature, the detection times), shares as bars with their
counts, and slopes with intervals. A share of nothing is "not measured".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator, PercentFormatter
from numpy.typing import ArrayLike

from reports.figures.drawing import (
    COLOURS,
    HALF_INCHES,
    THIRD_INCHES,
    WIDE_INCHES,
    LegendEntry,
    Marker,
    Plot,
    detector_look,
    envelope,
    finite,
    legend,
    marks,
    plain,
    plotted,
    row_names,
    subsample,
    together,
)

_MOST_CAPTURES = 250  # more marks than that stand on each other
_TIMES = (HALF_INCHES, 3.6)
_THIRD = (THIRD_INCHES, 1.6)
_THESIS_PRESENT = 4  # teats in each of the thesis's pictures


@plotted
def bath_curve(
    times_s: ArrayLike,
    temps_c: ArrayLike,
    setpoint_c: float,
    band_k: float,
    captures_s: ArrayLike,
    stable_spans_s: Sequence[tuple[float, float]] = (),
) -> Plot:
    """Bath temperature (n,) over time (n,), and below its deviation from the set point with the
    band; ticks at `captures_s`, shaded where the gate called it stable.
    """
    times, temps = together("bath_curve", times_s=times_s, temps_c=temps_c)
    captures = finite("bath_curve", "captures_s", captures_s).ravel()
    taken = captures.size
    inches = (WIDE_INCHES, 4.4)
    figure = yield "bath-curve", inches, "" if times.size else "the bath gave no reading"
    shown = envelope(temps)
    minutes, temps = times[shown] / 60, temps[shown]
    captures = captures[subsample(captures, _MOST_CAPTURES)]
    single = "o" if minutes.size == 1 else ""
    whole, close = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
    for panel in (whole, close):
        for start, end in stable_spans_s:
            panel.axvspan(start / 60, end / 60, color=COLOURS["span"], linewidth=0)
    whole.axhline(setpoint_c, color=COLOURS["good"], linewidth=1, linestyle="--")
    whole.plot(minutes, temps, color=COLOURS["ours"], marker=single)
    whole.set(ylabel="temperature (°C)")
    whole.margins(x=0.01, y=0.12)
    close.axhspan(-band_k, band_k, facecolor=COLOURS["band"], linewidth=0)
    for side in (-band_k, band_k):
        close.axhline(side, color=COLOURS["good"], linewidth=0.8)
    off_k = temps - setpoint_c
    close.plot(minutes, off_k, color=COLOURS["ours"], marker=single, linewidth=1.1)
    close.set(ylim=(-3 * band_k, 3 * band_k), ylabel="from set point (K)")
    ticks = {"linestyle": "none", "marker": "v", "markersize": 5, "color": COLOURS["ink"]}
    (drawn,) = close.plot(captures / 60, np.full(captures.size, 1.0), **ticks)
    drawn.set(transform=close.get_xaxis_transform(), clip_on=False)
    close.set_xlabel("time (min)")
    held: LegendEntry = (f"set point {setpoint_c:g} °C ± {band_k:g} K", "good", "--")
    capture: LegendEntry = (f"capture ({taken})", "ink", "v")
    legend(figure, [("bath", "ours", "-"), held, ("stable", "span", "patch"), capture])


@plotted
def bath_sparkline(
    times_s: ArrayLike, temps_c: ArrayLike, setpoint_c: float, band_k: float
) -> Plot:
    """Bath temperature (n,) over time (n,) as a line on its band, ± band_k."""
    times, temps = together("bath_sparkline", times_s=times_s, temps_c=temps_c)
    shown = envelope(temps)
    figure = yield "bath-sparkline", (THIRD_INCHES, 1.6), ""
    axes = figure.add_subplot()
    axes.axhspan(-band_k, band_k, facecolor=COLOURS["band"], linewidth=0)
    single = "o" if shown.size == 1 else ""
    off_k = temps[shown] - setpoint_c
    axes.plot(times[shown] / 60, off_k, color=COLOURS["ours"], marker=single, linewidth=1.1)
    axes.set(ylim=(-1.8 * band_k, 1.8 * band_k), yticks=[-band_k, band_k])
    axes.set_yticklabels([f"−{band_k:g} K", f"+{band_k:g} K"])
    axes.set(xlabel="time (min)", ylabel=f"{setpoint_c:g} °C")
    axes.grid(visible=False)


@plotted
def control_chart(
    values: ArrayLike,
    limits: tuple[float, float] | None,
    broken: Sequence[bool],
    base: int,
    dates: tuple[str, str],
    *,
    unit: str = "",
    name: str,
) -> Plot:
    """Values (n,) in the order of their runs, with mean and three standard deviations (``limits``)
    of the first ``base``; a diamond where a rule is ``broken``; ``dates`` of the first and last.
    """
    shown = finite("control_chart", "values", values)
    figure = yield name, _THIRD, ""
    axes = figure.add_subplot(ylabel=unit)
    order = np.arange(1, shown.size + 1)
    if limits:
        centre, sigma = limits
        axes.axvspan(0.5, base + 0.5, facecolor=COLOURS["span"], linewidth=0)
        axes.axhline(centre, color=COLOURS["good"], linewidth=1.0)
        for side in (-3.0, 3.0):
            at = centre + side * sigma
            axes.axhline(at, color=COLOURS["limit"], linewidth=0.9, linestyle="--")
    axes.plot(order, shown, color=COLOURS["ours"], linewidth=0.9)
    out = np.array(broken or [False] * shown.size)
    marks(axes, order[~out], shown[~out])
    marks(axes, order[out], shown[out], "limit", 6.0, "D")
    axes.set(xlim=(0.4, shown.size + 0.6), xticks=[1, shown.size])
    axes.set_xticklabels(dates)
    first, last = axes.get_xticklabels()
    first.set_horizontalalignment("left")
    last.set_horizontalalignment("right")
    axes.margins(y=0.15)


@plotted
def latency_strip(
    times_s: ArrayLike, limits_s: Sequence[float], *, who: int = 0, name: str = "latency-strip"
) -> Plot:
    """Every detection time (n,) in order, with limits; p50, p95 and the longest written out."""
    times = finite("latency_strip", "times_s", times_s)
    figure = yield name, _TIMES, "" if times.size else "no detection was timed"
    axes = figure.add_subplot()
    order, shown = np.arange(1, times.size + 1), subsample(times)
    role, form = detector_look(who)
    marks(axes, order[shown], times[shown], role, form=form)
    top = 1.12 * max(float(times.max()), *limits_s, 1e-6)
    axes.set(xlim=(0.5, times.size + 0.5), ylim=(0, top))
    axes.set(xlabel="detection, in order", ylabel="time (s)")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    for limit in limits_s:
        axes.axhline(limit, color=COLOURS["limit"], linewidth=1.2)
        text = axes.text(1, limit, f"limit {limit:g} s", color=COLOURS["limit"])
        text.set(ha="right", va="bottom", transform=axes.get_yaxis_transform())
    p50, p95 = np.quantile(times, [0.5, 0.95])
    title = f"p50 {p50:.3g} s · p95 {p95:.3g} s · longest {times.max():.3g} s"
    axes.set_title(title, loc="left", color=COLOURS["muted"])


@plotted
def found_bars(
    situations: Sequence[str],
    found: Sequence[int],
    present: Sequence[int],
    thesis_found: Sequence[int | None],
    *,
    who: int = 0,
    name: str = "found-bars",
) -> Plot:
    """Share found in each situation, ours over the thesis's (None: no figure), with counts."""
    inches = (HALF_INCHES, 0.9 + 0.52 * max(len(situations), 3))
    figure = yield name, inches, "" if situations else "no situation was run"
    axes = figure.add_subplot()
    role, _ = detector_look(who)
    for row, (ours, of, theirs) in enumerate(zip(found, present, thesis_found, strict=True)):
        _share_bar(axes, row - 0.2, ours, of, role)
        if theirs is not None:
            _share_bar(axes, row + 0.2, theirs, _THESIS_PRESENT, "muted")
    row_names(axes, situations)
    axes.set(xlim=(0, 1.28), ylim=(len(situations) - 0.45, -0.55))
    axes.set(xlabel="share of visible teats found", xticks=[0, 0.25, 0.5, 0.75, 1])
    axes.xaxis.set_major_formatter(PercentFormatter(1, symbol=" %"))
    legend(figure, [("this run", role, "patch"), ("thesis, section 5.2", "muted", "patch")])


def _share_bar(axes: Axes, y: float, found: int, of: int, role: str) -> None:
    if of:
        axes.barh(y, found / of, height=0.36, color=COLOURS[role])
    text = f"{found} of {of}" if of else "not measured"
    axes.text((found / of if of else 0) + 0.02, y, text, va="center", color=COLOURS[role])


@dataclass(frozen=True, slots=True)
class Slope:
    """A line: quantity, response, effect over the range, mm, interval; ``shown``: significant."""

    against: str
    response: str
    value: float
    low: float
    high: float
    shown: bool


@plotted
def slope_intervals(slopes: Sequence[Slope], *, name: str = "slope-intervals") -> Plot:
    """A panel a response, a row a question, with intervals. Raises ValueError if not finite."""
    for one in slopes:
        finite("slope_intervals", one.against, [one.value, one.low, one.high])
    rows = list(dict.fromkeys(slope.against for slope in slopes))
    panels = list(dict.fromkeys(slope.response for slope in slopes))
    if not rows:
        yield name, (WIDE_INCHES, 2.0), "no line was drawn through the errors"
    figure = yield name, (WIDE_INCHES, 0.9 + 0.28 * max(len(rows), 3)), ""
    reach = 1.1 * max(1e-6, *(max(abs(slope.low), abs(slope.high)) for slope in slopes))
    every = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    for axes, panel in zip(every, panels, strict=True):
        axes.axvline(0, color=COLOURS["muted"], linewidth=0.8)
        for slope in (one for one in slopes if one.response == panel):
            y, role = rows.index(slope.against), "limit" if slope.shown else "ink"
            axes.plot([slope.low, slope.high], [y, y], color=COLOURS[role], linewidth=1.4)
            form: Marker = "D" if slope.shown else "o"
            marks(axes, [slope.value], [y], role, 4.5, form, line="-")
        axes.set(xlim=(-reach, reach), xlabel=f"{plain(panel)} (mm)")
        row_names(axes, rows)
    unshown: LegendEntry = ("no trend shown, 95 % interval", "ink", "o")
    legend(figure, [unshown, ("trend shown", "limit", "D")])

"""What went on over time: the bath's temperature and the detection times."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import ArrayLike

from reports.figures.drawing import (
    COLOURS,
    HALF_INCHES,
    WIDE_INCHES,
    Floats,
    LegendEntry,
    draw,
    envelope,
    finite,
    legend,
    not_measured,
    telling,
    together,
)

_MOST_CAPTURES = 250  # more marks than that stand on each other


def bath_curve(
    times_s: ArrayLike,
    temps_c: ArrayLike,
    setpoint_c: float,
    band_k: float,
    captures_s: ArrayLike,
    stable_spans_s: Sequence[tuple[float, float]] = (),
    teat_temps_c: ArrayLike | None = None,
    *,
    name: str = "bath-curve",
) -> str:
    """Bath temperature (n,) over time (n,), above; its deviation from the set point at the scale of
    the band (+- band_k), below.

    `captures_s` (m,): when frames were taken, ticks between the panels. `stable_spans_s`: (start,
    end) of the times the gate called stable. `teat_temps_c` (n,) or (n, k): teats' temperatures at
    the same times, thin lines in the upper panel.
    """
    times, temps = together("bath_curve", times_s=times_s, temps_c=temps_c)
    captures = finite("bath_curve", "captures_s", captures_s).ravel()
    taken = captures.size
    teats = None if teat_temps_c is None else finite("bath_curve", "teat_temps_c", teat_temps_c)
    if teats is not None and len(teats) != times.size:
        raise ValueError(
            f"bath_curve: teat_temps_c has {len(teats)} rows for {times.size} times; give one row a"
            " time"
        )
    inches = (WIDE_INCHES, 4.4)
    if not times.size:
        return not_measured(name, inches, "the bath gave no reading")
    shown = envelope(temps)
    times, temps, teats = times[shown], temps[shown], None if teats is None else teats[shown]
    captures = captures[telling(captures, _MOST_CAPTURES)]

    def plot(figure: Figure) -> None:
        whole, close = figure.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for panel in (whole, close):
            for start, end in stable_spans_s:
                panel.axvspan(start / 60, end / 60, color=COLOURS["span"], linewidth=0)
        _bath_lines(whole, times / 60, temps, teats, setpoint_c)
        _deviation(close, times / 60, temps - setpoint_c, band_k)
        marks = close.plot(
            captures / 60,
            np.full(captures.size, 1.0),
            linestyle="none",
            marker="v",
            markersize=5,
            color=COLOURS["ink"],
        )
        marks[0].set(transform=close.get_xaxis_transform(), clip_on=False)
        close.set_xlabel("time (min)")
        teat_entry: list[LegendEntry] = [] if teats is None else [("teats", "theirs", "-")]
        limits: list[LegendEntry] = [
            (f"set point {setpoint_c:g} °C ± {band_k:g} K", "good", "--"),
            ("stable", "span", "patch"),
        ]
        legend(
            figure,
            [("bath", "ours", "-"), *teat_entry, *limits, (f"capture ({taken})", "ink", "v")],
        )

    return draw(name, inches, plot)


def latency_strip(
    times_s: ArrayLike, limits_s: Sequence[float], *, name: str = "latency-strip"
) -> str:
    """Every detection time (n,) in order, with limits; p50, p95 and the longest written out."""
    times = finite("latency_strip", "times_s", times_s)
    if not times.size:
        return not_measured(name, (HALF_INCHES, 3.6), "no detection was timed")

    def plot(figure: Figure) -> None:
        axes = figure.add_subplot()
        order = np.arange(1, times.size + 1)
        shown = telling(times)
        axes.plot(
            order[shown],
            times[shown],
            linestyle="none",
            marker="o",
            markersize=4.2,
            color=COLOURS["ours"],
            markeredgewidth=0,
        )
        top = 1.12 * max(float(times.max()), *limits_s, 1e-6)
        axes.set(
            xlim=(0.5, times.size + 0.5),
            ylim=(0, top),
            xlabel="detection, in order",
            ylabel="time (s)",
        )
        axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        for limit in limits_s:
            axes.axhline(limit, color=COLOURS["limit"], linewidth=1.2)
            axes.text(
                1,
                limit,
                f"limit {limit:g} s",
                color=COLOURS["limit"],
                ha="right",
                va="bottom",
                transform=axes.get_yaxis_transform(),
            )
        p50, p95 = np.quantile(times, [0.5, 0.95])
        axes.set_title(
            f"p50 {p50:.3g} s · p95 {p95:.3g} s · longest {times.max():.3g} s",
            loc="left",
            color=COLOURS["muted"],
        )

    return draw(name, (HALF_INCHES, 3.6), plot)


def _bath_lines(
    axes: Axes, minutes: Floats, temps: Floats, teats: Floats | None, setpoint_c: float
) -> None:
    axes.axhline(setpoint_c, color=COLOURS["good"], linewidth=1, linestyle="--")
    if teats is not None:
        axes.plot(minutes, teats, color=COLOURS["theirs"], linewidth=0.9)
    axes.plot(minutes, temps, color=COLOURS["ours"], marker="o" if minutes.size == 1 else "")
    axes.set(ylabel="temperature (°C)")
    axes.margins(x=0.01, y=0.12)


def _deviation(axes: Axes, minutes: Floats, deviation_k: Floats, band_k: float) -> None:
    axes.axhspan(-band_k, band_k, facecolor=COLOURS["band"], linewidth=0)
    for side in (-band_k, band_k):
        axes.axhline(side, color=COLOURS["good"], linewidth=0.8)
    axes.plot(
        minutes,
        deviation_k,
        color=COLOURS["ours"],
        marker="o" if minutes.size == 1 else "",
        linewidth=1.1,
    )
    axes.set(ylim=(-3 * band_k, 3 * band_k), ylabel="from set point (K)")

"""What `bath watch` shows of a bath: its last minutes as a plot of characters, its state, and how
long until it is stable.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

import bench
from instruments import BathReading

PERIOD_S = 1.0  # between two readings
KEPT_S = 3600.0
WIDTH, HEIGHT = 72, 14
LEAST_SPAN_K = 0.2  # or noise would fill the plot
POINT, LINE = "•", "─"
BARS = "▁▂▃▄▅▆▇█"  # 0 to 100 %


def plot(samples: Sequence[BathReading], set_point_c: float) -> list[str]:
    """Temperature over time, the set point as a line, in `HEIGHT` rows; then the time."""
    temps_c = np.array([set_point_c, *(sample.temp_c for sample in samples)])
    low, high = temps_c.min(), temps_c.max()
    middle, half = (low + high) / 2, max(high - low, LEAST_SPAN_K) * 0.55
    from_top = np.rint((middle + half - temps_c) / (2 * half) * (HEIGHT - 1))
    rows = np.clip(from_top, 0, HEIGHT - 1).astype(int)
    cells = np.full((HEIGHT, WIDTH), " ")
    cells[rows[0]] = LINE
    columns, span_s = _columns(samples)
    cells[rows[1:], columns] = POINT
    labels = {0: middle + half, HEIGHT - 1: middle - half, rows[0]: set_point_c}
    lines = [
        f"{f'{labels[i]:.2f}' if i in labels else '':>7} {''.join(row)}"
        for i, row in enumerate(cells)
    ]
    return [*lines, f"{'degC':>7} last {span_s / 60:.1f} min; {LINE * 2} set point, {POINT} bath"]


def output_strip(samples: Sequence[BathReading]) -> str:
    """The heater's output over the same time, a bar a column; empty where it isn't reported."""
    bars = [" "] * WIDTH
    for column, sample in zip(_columns(samples)[0], samples, strict=True):
        if sample.power_percent is not None:
            part = min(100.0, max(0.0, sample.power_percent)) / 100.0
            bars[column] = BARS[round(part * (len(BARS) - 1))]
    return f"{'output':>7} {''.join(bars)}" if any(bar != " " for bar in bars) else ""


def _columns(samples: Sequence[BathReading]) -> tuple[NDArray[np.int_], float]:
    """In which of `WIDTH` columns each reading stands, and how many seconds they span."""
    after_s = np.array([sample.t_s for sample in samples]) - samples[0].t_s
    span_s = max(float(after_s[-1]), WIDTH * PERIOD_S)
    return np.minimum(WIDTH - 1, after_s / span_s * (WIDTH - 1)).astype(int), span_s


class BathPlot:
    """What is shown of each view of a bath."""

    def __init__(self) -> None:
        self._samples: deque[BathReading] = deque()

    def add(self, view: bench.BathView) -> None:
        """Take a view in."""
        self._view = view
        if (reading := view.reading) is not None:
            self._samples.append(reading)
            while reading.t_s - self._samples[0].t_s > KEPT_S:
                self._samples.popleft()

    def line(self) -> str:
        """The state in one line."""
        view, problem = self._view, self._view.fault and f"NO READING: {self._view.fault}"
        if not self._samples:
            return problem
        reading, left_s = self._samples[-1], view.stable_in_s
        percent = reading.power_percent
        output = "not reported" if percent is None else f"{percent:.0f} %"
        parts = [f"{reading.temp_c:.2f} degC", f"set point {view.set_point_c:.2f} degC"]
        minutes, seconds = divmod(int(left_s or 0), 60)
        when = {None: "not getting nearer", 0.0: "stable now"}.get(
            left_s, f"stable in {minutes}:{seconds:02d} min at the earliest"
        )
        parts += [f"output {output}", *([view.state, when] if view.started else ["in standby"])]
        parts += [f"alarm {reading.alarm}"] if reading.alarm else []
        return ", ".join(filter(None, [*parts, problem]))

    def lines(self) -> Iterator[str]:
        """Plot, state, and what the gate still waits for."""
        if self._samples:
            yield from plot(self._samples, self._view.set_point_c)
            yield from filter(None, [output_strip(self._samples)])
        yield self.line()
        if self._view.state != "heating":
            yield from (f"  {reason}" for reason in self._view.reasons)


def show_views(views: Iterable[bench.BathView], console: Console) -> None:
    """Show each; a line a view without a terminal."""
    shown = BathPlot()
    with Live(console=console, auto_refresh=False, transient=False) as live:
        for view in views:
            shown.add(view)
            if console.is_terminal:
                live.update(Group(*(Text(line) for line in shown.lines())), refresh=True)
            else:
                console.print(shown.line(), markup=False, highlight=False, soft_wrap=True)

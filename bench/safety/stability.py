"""A sliding window of readings with its mean, slope, extremes, and how many of them differ.

Strategy: running sums for mean and slope, monotonic queues for the extremes, a count of distinct
raw readings; a reading costs the same however long the window is. Pure; may not know what the
figures are good for.

When is the bath stable? A sliding window of readings against the gate of the script: heating,
settling, stable.

The window's figures are `stability_window`'s. Criteria after ASTM E2488 practice: mean, half range
and least-squares slope over the window, with hysteresis on leaving; a sensor at the teats, where
there is one, has a slope of its own to keep. Knows no bath, no Modbus, no clock: a reading comes
with its time. A frozen reading, a gap or an alarm is never evidence of stability.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Hashable
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from math import isfinite

TIME_SLACK_S = 1e-6  # readings at 0.1 s steps add up to 599.9999999 s


class Window:
    """Deviations from the set point (K) over the last `span`: sums about a moving origin, and
    extremes in monotonic queues.
    """

    __slots__ = (
        "_highs",
        "_lows",
        "_origin_s",
        "_raw",
        "_readings",
        "_since_sums",
        "_st",
        "_stt",
        "_sty",
        "_sy",
    )

    def __init__(self) -> None:
        self._readings: deque[tuple[float, float, Hashable]] = deque()
        self._lows: deque[tuple[float, float]] = deque()
        self._highs: deque[tuple[float, float]] = deque()
        self._raw: Counter[Hashable] = Counter()
        self._origin_s = self._st = self._stt = self._sy = self._sty = 0.0
        self._since_sums = 0

    def __len__(self) -> int:
        return len(self._readings)

    def add(self, t_s: float, y: float, raw: Hashable, window_s: float) -> None:
        """Append a reading and drop those that the window no longer needs to span `window_s`."""
        if not self._readings:
            self._origin_s = t_s
        self._readings.append((t_s, y, raw))
        self._raw[raw] += 1
        self._sum(t_s, y, 1.0)
        while self._lows and self._lows[-1][1] >= y:
            self._lows.pop()
        self._lows.append((t_s, y))
        while self._highs and self._highs[-1][1] <= y:
            self._highs.pop()
        self._highs.append((t_s, y))
        while len(self._readings) > 1 and t_s - self._readings[1][0] >= window_s - TIME_SLACK_S:
            self._drop()
        self._since_sums += 1
        if self._since_sums > 2 * len(self._readings) + 64:
            self._sum_afresh()

    @property
    def span_s(self) -> float:
        return self._readings[-1][0] - self._readings[0][0] if self._readings else 0.0

    @property
    def distinct(self) -> int:
        return len(self._raw)

    @property
    def mean(self) -> float:
        return self._sy / len(self._readings)

    @property
    def half_range(self) -> float:
        return (self._highs[0][1] - self._lows[0][1]) / 2.0

    @property
    def slope(self) -> float:
        """Least squares, K/s."""
        n = len(self._readings)
        return (self._sty - self._st * self._sy / n) / (self._stt - self._st * self._st / n)

    def _drop(self) -> None:
        t_s, y, raw = self._readings.popleft()
        self._sum(t_s, y, -1.0)
        self._raw[raw] -= 1
        if not self._raw[raw]:
            del self._raw[raw]
        for extremes in (self._lows, self._highs):
            if extremes[0][0] <= t_s:
                extremes.popleft()

    def _sum(self, t_s: float, y: float, sign: float) -> None:
        t = t_s - self._origin_s
        self._st += sign * t
        self._stt += sign * t * t
        self._sy += sign * y
        self._sty += sign * t * y

    def _sum_afresh(self) -> None:
        """Rounding of added and dropped readings piles up, and the origin falls behind: start the
        sums again, at a cost spread over the window.
        """
        self._origin_s, self._since_sums = self._readings[0][0], 0
        self._st = self._stt = self._sy = self._sty = 0.0
        for t_s, y, _ in self._readings:
            self._sum(t_s, y, 1.0)


FIGURES_FROM = 0.1  # of the window: figures of less are noise


class State(StrEnum):
    """`heating`: further from the set point than `leave_k`; `settling`: near it, not shown to be
    stable; `stable`.
    """

    HEATING = "heating"
    SETTLING = "settling"
    STABLE = "stable"


@dataclass(frozen=True, slots=True)
class StabilityReport:
    """The window as it stands. Figures are None before the first reading (the slope before the
    second); `near_s` is how long the bath has been near its set point without a gap, at most the
    window; `reasons` says what is not fulfilled.
    """

    state: State
    set_point_c: float
    t_s: float | None
    pv_c: float | None
    n: int
    window_s: float
    mean_c: float | None
    half_range_k: float | None
    slope_k_per_min: float | None
    distinct: int
    frozen: bool
    near_s: float
    reasons: tuple[str, ...]

    def as_dict(self) -> dict[str, object]:
        """Plain numbers, text and None."""
        return {**asdict(self), "state": self.state.value, "reasons": list(self.reasons)}


@dataclass(slots=True, eq=False)
class StabilityGate:
    """Feed every reading to `add`; ask `state` and `report`. Limits are the script's.

    `min_distinct` raw readings must differ within the window, and a raw reading may repeat for
    `frozen_s` at the most: a steady bath shows one value of a 0.01 K step for a while, a dead
    controller shows it for ever. Where the temperature is so coarse that a good bath shows one
    value only (0.1 K), pass another value that moves (heater output, a heartbeat) within `raw`.
    """

    set_point_c: float
    window_s: float = 600.0
    mean_k: float = 0.10
    half_range_k: float = 0.05
    slope_k_per_min: float = 0.01
    teat_slope_k_per_min: float = 0.02
    leave_k: float = 0.15
    max_gap_s: float = 5.0
    min_distinct: int = 2
    frozen_s: float = 300.0
    _state: State = field(default=State.HEATING, init=False, repr=False)
    _last: tuple[float, float] | None = field(default=None, init=False, repr=False)
    _raw: Hashable = field(default=None, init=False, repr=False)
    _raw_since_s: float = field(default=0.0, init=False, repr=False)
    _alarm: bool = field(default=False, init=False, repr=False)
    _window: Window = field(default_factory=Window, init=False, repr=False)
    # of the window, what came after the last heating
    _near: Window = field(default_factory=Window, init=False, repr=False)
    _teats: Window = field(default_factory=Window, init=False, repr=False)

    def __post_init__(self) -> None:
        positive = (
            "window_s",
            "mean_k",
            "half_range_k",
            "slope_k_per_min",
            "teat_slope_k_per_min",
            "leave_k",
            "max_gap_s",
            "frozen_s",
        )
        for name in positive:
            value = getattr(self, name)
            if not (isfinite(value) and value > 0.0):
                raise ValueError(f"stability gate: {name} = {value} must be finite and above 0")
        if self.leave_k < self.mean_k:
            raise ValueError(
                f"stability gate: leave_k = {self.leave_k} is below mean_k = {self.mean_k}; a bath"
                " could leave the state it enters"
            )
        if self.min_distinct < 1:
            raise ValueError(
                f"stability gate: min_distinct = {self.min_distinct} must be at least 1"
            )
        self.restart(self.set_point_c)  # refuses a set point that is not finite

    def restart(self, set_point_c: float | None = None) -> None:
        """Forget all readings; with a temperature, that is the new set point. To be called when the
        set point changes.
        """
        if set_point_c is not None:
            if not isfinite(set_point_c):
                raise ValueError(f"stability gate: set point {set_point_c} degC must be finite")
            self.set_point_c = set_point_c
        self._state = State.HEATING
        self._last, self._raw, self._raw_since_s = None, None, 0.0
        self._alarm = False
        self._window, self._near, self._teats = Window(), Window(), Window()

    def change_set_point(self, set_point_c: float) -> None:
        """A new set point restarts the gate; the same one again doesn't."""
        if set_point_c != self.set_point_c:
            self.restart(set_point_c)

    def add(
        self,
        t_s: float,
        temp_c: float,
        *,
        raw: Hashable = None,
        alarm: bool = False,
        teat_c: float | None = None,
    ) -> State:
        """One reading: time in seconds (increasing), bath temperature, the raw value as it came
        over the wire (else the temperature), any alarm, and the temperature at the teats where a
        sensor tells it.

        Raises ValueError where time doesn't advance or a number is not finite: a sensor fault is
        the caller's to handle.
        """
        if not (isfinite(t_s) and isfinite(temp_c)):
            raise ValueError(
                f"stability gate: reading {temp_c} degC at {t_s} s is not finite; a sensor fault is"
                " no reading"
            )
        if self._last is not None and t_s <= self._last[0]:
            raise ValueError(
                f"stability gate: reading at {t_s} s after one at {self._last[0]} s; time has to"
                " advance"
            )
        gap = self._last is not None and t_s - self._last[0] > self.max_gap_s + TIME_SLACK_S
        value = temp_c if raw is None else raw
        if self._last is None or gap or value != self._raw:
            self._raw, self._raw_since_s = value, t_s
        self._last, self._alarm = (t_s, temp_c), alarm
        if gap or alarm or self.frozen:
            self._window, self._near, self._teats = Window(), Window(), Window()
            self._state = State.SETTLING
        if not alarm and not self.frozen:
            self._window.add(t_s, temp_c - self.set_point_c, value, self.window_s)
            self._add_teat(t_s, teat_c)
        self._state = self._next(abs(temp_c - self.set_point_c))
        if self._state is State.HEATING:
            self._near = Window()
        elif not alarm and not self.frozen:
            self._near.add(t_s, temp_c - self.set_point_c, value, self.window_s)
        return self._state

    @property
    def state(self) -> State:
        """The state after the last reading; `heating` before the first."""
        return self._state

    @property
    def frozen(self) -> bool:
        """Whether the raw reading has been the same for longer than `frozen_s`."""
        return self._last is not None and self._last[0] - self._raw_since_s > self.frozen_s

    @property
    def at_least_s(self) -> float:
        """How long it takes at the least until it opens; 0 where it is open."""
        return (
            0.0
            if self._state is State.STABLE
            else max(self.max_gap_s, self.window_s - self._near.span_s)
        )

    @property
    def report(self) -> StabilityReport:
        """The window's figures and what is still missing."""
        w, last = self._window, self._last
        return StabilityReport(
            state=self._state,
            set_point_c=self.set_point_c,
            t_s=last[0] if last else None,
            pv_c=last[1] if last else None,
            n=len(w),
            window_s=w.span_s,
            mean_c=self.set_point_c + w.mean if len(w) else None,
            half_range_k=w.half_range if len(w) else None,
            slope_k_per_min=60.0 * w.slope if len(w) > 1 else None,
            distinct=w.distinct,
            frozen=self.frozen,
            near_s=self._near.span_s,
            reasons=tuple(self._unfulfilled()),
        )

    def _add_teat(self, t_s: float, teat_c: float | None) -> None:
        """A sensor that has gone takes its evidence along, and asks for nothing any more."""
        if teat_c is None or not isfinite(teat_c):
            self._teats = Window()
        else:
            self._teats.add(t_s, teat_c - self.set_point_c, teat_c, self.window_s)

    @property
    def _teat_slope(self) -> float:
        """K/min; 0 without a sensor at the teats."""
        return 60.0 * self._teats.slope if len(self._teats) > 1 else 0.0

    def _next(self, off_k: float) -> State:
        if off_k > self.leave_k:
            return State.HEATING
        if self._state is State.STABLE or self._fulfilled():
            return State.STABLE
        return State.SETTLING

    def _fulfilled(self) -> bool:
        w = self._window
        return (
            w.span_s >= self.window_s - TIME_SLACK_S
            and w.distinct >= self.min_distinct
            and abs(w.mean) <= self.mean_k
            and w.half_range <= self.half_range_k
            and 60.0 * abs(w.slope) <= self.slope_k_per_min
            and abs(self._teat_slope) <= self.teat_slope_k_per_min
        )

    def _unfulfilled(self) -> list[str]:
        """By the readings near the set point: those of the way there say nothing of how steady it
        is.
        """
        w, last = self._near, self._last
        if self._alarm:
            return ["the bath has an alarm"]
        if self.frozen:
            return [
                (
                    f"the reading has not changed for more than {self.frozen_s:g} s: is"
                    " the controller alive?"
                )
            ]
        if self._state is State.HEATING and last is not None:
            return [f"{last[1]:.2f} degC, needs {self.set_point_c:g} ± {self.leave_k:g}"]
        if len(w) < 2:
            return ["too few readings"]
        time = (
            w.span_s < self.window_s - TIME_SLACK_S,
            f"stable for {_of(w.span_s, self.window_s)}",
        )
        rows = [
            (
                w.distinct < self.min_distinct,
                f"{w.distinct} distinct readings, needs {self.min_distinct}",
            ),
            (
                abs(w.mean) > self.mean_k,
                f"mean {w.mean:+.3f} K from the set point, needs {self.mean_k:g}",
            ),
            (
                w.half_range > self.half_range_k,
                f"half the range {w.half_range:.3f} K, needs {self.half_range_k:g}",
            ),
            (
                60 * abs(w.slope) > self.slope_k_per_min,
                f"slope {60 * w.slope:+.3f} K/min, needs {self.slope_k_per_min:g}",
            ),
            (
                abs(self._teat_slope) > self.teat_slope_k_per_min,
                (
                    f"slope at the teats {self._teat_slope:+.3f} K/min, needs"
                    f" {self.teat_slope_k_per_min:g}"
                ),
            ),
        ]
        told = w.span_s >= FIGURES_FROM * self.window_s
        return [text for failed, text in [time, *(rows if told else [])] if failed]


def _of(span_s: float, window_s: float) -> str:
    """``4 of 10 min``."""
    return (
        f"{span_s:.0f} of {window_s:g} s"
        if window_s < 120.0
        else f"{span_s // 60:.0f} of {window_s / 60:g} min"
    )

"""When is the bath stable? A sliding window of readings against the gate of the script: heating,
settling, stable.

Criteria after ASTM E2488 practice: mean, half range and least-squares slope over the window, with
hysteresis on leaving; a sensor at the teats, where there is one, has a level and a slope of its own
to keep. A reading comes with its time. A frozen reading, a gap, an alarm or a sensor at the teats
that fell silent is never evidence of stability.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from math import inf, isfinite

import numpy as np

from textfiles.text import plural

TIME_SLACK_S = 1e-6  # readings at 0.1 s steps add up to 599.9999999 s


class Window:
    """Deviations from the set point (K) over the last `window_s`, with their figures."""

    def __init__(self) -> None:
        self._t_s: deque[float] = deque()
        self._y: deque[float] = deque()
        self._raw: deque[Hashable] = deque()
        self._often: Counter[Hashable] = Counter()  # how often each raw reading is in the window

    def __len__(self) -> int:
        return len(self._t_s)

    def add(self, t_s: float, y: float, raw: Hashable, window_s: float) -> None:
        """Append a reading and drop those that the window no longer needs to span `window_s`."""
        self._t_s.append(t_s)
        self._y.append(y)
        self._raw.append(raw)
        self._often[raw] += 1
        while len(self) > 1 and t_s - self._t_s[1] >= window_s - TIME_SLACK_S:
            self._t_s.popleft()
            self._y.popleft()
            gone = self._raw.popleft()
            self._often[gone] -= 1
            if not self._often[gone]:
                del self._often[gone]

    @property
    def span_s(self) -> float:
        return self._t_s[-1] - self._t_s[0] if self._t_s else 0.0

    @property
    def distinct(self) -> int:
        return len(self._often)

    @property
    def mean(self) -> float:
        return float(np.mean(self._y))

    @property
    def half_range(self) -> float:
        return (max(self._y) - min(self._y)) / 2.0

    @property
    def slope(self) -> float:
        """Least squares, K/s."""
        t = np.array(self._t_s)
        t -= t.mean()
        return float(t @ np.array(self._y) / (t @ t))


FIGURES_FROM = 0.1  # of the window: figures of less are noise


class BathState(StrEnum):
    """`heating`: further from the set point than `leave_k`; `settling`: near it; `stable`."""

    HEATING = "heating"
    SETTLING = "settling"
    STABLE = "stable"


@dataclass(slots=True, eq=False)
class StabilityGate:
    """Feed every reading to `add`; ask `state` and `reasons`. Limits are the script's.
    `min_distinct` raw readings must differ within the window, and one may repeat for `frozen_s`.
    Where a good bath shows one value only (0.1 K steps), put another sign of life into `raw`.
    ``teat_level_k``: how far the teats may be from the set point, whatever the bath reads.
    """

    set_point_c: float
    window_s: float = 600.0
    mean_k: float = 0.10
    half_range_k: float = 0.05
    slope_k_per_min: float = 0.01
    teat_slope_k_per_min: float = 0.02
    teat_level_k: float = 1.0
    leave_k: float = 0.15
    max_gap_s: float = 5.0
    min_distinct: int = 2
    frozen_s: float = 300.0
    _state: BathState = field(default=BathState.HEATING, init=False, repr=False)
    _last: tuple[float, float] | None = field(default=None, init=False, repr=False)
    _raw: Hashable = field(default=None, init=False, repr=False)
    _raw_since_s: float = field(default=0.0, init=False, repr=False)
    _alarm: bool = field(default=False, init=False, repr=False)
    window: Window = field(default_factory=Window, init=False, repr=False)
    near: Window = field(default_factory=Window, init=False, repr=False)
    _teats: Window = field(default_factory=Window, init=False, repr=False)
    _teats_last: tuple[float, float] | None = field(default=None, init=False, repr=False)
    _teats_gone: bool = field(default=False, init=False, repr=False)

    def __post_init__(self) -> None:
        self.restart(self.set_point_c)  # refuses a set point that is not finite

    def restart(self, set_point_c: float | None = None) -> None:
        """Forget all readings; with a temperature, that is the new set point."""
        if set_point_c is not None:
            if not isfinite(set_point_c):
                raise ValueError(f"stability gate: set point {set_point_c} degC must be finite")
            self.set_point_c = set_point_c
        self._state = BathState.HEATING
        self._last, self._raw, self._raw_since_s = None, None, 0.0
        self._alarm = False
        self.window, self.near, self._teats = Window(), Window(), Window()
        if self._teats_last is not None:  # a sensor that was there has to be there again
            self._teats_last, self._teats_gone = (-inf, 0.0), True

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
    ) -> BathState:
        """One reading at ``t_s`` (increasing), with its raw value, any alarm, and the temperature
        at the teats, if measured. Raises ValueError where time doesn't advance or a number is not
        finite.
        """
        if not (isfinite(t_s) and isfinite(temp_c)):
            why = f"reading {temp_c} degC at {t_s} s is not finite; a sensor fault is no reading"
            raise ValueError(f"stability gate: {why}")
        if self._last is not None and t_s <= self._last[0]:
            why = f"reading at {t_s} s after one at {self._last[0]} s; time has to advance"
            raise ValueError(f"stability gate: {why}")
        gap = self._last is not None and t_s - self._last[0] > self.max_gap_s + TIME_SLACK_S
        value = temp_c if raw is None else raw
        if self._last is None or gap or value != self._raw:
            self._raw, self._raw_since_s = value, t_s
        self._last, self._alarm = (t_s, temp_c), alarm
        if gap or alarm or self.frozen:
            self.window, self.near, self._teats = Window(), Window(), Window()
            self._state = BathState.SETTLING
        if not alarm and not self.frozen:
            self.window.add(t_s, temp_c - self.set_point_c, value, self.window_s)
        self._add_teats(t_s, teat_c, evidence=not alarm and not self.frozen)
        if abs(temp_c - self.set_point_c) > self.leave_k:
            self._state, self.near = BathState.HEATING, Window()
        elif self._state is not BathState.STABLE:
            w = self.window
            full = w.span_s >= self.window_s - TIME_SLACK_S
            stable = full and not any(failed for failed, *_ in self._criteria(w))
            self._state = BathState.STABLE if stable else BathState.SETTLING
        if self._state is not BathState.HEATING and not alarm and not self.frozen:
            self.near.add(t_s, temp_c - self.set_point_c, value, self.window_s)
        return self._state

    def _add_teats(self, t_s: float, teat_c: float | None, *, evidence: bool) -> None:
        """What the sensor at the teats shows; while they are off or it is gone, no evidence."""
        if teat_c is not None and isfinite(teat_c):
            self._teats_last = t_s, teat_c - self.set_point_c
            if evidence:
                self._teats.add(t_s, self._teats_last[1], teat_c, self.window_s)
        if self._teats_last is None:
            return
        last_s, away_k = self._teats_last
        self._teats_gone = t_s - last_s > self.max_gap_s + TIME_SLACK_S
        if self._teats_gone or abs(away_k) > self.teat_level_k + self.leave_k:
            self._teats = Window()
            if self._state is BathState.STABLE:
                self._state, self.near = BathState.SETTLING, Window()

    @property
    def moved_s(self) -> float:
        """When the raw reading changed last; before the first reading, never."""
        return -inf if self._last is None else self._raw_since_s

    @property
    def state(self) -> BathState:
        """The state after the last reading; `heating` before the first."""
        return self._state

    @property
    def frozen(self) -> bool:
        """Whether the raw reading has been the same for longer than `frozen_s`."""
        return self._last is not None and self._last[0] - self._raw_since_s > self.frozen_s

    @property
    def at_least_s(self) -> float:
        """How long it takes at the least until it opens; 0 where it is open."""
        left_s = max(self.max_gap_s, self.window_s - self.near.span_s)
        return 0.0 if self._state is BathState.STABLE else left_s

    def _criteria(self, w: Window) -> Iterator[tuple[bool, str, float]]:
        """Of each criterion but the span: whether ``w`` fails it, what was seen, and the limit."""
        seen = plural(w.distinct, "distinct reading")
        yield w.distinct < self.min_distinct, seen, self.min_distinct
        yield abs(w.mean) > self.mean_k, f"mean {w.mean:+.3f} K from the set point", self.mean_k
        half_range, limit = w.half_range, self.half_range_k
        yield half_range > limit, f"half the range {half_range:.3f} K", limit
        slope, limit = 60.0 * w.slope, self.slope_k_per_min
        yield abs(slope) > limit, f"slope {slope:+.3f} K/min", limit
        yield from self._teat_criteria()

    def _teat_criteria(self) -> Iterator[tuple[bool, str, float]]:
        """The same of the sensor at the teats; nothing where there never was one."""
        if self._teats_last is None:
            return
        teats, (_, away_k), limit = self._teats, self._teats_last, self.teat_level_k
        yield self._teats_gone, "no value of the sensor at the teats", 1
        yield abs(away_k) > limit, f"teats {away_k:+.2f} K from the set point", limit
        short = teats.span_s < self.window_s - TIME_SLACK_S
        yield short, f"teats on their level for {teats.span_s:.0f} s", self.window_s
        slope, limit = 60.0 * teats.slope if len(teats) > 1 else 0.0, self.teat_slope_k_per_min
        yield abs(slope) > limit, f"slope at the teats {slope:+.3f} K/min", limit

    @property
    def reasons(self) -> list[str]:
        """What is still missing, by the readings near the set point."""
        w, last = self.near, self._last
        if self._alarm:
            return ["the bath has an alarm"]
        if self.frozen:
            why = f"the reading has not changed for more than {self.frozen_s:g} s"
            return [f"{why}: does the controller still run?"]
        if last is None:
            return ["too few readings"]
        if self._teats_gone:
            return ["the sensor at the teats gives no value any more: look at it and its plug"]
        if self._state is BathState.HEATING:
            return [f"{last[1]:.2f} degC, needs {self.set_point_c:g} ± {self.leave_k:g}"]
        if self._teats_last and abs(self._teats_last[1]) > self.teat_level_k:
            teats = f"the teats are {self._teats_last[1]:+.2f} K from the set point"
            return [f"{teats}, needs ± {self.teat_level_k:g}: does the pump turn?"]
        if len(w) < 2:
            return ["too few readings"]
        short = w.span_s < self.window_s - TIME_SLACK_S
        note = self._criteria(w) if w.span_s >= FIGURES_FROM * self.window_s else ()
        return [
            *([f"stable for {_span_text(w.span_s, self.window_s)}"] if short else []),
            *(f"{text}, needs {limit:g}" for failed, text, limit in note if failed),
        ]


def _span_text(span_s: float, window_s: float) -> str:
    """``4 of 10 min``."""
    if window_s < 120.0:
        return f"{span_s:.0f} of {window_s:g} s"
    return f"{span_s // 60:.0f} of {window_s / 60:g} min"

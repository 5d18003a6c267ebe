"""A sliding window of readings with its mean, slope, extremes, and how many of them differ.

Strategy: running sums for mean and slope, monotonic queues for the extremes, a count of distinct raw readings; a reading costs
the same however long the window is. Pure; may not know what the figures are good for.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Hashable

TIME_SLACK_S = 1e-6  # readings at 0.1 s steps add up to 599.9999999 s


class Window:
    """Deviations from the set point (K) over the last `span`: sums about a moving origin, and extremes in monotonic queues."""

    __slots__ = ("_highs", "_lows", "_origin_s", "_raw", "_readings", "_since_sums", "_st", "_stt", "_sty", "_sy")

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
        """Rounding of added and dropped readings piles up, and the origin falls behind: start the sums again, at a cost spread over the
        window."""
        self._origin_s, self._since_sums = self._readings[0][0], 0
        self._st = self._stt = self._sy = self._sty = 0.0
        for t_s, y, _ in self._readings:
            self._sum(t_s, y, 1.0)

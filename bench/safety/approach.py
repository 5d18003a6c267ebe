"""How long a bath takes until it is stable, by the way that it goes now."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable

from bench.safety.stability import StabilityGate, State
from instruments.bath.reading import BathReading

RATE_S, LEAST_S = 60.0, 10.0  # over which a rate is taken


class Approach:
    """How long a bath takes until its ``gate`` opens, by its rate over the last minute."""

    def __init__(self, gate: StabilityGate) -> None:
        self.gate = gate
        self._last: deque[tuple[float, float]] = deque()

    def add(self, reading: BathReading, raw: Hashable) -> None:
        """Take in a reading with its sign of life."""
        t_s, alarm, teat_c = reading.t_s, bool(reading.alarm), reading.external_c
        self.gate.add(t_s, reading.temp_c, raw=raw, alarm=alarm, teat_c=teat_c)
        self._last.append((t_s, reading.temp_c))
        while t_s - self._last[0][0] > RATE_S:
            self._last.popleft()

    def seconds_to_stable(self) -> float | None:
        """At the least: the way at the present rate and a window, or what is left of the window.
        None where the bath doesn't approach its set point, or too little was read.
        """
        gate = self.gate
        if gate.state is State.STABLE:
            return 0.0
        if gate.state is State.SETTLING:
            return max(0.0, gate.window_s - gate.near.span_s) or 1.0
        if not self._last or (span_s := self._last[-1][0] - self._last[0][0]) < LEAST_S:
            return None
        rate_k_per_s = (self._last[-1][1] - self._last[0][1]) / span_s
        away_k = gate.set_point_c - self._last[-1][1]
        if away_k * rate_k_per_s <= 0.0:
            return None
        return (abs(away_k) - gate.leave_k) / abs(rate_k_per_s) + gate.window_s

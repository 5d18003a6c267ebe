"""How long a bath takes until it is stable, by the way that it goes now."""

from __future__ import annotations

from collections.abc import Sequence

from bench.safety.stability import StabilityGate, State
from instruments.bath.reading import BathReading

RATE_S, LEAST_S = 60.0, 10.0  # over which a rate is taken


def seconds_to_stable(gate: StabilityGate, seen: Sequence[BathReading]) -> float | None:
    """At the least: the way at the rate of the last minute, ``seen``, and a window, or what is left
    of it. None where the bath doesn't approach its set point, or too little was read.
    """
    if not seen or gate.state is State.STABLE:
        return 0.0 if seen else None
    if gate.state is State.SETTLING:
        return max(0.0, gate.window_s - gate.near.span_s) or 1.0
    first, last = seen[0], seen[-1]
    away_k, way_k = gate.set_point_c - last.temp_c, last.temp_c - first.temp_c
    if last.t_s - first.t_s < LEAST_S or away_k * way_k <= 0.0:
        return None
    return (abs(away_k) - gate.leave_k) / abs(way_k) * (last.t_s - first.t_s) + gate.window_s

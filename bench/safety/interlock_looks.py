"""What the interlocks look at, and what each of them sees in it: a sentence about what is wrong, or nothing.

Pure: a reading in its context in. When a condition becomes a trip is the table's business (`interlock_rules`). Figures:
water-bath fact sheet, section 4.1.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from bench.rig_tables import Limits

RATE_SPAN_S = 30.0  # a rate from two readings a second apart would be all noise
FROZEN_S, FROZEN_OUTPUT_PERCENT = 120.0, 20.0
LOOP_BREAK_S, LOOP_BREAK_OUTPUT_PERCENT = 120.0, 90.0
LOOP_RISE_K = 0.1  # the weakest bath of section 4.3 rises by 2.4 K in the time that the rule gives it
DISAGREE_S = 10.0
SAME_SET_POINT_K = 0.06  # a controller may show tenths


class Reading(Protocol):
    """What the rules look at: one poll of the controller."""

    @property
    def t_s(self) -> float: ...
    @property
    def temp_c(self) -> float: ...
    @property
    def raw(self) -> tuple[int, ...]: ...
    @property
    def external_c(self) -> float | None: ...
    @property
    def safety_c(self) -> float | None: ...
    @property
    def power_percent(self) -> float | None: ...
    @property
    def alarm(self) -> int: ...
    @property
    def running(self) -> bool | None: ...
    @property
    def set_point_c(self) -> float | None: ...


@dataclass(frozen=True, slots=True)
class Bath:
    """What the rules have to know of the bath itself: what its family tells, and the codes of its alarms."""

    tells: frozenset[str] = frozenset({"output", "other sensor"})
    low_level: Callable[[int], bool] = lambda _: False
    alarm_text: Callable[[int], str] = lambda code: f"alarm {code}"


@dataclass(frozen=True, slots=True)
class Look:
    """One reading in its context.

    ``asked_c`` is the set point that the bath was started with, None before. ``since`` is the last reading with which the rule
    was content, ``earlier`` one at least RATE_SPAN_S older than ``now``. ``pump_on`` is None where nothing tells whether the
    pump is on; ``settled`` says that the other sensors have had time to follow.
    """

    now: Reading
    since: Reading
    earlier: Reading | None
    asked_c: float | None
    pump_on: bool | None
    settled: bool
    limits: Limits
    bath: Bath


def too_hot(look: Look) -> str | None:
    limit_c = look.limits.bath_max_c
    seen = {"the bath": look.now.temp_c, "the safety sensor": look.now.safety_c, "the external sensor": look.now.external_c}
    hot = [f"{name} is at {value:.2f} degC" for name, value in seen.items() if value is not None and value > limit_c]
    return f"{' and '.join(hot)}, above {limit_c:g} degC" if hot else None


def dry_heat(look: Look) -> str | None:
    output = look.now.power_percent
    if not output or output <= 0.0:
        return None
    if look.bath.low_level(look.now.alarm):
        return f"the heater is asked for {output:.0f} % while the level is low"
    return f"the heater is asked for {output:.0f} % while the pump stands" if look.pump_on is False else None


def implausible(look: Look) -> str | None:
    return implausible_c(look.now, look.limits)


def implausible_c(now: Reading, limits: Limits) -> str | None:
    low, high = limits.bath_plausible_c
    return None if low <= now.temp_c <= high else f"the bath reads {now.temp_c:.2f} degC, which no water bath has"


def frozen(look: Look) -> str | None:
    output = look.now.power_percent
    if output is None or output <= FROZEN_OUTPUT_PERCENT or look.now.raw != look.since.raw:
        return None
    return f"the reading has stood at {look.now.temp_c:.2f} degC for {_lasted(look):.0f} s with the output at {output:.0f} %"


def too_fast(look: Look) -> str | None:
    now, earlier = look.now, look.earlier
    if earlier is None:
        return None
    rate = 60.0 * (now.temp_c - earlier.temp_c) / (now.t_s - earlier.t_s)
    return f"the bath changed by {rate:+.1f} K/min" if abs(rate) > look.limits.bath_rate_k_per_min else None


def loop_broken(look: Look) -> str | None:
    output, rise_k = look.now.power_percent, look.now.temp_c - look.since.temp_c
    if output is None or output <= LOOP_BREAK_OUTPUT_PERCENT or rise_k > LOOP_RISE_K:
        return None
    return f"the bath went from {look.since.temp_c:.2f} to {look.now.temp_c:.2f} degC in {_lasted(look):.0f} s at {output:.0f} % output"


def sensors_disagree(look: Look) -> str | None:
    if not look.settled:
        return None
    for name, other_c in (("external", look.now.external_c), ("safety", look.now.safety_c)):
        if other_c is not None and abs(look.now.temp_c - other_c) > look.limits.sensors_differ_k:
            return f"the bath reads {look.now.temp_c:.2f} degC and its {name} sensor {other_c:.2f} degC"
    return None


def changed(look: Look) -> str | None:
    if look.asked_c is None:
        return None
    if look.now.running is False:
        return "the controller has stopped, and not for us"
    seen_c = look.now.set_point_c
    if seen_c is not None and abs(seen_c - look.asked_c) > SAME_SET_POINT_K:
        return f"the controller's set point is {seen_c:.2f} degC, and {look.asked_c:.2f} degC was asked for"
    return None


def alarm(look: Look) -> str | None:
    return f"the controller reports {look.bath.alarm_text(look.now.alarm)}" if look.now.alarm else None


def still_hot(now: Reading, limits: Limits) -> str | None:
    hottest = max(value for value in (now.temp_c, now.safety_c, now.external_c) if value is not None)
    limit_c = limits.bath_max_c - 1.0
    return f"it is still at {hottest:.2f} degC; it has to cool below {limit_c:g} degC" if hottest >= limit_c else None


def still_alarmed(now: Reading, _: Limits) -> str | None:
    return f"the controller still reports alarm {now.alarm}" if now.alarm else None


def still_heating(now: Reading, _: Limits) -> str | None:
    return f"the heater is still asked for {now.power_percent:.0f} %" if now.power_percent and now.power_percent > 0 else None


def not_cold_and_plausible(now: Reading, limits: Limits) -> str | None:
    return implausible_c(now, limits) or still_heating(now, limits)


def nothing_more(_now: Reading, _limits: Limits) -> str | None:
    return None


def nothing(_: Look) -> str | None:
    return None


def _lasted(look: Look) -> float:
    return look.now.t_s - look.since.t_s

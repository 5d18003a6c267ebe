"""What must never happen while the bath is hot: a table of rules over its readings, each with the reason that it trips for.

Pure: a reading and the one before it in, a sentence or nothing out. Who acts on a trip is the watch's and the engine's
business. None of this is a safety function; the bath's independent cut-out is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from bench.rig import Limits

RATE_SPAN_S = 30.0  # a rate from two readings a second apart would be all noise


class Reading(Protocol):
    """What the rules look at."""

    @property
    def t_s(self) -> float: ...
    @property
    def temp_c(self) -> float: ...
    @property
    def alarm(self) -> int | None: ...


@dataclass(frozen=True, slots=True)
class Rule:
    """``broken(now, earlier, limits)`` says what is wrong, or gives None; ``earlier`` is at least RATE_SPAN_S older, or None."""

    name: str
    broken: Callable[[Reading, Reading | None, Limits], str | None]
    then: str


class InterlockTrip(Exception):  # noqa: N818 - the field's word
    """A rule is broken; the bench has to go to safe and stay there."""

    def __init__(self, rule: str, why: str, then: str) -> None:
        self.rule = rule
        super().__init__(f"interlock {rule}: {why}. {then}")


def _too_hot(now: Reading, _: Reading | None, limits: Limits) -> str | None:
    hot = now.temp_c > limits.bath_max_c
    return f"the bath is at {now.temp_c:.2f} degC, above {limits.bath_max_c:g} degC" if hot else None


def _implausible(now: Reading, _: Reading | None, limits: Limits) -> str | None:
    low, high = limits.bath_plausible_c
    return None if low <= now.temp_c <= high else f"the bath reads {now.temp_c:.2f} degC, which no water bath has"


def _too_fast(now: Reading, earlier: Reading | None, limits: Limits) -> str | None:
    if earlier is None:
        return None
    rate = 60.0 * (now.temp_c - earlier.temp_c) / (now.t_s - earlier.t_s)
    return f"the bath changed by {rate:+.1f} K/min" if abs(rate) > limits.bath_rate_k_per_min else None


def _alarm(now: Reading, _: Reading | None, _limits: Limits) -> str | None:
    return f"the controller reports alarm {now.alarm}" if now.alarm else None


RULES = (
    Rule("over-temperature", _too_hot, "Check the controller's set point and its heater relay before you start again."),
    Rule("implausible reading", _implausible, "Check the bath's sensor and its plug."),
    Rule("rate", _too_fast, "Check that the sensor hangs in the water, and the water level."),
    Rule("controller alarm", _alarm, "Read the controller's display, clear the cause and the alarm there."),
)
COMMUNICATIONS = "communications lost"
COMMUNICATIONS_THEN = "The bath may still heat: look at it. Check its cable and power."


def first_broken(now: Reading, earlier: Reading | None, limits: Limits) -> InterlockTrip | None:
    """The first rule of the table that this reading breaks."""
    for rule in RULES:
        why = rule.broken(now, earlier, limits)
        if why:
            return InterlockTrip(rule.name, why, rule.then)
    return None

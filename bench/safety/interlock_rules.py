"""The table of interlocks: what must never happen while the bath is hot, each with what trips it and what resets it.

Every trip latches: the bench goes to safe and stays there until a person acknowledges, which the rule's reset condition has to
allow. None of this is a safety function; the bath's independent cut-out is. docs/safety.md shows the same table.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from bench.rig_tables import Limits
from bench.safety.interlock_looks import (
    DISAGREE_S,
    FROZEN_OUTPUT_PERCENT,
    FROZEN_S,
    LOOP_BREAK_OUTPUT_PERCENT,
    LOOP_BREAK_S,
    LOOP_RISE_K,
    RATE_SPAN_S,
    Look,
    Reading,
    alarm,
    changed,
    dry_heat,
    frozen,
    implausible,
    implausible_c,
    loop_broken,
    not_cold_and_plausible,
    nothing,
    nothing_more,
    sensors_disagree,
    still_alarmed,
    still_heating,
    still_hot,
    too_fast,
    too_hot,
)


@dataclass(frozen=True, slots=True)
class Rule:
    """A row of the table. Every row latches: what has tripped stays so, whatever the bath does, until a person acknowledges it.

    ``wrong`` says what is wrong at this moment, or gives None; it trips ``after_s`` after the last reading that was right. ``not_yet``
    says why a latched trip can't be reset, or gives None. ``needs`` names what the family has to tell, or the rule sleeps.
    """

    name: str
    trips: str
    wrong: Callable[[Look], str | None]
    resets: str
    not_yet: Callable[[Reading, Limits], str | None]
    then: str
    after_s: float = 0.0
    needs: str = ""


COLD_AND_PLAUSIBLE = "a plausible reading, and output 0 %"
COMMUNICATIONS, IMPLAUSIBLE, GUARDIAN = "communications lost", "implausible reading", "guardian lost"

RULES = (
    Rule(
        "over-temperature",
        "any sensor above bath_max_c",
        too_hot,
        "all sensors 1 K below bath_max_c",
        still_hot,
        "Check the controller's set point and its heater relay, and that the cut-out works, before you start again.",
    ),
    Rule(
        "heat without pump or level",
        "output above 0 % while the level alarm stands, or while the pump is known to stand",
        dry_heat,
        "output 0 % and no alarm",
        lambda now, limits: still_heating(now, limits) or still_alarmed(now, limits),
        "Fill the bath, see that the pump turns, then clear the alarm at the controller.",
        needs="output",
    ),
    Rule(
        IMPLAUSIBLE,
        "outside bath_plausible_c, or answers without a usable reading for bath_silence_s",
        implausible,
        "a plausible reading",
        implausible_c,
        "Check the bath's sensor and its plug.",
    ),
    Rule(
        "frozen reading",
        f"identical raw value for {FROZEN_S:g} s with the output above {FROZEN_OUTPUT_PERCENT:g} %",
        frozen,
        "output at most 20 %",
        lambda now, limits: still_heating(now, limits) if (now.power_percent or 0.0) > FROZEN_OUTPUT_PERCENT else None,
        "Switch the controller off and on; check the sensor.",
        after_s=FROZEN_S,
        needs="output",
    ),
    Rule(
        "rate",
        f"faster than bath_rate_k_per_min over {RATE_SPAN_S:g} s",
        too_fast,
        COLD_AND_PLAUSIBLE,
        not_cold_and_plausible,
        "Check that the sensor hangs in the water, and the water level.",
    ),
    Rule(
        "loop break",
        f"output above {LOOP_BREAK_OUTPUT_PERCENT:g} % for {LOOP_BREAK_S:g} s and the bath has not risen by {LOOP_RISE_K:g} K",
        loop_broken,
        COLD_AND_PLAUSIBLE,
        not_cold_and_plausible,
        "Check heater, its relay and fuse, and that the sensor hangs in the water.",
        after_s=LOOP_BREAK_S,
        needs="output",
    ),
    Rule(
        "sensor disagreement",
        f"another sensor further away than sensors_differ_k for {DISAGREE_S:g} s, after settling",
        sensors_disagree,
        COLD_AND_PLAUSIBLE,
        not_cold_and_plausible,
        "Check that the pump turns, that both sensors are in their places, and the hoses.",
        after_s=DISAGREE_S,
        needs="other sensor",
    ),
    Rule(
        "controller alarm",
        "the controller's alarm code is not 0",
        alarm,
        "alarm code 0",
        still_alarmed,
        "Read the controller's display, clear the cause and the alarm there.",
    ),
    Rule(
        "changed at the controller",
        "stopped, or given another set point, by somebody or something else than the bench",
        changed,
        COLD_AND_PLAUSIBLE,
        not_cold_and_plausible,
        "Find out whether there was a power cut, or who is at the controller.",
    ),
    Rule(
        COMMUNICATIONS,
        "nobody answers for bath_silence_s",
        nothing,  # a reading in the hand is no silence: `Interlocks.silent` trips this row
        "a reading",
        nothing_more,
        "The bath may still heat: look at it. Check its cable and power.",
    ),
    Rule(
        GUARDIAN,
        "the guardian's process has ended, has not answered for 3 s, or has acted on a bench that hung",
        nothing,  # no reading shows it: the keeper trips this row
        "a reading",
        nothing_more,
        "See guardian.json and guardian.log in the run's folder.",
    ),
)


def rule_named(name: str) -> Rule:
    """The row of the table. Raises KeyError for a name that isn't there."""
    for rule in RULES:
        if rule.name == name:
            return rule
    raise KeyError(name)

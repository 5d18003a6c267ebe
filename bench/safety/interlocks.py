"""The table of interlocks: what must never happen while the bath is hot, each with what trips it
and what resets it, and how it is held against each reading of the bath.

A condition says what is wrong in a reading as a sentence, or gives None. Every trip latches: the
bench goes to safe and stays there until a person acknowledges, which the rule's reset condition has
to allow. Pure: readings with their times in, a trip or nothing out. None of this is a safety
function; the bath's independent cut-out is. docs/safety.md shows the same table. Figures:
water-bath fact sheet, section 4.1.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass

from bench.rig.model import SafetyLimits
from bench.safety.liveness import Liveness
from instruments.bath.profile import Profile
from instruments.bath.reading import BathReading
from textfiles.text import full_stop

RATE_SPAN_S = 30.0  # a rate from two readings a second apart would be all noise
FROZEN_S, FROZEN_OUTPUT_PERCENT = 120.0, 20.0
# at any output: whatever holds the bath then, it is no controller that sees it
LIFELESS_S = 600.0
LOOP_BREAK_S, LOOP_BREAK_OUTPUT_PERCENT = 120.0, 90.0
# the weakest bath of section 4.3 rises by 2.4 K in the time that the rule gives it
LOOP_RISE_K = 0.1
DISAGREE_S = 10.0
SAME_SET_POINT_K = 0.06  # a controller may show tenths


@dataclass(frozen=True, slots=True)
class RuleInput:
    """One reading in its context. ``asked_c``: the set point asked for, None before. ``since``: the
    last reading without the fault; ``earlier``: one RATE_SPAN_S older. ``settled``: the other
    sensors have followed. ``lived``: the reading has shown a sign of life since the one before.
    """

    now: BathReading
    since: BathReading
    earlier: BathReading | None
    asked_c: float | None
    pump_on: bool | None
    settled: bool
    lived: bool
    limits: SafetyLimits
    profile: Profile


def too_hot(given: RuleInput) -> str | None:
    limit_c = given.limits.bath_max_c
    now = given.now
    seen = {"bath": now.temp_c, "safety sensor": now.safety_c, "external sensor": now.external_c}
    hot = [
        f"the {name} is at {value:.2f} degC"
        for name, value in seen.items()
        if value is not None and value > limit_c
    ]
    return f"{' and '.join(hot)}, above {limit_c:g} degC" if hot else None


def dry_heat(given: RuleInput) -> str | None:
    output = given.now.power_percent
    if not output or output <= 0.0:
        return None
    if given.profile.means(given.now.alarm, "level"):
        return f"the heater is asked for {output:.0f} % while the level is low"
    stands = given.pump_on is False
    return f"the heater is asked for {output:.0f} % while the pump stands" if stands else None


def implausible_c(now: BathReading, limits: SafetyLimits) -> str | None:
    low, high = limits.bath_plausible_c
    if low <= now.temp_c <= high:
        return None
    return f"the bath reads {now.temp_c:.2f} degC, which no water bath has"


def frozen(given: RuleInput) -> str | None:
    output = given.now.power_percent
    if output is None or output <= FROZEN_OUTPUT_PERCENT or given.now.raw != given.since.raw:
        return None
    lasted_s = given.now.t_s - given.since.t_s
    stood = f"the reading has stood at {given.now.temp_c:.2f} degC for {lasted_s:.0f} s"
    return f"{stood} with the output at {output:.0f} %"


def lifeless(given: RuleInput) -> str | None:
    heats = given.asked_c is not None and given.now.running is not False
    if given.lived or not heats:
        return None
    lasted_s = given.now.t_s - given.since.t_s
    return f"the reading has stood at {given.now.temp_c:.2f} degC for {lasted_s:.0f} s"


def too_fast(given: RuleInput) -> str | None:
    now, earlier = given.now, given.earlier
    if earlier is None:
        return None
    rate = 60.0 * (now.temp_c - earlier.temp_c) / (now.t_s - earlier.t_s)
    fast = abs(rate) > given.limits.bath_rate_k_per_min
    return f"the bath changed by {rate:+.1f} K/min" if fast else None


def loop_broken(given: RuleInput) -> str | None:
    output, rise_k = given.now.power_percent, given.now.temp_c - given.since.temp_c
    if output is None or output <= LOOP_BREAK_OUTPUT_PERCENT or rise_k > LOOP_RISE_K:
        return None
    return (
        f"the bath went from {given.since.temp_c:.2f} to {given.now.temp_c:.2f} degC in"
        f" {given.now.t_s - given.since.t_s:.0f} s at {output:.0f} % output"
    )


def sensors_disagree(given: RuleInput) -> str | None:
    if not given.settled:
        return None
    for name, other_c in (("external", given.now.external_c), ("safety", given.now.safety_c)):
        if other_c is not None and abs(given.now.temp_c - other_c) > given.limits.sensors_differ_k:
            bath = f"the bath reads {given.now.temp_c:.2f} degC"
            return f"{bath} and its {name} sensor {other_c:.2f} degC"
    return None


def changed(given: RuleInput) -> str | None:
    if given.asked_c is None:
        return None
    if given.now.running is False:
        return "the controller has stopped, and not for us"
    seen_c = given.now.set_point_c
    if seen_c is None or abs(seen_c - given.asked_c) <= SAME_SET_POINT_K:
        return None
    asked = f"{given.asked_c:.2f} degC was asked for"
    return f"the controller's set point is {seen_c:.2f} degC, and {asked}"


def still_hot(now: BathReading, limits: SafetyLimits) -> str | None:
    readings = (now.temp_c, now.safety_c, now.external_c)
    hottest, limit_c = max(v for v in readings if v is not None), limits.bath_max_c - 1.0
    if hottest < limit_c:
        return None
    return f"it is still at {hottest:.2f} degC; it has to cool below {limit_c:g} degC"


def still_alarmed(now: BathReading, _: SafetyLimits) -> str | None:
    alarm = now.alarm_text or f"alarm {now.alarm}"
    return f"the controller still reports {alarm}" if now.alarm else None


def still_heating(now: BathReading, _: SafetyLimits, above_percent: float = 0.0) -> str | None:
    output = now.power_percent or 0.0
    return f"the heater is still asked for {output:.0f} %" if output > above_percent else None


def not_cold_and_plausible(now: BathReading, limits: SafetyLimits) -> str | None:
    return implausible_c(now, limits) or still_heating(now, limits)


@dataclass(frozen=True, slots=True)
class Rule:
    """A row of the table. ``wrong`` gives the fault of a reading, and trips after ``after_s`` of
    it; the trip latches until a person acknowledges it. ``not_yet``: why it can't be reset.
    ``needs``: rows of the profile without which the rule is inactive.
    """

    name: str
    trips: str
    wrong: Callable[[RuleInput], str | None]
    resets: str
    not_yet: Callable[[BathReading, SafetyLimits], str | None]
    then: str
    after_s: float = 0.0
    needs: tuple[str, ...] = ()


OUTPUT = ("power",)
COLD_AND_PLAUSIBLE = "a plausible reading, and output 0 %"
COMMUNICATIONS, IMPLAUSIBLE, GUARDIAN = (
    "communications lost",
    "implausible reading",
    "guardian lost",
)

RULES = (
    Rule(
        "over-temperature",
        "any sensor above bath_max_c",
        too_hot,
        "all sensors 1 K below bath_max_c",
        still_hot,
        "Check the controller's set point and its heater relay, and that the cut-out works, before"
        " you start again.",
    ),
    Rule(
        "heat without pump or level",
        "output above 0 % while the level alarm stands, or while the pump is known to stand",
        dry_heat,
        "output 0 % and no alarm",
        lambda now, limits: still_heating(now, limits) or still_alarmed(now, limits),
        "Fill the bath, see that the pump turns, then clear the alarm at the controller.",
        needs=OUTPUT,
    ),
    Rule(
        IMPLAUSIBLE,
        "outside bath_plausible_c, or answers without a usable reading for bath_silence_s",
        lambda given: implausible_c(given.now, given.limits),
        "a plausible reading",
        implausible_c,
        "Check the bath's sensor and its plug.",
    ),
    Rule(
        "frozen reading",
        f"identical raw value for {FROZEN_S:g} s with the output above {FROZEN_OUTPUT_PERCENT:g} %",
        frozen,
        "output at most 20 %",
        lambda now, limits: still_heating(now, limits, FROZEN_OUTPUT_PERCENT),
        "Switch the controller off and on; check the sensor.",
        after_s=FROZEN_S,
        needs=OUTPUT,
    ),
    Rule(
        "lifeless reading",
        f"no sign of life of the sensor for {LIFELESS_S:g} s while the bath may heat",
        lifeless,
        COLD_AND_PLAUSIBLE,
        not_cold_and_plausible,
        "Switch the controller off and on; check the sensor.",
        after_s=LIFELESS_S,
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
        f"output above {LOOP_BREAK_OUTPUT_PERCENT:g} % for {LOOP_BREAK_S:g} s and the bath has not"
        f" risen by {LOOP_RISE_K:g} K",
        loop_broken,
        COLD_AND_PLAUSIBLE,
        not_cold_and_plausible,
        "Check heater, its relay and fuse, and that the sensor hangs in the water.",
        after_s=LOOP_BREAK_S,
        needs=OUTPUT,
    ),
    Rule(
        "sensor disagreement",
        f"another sensor further away than sensors_differ_k for {DISAGREE_S:g} s, after settling",
        sensors_disagree,
        COLD_AND_PLAUSIBLE,
        not_cold_and_plausible,
        "Check that the pump turns, that both sensors are in their places, and the hoses.",
        after_s=DISAGREE_S,
        needs=("external", "safety"),
    ),
    Rule(
        "controller alarm",
        "the controller's alarm code is not 0",
        lambda given: (
            f"the controller reports {given.now.alarm_text or given.profile.alarm_text(code)}"
            if (code := given.now.alarm)
            else None
        ),
        "alarm code 0",
        still_alarmed,
        "Read the controller's display, clear the cause and the alarm there.",
    ),
    Rule(
        "changed at the controller",
        "stopped, or given another set point, by something else than the bench",
        changed,
        COLD_AND_PLAUSIBLE,
        not_cold_and_plausible,
        "Find out whether there was a power cut, or who is at the controller.",
    ),
    Rule(
        COMMUNICATIONS,
        "no answer for bath_silence_s",
        lambda _: None,  # a reading in the hand is no silence: `Interlocks.silent` trips this row
        "a reading",
        lambda _now, _limits: None,
        "Look at the bath: it may have heated meanwhile. Check its cable and power.",
    ),
    Rule(
        GUARDIAN,
        "the guardian's process has ended, has not answered for 3 s, or has acted on a bench that"
        " hung",
        lambda _: None,  # no reading shows it: `TripHandler` trips this row
        "a reading",
        lambda _now, _limits: None,
        "See guardian-1.log in the run's folder, or that of a later session.",
    ),
)


def rule_named(name: str) -> Rule:
    """The row of the table. Raises KeyError for a name that isn't there."""
    return {rule.name: rule for rule in RULES}[name]


# near the set point for so long, the teats have caught up with the water
SETTLED_WITHIN_K, SETTLED_S = 0.5, 120.0
KEPT = 10  # readings that go into the record with a trip, beside those that the rule compares with
PLAIN = (  # of a reading, in the record, beside the raw values
    *("t_s", "temp_c", "external_c", "safety_c", "power_percent", "alarm", "running"),
    "set_point_c",
)


class InterlockTrip(Exception):  # noqa: N818 - the field's word
    """A rule has tripped. ``values``: the readings that led to it, oldest first."""

    def __init__(
        self, rule: str, why: str, then: str, values: tuple[Mapping[str, object], ...] = ()
    ) -> None:
        self.rule = rule
        self.why = why
        self.then = then
        self.values = values
        super().__init__(f"interlock {rule}: {full_stop(why)} {then}")

    def as_dict(self) -> dict[str, object]:
        """For a record: plain text, numbers and None."""
        return {"rule": self.rule, "why": self.why, "then": self.then, "values": list(self.values)}


class Interlocks:
    """Holds the table against each reading. ``t_s`` of the readings has to advance."""

    def __init__(self, limits: SafetyLimits, profile: Profile) -> None:
        self._limits = limits
        self._profile = profile
        provided = {row.name for row in profile.rows}
        self._active = [rule for rule in RULES if not rule.needs or provided & set(rule.needs)]
        self._since: dict[str, BathReading] = {}
        self._recent: deque[BathReading] = deque()
        self._near_since_s = math.nan
        self._asked_c: float | None = None
        self._liveness = Liveness(profile)
        self._sign: Hashable = None

    @property
    def inactive(self) -> tuple[str, ...]:
        """Names of the rules whose rows the family doesn't have."""
        return tuple(rule.name for rule in RULES if rule not in self._active)

    def heating(self, set_point_c: float) -> None:
        """The bath has been started: the other sensors may lag again."""
        self._asked_c = set_point_c
        self._near_since_s = math.nan

    def add(self, now: BathReading, pump_on: bool | None = None) -> InterlockTrip | None:
        """The first rule of the table that trips with this reading."""
        settled = self._has_settled(now)
        before, self._sign = self._sign, self._liveness(now)
        # a coarse reading may stand while a bath without heat cools by a tenth
        rests = self._liveness.coarse and now.power_percent == 0.0
        lived = rests or before != self._sign
        self._recent.append(now)
        while len(self._recent) > 1 and now.t_s - self._recent[1].t_s >= RATE_SPAN_S:
            self._recent.popleft()
        oldest = self._recent[0]
        earlier = oldest if now.t_s - oldest.t_s >= RATE_SPAN_S else None
        given: RuleInput | None = None
        for rule in self._active:
            since = self._since.setdefault(rule.name, now)
            if given is None or given.since is not since:  # most rules have the same
                seen = (now, since, earlier, self._asked_c, pump_on, settled, lived)
                given = RuleInput(*seen, self._limits, self._profile)
            why = rule.wrong(given)
            if why is None:
                self._since[rule.name] = now
            elif now.t_s - since.t_s >= rule.after_s:
                return InterlockTrip(rule.name, why, rule.then, self._values(since, earlier or now))
        return None

    def silent(self, silent_s: float, error: Exception, *, answered: bool) -> InterlockTrip | None:
        """The trip of a missing reading: no answer, or (``answered``) one without a temperature."""
        if silent_s < self._limits.bath_silence_s:
            return None
        rule = rule_named(IMPLAUSIBLE if answered else COMMUNICATIONS)
        hint = getattr(error, "hint", None)  # the rule has its own
        last = str(error).removesuffix(f". {hint}")
        why = f"no {'usable ' if answered else ''}reading for {silent_s:.0f} s: {last}"
        return InterlockTrip(rule.name, why, rule.then, self.values)

    @property
    def values(self) -> tuple[Mapping[str, object], ...]:
        """The last readings as plain numbers, oldest first."""
        return self._values()

    def _values(self, *compared: BathReading) -> tuple[Mapping[str, object], ...]:
        """Those that a rule has compared with and the last ones, as plain numbers, oldest first."""
        chosen: Iterable[BathReading] = (*compared, *list(self._recent)[-KEPT:])
        by_time = {reading.t_s: reading for reading in chosen}
        return tuple(
            {name: getattr(one, name) for name in PLAIN} | {"raw": list(one.raw)}
            for _, one in sorted(by_time.items())
        )

    def _has_settled(self, now: BathReading) -> bool:
        """Once settled it stays so: a bath driven off its set point has to trip."""
        if self._asked_c is None:
            return False
        if math.isnan(self._near_since_s) or now.t_s - self._near_since_s < SETTLED_S:
            near = abs(now.temp_c - self._asked_c) <= SETTLED_WITHIN_K
            if not near:
                self._near_since_s = math.nan
            elif math.isnan(self._near_since_s):
                self._near_since_s = now.t_s
        return not math.isnan(self._near_since_s) and now.t_s - self._near_since_s >= SETTLED_S

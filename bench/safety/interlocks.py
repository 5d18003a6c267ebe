"""Holds the table of interlocks against each reading of the bath, with what the rules have to remember.

Pure: readings with their times in, a trip or nothing out. Who acts on a trip is the watch's and the engine's business.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping

from bench.rig_tables import Limits
from bench.safety.interlock_looks import RATE_SPAN_S, Bath, Look, Reading
from bench.safety.interlock_rules import COMMUNICATIONS, IMPLAUSIBLE, RULES, rule_named
from instruments.bath.profile import Profile
from instruments.bath.reading import BathReading

SETTLED_WITHIN_K, SETTLED_S = 0.5, 120.0  # near the set point for so long, the teats have caught up with the water
KEPT = 10  # readings that go into the record with a trip, beside those that the rule compares with
COARSE_K = 0.05  # a temperature told in steps of more than this stands still in the best of baths


class InterlockTrip(Exception):  # noqa: N818 - the field's word
    """A rule is broken; the bench goes to safe and stays there. ``values`` are the readings that led to it, oldest first."""

    def __init__(self, rule: str, why: str, then: str, values: tuple[Mapping[str, object], ...] = ()) -> None:
        self.rule = rule
        self.why = why
        self.then = then
        self.values = values
        super().__init__(f"interlock {rule}: {why}. {then}")

    def as_dict(self) -> dict[str, object]:
        """For a record: plain text, numbers and None."""
        return {"rule": self.rule, "why": self.why, "then": self.then, "values": list(self.values)}


class Interlocks:
    """Holds the table against each reading. ``t_s`` of the readings has to advance."""

    def __init__(self, limits: Limits, bath: Bath) -> None:
        self._limits = limits
        self._bath = bath
        self._awake = [rule for rule in RULES if not rule.needs or rule.needs in bath.tells]
        self._since: dict[str, Reading] = {}
        self._recent: deque[Reading] = deque()
        self._near_since_s = math.nan
        self._asked_c: float | None = None

    @property
    def asleep(self) -> tuple[str, ...]:
        """Names of the rules that can't work because the family doesn't tell what they need."""
        return tuple(rule.name for rule in RULES if rule not in self._awake)

    def heating(self, set_point_c: float) -> None:
        """The bath has been started: the other sensors may lag again, and who stops it now is not the bench."""
        self._asked_c = set_point_c
        self._near_since_s = math.nan

    def add(self, now: Reading, pump_on: bool | None = None) -> InterlockTrip | None:
        """The first rule of the table that trips with this reading."""
        settled = self._has_settled(now)
        earlier = self._earlier(now)
        for rule in self._awake:
            since = self._since.setdefault(rule.name, now)
            why = rule.wrong(Look(now, since, earlier, self._asked_c, pump_on, settled, self._limits, self._bath))
            if why is None:
                self._since[rule.name] = now
            elif now.t_s - since.t_s >= rule.after_s:
                return InterlockTrip(rule.name, why, rule.then, self._values(since, earlier or now))
        return None

    def silent(self, silent_s: float, error: Exception, *, answered: bool) -> InterlockTrip | None:
        """The trip that a missing reading means: nobody answers, or (``answered``) there is no temperature in the answer."""
        if silent_s < self._limits.bath_silence_s:
            return None
        rule = rule_named(IMPLAUSIBLE if answered else COMMUNICATIONS)
        what = "no usable reading" if answered else "no reading"
        return InterlockTrip(rule.name, f"{what} for {silent_s:.0f} s ({error})", rule.then, self.values)

    @property
    def values(self) -> tuple[Mapping[str, object], ...]:
        """The last readings as plain numbers, oldest first."""
        return self._values()

    def _values(self, *compared: Reading) -> tuple[Mapping[str, object], ...]:
        """Those that a rule has compared with and the last ones, as plain numbers, oldest first."""
        chosen: Iterable[Reading] = (*compared, *list(self._recent)[-KEPT:])
        by_time = {reading.t_s: reading for reading in chosen}
        return tuple(_plain(by_time[t_s]) for t_s in sorted(by_time))

    def _earlier(self, now: Reading) -> Reading | None:
        self._recent.append(now)
        while len(self._recent) > 1 and now.t_s - self._recent[1].t_s >= RATE_SPAN_S:
            self._recent.popleft()
        oldest = self._recent[0]
        return oldest if now.t_s - oldest.t_s >= RATE_SPAN_S else None

    def _has_settled(self, now: Reading) -> bool:
        """Once settled it stays so, or a bath that is driven off its set point would switch its own interlock off."""
        if self._asked_c is None:
            return False
        if math.isnan(self._near_since_s) or now.t_s - self._near_since_s < SETTLED_S:
            near = abs(now.temp_c - self._asked_c) <= SETTLED_WITHIN_K
            if not near:
                self._near_since_s = math.nan
            elif math.isnan(self._near_since_s):
                self._near_since_s = now.t_s
        return not math.isnan(self._near_since_s) and now.t_s - self._near_since_s >= SETTLED_S


def bath_of(profile: Profile) -> Bath:
    """What the rules have to know of a family."""
    rows = {"output": ("power",), "other sensor": ("external", "safety")}
    tells = {what for what, names in rows.items() if any(profile.find(name) for name in names)}
    levels = [alarm.code for alarm in profile.alarms if alarm.cause == "level"]
    bits = any(row.alarm == "bits" for row in profile.rows)

    def low_level(alarm: int) -> bool:
        return any(alarm & level if bits else alarm == level for level in levels)

    return Bath(frozenset(tells), low_level, profile.alarm_text)


def moving_of(profile: Profile) -> Callable[[BathReading], Hashable]:
    """What of a reading has to change while the controller lives: the temperature, and where that is told coarsely the output too."""
    row = profile.row("temperature")
    if row.type == "f32" or row.scale <= COARSE_K:
        return lambda reading: reading.raw
    return lambda reading: (reading.raw, reading.power_percent)


def _plain(reading: Reading) -> Mapping[str, object]:
    names = ("t_s", "temp_c", "external_c", "safety_c", "power_percent", "alarm", "running", "set_point_c")
    return {name: getattr(reading, name) for name in names} | {"raw": list(reading.raw)}

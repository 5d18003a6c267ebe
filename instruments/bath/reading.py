"""One poll of a controller: values to a reading, and whether the reading is plausible. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from instruments.bath.profile import Profile
from instruments.bath.rows import FULL_PERCENT, Quantity
from instruments.errors import DeviceError, ProtocolError

TINY_C = 1e-3  # no controller resolves this; words in the wrong order often give less

Values = Mapping[str, float]


class ChangedError(ProtocolError):
    """The controller's format is not what it was: it has to be identified anew."""


@dataclass(frozen=True, slots=True)
class BathReading:
    """One poll at ``t_s``; None where the family has no such row or there was no number. ``raw``:
    the temperature as it came. ``alarm``, ``warning``: codes, 0 for none. ``remote``: whether it
    takes our commands; ``running``: whether it heats; ``restarted``: whether it says that it was
    without power and lost its set point; ``not_met``: what its set point needs of other rows, and
    what they show; ``alarm_text``: a plug-in's own words of its alarm.
    """

    t_s: float
    temp_c: float
    raw: tuple[int, ...]
    external_c: float | None
    power_percent: float | None
    safety_c: float | None
    alarm: int
    warning: int
    remote: bool | None
    running: bool | None = None
    set_point_c: float | None = None
    restarted: bool | None = None
    not_met: str = ""
    alarm_text: str = ""


class Assembler:
    """Makes the reading of a poll, and refuses what no bath can show."""

    def __init__(self, profile: Profile, who: str) -> None:
        self._profile = profile
        self._who = who

    def reading(
        self,
        t_s: float,
        rows: Sequence[Quantity],
        values: Values,
        raw: Sequence[int],
        *,
        alarm: int,
        diagnoses: Iterable[str],
    ) -> BathReading:
        """The reading of ``values`` by row; ``raw`` is the temperature's, ``diagnoses`` what else
        an implausible one may mean, asked only then. Raises DeviceError without a temperature,
        ProtocolError for an implausible value.
        """
        self._check(rows, values, alarm, diagnoses)
        needs = self._profile.row("set_point").needs
        others = ((name, self._profile.find(name), label) for name, label in needs.items())
        return BathReading(
            t_s=t_s,
            temp_c=values["temperature"],
            raw=tuple(raw),
            external_c=_number(values, "external"),
            power_percent=_number(values, "power"),
            safety_c=_number(values, "safety") or None,  # 0.0 stands where no sensor is fitted
            alarm=alarm,
            warning=int(_number(values, "warning") or 0),
            remote=self._shows(values, "remote", self._profile.remote_label),
            running=self._shows(values, "run", "started"),
            set_point_c=_number(values, "set_point"),
            restarted=self._shows(values, "restarted", "yes"),
            not_met=", ".join(
                f"{name} = {row.label(values[name])} where {label} is needed"
                for name, row, label in others
                if row and not math.isnan(values.get(name, math.nan))
                if values[name] != row.codes[label]
            ),
        )

    def alarm_of(self, row: Quantity, value: float) -> int:
        """The alarm that ``row`` shows; 0 for none, and for a row that reports none."""
        if not row.alarm or math.isnan(value):
            return 0
        code = int(value)
        if row.alarm == "bits":
            return code & sum({alarm.code for alarm in self._profile.alarms})
        return 0 if code in row.quiet or (row.alarm == "negative" and code > 0) else code

    def is_plausible(self, temp_c: float) -> bool:
        """Whether a bath may have this temperature."""
        low, high = self._profile.plausible_c
        return low <= temp_c <= high and (temp_c == 0.0 or abs(temp_c) > TINY_C)

    def in_fahrenheit(self, shown: float) -> Iterator[str]:
        """What to do where ``shown`` would be a bath's temperature in degF."""
        metric_c = (shown - 32.0) / 1.8
        if self.is_plausible(metric_c):
            yield f"In degF it would be {metric_c:.1f} degC: set the controller to degC."

    def _shows(self, values: Values, name: str, label: str) -> bool | None:
        value = values.get(name, math.nan)
        return None if math.isnan(value) else value == self._profile.row(name).codes.get(label)

    def _check(
        self, rows: Sequence[Quantity], values: Values, alarm: int, diagnoses: Iterable[str]
    ) -> None:
        for name in self._profile.number_unit.rows:
            if self._shows(values, name, "c") is False:  # changed at the panel
                seen = self._profile.row(name).label(values[name])
                what, hint = "it does not speak degC", "Set the controller to degrees Celsius."
                raise DeviceError(self._who, what, asked=f"its {name}", seen=seen, hint=hint)
        if math.isnan(values["temperature"]):
            raise self._no_temperature("temperature", alarm)
        for row in rows:  # all: in another order of bytes, one in 20 is plausible
            value = values[row.name]
            if math.isnan(value) or not (why := self._wrong(row, value)):
                continue
            if row.unit == "degC" and alarm and self._profile.means(alarm, "sensor"):
                raise self._no_temperature(row.name, alarm)
            hint = " ".join(diagnoses) if row.unit == "degC" else ""
            if self.is_plausible(values["temperature"]):
                hint = "Its temperature makes sense, so it is this row: is it another model?"
            hint = hint or "Another family than the profile's, or a broken sensor?"
            shown = f"{value:g} {row.unit}".rstrip()
            shown = shown if row.unit != "degC" or row.is_possible(value) else "no temperature"
            what = f"its {row.name} can't be: {why}"
            raise ProtocolError(self._who, what, asked=row.name, seen=shown, hint=hint)

    def _wrong(self, row: Quantity, value: float) -> str:
        """Why a row can't show ``value``; "" where it can."""
        low, high = self._profile.plausible_c
        if row.unit == "degC" and not self.is_plausible(value):
            return f"not within {low:g} to {high:g} degC"
        if row.unit == "%" and abs(value) > FULL_PERCENT:
            return "not within -100 to 100 %"
        needed = row.name in self._profile.row("set_point").needs  # it says so with its own words
        if row.values and not (row.alarm or needed or row.is_known(value)):
            return f"none of {', '.join((*row.values, *row.seen))}"
        return ""

    def _no_temperature(self, name: str, alarm: int) -> DeviceError:
        seen = self._profile.alarm_text(alarm) if alarm else "no alarm"
        hint = "Look at the sensor and its plug."
        return DeviceError(self._who, "it has no temperature", asked=name, seen=seen, hint=hint)


def _number(values: Values, name: str) -> float | None:
    value = values.get(name, math.nan)
    return value if math.isfinite(value) else None

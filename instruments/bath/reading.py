"""One poll of a controller: registers to a reading, and whether the reading is plausible. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

from instruments.bath.profile import Profile
from instruments.bath.registers import Order, Row, decode
from instruments.bath.requests import blocks
from instruments.errors import DeviceError, ProtocolError

FULL_PERCENT = 100.0
TINY_C = 1e-3  # no controller resolves this; words in the wrong order often give less

Values = Mapping[str, float]
Registers = Mapping[str, Sequence[int]]


class OrderError(ProtocolError):
    """The controller's order of bytes is not what it was; it has to be looked at anew."""


@dataclass(frozen=True, slots=True)
class BathReading:
    """One poll, at ``t_s`` of the clock. None where the family has no such row or the controller
    gave no number.

    ``raw`` are the temperature's registers as they came, to tell a frozen value from a steady one.
    ``alarm`` and ``warning`` are the controller's codes, 0 for none; `Profile.alarm_text` gives an
    alarm's meaning. ``remote``: whether it accepts commands by Modbus; ``running``: whether it
    heats, and turns its pump where ``pump == "with run"``.
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


class Poll:
    """The questions of a poll of ``profile``, and how to read the answers (`requests.blocks`)."""

    def __init__(
        self, profile: Profile, order: Order, *, gaps: bool, inferred: bool = False, who: str
    ) -> None:
        self.blocks = blocks(profile, gaps=gaps, inferred=inferred)
        self._profile = profile
        self._order = order
        self._who = who
        self._places = [
            (row, at, row.address - block.address)
            for at, block in enumerate(self.blocks)
            for row in block.rows
        ]
        self._bits = sum({alarm.code for alarm in profile.alarms})

    def reading(self, t_s: float, answers: Sequence[Sequence[int]]) -> BathReading:
        """The reading in ``answers``, the registers of each block.

        Raises DeviceError when there is no temperature in it, ProtocolError when it is none that a
        bath has.
        """
        raw = {row.name: answers[at][start : start + row.words] for row, at, start in self._places}
        values = {row.name: row.decode(raw[row.name], self._order) for row, *_ in self._places}
        alarm = next(self._alarm_codes(values, raw), 0)
        self._check_language(values)
        self._check(values, raw, alarm)
        return BathReading(
            t_s=t_s,
            temp_c=values["temperature"],
            raw=tuple(raw["temperature"]),
            external_c=_number(values, "external"),
            power_percent=_number(values, "power"),
            safety_c=_number(values, "safety") or None,  # 0.0 stands where no sensor is fitted
            alarm=alarm,
            warning=int(values.get("warning", 0)),
            remote=self._shows(values, "remote", "modbus"),
            running=self._shows(values, "run", "started"),
            set_point_c=_number(values, "set_point"),
        )

    def _shows(self, values: Values, name: str, label: str) -> bool | None:
        if name not in values:
            return None
        return values[name] == self._profile.row(name).values.get(label)

    def _alarm_codes(self, values: Values, raw: Registers) -> Iterator[int]:
        for row, *_ in self._places:
            if row.no_value:
                code = raw[row.name][0]
                active = code if code in row.no_value.values() else 0
            elif row.alarm == "bits":
                active = int(values[row.name]) & self._bits
            elif row.alarm:
                code = int(values[row.name])
                active = 0 if code in row.quiet else code
            else:
                continue
            if active:
                yield active

    def _check_language(self, values: Values) -> None:
        """Unit and order of bytes may be changed at the panel while we are connected."""
        if self._shows(values, "unit", "c") is False:
            seen = self._profile.row("unit").label(values["unit"])
            what, hint = "it does not speak degC", "Set the controller to degrees Celsius."
            raise DeviceError(self._who, what, asked="its unit", seen=seen, hint=hint)
        source = self._profile.order_from
        code = values.get(source.row) if source else None
        if source and code is not None and self._profile.order_for(int(code)) != self._order:
            what, seen = "its order of bytes has changed", f"{code:g}"
            raise OrderError(self._who, what, asked=source.row, seen=seen, hint="Ask again.")

    def _check(self, values: Values, raw: Registers, alarm: int) -> None:
        if math.isnan(values["temperature"]):
            raise self._no_temperature("temperature", alarm)
        for row, *_ in self._places:  # all: in another order of bytes, one in 20 is plausible
            value = values[row.name]
            if row.unit == "degC" and not (math.isnan(value) or self._is_plausible(value)):
                sensors = (known for known in self._profile.alarms if known.cause == "sensor")
                if alarm and any(known.code & alarm for known in sensors):
                    raise self._no_temperature(row.name, alarm)
                low, high = self._profile.plausible_c
                hint = " ".join(self._guesses(raw["temperature"]))
                raise self._implausible(row, value, f"not within {low:g} to {high:g} degC", hint)
            if row.unit == "%" and abs(value) > FULL_PERCENT:
                raise self._implausible(row, value, "not within -100 to 100 %")
            if row.values and not row.alarm and not row.is_known(value):
                labels = ", ".join((*row.values, *row.seen))
                raise self._implausible(row, value, f"none of {labels}")

    def _no_temperature(self, name: str, alarm: int) -> DeviceError:
        seen = self._profile.alarm_text(alarm) if alarm else "no alarm"
        hint = "Look at the sensor and its plug."
        return DeviceError(self._who, "it has no temperature", asked=name, seen=seen, hint=hint)

    def _implausible(self, row: Row, value: float, why: str, hint: str = "") -> ProtocolError:
        hint = hint or "Another family than the profile's, or a broken sensor?"
        what, seen = f"its {row.name} can't be: {why}", f"{value:g} {row.unit}".rstrip()
        return ProtocolError(self._who, what, asked=row.name, seen=seen, hint=hint)

    def _guesses(self, raw: Sequence[int]) -> Iterator[str]:
        """What else the temperature's registers may mean, each where it would be a bath's."""
        row = self._profile.row("temperature")
        metric_c = (row.decode(raw, self._order) - 32.0) / 1.8
        if self._is_plausible(metric_c):
            yield f"In degF it would be {metric_c:.1f} degC: set the controller to degC."
        for order in get_args(Order):
            turned = decode(raw, row.type, order) * row.scale
            if row.words > 1 and order != self._order and self._is_plausible(turned):
                where = "set order in the profile, or at the controller"
                yield f"In the order {order} it would be {turned:.1f} degC: {where}."

    def _is_plausible(self, temp_c: float) -> bool:
        low, high = self._profile.plausible_c
        return low <= temp_c <= high and (temp_c == 0.0 or abs(temp_c) > TINY_C)


def _number(values: Values, name: str) -> float | None:
    value = values.get(name, math.nan)
    return value if math.isfinite(value) else None

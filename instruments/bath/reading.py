"""One poll of a controller: registers to a reading, and whether
the reading can be believed. Pure.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

from instruments.bath.profile import Profile
from instruments.bath.registers import Order, Row, decode
from instruments.bath.requests import Block, blocks
from instruments.errors import DeviceError, ProtocolError

FAMILY = "Another family than the profile's, or a broken sensor?"
FULL_PERCENT = 100.0
TINY_C = 1e-3  # no controller resolves this; words in the wrong order often give less


class OrderError(ProtocolError):
    """The controller's order of bytes is not what it was; it has to be looked at anew."""


@dataclass(frozen=True, slots=True)
class BathReading:
    """One poll, at ``t_s`` of the clock. None where the family has no such row or the controller
    gave no number.

    ``raw`` are the temperature's registers as they came, to tell a frozen value from a steady one.
    ``alarm`` and ``warning`` are the controller's codes, 0 for none; what one means is told by
    ``Profile.alarm_text``. ``remote`` says whether it listens to Modbus, ``running`` whether it
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
    """What to ask for in a poll of ``profile``, and how to read the answers. ``gaps``,
    ``inferred``: see ``polling.blocks``.
    """

    def __init__(
        self, profile: Profile, order: Order, *, gaps: bool, inferred: bool = False, who: str
    ) -> None:
        self.blocks: Sequence[Block] = blocks(profile, gaps=gaps, inferred=inferred)
        self._profile = profile
        self._order = order
        self._who = who
        self._places = [
            (row, at, row.address - block.address, row.words)
            for at, block in enumerate(self.blocks)
            for row in block.rows
        ]
        self._temperature = next(place for place in self._places if place[0].name == "temperature")
        self._alarms = [place for place in self._places if place[0].alarm or place[0].no_value]
        self._bits = sum({alarm.code for alarm in profile.alarms})
        self._modbus = _code(profile, "remote", "modbus")
        self._started = _code(profile, "run", "started")
        self._celsius = _code(profile, "unit", "c")
        self._order_row = profile.order_from.row if profile.order_from else ""

    def reading(self, t_s: float, answers: Sequence[Sequence[int]]) -> BathReading:
        """The reading in ``answers``, the registers of each block.

        Raises DeviceError when there is no temperature in it, ProtocolError when it is none that a
        bath has.
        """
        order = self._order
        values = {
            row.name: row.decode(answers[at][start : start + words], order)
            for row, at, start, words in self._places
        }
        _, at, start, words = self._temperature
        raw = tuple(answers[at][start : start + words])
        alarm = next(self._alarm_codes(values, answers), 0)
        self._check_language(values)
        self._check(values, raw, alarm)
        return BathReading(
            t_s=t_s,
            temp_c=values["temperature"],
            raw=raw,
            external_c=_number(values.get("external")),
            power_percent=_number(values.get("power")),
            safety_c=_number(values.get("safety")) or None,  # 0.0 stands where no sensor is fitted
            alarm=alarm,
            warning=int(values.get("warning", 0)),
            remote=values["remote"] == self._modbus if "remote" in values else None,
            running=values["run"] == self._started if "run" in values else None,
            set_point_c=_number(values.get("set_point")),
        )

    def _alarm_codes(
        self, values: Mapping[str, float], answers: Sequence[Sequence[int]]
    ) -> Iterator[int]:
        for row, at, start, _ in self._alarms:
            code = answers[at][start] if row.no_value else int(values[row.name])
            if row.no_value:
                active = code if code in row.no_value.values() else 0
            elif row.alarm == "bits":
                active = code & self._bits
            else:
                active = 0 if code in row.quiet else code
            if active:
                yield active

    def _check_language(self, values: Mapping[str, float]) -> None:
        """Unit and order of bytes may be changed at the panel while we are connected."""
        unit = values.get("unit")
        if unit is not None and unit != self._celsius:
            seen, hint = (
                self._profile.row("unit").label(unit),
                "Set the controller to degrees Celsius.",
            )
            raise DeviceError(
                self._who, "it does not speak degC", asked="its unit", seen=seen, hint=hint
            )
        code = values.get(self._order_row)
        if code is not None and self._profile.order_for(int(code)) != self._order:
            raise OrderError(
                self._who,
                "its order of bytes has changed",
                asked=self._order_row,
                seen=f"{code:g}",
                hint="Ask again.",
            )

    def _check(self, values: Mapping[str, float], raw: Sequence[int], alarm: int) -> None:
        if math.isnan(values["temperature"]):
            said = self._profile.alarm_text(alarm) if alarm else "no alarm"
            raise DeviceError(
                self._who,
                "it has no temperature",
                asked="temperature",
                seen=said,
                hint="Look at the sensor and its plug.",
            )
        for row, *_ in self._places:  # all: in another order of bytes, one in 20 is plausible
            value = values[row.name]
            if row.unit == "degC" and not (math.isnan(value) or self._is_plausible(value)):
                self._refuse(row.name, value, raw, alarm)
            if row.unit == "%" and abs(value) > FULL_PERCENT:
                what = f"its {row.name} can't be: not within -100 to 100 %"
                raise ProtocolError(
                    self._who, what, asked=row.name, seen=f"{value:g} %", hint=FAMILY
                )
            if row.values and not row.alarm and not row.is_known(value):
                what = f"its {row.name} can't be: none of {', '.join((*row.values, *row.seen))}"
                raise ProtocolError(self._who, what, asked=row.name, seen=f"{value:g}", hint=FAMILY)

    def _refuse(self, name: str, temp_c: float, raw: Sequence[int], alarm: int) -> None:
        if alarm and any(
            known.cause == "sensor" and known.code & alarm for known in self._profile.alarms
        ):
            said = self._profile.alarm_text(alarm)
            raise DeviceError(
                self._who,
                "it has no temperature",
                asked=name,
                seen=said,
                hint="Look at the sensor and its plug.",
            )
        low, high = self._profile.plausible_c
        what = f"its {name} can't be: not within {low:g} to {high:g} degC"
        hint = " ".join(self._guesses(self._profile.row("temperature"), raw)) or FAMILY
        raise ProtocolError(self._who, what, asked=name, seen=f"{temp_c:g} degC", hint=hint)

    def _guesses(self, row: Row, raw: Sequence[int]) -> Iterator[str]:
        """What else the temperature's registers may mean, each where it would be a bath's."""
        temp_c = row.decode(raw, self._order)
        if self._is_plausible((temp_c - 32.0) / 1.8):
            yield (
                f"In degF it would be {(temp_c - 32.0) / 1.8:.1f} degC: set the controller to degC."
            )
        for order in get_args(Order):
            turned = decode(raw, row.type, order) * row.scale
            if row.words > 1 and order != self._order and self._is_plausible(turned):
                yield (
                    f"In the order {order} it would be {turned:.1f} degC: set order in the profile,"
                    " or at the controller."
                )

    def _is_plausible(self, temp_c: float) -> bool:
        low, high = self._profile.plausible_c
        return low <= temp_c <= high and (temp_c == 0.0 or abs(temp_c) > TINY_C)


def _code(profile: Profile, row: str, label: str) -> int | None:
    found = profile.find(row)
    return None if found is None else found.values.get(label)


def _number(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None

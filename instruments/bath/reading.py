"""One poll of a controller: registers to a reading, and whether the reading can be believed. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from instruments.bath.profile import Block, Profile
from instruments.bath.registers import Order
from instruments.errors import DeviceError, ProtocolError

TINY_C = 1e-3  # no controller resolves this; words in the wrong order often give less


@dataclass(frozen=True, slots=True)
class BathReading:
    """One poll, at ``t_s`` of the clock. None where the family has no such row or the controller gave no number.

    ``raw`` are the temperature's registers as they came, to tell a frozen value from a steady one. ``alarm`` and
    ``warning`` are the controller's codes, 0 for none. ``remote`` says whether it listens to Modbus.
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


class Poll:
    """What to ask for in a poll of ``profile``, and how to read the answers. ``gaps``: see ``Profile.blocks``."""

    def __init__(self, profile: Profile, order: Order, *, gaps: bool, who: str) -> None:
        self.blocks: Sequence[Block] = profile.blocks(gaps=gaps)
        self._profile = profile
        self._order = order
        self._who = who
        remote = profile.find("remote")
        self._modbus = None if remote is None else remote.values.get("modbus")

    def reading(self, t_s: float, answers: Sequence[Sequence[int]]) -> BathReading:
        """The reading in ``answers``, the registers of each block.

        Raises DeviceError when there is no temperature in it, ProtocolError when it is none that a bath has.
        """
        values: dict[str, float] = {}
        raw: tuple[int, ...] = ()
        for block, registers in zip(self.blocks, answers, strict=True):
            for row in block.rows:
                words = registers[row.address - block.address : row.end - block.address]
                values[row.name] = row.decode(words, self._order)
                if row.name == "temperature":
                    raw = tuple(words)
        self._check(values)
        return BathReading(
            t_s=t_s,
            temp_c=values["temperature"],
            raw=raw,
            external_c=_number(values.get("external")),
            power_percent=_number(values.get("power")),
            safety_c=_number(values.get("safety")),
            alarm=int(values.get("alarm", 0)),
            warning=int(values.get("warning", 0)),
            remote=values["remote"] == self._modbus if "remote" in values else None,
        )

    def _check(self, values: Mapping[str, float]) -> None:
        if math.isnan(values["temperature"]):
            code = int(values.get("alarm", 0))
            said = self._profile.alarm_text(code) if code else "no alarm"
            raise DeviceError(self._who, "it has no temperature", asked="temperature", seen=said, hint="Look at the sensor and its plug.")
        for name in ("temperature", "safety"):  # both: in another order of bytes, one number in 20 looks like a bath's
            self._believe(name, values.get(name, math.nan))

    def _believe(self, name: str, temp_c: float) -> None:
        low, high = self._profile.plausible_c
        if math.isnan(temp_c) or (low <= temp_c <= high and (temp_c == 0.0 or abs(temp_c) > TINY_C)):
            return
        hint = "Another order of bytes, another unit, or another family than the profile's?"
        what = f"its {name} can't be: not within {low:g} to {high:g} degC"
        raise ProtocolError(self._who, what, asked=name, seen=f"{temp_c:g} degC", hint=hint)


def _number(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None

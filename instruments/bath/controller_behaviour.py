"""How controllers of each family behave beyond what a profile says: one table, read by the
emulator. Pure. From the water-bath fact sheet, section 1; where it is silent the choice is the one
that is harder on a driver, marked as chosen.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

from instruments.bath import protocol
from instruments.bath.profile import Profile
from instruments.bath.registers import Table

STANDARD: Mapping[int, Table] = {
    protocol.READ_COILS: "coil",
    protocol.READ_DISCRETE: "discrete",
    protocol.READ_HOLDING: "holding",
    protocol.READ_INPUT: "input",
    protocol.WRITE_COIL: "coil",
    protocol.WRITE_ONE: "holding",
    protocol.WRITE_COILS: "coil",
    protocol.WRITE_MANY: "holding",
    protocol.EXCHANGE: "holding",
}
WORDS: Mapping[int, Table] = {3: "holding", 4: "holding", 6: "holding", 16: "holding"}


@dataclass(frozen=True, slots=True)
class Manners:
    """One family's ways.

    ``functions`` says which table each function works on; others get exception 1, or nothing where
    ``unknown_function`` is "silence". ``alike``: input registers are the holding registers,
    discrete inputs the coils. ``gaps``: what is read where no row is. ``says_busy``: it has
    exception 6; without it, a busy controller is silent. ``areas``: each quantity has a 16-bit
    register n and, at 0x8000 + 2 n, a pair. ``sensor_break`` is what the temperature reads then:
    not-a-number, the last value before, or a raw code. After a reset of ``reset_s`` it stands by,
    or carries on. ``writable``: rows that anybody may write though the bench only looks; None for
    all holding registers. ``bits`` are the status word's, by what they tell. ``starts``: what rows
    that are only remembered hold at first.
    """

    functions: Mapping[int, Table] = field(default_factory=lambda: STANDARD)
    unknown_function: Literal["exception", "silence"] = "exception"
    alike: bool = False
    gaps: Literal["zeros", "refused", "undefined"] = "zeros"
    says_busy: bool = True
    areas: bool = False
    sensor_break: Literal["nan", "last"] | int = "nan"
    reset_s: float = 2.0
    after_reset: Literal["standby", "as it was"] = "as it was"
    fahrenheit_as_shipped: bool = False
    writable: frozenset[str] | None = frozenset()
    bits: Mapping[str, int] = field(default_factory=dict)
    starts: Mapping[str, float] = field(default_factory=dict)


LIMITS = {
    "range_low": 0.0,
    "range_high": 100.0,
    "set_point_low": 5.0,
    "set_point_high": 40.0,
    "alarm1_low": 0.0,
    "alarm1_high": 40.0,
}  # chosen

# 1.2: no bits; floats need function 16; all holding registers RW; the start command is gone after a
# power cut
JULABO = Manners(
    functions={3: "holding", 4: "input", 6: "holding", 16: "holding", 23: "holding"},
    after_reset="standby",
    writable=None,
    starts={
        **LIMITS,
        "firmware": 10400.0,
        "cooling_gradient": math.inf,
        "heating_gradient": math.inf,
        "low_warning": 0.0,
        "high_warning": 100.0,
        "cooling_limit": 0.0,
    },
)
# 1.1: an unsupported function gets no reply; exceptions 2 and 3 only; 5 s silent when it resets
EUROTHERM = Manners(
    functions={
        1: "coil",
        2: "coil",
        5: "coil",
        **WORDS,
        protocol.STATUS: "holding",
        protocol.LOOPBACK: "holding",
    },
    unknown_function="silence",
    alike=True,
    gaps="undefined",
    says_busy=False,
    areas=True,
    sensor_break="last",
    reset_s=5.0,
    writable=frozenset(
        (
            "set_point_select",
            "set_point_1",
            "set_point_2",
            "alarm1_high",
            "output_low",
            "set_point_low",
            "set_point_high",
            "output_demand",
        )
    ),
    bits={"alarm 1": 0x0001, "manual": 0x0010, "sensor": 0x0020, "loop": 0x0040},
    starts={**LIMITS, "decimals": 1.0, "version": 0x0461, "model": 0x2416},
)
WATLOW = Manners(  # 1.3: degF until it is told; 3 and 4 alike
    functions=WORDS,
    alike=True,
    sensor_break="last",
    fahrenheit_as_shipped=True,
    writable=frozenset(
        (
            "unit",
            "alarm1_low",
            "alarm1_high",
            "set_point_low",
            "set_point_high",
            "manual_power",
            "limit_high",
        )
    ),
    starts={**LIMITS, "limit_high": 60.0, "limit_state": 61.0},
)
OMEGA = Manners(  # 1.4: functions 2, 3, 5 and 6; an error code stands where the temperature would
    functions={2: "coil", 3: "holding", 5: "coil", 6: "holding"},
    alike=True,
    gaps="refused",
    sensor_break=0x8003,
    writable=frozenset(("alarm1_low", "alarm1_high")),
    starts=LIMITS,
)

FAMILIES: Mapping[str, Manners] = {  # by how the name of the family begins
    "julabo": JULABO,
    "eurotherm 2400": EUROTHERM,
    "eurotherm": replace(EUROTHERM, starts={**EUROTHERM.starts, "model": 0x3216}),
    "watlow": WATLOW,
    "omega": OMEGA,
}


def manners_of(profile: Profile) -> Manners:
    """The behaviour of the profile's family; of an unknown one, all that Modbus has."""
    name = profile.family.lower()
    known = (manners for begins, manners in FAMILIES.items() if name.startswith(begins))
    return next(known, Manners(alike=profile.alike))

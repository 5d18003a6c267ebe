"""What an emulated controller is at one moment, beside the plant that it controls: its memory and
the settings of its panel.

It knows the profile's names and codes, and may not know addresses, frames or clocks. What each name
means: `meanings`.

What the rows of an emulated controller mean: each name is a look at the plant, an act on it, or a
cell of memory.

A row that nothing here knows is remembered as it was written and changes nothing else. Numbers go
over the wire in the unit that the controller speaks just now. It may not know addresses, frames or
clocks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from instruments.bath.controller_behaviour import Manners
from instruments.bath.profile import Profile
from instruments.bath.registers import Order, Row
from instruments.world.plant import Plant

TURNED: Mapping[Order, Order] = {"ABCD": "CDAB", "CDAB": "ABCD", "BADC": "DCBA", "DCBA": "BADC"}


class Controller:
    """A controller of ``profile``'s family over ``plant``.

    ``fahrenheit`` and ``turned`` (the words of a number the other way round) are settings that
    somebody else may change, as is ``manual_mode``: in it a circulator confirms writes and ignores
    them (``ignores``); a controller holds its output where it was.
    """

    def __init__(self, plant: Plant, profile: Profile, manners: Manners, unit_id: int) -> None:
        self.plant = plant
        self.profile = profile
        self.manners = manners
        self.unit_id = unit_id
        self.fahrenheit = self.turned = self.ignores = False
        self.memory: dict[str, float] = {}
        self._order = profile.order_for(0) or profile.order
        self._shipped_c = plant.set_point_c
        self._last_c = plant.pv_c

    @property
    def manual_mode(self) -> bool:
        """Whether somebody has switched it to manual."""
        return self.ignores or self.plant.manual_output is not None

    @manual_mode.setter
    def manual_mode(self, on: bool) -> None:
        if self.profile.find("remote"):
            self.ignores = on
        else:
            self.plant.manual_output = self.plant.output if on else None

    @property
    def decimals(self) -> int:
        """Digits behind the decimal point that a 16-bit number leaves out (Eurotherm 525; none
        where 12550 says integers).
        """
        return 0 if self.remembered("resolution") == 1 else int(self.remembered("decimals"))

    @property
    def order(self) -> Order:
        """In which order the bytes of two registers go just now."""
        return TURNED[self._order] if self.turned else self._order

    def set_order(self, code: int) -> None:
        """Another order of bytes by its code; nothing for a code that means none."""
        self._order = self.profile.order_for(code) or self._order

    def shown(self, row: Row, value: float) -> float:
        """A value of ``row`` in the unit that it speaks just now."""
        if not self.fahrenheit:
            return value
        return (
            value * 1.8 + 32.0
            if row.unit == "degC"
            else value * 1.8
            if row.unit.startswith("K")
            else value
        )

    def metric(self, row: Row, shown: float) -> float:
        """The other way round."""
        if not self.fahrenheit:
            return shown
        return (
            (shown - 32.0) / 1.8
            if row.unit == "degC"
            else shown / 1.8
            if row.unit.startswith("K")
            else shown
        )

    def remembered(self, name: str) -> float:
        """What a row holds that nothing in the plant answers for."""
        start = self.manners.starts.get(name)
        if start is None:
            row = self.profile.find(name)
            codes = row.values.values() if row else ()
            low, high = row.range if row and row.range else (0.0, 0.0)
            start = float(min(codes, key=abs)) if codes else min(max(0.0, low), high)
        return self.memory.get(name, start)

    def code(self, name: str, label: str) -> float:
        """The code that a row of the profile has for a label; 0 where it has none."""
        row = self.profile.row(name)
        return float(row.values.get(label, row.seen.get(label, 0)))

    def temperature_c(self) -> float:
        """What it takes for the temperature."""
        if not self.plant.broken_sensor:
            self._last_c = self.plant.pv_c
        return (
            math.nan
            if self.plant.broken_sensor and self.manners.sensor_break == "nan"
            else self._last_c
        )

    def alarm1(self) -> str:
        """Which of alarm 1's two thresholds is passed."""
        temp_c = self.temperature_c()
        return (
            "high"
            if temp_c >= self.remembered("alarm1_high")
            else "low"
            if temp_c <= self.remembered("alarm1_low")
            else "none"
        )

    def reset(self) -> None:
        """Power off and on. A family that keeps nothing is as shipped then, in standby."""
        if self.manners.after_reset == "standby":
            self.memory.clear()
            plant = self.plant
            plant.standby()
            plant.set_point_c, plant.manual_output, plant.output_max = (
                self._shipped_c,
                None,
                plant.constants.output_max,
            )
            plant.set_flow(plant.constants.flow_l_per_min)


NO_NUMBER = 0x8000  # for a register that can't say not-a-number; chosen


class Meanings:
    """The rows' values as `cells.Values` wants them."""

    def __init__(self, controller: Controller) -> None:
        self._on = controller

    @property
    def decimals(self) -> int:
        """As `Controller.decimals`."""
        return self._on.decimals

    @property
    def order(self) -> Order:
        """As `Controller.order`."""
        return self._on.order

    def words(self, row: Row) -> tuple[int, ...]:
        """The registers that say the row's value."""
        instead = self._on.manners.sensor_break
        if row.name == "temperature" and self._on.plant.broken_sensor and isinstance(instead, int):
            return (instead,)
        number = self.number(row)
        if not math.isfinite(number) and row.type != "f32":
            return (NO_NUMBER,) * row.words
        return row.encode(number, self.order)

    def number(self, row: Row) -> float:
        """The row's value in the unit that the controller speaks."""
        look = LOOKS.get(row.name)
        return self._on.shown(row, look(self._on) if look else self._on.remembered(row.name))

    def refuses(self, row: Row, value: float) -> bool:
        """Whether a value in the unit that the controller speaks is out of bounds."""
        return row.refusal(self._on.metric(row, value)) is not None

    def take(self, row: Row, value: float) -> None:
        """Act on a value in the unit that the controller speaks."""
        if self._on.ignores:
            return
        self._on.memory[row.name] = value = self._on.metric(row, value)
        if row.name in ACTS:
            ACTS[row.name](self._on, value)


def _run(on: Controller) -> float:
    if not on.plant.running:
        return on.code("run", "standby")
    manual = "manual" in on.profile.row("run").seen and on.plant.manual_output is not None
    return on.code("run", "manual" if manual else "started")


def _mode(name: str, automatic: str) -> Callable[[Controller], float]:
    def look(on: Controller) -> float:
        if on.remembered(name) != on.code(name, automatic):
            return on.remembered(name)
        return on.code(name, "manual" if on.plant.manual_output is not None else automatic)

    return look


def _alarm(on: Controller) -> float:
    return next(
        (float(alarm.code) for alarm in on.profile.alarms if alarm.cause == on.plant.alarm), 0.0
    )


def _status(on: Controller) -> float:
    told = {
        "alarm 1": on.alarm1() == "high",
        "manual": on.manual_mode,
        "sensor": on.plant.broken_sensor,
        "loop": on.plant.loop_broken,
    }
    return float(sum(on.manners.bits.get(name, 0) for name, true in told.items() if true))


def _encoding(on: Controller) -> float:
    codes = on.profile.order_from.codes if on.profile.order_from else {}
    return next((float(code) for code, order in codes.items() if order == on.order), 0.0)


def _set_point(on: Controller) -> float:
    return (
        on.memory.get("set_point", on.plant.set_point_c)
        if on.remembered("local_remote")
        else on.plant.set_point_c
    )


LOOKS: Mapping[str, Callable[[Controller], float]] = {
    "run": _run,
    "run_active": _run,
    "auto_manual": _mode("auto_manual", "auto"),
    "control": _mode("control", "pid"),
    "set_point": _set_point,
    "working_set_point": lambda on: on.plant.controlled_c,
    "temperature": lambda on: on.temperature_c(),
    "filtered": lambda on: on.temperature_c(),
    "error": lambda on: on.temperature_c() - on.plant.controlled_c,
    "rate": lambda on: on.plant.rate_k_per_min,
    "external": lambda on: float(on.plant.teat_c.mean()),
    "safety": lambda on: on.plant.bath_c,
    "cut_out": lambda on: on.plant.constants.cut_out_c,
    "power": lambda on: on.plant.power_percent,
    "output": lambda on: on.plant.power_percent,
    "output_demand": lambda on: on.plant.power_percent,
    "heating_limit": lambda on: on.plant.output_max * 100.0,
    "ramp": lambda on: on.plant.ramp_k_per_min,
    "band": lambda on: on.plant.constants.band_k,
    "reset_time": lambda on: on.plant.constants.integral_s,
    "rate_time": lambda on: on.plant.constants.derivative_s,
    "pump_stage": lambda on: 4.0 * on.plant.flow_l_per_min / on.plant.constants.flow_l_per_min,
    "unit": lambda on: on.code("unit", "f" if on.fahrenheit else "c"),
    "encoding": _encoding,
    "address": lambda on: float(on.unit_id),
    "remote": lambda on: on.code("remote", "manual" if on.manual_mode else "modbus"),
    "alarm": _alarm,
    "status": _status,
    "sensor_break": lambda on: on.code("sensor_break", "yes" if on.plant.broken_sensor else "no"),
    "loop_break": lambda on: on.code("loop_break", "yes" if on.plant.loop_broken else "no"),
    "input_error": lambda on: on.code("input_error", "open" if on.plant.broken_sensor else "none"),
    "loop_error": lambda on: on.code("loop_error", "open" if on.plant.loop_broken else "none"),
    "alarm1_state": lambda on: on.code("alarm1_state", on.alarm1()),
    "device_status": lambda on: on.code("device_status", "ok"),
}


def _start_or_stop(on: Controller, value: float) -> None:
    if value == on.code("run", "started"):
        if "manual" in on.profile.row("run").seen:
            on.plant.manual_output = None
        on.plant.run(on.plant.set_point_c)
    else:
        on.plant.standby()


def _automatic(on: Controller, value: float) -> None:  # noqa: ARG001 - the whitelist has no other code than automatic
    on.plant.manual_output = None


def _actuating(on: Controller, value: float) -> None:
    """JULABO: "digital" heats with a power of its own, whatever the set point; EPROG, with nobody's
    program, not at all.
    """
    digital = (
        on.memory.get("heating_power", 0.0) / 100.0
        if value == on.code("actuating", "digital")
        else 0.0
    )
    on.plant.manual_output = None if value == on.code("actuating", "controller") else digital


def _aim(on: Controller, value: float) -> None:  # noqa: ARG001 - one of three rows has changed; which does not matter
    """The set point is the local one or, on a controller that is set so, the remote one."""
    remote = on.remembered("local_remote") == 1
    on.plant.set_point_c = on.memory.get(
        "remote_set_point" if remote else "set_point", on.plant.set_point_c
    )


def _limit(on: Controller, value: float) -> None:
    on.plant.output_max = value / 100.0


def _ramp(on: Controller, value: float) -> None:
    on.plant.ramp_k_per_min = value


def _stage(on: Controller, value: float) -> None:
    on.plant.set_flow(on.plant.constants.flow_l_per_min * value / 4.0)


def _unit(on: Controller, value: float) -> None:
    on.fahrenheit = value == on.code("unit", "f")


def _encode(on: Controller, value: float) -> None:
    on.set_order(int(value))


ACTS: Mapping[str, Callable[[Controller, float], None]] = {
    "run": _start_or_stop,
    "auto_manual": _automatic,
    "control": _automatic,
    "actuating": _actuating,
    "heating_power": lambda on, _: _actuating(on, on.remembered("actuating")),
    "set_point": _aim,
    "remote_set_point": _aim,
    "local_remote": _aim,
    "heating_limit": _limit,
    "ramp": _ramp,
    "pump_stage": _stage,
    "unit": _unit,
    "encoding": _encode,
}

"""The emulated controller between registers and plant: how each family behaves beyond its profile;
what each row reads from the plant (`SOURCES`) and changes in it (`EFFECTS`); and the address space:
which row answers at which address, in how many registers, and what is refused.

A row in neither table is stored as it was written and changes nothing else. The families are from
the water-bath fact sheet, section 1; where it says nothing, the harder case for a driver is taken,
marked as chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Set
from dataclasses import dataclass, field, replace
from typing import Literal

from instruments.bath import protocol
from instruments.bath.profile import ModbusDevice, RegisterProfile
from instruments.bath.protocol import ModbusException, Read, Write
from instruments.bath.rows import Order, Row, Table
from instruments.bath.witness import IEEE_AREA
from instruments.world.plant import Plant

TURNED: Mapping[Order, Order] = {"ABCD": "CDAB", "CDAB": "ABCD", "BADC": "DCBA", "DCBA": "BADC"}
NO_NUMBER = 0x8000  # for a register that can't hold not-a-number; chosen
PADDING = 0x8000  # behind a word that takes only the first register of its pair
ALIKE: Mapping[Table, Table] = {"input": "holding", "discrete": "coil"}
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
class Behaviour:
    """How a family answers. ``functions``: each function's table. ``gaps``: what is read where no
    row is. ``says_busy``: it has exception 6. ``areas``: register n and the pair at 0x8000 + 2 n.
    ``sensor_break``: what the temperature reads then. ``writable``: rows that any host may write,
    None for all holding registers. ``bits``: of the status word. ``starts``: first values of stored
    rows.
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
    writable: Set[str] | None = frozenset()
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
JULABO = Behaviour(
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
EUROTHERM = Behaviour(
    functions={**WORDS, **dict.fromkeys((1, 2, 5), "coil"), 7: "holding", 8: "holding"},
    unknown_function="silence",
    alike=True,
    gaps="undefined",
    says_busy=False,
    areas=True,
    sensor_break="last",
    reset_s=5.0,
    writable={"set_point_select", "set_point_1", "set_point_2", "set_point_low", "set_point_high"}
    | {"alarm1_high", "output_low", "output_demand"},
    bits={"alarm 1": 0x0001, "manual": 0x0010, "sensor": 0x0020, "loop": 0x0040},
    starts={**LIMITS, "decimals": 1.0, "version": 0x0461, "model": 0x2416},
)
WATLOW = Behaviour(  # 1.3: 3 and 4 alike
    functions=WORDS,
    alike=True,
    sensor_break="last",
    writable={"unit", "alarm1_low", "alarm1_high", "set_point_low", "set_point_high"}
    | {"manual_power", "limit_high"},
    starts={**LIMITS, "limit_high": 60.0, "limit_state": 61.0},
)
OMEGA = Behaviour(  # 1.4: functions 2, 3, 5 and 6; an error code stands where the temperature would
    functions={2: "coil", 3: "holding", 5: "coil", 6: "holding"},
    alike=True,
    gaps="refused",
    sensor_break=0x8003,
    writable={"alarm1_low", "alarm1_high"},
    starts={**LIMITS, "write_enable": 1.0},
)

FAMILIES: Mapping[str, Behaviour] = {  # by how the name of the family begins
    "julabo": JULABO,
    "eurotherm 2400": EUROTHERM,
    "eurotherm": replace(EUROTHERM, starts={**EUROTHERM.starts, "model": 0x3216}),
    "watlow": WATLOW,
    "omega": OMEGA,
}


def behaviour_of(profile: RegisterProfile) -> Behaviour:
    """The behaviour of the profile's family; of an unknown one, all that Modbus has."""
    name = profile.family.lower()
    known = (behaviour for begins, behaviour in FAMILIES.items() if name.startswith(begins))
    return next(known, Behaviour(alike=profile.alike))


class Values:
    """The device's memory. Numbers are as they go over the wire: in the unit that it speaks."""

    def __init__(self, profile: ModbusDevice) -> None:
        self.device = profile
        self.memory: dict[str, float] = {}

    @property
    def decimals(self) -> int:
        """Digits behind the decimal point that a 16-bit number leaves out."""
        return 0

    @property
    def order(self) -> Order:
        return self.device.order

    def number(self, row: Row) -> float:
        return self.memory.get(row.name, 0.0)

    def words(self, row: Row) -> tuple[int, ...]:
        return row.encode(self.number(row), self.order)

    def refuses(self, row: Row, value: float) -> bool:
        return row.refusal(value) is not None

    def take(self, row: Row, value: float) -> None:
        self.memory[row.name] = value

    def reset(self) -> None:
        """Power off and on."""
        self.memory.clear()


class Panel(Values):
    """A controller of ``profile``'s family over ``plant``. Settings of its panel: ``fahrenheit``,
    ``turned`` (words the other way round), ``manual_mode`` (writes are confirmed and ignored),
    ``external_control`` (by the external sensor).
    """

    def __init__(
        self, plant: Plant, profile: RegisterProfile, behaviour: Behaviour, unit_id: int
    ) -> None:
        super().__init__(profile)
        self.plant = plant
        self.profile = profile
        self.behaviour = behaviour
        self.unit_id = unit_id
        self.fahrenheit = self.turned = self.ignores = self.external_control = False
        self._order = profile.order_for(0) or profile.order
        self._shipped_c = plant.set_point_c
        self._last_c = plant.pv_c

    @property
    def manual_mode(self) -> bool:
        return self.ignores or self.plant.manual_output is not None

    @manual_mode.setter
    def manual_mode(self, on: bool) -> None:
        if self.profile.find("remote"):
            self.ignores = on
        else:
            self.plant.manual_output = self.plant.output if on else None

    @property
    def decimals(self) -> int:
        """As Eurotherm's registers 525 and 12550 say."""
        return 0 if self.stored("resolution") == 1 else int(self.stored("decimals"))

    @property
    def order(self) -> Order:
        return TURNED[self._order] if self.turned else self._order

    def set_order(self, code: int) -> None:
        """Another order of bytes by its code; nothing for a code that means none."""
        self._order = self.profile.order_for(code) or self._order

    def words(self, row: Row) -> tuple[int, ...]:
        instead = self.behaviour.sensor_break
        if row.name == "temperature" and self.plant.broken_sensor and isinstance(instead, int):
            return (instead,)
        number = self.number(row)
        if not math.isfinite(number) and row.type != "f32":
            return (NO_NUMBER,) * row.words
        return row.encode(number, self.order)

    def number(self, row: Row) -> float:
        value = SOURCES[row.name](self) if row.name in SOURCES else self.stored(row.name)
        scale, offset = self._unit(row)
        return value * scale + offset

    def refuses(self, row: Row, value: float) -> bool:
        return super().refuses(row, self._metric(row, value))

    def take(self, row: Row, value: float) -> None:
        if self.ignores:
            return
        self.memory[row.name] = value = self._metric(row, value)
        if row.name in EFFECTS:
            EFFECTS[row.name](self, value)

    def _metric(self, row: Row, value: float) -> float:
        scale, offset = self._unit(row)
        return (value - offset) / scale

    def _unit(self, row: Row) -> tuple[float, float]:
        """Scale and offset from degC and K to what the controller shows."""
        if not self.fahrenheit or not row.unit.startswith(("degC", "K")):
            return 1.0, 0.0
        return 1.8, 32.0 if row.unit == "degC" else 0.0

    def stored(self, name: str) -> float:
        """The value of a row that does not come from the plant; before a write, as shipped."""
        if name in self.memory:
            return self.memory[name]
        if (start := self.behaviour.starts.get(name)) is None:
            row = self.profile.find(name)
            codes = row.values.values() if row else ()
            low, high = row.range if row and row.range else (0.0, 0.0)
            start = float(min(codes, key=abs)) if codes else min(max(0.0, low), high)
        return start

    def code(self, name: str, label: str) -> float:
        """The code that a row of the profile has for a label; 0 where it has none."""
        return float(self.profile.row(name).codes.get(label, 0))

    def temperature_c(self) -> float:
        """What it measures; with a broken sensor not-a-number, or the last value."""
        if not self.plant.broken_sensor:
            self._last_c = self.plant.pv_c
        elif self.behaviour.sensor_break == "nan":
            return math.nan
        return self._last_c

    def alarm1(self) -> str:
        """Which of alarm 1's two thresholds is passed."""
        temp_c = self.temperature_c()
        if temp_c >= self.stored("alarm1_high"):
            return "high"
        return "low" if temp_c <= self.stored("alarm1_low") else "none"

    def reset(self) -> None:
        """Power off and on. A family that keeps nothing is as shipped then, in standby."""
        if self.behaviour.after_reset == "standby":
            super().reset()
            plant = self.plant
            plant.standby()
            plant.set_point_c, plant.manual_output = self._shipped_c, None
            plant.output_max = plant.constants.output_max
            plant.set_flow(plant.constants.flow_l_per_min)


def _run(on: Panel) -> float:
    if not on.plant.running:
        return on.code("run", "standby")
    manual = "manual" in on.profile.row("run").seen and on.plant.manual_output is not None
    return on.code("run", "manual" if manual else "started")


def _mode(name: str, automatic: str) -> Callable[[Panel], float]:
    def look(on: Panel) -> float:
        if on.stored(name) != on.code(name, automatic):
            return on.stored(name)
        return on.code(name, "manual" if on.plant.manual_output is not None else automatic)

    return look


def _status(on: Panel) -> float:
    states = {
        "alarm 1": on.alarm1() == "high",
        "manual": on.manual_mode,
        "sensor": on.plant.broken_sensor,
        "loop": on.plant.loop_broken,
    }
    return float(sum(on.behaviour.bits.get(name, 0) for name, true in states.items() if true))


def _encoding(on: Panel) -> float:
    codes = on.profile.order_from.codes if on.profile.order_from else {}
    return next((float(code) for code, order in codes.items() if order == on.order), 0.0)


def _set_point(on: Panel) -> float:
    local = on.memory.get("set_point", on.plant.set_point_c)
    return local if on.stored("local_remote") else on.plant.set_point_c


def _set_point_1(on: Panel) -> float:
    """Eurotherm: the target set point is this one while it is selected."""
    chosen = on.stored("set_point_select") == on.code("set_point_select", "sp1")
    return _set_point(on) if chosen else on.stored("set_point_1")


SOURCES: Mapping[str, Callable[[Panel], float]] = {
    "run": _run,
    "run_active": _run,
    "auto_manual": _mode("auto_manual", "auto"),
    "control": _mode("control", "pid"),
    "set_point": _set_point,
    "set_point_1": _set_point_1,
    "working_set_point": lambda on: on.plant.controlled_c,
    "temperature": lambda on: on.temperature_c(),
    "filtered": lambda on: on.temperature_c(),
    "error": lambda on: on.temperature_c() - on.plant.controlled_c,
    "rate": lambda on: on.plant.rate_k_per_min,
    "external": lambda on: float(on.plant.teat_c.mean()),
    "safety": lambda on: on.plant.bath_c,
    "safety_reservoir": lambda on: on.plant.bath_c,
    "cut_out": lambda on: on.plant.constants.cut_out_c,
    "cut_out_reservoir": lambda on: on.plant.constants.cut_out_c,
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
    "unit_2": lambda on: on.code("unit_2", "f" if on.fahrenheit else "c"),
    "encoding": _encoding,
    "control_sensor": lambda on: on.code(
        "control_sensor", "external" if on.external_control else "internal"
    ),
    "address": lambda on: float(on.unit_id),
    "remote": lambda on: on.code("remote", "manual" if on.manual_mode else "modbus"),
    "alarm": lambda on: next(
        (float(known.code) for known in on.profile.alarms if known.cause == on.plant.alarm), 0.0
    ),
    "status": _status,
    "sensor_break": lambda on: on.code("sensor_break", "yes" if on.plant.broken_sensor else "no"),
    "loop_break": lambda on: on.code("loop_break", "yes" if on.plant.loop_broken else "no"),
    "input_error": lambda on: on.code("input_error", "open" if on.plant.broken_sensor else "none"),
    "loop_error": lambda on: on.code("loop_error", "open" if on.plant.loop_broken else "none"),
    "alarm1_state": lambda on: on.code("alarm1_state", on.alarm1()),
    "device_status": lambda on: on.code("device_status", "ok"),
}


def _start_or_stop(on: Panel, value: float) -> None:
    if value == on.code("run", "started"):
        if "manual" in on.profile.row("run").seen:
            on.plant.manual_output = None
        on.plant.run(on.plant.set_point_c)
    else:
        on.plant.standby()


def _automatic(on: Panel, value: float) -> None:  # noqa: ARG001 - the whitelist has no other code than automatic
    on.plant.manual_output = None


def _actuating(on: Panel, value: float) -> None:
    """JULABO: "digital" heats with a set power; EPROG, without a program, not at all."""
    digital = value == on.code("actuating", "digital")
    power = on.memory.get("heating_power", 0.0) / 100.0 if digital else 0.0
    on.plant.manual_output = None if value == on.code("actuating", "controller") else power


def _aim(on: Panel, value: float) -> None:  # noqa: ARG001 - which of three rows has changed does not matter
    """The set point is the local one or, on a controller that is set so, the remote one."""
    name = "remote_set_point" if on.stored("local_remote") == 1 else "set_point"
    on.plant.set_point_c = on.memory.get(name, on.plant.set_point_c)


def _take_set_point_1(on: Panel, value: float) -> None:
    if on.stored("set_point_select") == on.code("set_point_select", "sp1"):
        on.memory["set_point"] = value
        _aim(on, value)


EFFECTS: Mapping[str, Callable[[Panel, float], None]] = {
    "run": _start_or_stop,
    "auto_manual": _automatic,
    "control": _automatic,
    "actuating": _actuating,
    "heating_power": lambda on, _: _actuating(on, on.stored("actuating")),
    "set_point": _aim,
    "set_point_1": _take_set_point_1,
    "remote_set_point": _aim,
    "local_remote": _aim,
    "heating_limit": lambda on, value: setattr(on.plant, "output_max", value / 100.0),
    "ramp": lambda on, value: setattr(on.plant, "ramp_k_per_min", value),
    "pump_stage": lambda on, stage: on.plant.set_flow(
        on.plant.constants.flow_l_per_min * stage / 4
    ),
    "unit": lambda on, value: setattr(on, "fahrenheit", value == on.code("unit", "f")),
    "encoding": lambda on, value: on.set_order(int(value)),
    "control_sensor": lambda on, value: setattr(
        on, "external_control", value == on.code("control_sensor", "external")
    ),
}


@dataclass(frozen=True, slots=True)
class Cell:
    """A row at an address. ``padded``: a word and a filler; ``whole``: a float as 16 bits."""

    row: Row
    address: int
    form: Literal["plain", "padded", "whole"] = "plain"

    @property
    def count(self) -> int:
        return {"plain": self.row.words, "padded": 2, "whole": 1}[self.form]

    @property
    def end(self) -> int:
        return self.address + self.count

    def encode(self, values: Values) -> tuple[int, ...]:
        """The registers that hold its value."""
        if self.form == "whole":
            number = values.number(self.row) * 10.0**values.decimals
            return (round(number) & 0xFFFF if math.isfinite(number) else PADDING,)
        words = values.words(self.row)
        return (words[0], PADDING) if self.form == "padded" else words

    def decode(self, words: tuple[int, ...], values: Values) -> float:
        """The number in ``words``."""
        if self.form == "whole":
            return (words[0] - 0x10000 if words[0] & 0x8000 else words[0]) / 10.0**values.decimals
        return self.row.decode(words[: self.row.words], values.order)


class Cells:
    """The address space of a device of ``profile``'s family."""

    def __init__(
        self, profile: ModbusDevice, behaviour: Behaviour, values: Values, faults: Set[str]
    ) -> None:
        self._faults = faults
        self._behaviour = behaviour
        self._values = values
        self._at: dict[tuple[Table, int], Cell] = {}
        # a profile lets the bench write less than the controller takes
        known = behaviour.writable
        rows = [
            row.model_copy(update={"access": "rw"})
            if row.access == "r"
            and (row.table == "holding" if known is None else row.name in known)
            else row
            for row in profile.rows
        ]
        mirrored = [_mirrored(row) for row in rows] if behaviour.areas else []
        for cell in [Cell(row, row.address) for row in rows] + mirrored:
            if cell is not None:
                table = self._alike(cell.row.table)
                for address in range(cell.address, cell.end):
                    self._at.setdefault((table, address), cell)

    def read(self, request: Read) -> list[int]:
        """The bits or registers asked for. Raises ModbusException."""
        table = self._alike(self._behaviour.functions[request.function])
        end = request.address + request.count
        self._check_pairs(request.address, request.count, request.function)
        ends = {(table, request.address), (table, end - 1)}
        if end > 0x10000 or (self._behaviour.gaps != "undefined" and not ends <= self._at.keys()):
            raise ModbusException(protocol.ILLEGAL_ADDRESS)
        found, words = list[int](), tuple[int, ...]()
        last: Cell | None = None
        for address in range(request.address, end):
            cell = self._at.get((table, address))
            if cell is None:
                found.append(self._gap(table, address))
                continue
            if cell is not last:
                last, words = cell, cell.encode(self._values)
            found.append(words[address - cell.address])
        return found

    def write(self, request: Write) -> None:
        """Store the whole request or nothing; whole rows only. Raises ModbusException."""
        wanted = []
        for cell, words in self._targets(request):
            value = cell.decode(words, self._values)
            if not math.isfinite(value) or self._values.refuses(cell.row, value):
                raise ModbusException(protocol.ILLEGAL_VALUE)
            wanted.append((cell.row, value))
        for row, value in wanted:
            self._values.take(row, value)

    def _targets(self, request: Write) -> Iterator[tuple[Cell, tuple[int, ...]]]:
        table = self._alike(self._behaviour.functions[request.function])
        address, end = request.address, request.address + len(request.values)
        self._check_pairs(address, len(request.values), request.function)
        lone = request.function == protocol.WRITE_MANY and len(request.values) == 1
        if self._behaviour.gaps == "undefined" and lone and (table, address) not in self._at:
            return  # Eurotherm confirms a block of one register that is not configured
        while address < end:
            cell = self._at.get((table, address))
            if (
                cell is None
                or "w" not in cell.row.access
                or cell.address != address
                or cell.end > end
                or (cell.count > 1 and request.function == protocol.WRITE_ONE)
            ):
                raise ModbusException(protocol.ILLEGAL_ADDRESS)
            yield cell, request.values[address - request.address :][: cell.count]
            address = cell.end

    def _gap(self, table: Table, address: int) -> int:
        """What stands where no row is. Raises ModbusException."""
        if self._behaviour.gaps == "undefined":
            return (address * 40503 & 0xFFFF) if table == "holding" else address & 1
        if "gaps refused" in self._faults or self._behaviour.gaps == "refused":
            raise ModbusException(protocol.ILLEGAL_ADDRESS)
        return 0

    def _check_pairs(self, address: int, count: int, function: int) -> None:
        """The IEEE area takes whole pairs only, from an even address, and never with function 6."""
        if not self._behaviour.areas or address < IEEE_AREA or function in protocol.BITS:
            return
        if address % 2 or count % 2 or function == protocol.WRITE_ONE:
            raise ModbusException(protocol.ILLEGAL_ADDRESS)

    def _alike(self, table: Table) -> Table:
        return ALIKE.get(table, table) if self._behaviour.alike else table


def _mirrored(row: Row) -> Cell | None:
    if row.type == "bit":
        return None
    if row.address >= IEEE_AREA and row.address % 2 == 0:
        form: Literal["plain", "whole"] = "whole" if row.words == 2 else "plain"
        return Cell(row, (row.address - IEEE_AREA) // 2, form)
    if row.address < IEEE_AREA // 2 and row.words == 1:
        return Cell(row, IEEE_AREA + 2 * row.address, "padded")
    return None

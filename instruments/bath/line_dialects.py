"""How circulators that speak lines of ASCII answer, make by make, typed from the makers' manuals;
each a table of commands. What a manual is silent about is chosen to be hard on a driver.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

from instruments.world.plant import Plant

NUMBER = re.compile(r"[+-]?\d{1,4}(\.\d{0,3})?")
LEAST_C, MOST_C = -50.0, 300.0


class Dialect:
    """A circulator's panel over ``plant``. ``READS``: its queries; ``RUNS``: commands that start
    and stop it; ``SETS``: the beginning of the set point's command. ``DONE``, ``WRONG``,
    ``OUTSIDE``, ``UNKNOWN``: its replies. Set at the panel: ``fahrenheit``, ``manual_mode``,
    ``external_control`` (by the external sensor). ``restarted``: it was without power.
    """

    end: bytes = b"\r"
    reply_end: bytes = b"\r"
    READS: ClassVar[Mapping[str, Callable[[Any], str]]] = {}
    RUNS: ClassVar[Mapping[str, bool]] = {}
    SETS: ClassVar[str] = ""
    DONE: ClassVar[str] = "OK"
    WRONG: ClassVar[str | None] = None
    OUTSIDE: ClassVar[str | None] = None
    UNKNOWN: ClassVar[str | None] = None

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.manual_mode = self.fahrenheit = self.external_control = self.restarted = False
        self.watchdog_s = 0.0  # without a command for so long, it stops; 0: never
        self._shipped_c = plant.set_point_c
        self._last_c = plant.pv_c

    def answer(self, command: str) -> str | None:
        """The reply to a command without its end; None for silence."""
        if read := self.READS.get(command):
            return read(self)
        if command in self.RUNS:
            self.run(on=self.RUNS[command])
            return self.DONE
        value = command.removeprefix(self.SETS)
        if value == command:
            return self.UNKNOWN
        if not NUMBER.fullmatch(value):
            return self.WRONG
        return self.DONE if self.set_point(self.in_c(float(value))) else self.OUTSIDE

    def set_point(self, temp_c: float) -> bool:
        """Whether it takes the set point."""
        takes = LEAST_C <= temp_c <= MOST_C
        if takes:
            self.plant.set_point_c = temp_c
        return takes

    def reset(self) -> None:
        """Power off and on: in standby, with the set point as shipped."""
        self.restarted = True
        self.plant.standby()
        self.plant.set_point_c = self._shipped_c

    def time_out(self) -> None:
        """Its watchdog has run out."""
        self.plant.standby()

    def temperature_c(self) -> float:
        """What it measures; with a broken sensor the last value before."""
        if not self.plant.broken_sensor:
            self._last_c = self.plant.pv_c
        return self._last_c

    def shown(self, temp_c: float) -> float:
        """In the unit of the display."""
        return temp_c * 1.8 + 32.0 if self.fahrenheit else temp_c

    def in_c(self, shown: float) -> float:
        """degC of a number in the unit of the display."""
        return (shown - 32.0) / 1.8 if self.fahrenheit else shown

    @property
    def bath(self) -> float:
        """The bath's temperature in the unit of the display, as are ``teats`` and ``target``."""
        return self.shown(self.temperature_c())

    @property
    def teats(self) -> float:
        return self.shown(float(self.plant.teat_c.mean()))

    @property
    def target(self) -> float:
        return self.shown(self.plant.set_point_c)

    def run(self, *, on: bool) -> None:
        """Start, at the present set point, or stand by."""
        if on:
            self.plant.run(self.plant.set_point_c)
        else:
            self.plant.standby()


class Julabo(Dialect):
    """JULABO's interface commands (SL/HL manual, chapter 12; CF31 manual). An out command has no
    answer, acts in remote control only, and what is wrong with it shows in the next answer to
    ``status``. What ``version`` says chooses the model: a FP50 has power and external sensor the
    other way round and lacks some, a FP51-SL tells its unit. A query that it does not know is
    answered with INVALID COMMAND (FIELD).
    """

    ALARMS: ClassVar[dict[str, str]] = {
        "level": "-01 LOW LEVEL ALARM",
        "sensor": "-05 WORKING SENSOR ALARM",
        "over-temperature": "-14 TEMPERATURE/LEVEL ALARM",
    }
    reply_end = b"\r\n"
    STATES: ClassVar[dict[tuple[bool, bool], str]] = {  # by hand, started
        (True, False): "00 MANUAL STOP",
        (True, True): "01 MANUAL START",
        (False, False): "02 REMOTE STOP",
        (False, True): "03 REMOTE START",
    }
    INVALID, NOT_NOW = "-08 INVALID COMMAND", "-09 COMMAND NOT ALLOWED IN CURRENT OPERATING MODE"
    TOO_SMALL, TOO_LARGE = "-10 VALUE TOO SMALL", "-11 VALUE TOO LARGE"
    READS: ClassVar[Mapping[str, Callable[[Any], str]]] = {
        "version": lambda panel: panel.version,
        "status": lambda panel: panel.status(),
        "in_pv_00": lambda panel: f"{panel.bath:.2f}",
        "in_pv_01": lambda panel: f"{panel.plant.power_percent:.0f}",
        "in_pv_02": lambda panel: f"{panel.teats:.2f}",
        "in_pv_03": lambda panel: f"{panel.shown(panel.plant.bath_c):.2f}",
        "in_pv_04": lambda panel: f"{panel.shown(panel.plant.constants.cut_out_c):.1f}",
        "in_sp_00": lambda panel: f"{panel.target:.2f}",
        "in_sp_07": lambda panel: f"{panel.stage}",
        "in_mode_04": lambda panel: f"{int(panel.external_control)}",
        "in_mode_05": lambda panel: f"{int(panel.plant.running)}",
    }
    STORED: ClassVar[Mapping[str, str]] = {  # as shipped: set points, limits, modes, parameters
        "in_sp_01": "25.00", "in_sp_02": "30.00", "in_sp_03": "100.00", "in_sp_04": "0.00",
        "in_sp_05": "0.00", "in_sp_06": "0.00", "in_sp_08": "0", "in_hil_00": "0",
        "in_hil_01": "100", "in_mode_01": "0", "in_mode_02": "0", "in_mode_03": "0",
        "in_mode_08": "0", "in_par_00": "0.00", "in_par_01": "60", "in_par_02": "22",
        "in_par_03": "300", "in_par_04": "0.0", "in_par_05": "5.0", "in_par_06": "1.0",
        "in_par_07": "1200", "in_par_08": "20", "in_par_09": "1.0", "in_par_10": "1.0",
        "in_par_11": "300", "in_par_12": "20", "in_par_13": "100.00", "in_par_14": "0.00",
        "in_par_15": "100", "in_par_16": "100",
    }  # fmt: skip
    version = "JULABO FP51-SL V 4.0"
    rejected = ""
    stage = 4

    def __init__(self, plant: Plant) -> None:
        super().__init__(plant)
        self.stored = dict(self.STORED)

    def answer(self, command: str) -> str | None:
        word, _, parameter = command.partition(" ")
        word = word.lower()
        if word in self.READS or word.startswith("in_"):
            if "FP50" in self.version:
                swapped = {"in_pv_01": "in_pv_02", "in_pv_02": "in_pv_01"}
                word = {"in_pv_03": "", "in_pv_04": "", **swapped}.get(word, word)
            if word == "in_sp_06" and "FP51" in self.version:
                return f"{int(self.fahrenheit)}"
            if read := self.READS.get(word):
                return read(self)
            return self.stored.get(word, self.INVALID)
        self.rejected = self._set(word, parameter.strip())
        return None

    def status(self) -> str:
        if self.rejected:
            said, self.rejected = self.rejected, ""
            return said
        if self.plant.alarm:
            return self.ALARMS[self.plant.alarm]
        return self.STATES[self.manual_mode, self.plant.running]

    def _set(self, word: str, parameter: str) -> str:
        """What is wrong with an out command; "" where it was done."""
        read = word.replace("out_", "in_", 1)
        if not word.startswith("out_") or read not in {**self.READS, **self.stored}:
            return self.INVALID
        if not NUMBER.fullmatch(parameter):
            return self.INVALID
        if self.manual_mode:
            return self.NOT_NOW
        return self._take(word, read, parameter)

    def _take(self, word: str, read: str, parameter: str) -> str:
        value = float(parameter)
        if word == "out_sp_00":
            if not self.set_point(temp_c := self.in_c(value)):
                return self.TOO_LARGE if temp_c > MOST_C else self.TOO_SMALL
        elif word == "out_sp_07":
            if not 1 <= value <= 4:
                return self.TOO_LARGE if value > 4 else self.TOO_SMALL
            self.stage = int(value)
            self.plant.set_flow(self.plant.constants.flow_l_per_min * self.stage / 4)
        elif read in self.stored:
            self.stored[read] = parameter
        elif word not in ("out_mode_04", "out_mode_05") or parameter not in ("0", "1"):
            return self.INVALID
        elif word == "out_mode_04":
            self.external_control = parameter == "1"
        else:
            self.run(on=parameter == "1")
        return ""


class Lauda(Dialect):
    """LAUDA's commands (LOOP 100 manual, 5.11; fault characters: ECO Gold manual, p. 125). Each has
    an answer; a blank may stand for an underscore. Its watchdog ends in alarm 22 (fact sheet, 4.1).
    Chosen: the keys have no effect on it; START is confirmed and ignored in that alarm, which ends
    when it is switched off.
    """

    reply_end = b"\r\n"
    RUNS: ClassVar[Mapping[str, bool]] = {"START": True, "STOP": False}
    SETS, UNKNOWN, WRONG, OUTSIDE = "OUT_SP_00_", "ERR_3", "ERR_5", "ERR_6"
    READS: ClassVar[Mapping[str, Callable[[Any], str]]] = {
        "TYPE": lambda _: "RP845",
        "VERSION_R": lambda _: "1.30",
        "STATUS": lambda panel: "-1" if panel.plant.alarm or panel.timed_out else "0",
        "STAT": lambda panel: panel.stat(),
        "IN_PV_00": lambda panel: panel.fixed(panel.bath),
        "IN_PV_01": lambda panel: panel.fixed(
            panel.teats if panel.external_control else panel.bath
        ),
        "IN_PV_02": lambda panel: f"{0.4 * int(panel.plant.running):.2f}",
        "IN_PV_03": lambda panel: panel.fixed(panel.teats),
        "IN_PV_10": lambda panel: f"{panel.bath:.3f}",
        "IN_PV_13": lambda panel: f"{panel.teats:.3f}",
        "IN_MODE_01": lambda panel: f"{int(panel.external_control)}",
        "IN_SP_00": lambda panel: panel.fixed(panel.target),
        "IN_SP_01": lambda _: "004",
        "IN_SP_02": lambda _: "002",
        "IN_SP_03": lambda panel: panel.fixed(panel.shown(panel.plant.constants.cut_out_c)),
        "IN_SP_04": lambda panel: panel.fixed(panel.shown(MOST_C)),
        "IN_SP_05": lambda panel: panel.fixed(panel.shown(LEAST_C)),
        "IN_SP_07": lambda panel: panel.fixed(panel.shown(20.0)),
        "IN_SP_08": lambda panel: panel.fixed(panel.watchdog_s),
        "IN_MODE_02": lambda panel: "0" if panel.plant.running else "1",
    }
    WATCHDOG: ClassVar[str] = "OUT_SP_08_"
    timed_out = False

    def answer(self, command: str) -> str | None:
        command = command.strip("\n").replace(" ", "_").upper()
        seconds = command.removeprefix(self.WATCHDOG)
        if seconds == command:
            return super().answer(command)
        if not seconds.isdecimal():
            return self.WRONG
        if float(seconds) > 99.0:
            return self.OUTSIDE
        self.watchdog_s = float(seconds)
        return self.DONE

    def run(self, *, on: bool) -> None:
        super().run(on=on and not self.timed_out)

    def time_out(self) -> None:
        super().time_out()
        self.timed_out = True

    def reset(self) -> None:
        super().reset()
        self.timed_out = False

    def fixed(self, shown: float) -> str:
        return f"{'-' if shown < 0 else ''}{abs(shown):06.2f}"

    def stat(self) -> str:
        """Error, alarm, warning, over-temperature, low level, 0, external value missing."""
        alarm = self.plant.alarm
        alarmed = bool(alarm) or self.timed_out
        flags = (alarm == "sensor", alarmed, False, alarm == "over-temperature")
        return "".join(str(int(flag)) for flag in (*flags, alarm == "level", False, False))


class Huber(Dialect):
    """Huber's PB commands, by address; values are 0.01 degC, whatever the display shows. A write is
    answered with the value as it is then, also where it was not taken. Chosen: the errors' numbers,
    and that the bit of a restart stays until the next start.
    """

    end = reply_end = b"\r\n"
    NOTHING = 0x7FFF
    ERRORS: ClassVar[dict[str, int]] = {"level": -2, "sensor": -5, "over-temperature": -1331}
    COMMAND = re.compile(r"\{M([0-9A-F]{2})(\*{4}|[0-9A-F]{4})", re.IGNORECASE)
    VALUES: ClassVar[Mapping[int, Callable[[Huber], int]]] = {
        0x00: lambda panel: round(100 * panel.plant.set_point_c),
        0x01: lambda panel: round(100 * panel.temperature_c()),
        0x05: lambda panel: panel.ERRORS[panel.plant.alarm] if panel.plant.alarm else 0,
        0x03: lambda panel: 1000 + 400 * int(panel.plant.running),
        0x04: lambda panel: round(
            panel.plant.power_percent / 100.0 * panel.plant.constants.heater_w
        ),
        0x06: lambda _: 0,
        0x0A: lambda panel: panel.status(),
        0x0F: lambda _: 1000,
        0x26: lambda panel: 3200 * int(panel.plant.running),
        0x30: lambda _: round(100 * LEAST_C),
        0x31: lambda _: round(100 * MOST_C),
        0x48: lambda _: 3200,
        0x5C: lambda _: 365,
        0x07: lambda panel: round(100 * float(panel.plant.teat_c.mean())),
        0x14: lambda panel: int(panel.plant.running),
        0x16: lambda panel: int(panel.plant.running),
        0x1B: lambda _: 0x3039,
        0x1C: lambda _: 0x0001,
    }

    def answer(self, command: str) -> str | None:
        if not (asked := self.COMMAND.fullmatch(command)):
            return None
        address = int(asked[1], 16)
        if "*" not in asked[2] and not self.manual_mode:
            self._set(address, (int(asked[2], 16) ^ 0x8000) - 0x8000)
        read = self.VALUES.get(address)
        return f"{{S{address:02X}{(read(self) if read else self.NOTHING) & 0xFFFF:04X}"

    def _set(self, address: int, value: int) -> None:
        if address == 0x00:
            self.set_point(value / 100.0)
        elif address == 0x14 and value in (0, 1):
            self.restarted = self.restarted and value == 0
            self.run(on=value == 1)

    def status(self) -> int:
        """Bits: control, circulation, by the process sensor, pump, error, restarted."""
        running = self.plant.running
        places = {0: running, 1: running, 3: self.external_control, 4: running}
        places |= {8: bool(self.plant.alarm), 13: self.restarted}
        return sum(1 << place for place, true in places.items() if true)


class Thermo(Dialect):
    """Thermo Scientific's commands (ARCTIC manual, tables A-2 and A-3; the numbers of faults:
    NESLAB EX manual, p. B-5, d1 to d5). Chosen: what is not understood has no answer.
    """

    RUNS: ClassVar[Mapping[str, bool]] = {"SO 1": True, "SO 0": False}
    SETS = "SS "
    READS: ClassVar[Mapping[str, Callable[[Any], str]]] = {
        "RT": lambda panel: panel.with_unit(panel.bath),
        "RT2": lambda panel: panel.with_unit(panel.teats),
        "RS": lambda panel: panel.with_unit(panel.target),
        "RO": lambda panel: f"{int(panel.plant.running)}",
        "RTU": lambda panel: "F" if panel.fahrenheit else "C",
        "RVER": lambda _: "082100.14C",
        "RUFS": lambda panel: panel.faults(),
    }

    def with_unit(self, shown: float) -> str:
        return f"{shown:.2f}{'F' if self.fahrenheit else 'C'}"

    def faults(self) -> str:
        alarm, running = self.plant.alarm, self.plant.running
        second = 2 * int(self.external_control)
        third = {"level": 8, "over-temperature": 32}.get(alarm, 0)
        fourth = 8 * int(running) + 4 * int(running) + int(self.plant.power_percent > 0.0)
        return f"{128 if alarm == 'sensor' else 0} {second} {third} {fourth} 64"


class Haake(Dialect):
    """HAAKE's commands, as a driver that runs has them. Chosen: no trailing $ after an error."""

    RUNS: ClassVar[Mapping[str, bool]] = {"W TS 1": True, "W TS 0": False}
    SETS, DONE, OUTSIDE = "W SW ", "$", "F123"
    UNKNOWN = WRONG = "F001"
    READS: ClassVar[Mapping[str, Callable[[Any], str]]] = {
        "R V1": lambda _: "2P/H PhoenixII 1.31$",
        "R T1": lambda panel: f"T1{panel.bath:.2f}$",
        "R T3": lambda panel: f"T3{panel.teats:.2f}$",
        "R SW": lambda panel: f"SW{panel.target:.2f}$",
        "R HL": lambda panel: f"HL{panel.shown(MOST_C):.2f}$",
        "R LL": lambda panel: f"LL{panel.shown(LEAST_C):.2f}$",
        "R PF": lambda panel: f"PF{100.0 * int(panel.plant.running):.2f}$",
        "R CC": lambda _: "CC0$",
        "R FR": lambda _: "FR0$",
        "R WD": lambda _: "WD0$",
        "R WS": lambda panel: f"WS{panel.target:.2f}$",
        "R ZA": lambda _: "ZA0$",
        "R ZB": lambda _: "ZB0$",
        "R ZI": lambda _: "ZI0$",
        "R BS": lambda panel: panel.status(),
    }

    def status(self) -> str:
        alarm = self.plant.alarm
        hot, low = alarm == "over-temperature", alarm == "level"
        flags = (self.plant.running, self.external_control, False, hot, low)
        rest = (False, False, False, False, low, alarm == "sensor", False)
        return f"BS{''.join(str(int(flag)) for flag in (*flags, *rest))}$"


class PolyScience(Dialect):
    """PolyScience's commands (LS manual: CR alone ends both; "!" is done, "?" is not)."""

    RUNS: ClassVar[Mapping[str, bool]] = {"SO1": True, "SO0": False}
    SETS, DONE = "SS", "!"
    UNKNOWN = WRONG = OUTSIDE = "?"
    READS: ClassVar[Mapping[str, Callable[[Any], str]]] = {
        "RT": lambda panel: f"{panel.bath:+.2f}",
        "RR": lambda panel: f"{panel.teats:+.2f}",
        "RS": lambda panel: f"{panel.target:+.2f}",
        "RH": lambda panel: f"{panel.shown(MOST_C):+.0f}",
        "RL": lambda panel: f"{panel.shown(LEAST_C):+.0f}",
        "RM": lambda _: "100",
        "RO": lambda panel: f"{int(panel.plant.running)}",
        "RF": lambda panel: f"{int(bool(panel.plant.alarm))}",
        "RU": lambda panel: "F" if panel.fahrenheit else "C",
    }


DIALECTS: dict[str, type[Dialect]] = {
    "julabo": Julabo,
    "lauda": Lauda,
    "huber": Huber,
    "thermo": Thermo,
    "haake": Haake,
    "polyscience": PolyScience,
}  # by how the name of the family begins

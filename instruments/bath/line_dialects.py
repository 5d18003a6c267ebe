"""How circulators that speak lines of ASCII answer, make by make, typed from the makers' manuals;
each a table of commands. What a manual is silent about is chosen to be hard on a driver.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import ClassVar

from instruments.world.plant import Plant

NUMBER = re.compile(r"[+-]?\d{1,4}(\.\d{0,3})?")
LEAST_C, MOST_C = -50.0, 300.0


class Dialect:
    """A circulator's panel over ``plant``: ``manual_mode`` (operated by hand) and ``fahrenheit``
    are its settings; ``end`` ends a command, ``reply_end`` a reply.
    """

    end: bytes = b"\r"
    reply_end: bytes = b"\r\n"

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.manual_mode = self.fahrenheit = False
        self._shipped_c = plant.set_point_c
        self._last_c = plant.pv_c

    def answer(self, command: str) -> str | None:
        """The reply to a command without its end; None for silence."""
        raise NotImplementedError

    def reset(self) -> None:
        """Power off and on: in standby, with the set point as shipped."""
        self.plant.standby()
        self.plant.set_point_c = self._shipped_c

    def temperature_c(self) -> float:
        """What it measures; with a broken sensor the last value before."""
        if not self.plant.broken_sensor:
            self._last_c = self.plant.pv_c
        return self._last_c

    def shown(self, temp_c: float) -> float:
        """In the unit of the display."""
        return temp_c * 1.8 + 32.0 if self.fahrenheit else temp_c

    def meant_c(self, shown: float) -> float:
        return (shown - 32.0) / 1.8 if self.fahrenheit else shown

    def run(self, *, on: bool) -> None:
        """Start, at the present set point, or stand by."""
        if on:
            self.plant.run(self.plant.set_point_c)
        else:
            self.plant.standby()


class Julabo(Dialect):
    """JULABO's interface commands (SL/HL manual, chapter 12). An out command has no answer, acts in
    remote control only, and what is wrong with it shows in the next answer to ``status``. Chosen:
    no answer to an unknown command.
    """

    ALARMS: ClassVar[dict[str, str]] = {
        "level": "-01 LOW LEVEL ALARM",
        "sensor": "-05 WORKING SENSOR ALARM",
        "over-temperature": "-14 TEMPERATURE/LEVEL ALARM",
    }
    STATES: ClassVar[dict[tuple[bool, bool], str]] = {  # by hand, started
        (True, False): "00 MANUAL STOP",
        (True, True): "01 MANUAL START",
        (False, False): "02 REMOTE STOP",
        (False, True): "03 REMOTE START",
    }
    INVALID, NOT_NOW = "-08 INVALID COMMAND", "-09 COMMAND NOT ALLOWED IN CURRENT OPERATING MODE"
    TOO_SMALL, TOO_LARGE = "-10 VALUE TOO SMALL", "-11 VALUE TOO LARGE"
    READS: ClassVar[dict[str, Callable[[Julabo], str]]] = {
        "version": lambda on: on.VERSION,
        "status": lambda on: on.status(),
        "in_pv_00": lambda on: f"{on.shown(on.temperature_c()):.2f}",
        "in_pv_01": lambda on: f"{on.plant.power_percent:.0f}",
        "in_pv_02": lambda on: f"{on.shown(float(on.plant.teat_c.mean())):.2f}",
        "in_pv_03": lambda on: f"{on.shown(on.plant.bath_c):.2f}",
        "in_pv_04": lambda on: f"{on.shown(on.plant.constants.cut_out_c):.1f}",
        "in_sp_00": lambda on: f"{on.shown(on.plant.set_point_c):.2f}",
        "in_sp_07": lambda on: f"{on.stage}",
        "in_mode_04": lambda _: "0",
        "in_mode_05": lambda on: f"{int(on.plant.running)}",
    }
    VERSION = "JULABO SL-12 V 4.0"
    rejected = ""
    stage = 4

    def answer(self, command: str) -> str | None:
        word, _, parameter = command.partition(" ")
        if read := self.READS.get(word.lower()):
            return read(self)
        self.rejected = self._set(word.lower(), parameter.strip())
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
        if word not in ("out_sp_00", "out_sp_07", "out_mode_05"):
            return self.INVALID
        if not NUMBER.fullmatch(parameter):
            return self.INVALID
        if self.manual_mode:
            return self.NOT_NOW
        value = float(parameter)
        if word == "out_sp_00":
            temp_c = self.meant_c(value)
            if not LEAST_C <= temp_c <= MOST_C:
                return self.TOO_LARGE if temp_c > MOST_C else self.TOO_SMALL
            self.plant.set_point_c = temp_c
        elif word == "out_sp_07":
            if not 1 <= value <= 4:
                return self.TOO_LARGE if value > 4 else self.TOO_SMALL
            self.stage = int(value)
            self.plant.set_flow(self.plant.constants.flow_l_per_min * self.stage / 4)
        elif parameter not in ("0", "1"):
            return self.INVALID
        else:
            self.run(on=parameter == "1")
        return ""


class Lauda(Dialect):
    """LAUDA's commands (LOOP 100 manual, 5.11; fault characters: ECO Gold manual, p. 125). Each has
    an answer; a blank may stand for an underscore. Chosen: the keys have no effect on it.
    """

    end = b"\r"
    OK, WRONG_COMMAND, SYNTAX, NOT_ALLOWED = "OK", "ERR_3", "ERR_5", "ERR_6"
    READS: ClassVar[dict[str, Callable[[Lauda], str]]] = {
        "TYPE": lambda _: "RP845",
        "VERSION_R": lambda _: "1.30",
        "STATUS": lambda on: "-1" if on.plant.alarm else "0",
        "STAT": lambda on: on.stat(),
        "IN_PV_00": lambda on: on.fixed(on.temperature_c()),
        "IN_PV_03": lambda on: on.fixed(float(on.plant.teat_c.mean())),
        "IN_SP_00": lambda on: on.fixed(on.plant.set_point_c),
        "IN_SP_03": lambda on: on.fixed(on.plant.constants.cut_out_c),
        "IN_MODE_02": lambda on: "0" if on.plant.running else "1",
    }

    def answer(self, command: str) -> str:
        word = command.strip("\n").replace(" ", "_").upper()
        if read := self.READS.get(word):
            return read(self)
        if word in ("START", "STOP"):
            self.run(on=word == "START")
            return self.OK
        if not word.startswith("OUT_SP_00_"):
            return self.WRONG_COMMAND
        value = word.removeprefix("OUT_SP_00_")
        if not NUMBER.fullmatch(value):
            return self.SYNTAX
        temp_c = self.meant_c(float(value))
        if not LEAST_C <= temp_c <= MOST_C:
            return self.NOT_ALLOWED
        self.plant.set_point_c = temp_c
        return self.OK

    def fixed(self, temp_c: float) -> str:
        shown = self.shown(temp_c)
        return f"{'-' if shown < 0 else ''}{abs(shown):06.2f}"

    def stat(self) -> str:
        """Error, alarm, warning, over-temperature, low level, 0, external value missing."""
        alarm = self.plant.alarm
        flags = (alarm == "sensor", bool(alarm), False, alarm == "over-temperature")
        return "".join(str(int(flag)) for flag in (*flags, alarm == "level", False, False))


DIALECTS: dict[str, type[Dialect]] = {
    "julabo": Julabo,
    "lauda": Lauda,
}  # by how the name of the family begins

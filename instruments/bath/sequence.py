"""The order in which a bath is started and stopped (water-bath fact sheet, section 4.1, item 6).

Start: level, pump, ten seconds of flow, set point, run. Stop: heater off, pump on for a minute,
pump off. A pump that turns with the controller's run can't do that, and one that is not fitted
isn't simulated.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from instruments.bath.profile import PUMP
from instruments.bath.reading import BathReading
from instruments.errors import DeviceError, InstrumentError, LimitError
from textfiles.text import named

if TYPE_CHECKING:
    from instruments.bath.interface import Bath

ON, OFF = "on", "off"  # labels of the row of a pump that is switched by itself
FLOW_S = 10.0
OVERRUN_S = 60.0
SLICE_S = 0.5


def cause_of(error: BaseException) -> str:
    """Why a step of going to safe failed; a mistake of the bench with its place in the code."""
    if isinstance(error, InstrumentError | KeyboardInterrupt):
        return str(error) or "interrupted by Ctrl-C, or by a KeyboardInterrupt of its driver"
    at = traceback.extract_tb(error.__traceback__)[-1]
    return f"{named(error)} ({Path(at.filename).name}:{at.lineno})"


def pump_text(bath: Bath) -> str:
    """What the record says of the pump."""
    if bath.pump == "own":
        return f"switched by itself: {FLOW_S:g} s before the heater, {OVERRUN_S:g} s after it"
    if bath.pump == "with run":
        return "turns with the controller's run, and stops with standby: it can't run on alone"
    return "not fitted to the controller: nothing here proves that the water goes round"


def pump_on(bath: Bath, reading: BathReading) -> bool | None:
    """Whether the pump is switched on (not: turns); None where the family doesn't report it."""
    if bath.pump == "own":
        return bath.get(PUMP) == bath.profile.row(PUMP).values[ON]
    return reading.running if bath.pump == "with run" else None


def start_bath(bath: Bath, set_point_c: float, wait: Callable[[float], None]) -> None:
    """Heat to ``set_point_c``, in order. Raises as the driver, and DeviceError for an alarm."""
    bath.check_start(set_point_c)
    if bath.pump == "own":
        reading = bath.read()
        if reading.alarm:  # the level among them: a pump must not run dry either
            what = f"not started: {bath.profile.alarm_text(reading.alarm)}"
            hint = "Clear its cause and the alarm at the controller."
            raise DeviceError(bath.who, what, hint=hint)
        bath.set(PUMP, ON)
        wait(FLOW_S)
    bath.start(set_point_c)


def heater_off(bath: Bath) -> str:
    """Standby at once; then a pump with its own switch on, whose fault is returned. Raises
    InstrumentError where the heater can't be reached.
    """
    bath.safe()
    if bath.pump != "own":
        return ""
    try:
        bath.set(PUMP, ON)
    except InstrumentError as error:
        return f"the pump could not be switched on: {error}"
    return ""


def run_pump_on(bath: Bath, sleep: Callable[[float], None], cut_short: Callable[[], bool]) -> str:
    """Let the pump run on, then switch it off; what became of it. ``cut_short`` and Ctrl-C end the
    wait. Raises InstrumentError where the pump can't be read or switched.
    """
    if bath.pump != "own":
        return ""
    if bath.get(PUMP) != bath.profile.row(PUMP).values[ON]:
        return "the pump is off, so it did not run on"
    left_s = OVERRUN_S
    try:
        while left_s > 0.0:
            if cut_short():
                raise KeyboardInterrupt
            sleep(SLICE_S)
            left_s -= SLICE_S
    except KeyboardInterrupt:
        return f"the pump was left running: the rest of its {OVERRUN_S:g} s was cut short"
    bath.set(PUMP, OFF)
    return f"the pump ran on for {OVERRUN_S:g} s and is off"


def pump_off(bath: Bath) -> str:
    """Switch off a pump that was switched on without heating; what became of it. Raises
    InstrumentError where it can't be reached.
    """
    try:
        bath.set(PUMP, OFF)
    except LimitError as error:  # the controller heats, by another's order
        return f"the pump was left on: {error.what}"
    return "the pump is off"

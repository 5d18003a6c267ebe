"""Polls from registers typed by hand: 33.0 as a float32 is 4204 0000, not-a-number 7FC0 0000."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from instruments.bath.reading import BathReading
from instruments.bath.register_access import RegisterAccess
from instruments.bath.requests import blocks
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, ProtocolError
from tests.instruments.bath.devices import load_register_profile

# started, controller in charge, set point 33.125, its own sensor controls; degC, first order
RUN = "0001 0000 4204 8000 0000 0000 0000 0000 0000 0000 0000 | 0000 0000 0000 0000 | "
HEAD = "0004 0000 0002 0000 0000 "  # Modbus in charge, no alarm, warning 2, a gap


def read(registers: str) -> BathReading:
    """The reading at 7 s; blocks are cut apart by ``|``."""
    profile = load_register_profile("julabo-presto")
    access = RegisterAccess("tcp://127.0.0.1:1", profile, VirtualClock(), who="bath")
    raw: dict[str, Sequence[int]] = {}
    for block, words in zip(blocks(profile, gaps=True), (RUN + registers).split("|"), strict=True):
        raw |= block.split_rows([int(word, 16) for word in words.split()])
    return access.reading(7.0, raw)


def test_a_reading() -> None:
    assert read(HEAD + "4204 0000  41F0 0000  FFCE  4204 8000") == BathReading(
        t_s=7.0,
        temp_c=33.0,
        raw=(0x4204, 0x0000),
        external_c=30.0,
        power_percent=-50.0,
        safety_c=33.125,
        alarm=0,
        warning=2,
        remote=True,
        running=True,
        set_point_c=33.125,
    )


def test_sensors_that_are_not_there_are_none() -> None:
    reading = read(HEAD + "4204 0000  7FC0 0000  0000  7FC0 0000")
    assert (reading.external_c, reading.safety_c) == (None, None)


def test_another_remote_control_shows() -> None:
    assert read("0000 0000 0000 0000 0000  4204 0000 4204 0000 0000 4204 0000").remote is False


@pytest.mark.parametrize(
    "registers",
    [
        HEAD + "0000 4204  0000 4204  0000  7FC0 0000",  # 33 with its words swapped is 2.4e-41
        HEAD + "4285 0000  4204 0000  0000  7FC0 0000",  # 66.5
        HEAD + "C0C0 0000  4204 0000  0000  7FC0 0000",  # -6
        HEAD + "7F80 0000  4204 0000  0000  7FC0 0000",  # infinite
        HEAD + "4204 0000  4204 0000  0000  4300 0000",  # the safety sensor at 128
    ],
)
def test_what_no_bath_has_is_not_believed(registers: str) -> None:
    with pytest.raises(ProtocolError, match="can't be: not within -5 to 60 degC"):
        read(registers)


@pytest.mark.parametrize(
    ("registers", "what"),
    [
        (HEAD + "4204 0000  4204 0000  0065  7FC0 0000", "its power can't be: .* got 101 %"),
        (HEAD + "4204 0000  4204 0000  FF9B  7FC0 0000", "its power can't be: .* got -101 %"),
        (HEAD + "4204 0000  4274 0000  0000  7FC0 0000", "its external can't be: .* got 61 degC"),
        (
            "0006" + HEAD[4:] + "4204 0000  4204 0000  0000  7FC0 0000",
            "its remote can't be: .* got 6",
        ),
    ],
)
def test_every_value_has_to_be_one_that_a_bath_has(registers: str, what: str) -> None:
    with pytest.raises(ProtocolError, match=what):
        read(registers)


def test_full_power_is_believed_and_a_safety_sensor_at_zero_is_none() -> None:
    reading = read(HEAD + "4204 0000  4270 0000  0064  0000 0000")
    assert (reading.power_percent, reading.external_c, reading.safety_c) == (100.0, 60.0, None)


def test_no_temperature_is_reported_with_the_alarm() -> None:
    with pytest.raises(DeviceError, match=r"no temperature .*alarm 5, working sensor"):
        read("0004 0005 0000 0000 0000  7FC0 0000  4204 0000  0000  4204 0000")


def test_freezing_water_is_believed() -> None:
    assert read(HEAD + "0000 0000  0000 0000  0000  0000 0000").temp_c == 0.0

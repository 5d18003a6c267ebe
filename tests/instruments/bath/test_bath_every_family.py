"""Rules that hold for every shipped family, seen through driver and emulator: who is refused, and what is
never written; what its alarms say, and which profiles are refused."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from instruments.bath.driver import OwnBath
from instruments.bath.profile import SHIPPED, RegisterProfile
from instruments.bath.rows import Row
from instruments.device_file import DeviceFileError
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from tests.instruments.bath.devices import (
    REGISTER_FAMILIES,
    Stand,
    load_register_profile,
)
from tests.instruments.bath.far_end import bath_on, shown_by
from tests.instruments.bath.test_bath_profile import BROWSED, EUROTHERM_MEMORY

NAMES = REGISTER_FAMILIES
ALIKE = {  # nothing that may be read for certain tells them apart
    ("julabo-magio", "julabo-presto")
}


def on_either(name: str) -> RegisterProfile:
    return load_register_profile(name).model_copy(update={"transports": ("tcp", "rtu")})


@contextmanager
def met(name: str, other: str | None = None, *, fault: str = "") -> Iterator[Stand]:
    """A controller of the family ``other``, and the profile ``name`` to meet it with, by TCP."""
    with Stand(profile=on_either(other or name)) as stand:
        stand.profile = on_either(name)  # so that any driver can meet any controller
        stand.plant.set_point_c = 25.0
        if fault:
            stand.emulator.fault(fault)
        yield stand


# ---- evidence


def doubtful(name: str) -> list[Row]:
    """The family's rows that might be written but for their evidence."""
    rows = load_register_profile(name).rows
    return [row for row in rows if row.evidence == "INFERRED" and row.access != "r"]


@pytest.mark.parametrize("name", NAMES)
def test_no_inferred_row_is_written_or_polled_unless_the_rig_says_so(name: str) -> None:
    with met(name) as stand:
        bath, emulator, profile = stand.bath(), stand.emulator, stand.profile
        for row in doubtful(name):
            value = float(next(iter((*row.values.values(), *(row.range or (0.0,))))))
            with pytest.raises(
                LimitError, match=f"not written: the profile only infers where {row.name} is"
            ):
                bath.set(row.name, value)
        bath.read()
        inferred = {row.address for row in profile.rows if row.evidence == "INFERRED"}
        certain = {
            address
            for row in profile.rows
            if row.evidence != "INFERRED"
            for address in range(row.address, row.end)
        }
        assert emulator.writes() == []
        assert not {address for _, _, address in emulator.asked} & (inferred - certain)


def test_an_inferred_row_is_written_where_the_rig_says_so() -> None:
    (name,) = {name for name in NAMES if doubtful(name)}
    with met(name) as stand:
        bath = stand.bath(allow_inferred=True)
        for row in doubtful(name):
            if row.values:
                bath.set(row.name, float(max(row.values.values())))
            elif row.range and row.range[1] < 1e6:
                bath.set(row.name, float(round(min(row.range[1], 30.0))))
        assert stand.emulator.writes()


# ---- who is there


@pytest.mark.parametrize("name", NAMES)
def test_a_controller_of_another_family_is_refused_before_the_first_write(name: str) -> None:
    for other in NAMES:
        with met(name, other) as stand:
            if name == other or (name, other) in ALIKE:
                assert stand.bath().read().temp_c == pytest.approx(20.0, abs=0.1)
            else:
                with pytest.raises(InstrumentError) as caught:
                    stand.bath(unit_confirmed=False)
                assert str(caught.value).startswith("bath at "), "it says who"
            assert stand.emulator.writes() == [], other


@pytest.mark.parametrize("name", NAMES)
def test_another_unit_is_silence(name: str) -> None:
    with met(name) as stand:
        stand.url += "?unit=2"
        with pytest.raises(LinkError, match="no answer"):
            stand.bath()
        assert stand.emulator.writes() == []
        stand.emulator.unit_id = 2
        assert stand.bath().read().temp_c == pytest.approx(20.0)


# ---- unit


@pytest.mark.parametrize("name", NAMES)
def test_a_controller_in_fahrenheit_is_refused(name: str) -> None:
    with met(name, fault="fahrenheit") as stand:
        error, what = (
            (DeviceError, "does not speak degC")
            if stand.profile.find("unit")
            else (ProtocolError, "In degF it would be 20")
        )
        with pytest.raises(error, match=what):
            stand.bath(unit_confirmed=False)
        assert stand.emulator.writes() == []


# ---- order of words

FLOATS = [name for name in NAMES if load_register_profile(name).row("temperature").words == 2]
LEARNT = "julabo-presto"  # it tells its order, and the driver follows


@pytest.mark.parametrize("name", FLOATS)
def test_words_the_other_way_round_are_refused_or_found(name: str) -> None:
    with met(name, fault="word order") as stand:
        if name == LEARNT:
            bath = stand.bath()
            assert bath.read().temp_c == pytest.approx(20.0)
            assert bath.identity["order"] == "CDAB"
            assert stand.emulator.writes() == []
            bath.start(33.0)
            assert stand.plant.set_point_c == 33.0
            return
        turned = "ABCD" if stand.profile.order == "CDAB" else "CDAB"
        with pytest.raises(
            ProtocolError,
            match=(
                rf"can't be: not within -5 to 60 degC.*In the order {turned} it would be 20\.0"
                r" degC"
            ),
        ):
            stand.bath(unit_confirmed=False)
        assert stand.emulator.writes() == []


# ---- what a family can do


@pytest.mark.parametrize("name", NAMES)
def test_a_pump_that_the_family_lacks_is_never_made_up(name: str) -> None:
    with met(name) as stand:
        bath = stand.bath()
        bath.start(33.0)
        stand.plant.advance_to(5.0)
        assert stand.plant.pump_on == (bath.pump == "with run") == ("julabo" in name)


MAP_2 = {30: 138, 360: 0, 361: 0x41A0, 362: 61, 1896: 61, 2360: 62, 2408: 61}
MAP_2 |= {2640: 0, 2641: 0x41A0}


# ---- who is refused

IN_F = r"does not speak degC \(asked its unit, got f\)"


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("eurotherm-2400", {122: 0x3216}, "no Eurotherm 2400 .*hexadecimal 3216.*Is it a 3200"),
        ("eurotherm-3200", {}, "no Eurotherm 3200 .*hexadecimal 2416.*Is it a 2400"),
        ("eurotherm-2400", {516: 1}, IN_F),
        ("watlow-pm-map1", {1880: 0, 1881: 0x4296}, "no Watlow EZ-ZONE PM map 1 .*Is it map 2"),
        ("watlow-pm-map2", {}, "no Watlow EZ-ZONE PM map 2 .*Is it map 1"),
        ("omega-cn7", {0x1005: 0x1234}, "it is no Omega CN7 .*1234"),
        ("eurotherm-2400", {75: 0x0020, 0x8002: 0x447A}, "no temperature .*alarm 32, sensor break"),
        (
            "omega-cn7",
            {0x1000: 0x8003},
            r"no temperature .*alarm 32771, sensor not connected \(meaning inferred\)",
        ),
    ],
)
def test_another_controller_or_a_broken_sensor_is_refused_before_anything_is_written(
    name: str, changes: dict[int, int], message: str
) -> None:
    memory = next(known for other, known in BROWSED.items() if other[:5] == name[:5]) | changes
    with shown_by(memory) as (far_end, url):
        with pytest.raises(DeviceError, match=message):
            OwnBath(url, load_register_profile(name), far_end.clock)
        assert all(pdu[0] not in (5, 6, 16) for pdu in far_end.asked)


@pytest.mark.parametrize(
    ("name", "changes", "alarm", "text"),
    [
        ("eurotherm-2400", {75: 0x0010}, 0, ""),  # manual: no alarm
        ("eurotherm-2400", {75: 0xC1}, 193, "alarm 193, alarm 1 and loop break and heater failed"),
        ("watlow-pm-map2", {1896: 7}, 7, "alarm 7, alarm 1 high"),
        ("watlow-pm-map2", {1896: 88}, 0, ""),
        ("watlow-pm-map2", {2408: 1274}, 1274, "alarm 1274, open loop"),
        ("watlow-pm-map2", {362: 99}, 99, "alarm 99, see the controller's manual"),
        ("omega-cn7", {0x102E: 1}, 0, ""),
        ("omega-cn7", {0x102E: 5}, 5, "alarm 5, over the range of its input"),
        (
            "eurotherm-2400",
            {75: 0x0420},
            0x0420,
            "alarm 1056, sensor break and process value out of range",
        ),
    ],
)
def test_alarms_of_each_kind(name: str, changes: dict[int, int], alarm: int, text: str) -> None:
    memory = (MAP_2 if "map2" in name else BROWSED[name]) | changes
    with bath_on(name, memory) as (_, bath):
        reading = bath.read()
        assert reading.alarm == alarm
        if alarm:
            assert bath.profile.alarm_text(alarm) == text
            with pytest.raises(DeviceError, match=f"not started: {text}"):
                bath.start(33.0)


def test_a_rounded_set_point_stands_and_is_not_written_again() -> None:
    with bath_on("eurotherm-2400", EUROTHERM_MEMORY) as (far_end, bath):
        good = [bytes] * 5  # a poll, and the look whether it stands already
        # 33.04 becomes 33.0
        far_end.spoils = [
            *good,
            lambda f: (far_end.memory.update({0x8004: 0x4204, 0x8005: 0}), f)[1],
        ]
        bath.set_point(33.04)
        count = len(far_end.asked)
        bath.set_point(33.04)
        assert all(pdu[0] == 3 for pdu in far_end.asked[count:])
        # what was confirmed is not done
        far_end.spoils = [*good, lambda f: (far_end.memory.update({0x8004: 0x41A0}), f)[1]]
        with pytest.raises(
            DeviceError, match=r"did not do it \(asked set_point = 34, got set_point = 20\)"
        ):
            bath.set_point(34.0)


# ---- profiles that are refused

FAULTY = """
eurotherm-2400 | address = 0x8004 | address = 0x8003 | from 32768 on, rows take two registers
eurotherm-2400 | functions = [3, 4, 16] | functions = [3, 4, 6] | functions 3, 4, 6 writes f32
omega-cn7 | functions = [2, 3, 5, 6] | functions = [3, 5, 6] | 3, 5, 6 reads table coil
omega-cn7 | functions = [2, 3, 5, 6] | functions = [2, 3, 7] | functions
watlow-pm-map1 | row = "run" | row = "rum" | there is no row 'rum'
watlow-pm-map1 | seen = { manual = 54 } | seen = { manual = 10 } | mean the same code
omega-cn7 | not_yet = 0x8002 | not_yet = 0x18002 | is no register of 16 bits
omega-cn7 | control = "pid" | control = "manual" | that may be written with the value 'manual'
"""


@pytest.mark.parametrize("case", FAULTY.strip().split("\n"))
def test_a_familys_rules_are_checked(tmp_path: Path, case: str) -> None:
    name, old, new, message = case.split(" | ")
    text = (SHIPPED / f"{name}.toml").read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / "own.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(DeviceFileError, match=re.escape(message)):
        load_register_profile(path)

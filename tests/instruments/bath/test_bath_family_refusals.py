"""Which controllers are refused at the first look, in every family, what its alarms say, and which
profiles are refused.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from instruments.bath.driver import Bath
from instruments.bath.profile import ProfileError, load_profile
from instruments.clock import VirtualClock
from instruments.errors import DeviceError, LimitError, ProtocolError
from tests.instruments.bath.far_end import FarEnd, served
from tests.instruments.bath.test_bath_profile_families import (
    BROWSED,
    EUROTHERM_MEMORY,
    OMEGA_MEMORY,
)

# ---- who is refused


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        (
            "eurotherm-2400",
            {122: 0x3216},
            r"it is no Eurotherm 2400 .*hexadecimal 3216.*Is it a 3200",
        ),
        ("eurotherm-3200", {}, r"it is no Eurotherm 3200 .*hexadecimal 2416.*Is it a 2400"),
        ("eurotherm-2400", {516: 1}, r"does not speak degC \(asked its unit, got f\)"),
        ("watlow-pm-map1", {2490: 30}, r"does not speak degC \(asked its unit, got f\)"),
        (
            "watlow-pm-map1",
            {1880: 0, 1881: 0x4296},
            r"it is no Watlow EZ-ZONE PM map 1 .*Is it map 2",
        ),
        ("watlow-pm-map2", {}, r"it is no Watlow EZ-ZONE PM map 2 .*Is it map 1"),
        ("omega-cn7", {0x1005: 0x1234}, r"it is no Omega CN7 .*1234"),
    ],
)
def test_another_controller_is_refused_before_anything_is_written(
    name: str, changes: dict[int, int], message: str
) -> None:
    memory = next(known for other, known in BROWSED.items() if other[:5] == name[:5]) | changes
    assert message_at_the_first_look(name, memory, DeviceError, message)


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        (
            "watlow-pm-map1",
            {360: 0x41A0, 361: 0},
            r"temperature can't be.*In the order ABCD it would be 20\.0 degC: set order",
        ),
        (
            "watlow-pm-map1",
            {360: 0x0000, 361: 0x42B6},
            r"temperature can't be.*91 degC.*In degF it would be 32\.8 degC",
        ),
        (
            "eurotherm-2400",
            {0x8002: 0x0000, 0x8003: 0x41A0},
            r"temperature can't be.*In the order CDAB it would be 20\.0 degC",
        ),
        (
            "omega-cn7",
            {0x1000: 680},
            r"temperature can't be.*68 degC.*In degF it would be 20\.0 degC",
        ),
    ],
)
def test_the_wrong_order_or_unit_is_refused_with_what_it_may_be(
    name: str, changes: dict[int, int], message: str
) -> None:
    assert message_at_the_first_look(name, BROWSED[name] | changes, ProtocolError, message)


def message_at_the_first_look(
    name: str, memory: dict[int, int], error: type[Exception], message: str
) -> bool:
    clock = VirtualClock()
    far_end = FarEnd(clock)
    far_end.memory = dict(memory)
    with served(far_end) as url, pytest.raises(error, match=message):
        Bath(url, load_profile(name), clock)
    return all(pdu[0] not in (5, 6, 16) for pdu in far_end.asked)


@pytest.mark.parametrize(
    ("name", "changes", "text"),
    [
        ("eurotherm-2400", {75: 0x0020, 0x8002: 0x447A}, "alarm 32, sensor break"),
        ("omega-cn7", {0x1000: 0x8003}, r"alarm 32771, sensor not connected \(meaning inferred\)"),
    ],
)
def test_a_broken_sensor_is_told_by_its_alarm(
    name: str, changes: dict[int, int], text: str
) -> None:
    assert message_at_the_first_look(
        name, BROWSED[name] | changes, DeviceError, rf"no temperature .*{text}"
    )


@pytest.mark.parametrize(
    ("name", "changes", "alarm", "text"),
    [
        ("eurotherm-2400", {75: 0x0010}, 0, ""),  # manual: no alarm
        (
            "eurotherm-2400",
            {75: 0x00C1},
            0xC1,
            "alarm 193, alarm 1 and loop break and heater failed",
        ),
        ("watlow-pm-map2", {1896: 7}, 7, "alarm 7, alarm 1 high"),
        ("watlow-pm-map2", {1896: 88}, 0, ""),
        ("watlow-pm-map2", {2408: 1274}, 1274, "alarm 1274, open loop"),
        ("watlow-pm-map2", {362: 99}, 99, "alarm 99, see the controller's manual"),
    ],
)
def test_alarms_of_each_kind(name: str, changes: dict[int, int], alarm: int, text: str) -> None:
    map_2 = {
        30: 138,
        360: 0,
        361: 0x41A0,
        362: 61,
        1896: 61,
        2308: 15,
        2360: 62,
        2408: 61,
        2640: 0,
        2641: 0x41A0,
    }
    clock = VirtualClock()
    far_end = FarEnd(clock)
    far_end.memory = (map_2 if "map2" in name else EUROTHERM_MEMORY) | changes
    with served(far_end) as url:
        bath = Bath(url, load_profile(name), clock)
        reading = bath.read()
        assert reading.alarm == alarm
        if alarm:
            assert bath.profile.alarm_text(alarm) == text
            with pytest.raises(DeviceError, match=f"not started: {text}"):
                bath.start(33.0)
        bath.close()


def test_a_family_without_a_pump_has_no_calls_for_one() -> None:
    clock = VirtualClock()
    far_end = FarEnd(clock)
    far_end.memory = dict(OMEGA_MEMORY)
    with served(far_end) as url:
        bath = Bath(url, load_profile("omega-cn7"), clock)
        assert bath.pump == "none"
        for name in ("pump_stage", "pump"):
            with pytest.raises(LimitError, match=f"Omega CN7 has no '{name}'"):
                bath.set(name, 1.0)
        assert (bath.read().safety_c, bath.read().external_c) == (None, None)
        bath.close()


def test_a_rounded_set_point_stands_and_is_not_written_again() -> None:
    clock = VirtualClock()
    far_end = FarEnd(clock)
    far_end.memory = dict(EUROTHERM_MEMORY)
    with served(far_end) as url:
        bath = Bath(url, load_profile("eurotherm-2400"), clock)
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
        bath.close()


# ---- profiles that are refused


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "eurotherm-2400",
            "address = 0x8004",
            "address = 0x8003",
            "from 32768 on, rows take two registers at an even address",
        ),
        (
            "eurotherm-2400",
            "functions = [3, 4, 16]",
            "functions = [3, 4, 6]",
            "none of the functions 3, 4, 6 writes f32",
        ),
        (
            "omega-cn7",
            "functions = [2, 3, 5, 6]",
            "functions = [3, 5, 6]",
            "none of the functions 3, 5, 6 reads table coil",
        ),
        ("omega-cn7", "functions = [2, 3, 5, 6]", "functions = [2, 3, 7]", "functions"),
        ("watlow-pm-map1", 'row = "run"', 'row = "rum"', "there is no row 'rum'"),
        (
            "watlow-pm-map1",
            "seen = { manual = 54 }",
            "seen = { manual = 10 }",
            "mean the same code",
        ),
        ("omega-cn7", "not_yet = 0x8002", "not_yet = 0x18002", "is no register of 16 bits"),
        (
            "omega-cn7",
            'control = "pid"',
            'control = "manual"',
            "that may be written with the value 'manual'",
        ),
    ],
)
def test_a_familys_rules_are_checked(
    tmp_path: Path, name: str, old: str, new: str, message: str
) -> None:
    text = (Path(__file__).parents[3] / f"instruments/bath/profiles/{name}.toml").read_text(
        encoding="utf-8"
    )
    assert old in text
    path = tmp_path / "own.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ProfileError, match=re.escape(message)):
        load_profile(path)

"""A rig file's bath: its URL, its own profile, and faults of that profile shown in their lines."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from bench.config import ConfigError
from bench.rig.loading import RIGS, load_rig
from instruments.bath.profile import SHIPPED


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """A folder with an emulated rig and a profile of its own, ``own.toml``."""
    shutil.copy(RIGS / "calibration.toml", tmp_path)
    shutil.copy(SHIPPED / "watlow-pm-map2.toml", tmp_path / "own.toml")
    text = (RIGS / "emulated.toml").read_text(encoding="utf-8")
    path = tmp_path / "rig.toml"
    path.write_text(
        text.replace('profile = "julabo-presto"', 'profile = "own.toml"'), encoding="utf-8"
    )
    return path


def change(path: Path, old: str, new: str) -> int:
    """Replace ``old`` once; the line where it stood, from 1."""
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    return text[: text.index(old)].count("\n") + 1


def fault_of(rig: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        load_rig(rig)
    return str(caught.value)


def test_a_profile_of_its_own(rig: Path) -> None:
    assert load_rig(rig).profile.family == "Watlow EZ-ZONE PM map 2"
    assert load_rig(rig).rig.bath.allow_inferred is False
    change(rig, 'profile = "own.toml"', 'profile = "own.toml"\nallow_inferred = true')
    assert load_rig(rig).rig.bath.allow_inferred is True


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("address = 1882", "address = 1881", "alarm1_low at holding 1881 overlaps alarm1_high at"),
        ("address = 2640", "address = 70000", "less than or equal to 65535"),
        ('row = "device_status"', 'row = "divice_status"', "there is no row 'divice_status'"),
        ('comms_loss = "hold"', 'comms_loss = "maybe"', "'hold', 'stop', 'safe_setpoint' or"),
    ],
)
def test_a_fault_of_the_profile_is_shown_in_its_line(
    rig: Path, old: str, new: str, message: str
) -> None:
    own = rig.with_name("own.toml")
    line = change(own, old, new)
    said = fault_of(rig)
    assert message in said
    shown = [int(at) for at in re.findall(rf"{re.escape(str(own))}:(\d+): ", said)]
    heads = [own.read_text(encoding="utf-8").split("\n")[at - 1] for at in shown]
    assert line in shown or "[[rows]]" in heads, said  # a row's own fault is shown at its head
    assert "^" in said


def test_a_profile_that_is_not_there_or_no_toml(rig: Path) -> None:
    own = rig.with_name("own.toml")
    own.write_text("family = ", encoding="utf-8")
    assert "not TOML" in fault_of(rig)
    own.unlink()
    assert "no such file" in fault_of(rig)
    change(rig, "own.toml", "eurotherm-3210")
    assert 'did you mean "eurotherm-3200"?' in fault_of(rig)


@pytest.mark.parametrize(
    ("url", "message"),
    [
        (
            "socket://moxa:4001",
            'did you mean "rtu+tcp://"?; allowed: "emulator:", "tcp://host:port"',
        ),
        ("tcp://h:502?untit=1", 'did you mean "unit"?'),
        ("/dev/ttyUSB0?parity=even", "N (none), E (even) and O (odd)"),
    ],
)
def test_links_that_are_none(rig: Path, url: str, message: str) -> None:
    line = 1 + change(rig, '[bath]\nurl = "emulator:"', f'[bath]\nurl = "{url}"')
    said = fault_of(rig)
    assert message in said
    assert f"rig.toml:{line}: " in said


# ---- the relay of a pump

RELAY = """
family = "Relay box"
source = "made up for these tests"
transports = ["rtu", "tcp"]
functions = [1, 5]
unit_id = 5

[[rows]]
name = "pump"
table = "coil"
address = 2
type = "bit"
access = "rw"
values = { off = 0, on = 1 }
evidence = "CERTAIN"
"""
PUMP = 'pump_url = "/dev/ttyUSB1?unit=5"\npump_profile = "relay.toml"\n'
REAL = {
    "operator": "console:",
    "arm": "COM1",
    "bath": "COM3?parity=E",
    "stage": "COM2",
    "cameras": "opencv:0,1,2",
}


@pytest.fixture
def real_rig(rig: Path) -> Path:
    """A rig of real instruments, with an Omega and its pump's relay."""
    rig.with_name("relay.toml").write_text(RELAY, encoding="utf-8")
    for name, url in REAL.items():
        change(rig, f'[{name}]\nurl = "emulator:"', f'[{name}]\nurl = "{url}"')
    change(rig, 'profile = "own.toml"', f'profile = "omega-cn7"\n{PUMP}')
    return rig


def test_a_pump_in_the_rig_file(real_rig: Path) -> None:
    loaded = load_rig(real_rig)
    assert loaded.relay is not None
    assert loaded.relay.family == "Relay box"
    assert loaded.rig.bath.pump_url == "/dev/ttyUSB1?unit=5"


OWN = "JULABO PRESTO has a pump of its own: leave pump_url and pump_profile out"


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("rig.toml", 'profile = "omega-cn7"', 'profile = "julabo-presto"', OWN),
        ("rig.toml", '"relay.toml"', '"rely.toml"', "no such file beside the rig file"),
        ("rig.toml", "1?unit=5", "1?unit=500", "unit=500: a whole number from 1 to 254"),
        ("rig.toml", 'pump_profile = "relay.toml"\n', "", "pump_profile is missing"),
        ("rig.toml", 'pump_url = "/dev/ttyUSB1?unit=5"\n', "", "pump_url is missing"),
        ("relay.toml", 'name = "pump"', 'name = "pomp"', "the row 'pump' is missing"),
    ],
)
def test_faults_of_a_pump_are_shown_in_their_place(
    real_rig: Path, name: str, old: str, new: str, message: str
) -> None:
    path = real_rig.with_name(name)
    change(path, old, new)
    said = fault_of(real_rig)
    assert message in said
    assert f"{path}:" in said


def test_a_real_bath_has_no_emulated_pump(real_rig: Path) -> None:
    change(real_rig, 'pump_url = "/dev/ttyUSB1?unit=5"', 'pump_url = "emulator:"')
    assert "bath.pump_url: bath and pump are both emulated or both real" in fault_of(real_rig)


def test_an_emulated_bath_has_no_real_pump(rig: Path) -> None:
    rig.with_name("relay.toml").write_text(RELAY, encoding="utf-8")
    change(rig, 'profile = "own.toml"', f'profile = "own.toml"\n{PUMP}')
    assert "bath.pump_url: bath and pump are both emulated or both real" in fault_of(rig)


def test_a_shipped_relay_by_its_name(real_rig: Path) -> None:
    change(real_rig, 'pump_profile = "relay.toml"', 'pump_profile = "modbus-relay"')
    loaded = load_rig(real_rig)
    assert loaded.relay is not None
    assert loaded.relay.family == "Modbus relay board"
    change(real_rig, 'pump_profile = "modbus-relay"', 'pump_profile = "modbus-rely"')
    with pytest.raises(
        ConfigError, match=r'no such profile; did you mean "modbus-relay"\? .*shipped: modbus-relay'
    ):
        load_rig(real_rig)

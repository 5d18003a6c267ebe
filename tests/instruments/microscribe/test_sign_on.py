"""Sign-on: by the sheet, in spite of what may be on the line, at other rates, and refused with what
to try.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from instruments.errors import InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Link, latency_warning
from instruments.listener import Connection, Listener
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.errors import (
    NoMicroScribeError,
    NotHomedError,
    SilentArmError,
    UnusableArmError,
)
from instruments.microscribe.faults import ArmFault
from instruments.microscribe.protocol import State
from tests.instruments.microscribe.rigs import UNIT, Ear, Parrot, Rig, driver_of, ghost, renamed

MAKERS_ORDER = bytes.fromhex("C8 C9 CA CB CC CD CE C6 C0 D3")


def test_sign_on_goes_by_the_sheet_and_reads_who_it_is_twice(rig: Rig) -> None:
    driver = rig.driver()
    identity = driver.sign_on()
    assert rig.ear.heard == b"\xc5\xc5IMMCBEGIN" + MAKERS_ORDER + MAKERS_ORDER
    names = ["MicroScribe3D", "MSCR", "DX", "40937", "Standard+Beta", "Format DH0.5", "HCI 2.0"]
    assert dataclasses.astuple(identity) == tuple(names)
    assert driver.identity == identity
    assert driver.info.maxima.turns == (16384, 16384, 8192, 4096, 4096, 0)
    assert driver.info.parameters.d == (8300, -878, -3, 9244, 320, -5274)
    assert driver.info.geometry().beta_rad == pytest.approx(3 / 32768 * np.pi)
    # the pause after an end, and the silence that surplus echoes are waited for
    assert rig.clock.now() == pytest.approx(0.115)
    assert driver.warnings == ()


def test_what_a_run_records_is_enough_to_compute_positions_anew(rig: Rig) -> None:
    driver = rig.driver()
    driver.sign_on()
    record = driver.record()
    assert (record["serial_number"], record["beta"], record["baud"]) == ("40937", 3, 115200)
    assert record["parameters"] == dataclasses.asdict(UNIT.parameters)
    assert record["maxima"] == dataclasses.asdict(UNIT.maxima)


@pytest.mark.parametrize("echo_after", [2, 6])
def test_an_arm_that_wants_it_several_times(rig: Rig, echo_after: int) -> None:
    rig.arm.faults.inject(ArmFault.LATE_ECHO, amount=echo_after)
    rig.driver().sign_on()
    assert rig.ear.heard.startswith(b"\xc5" + b"\xc5IMMC" * echo_after + b"BEGIN" + MAKERS_ORDER)


def test_a_second_host_takes_over_a_session_that_was_left_streaming(rig: Rig) -> None:
    link = Link(rig.listener.url, rig.clock, who="other host")
    for words in (b"IMMC", b"BEGIN", bytes.fromhex("CF 000A 03") + bytes(21)):
        link.write(words)
        link.receive(1.0)
    link.drain(0.2, at_most_s=0.05)
    link.close()
    rig.ear.heard = b""
    assert rig.arm.state is State.STREAMING
    assert rig.signed_on().poll().counts == UNIT.home


def test_a_joint_that_loses_count_is_reported(make: Callable[..., Rig]) -> None:
    maxima = dataclasses.replace(UNIT.maxima, encoders=(0x3FFF, 0x3FFF, 0x1FFF, 4999, 0x0FFF, 0))
    driver = make(dataclasses.replace(UNIT, maxima=maxima)).driver()
    driver.sign_on()
    assert len(driver.warnings) == 1
    assert "joint 3 has 5000 counts a turn" in driver.warnings[0]


def test_whichever_byte_of_sign_on_is_lost_an_old_session_comes_to_no_harm(rig: Rig) -> None:
    for lost in range(30):
        rig.arm.faults.inject(ArmFault.OLD_SESSION, 1)
        driver = rig.driver()
        rig.ear.lose = {lost}
        with contextlib.suppress(InstrumentError):  # a BEGIN that arrives maimed is not sent again
            driver.sign_on()
        assert rig.arm.eeprom_attempts == 0
        driver.sign_on()
        assert driver.poll().counts == UNIT.home
        driver.close()


# What is refused


@pytest.mark.parametrize(
    ("unit", "fault", "message"),
    [
        (UNIT, "IBOX", "Immersion Interface Box"),
        (UNIT, "parameter block of another length", "says it has 34 bytes; 36 are understood"),
        (renamed(format="Format DH1.0"), "", r"not understood: 'Format DH1.0', not 'Format DH0.5'"),
    ],
)
def test_an_arm_that_cannot_be_measured_with_is_refused_and_let_go(
    make: Callable[..., Rig], unit: object, fault: str, message: str
) -> None:
    rig = make(unit)
    if fault:
        rig.arm.faults.inject(fault)
    with pytest.raises(UnusableArmError, match=message):
        rig.driver().sign_on()
    assert rig.ear.heard.endswith(b"\xc5")
    assert (b"\xc0" in rig.ear.heard) == ("block" in fault)
    assert rig.arm.state is State.FINDING_BAUD


def refused(
    device: Parrot, error: type[Exception], message: str, *, answer_s: float = 0.12
) -> None:
    """A sign-on that has to fail and leaves no session."""
    with driver_of(device, answer_s=answer_s) as driver:
        with pytest.raises(error, match=message):
            driver.sign_on()
        with pytest.raises(LimitError, match="no session"):
            driver.poll()


def test_an_arm_that_has_echoed_is_waited_for_as_long_as_is_asked() -> None:
    echoing = Parrot(lambda data: data if b"IMMC" in data else b"")
    for answer_s, waited in ((0.12, "3 s"), (20.0, "20 s")):
        message = rf"echoed, then fell silent \(.*after {waited}\)"
        refused(echoing, SilentArmError, message, answer_s=answer_s)


def says(words: bytes) -> Callable[[bytes], bytes]:
    return lambda _: words


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            bytes,
            NoMicroScribeError,
            r"not that of a MicroScribe \(asked 42 45 47 49 4E, got 42 45 47 49 4E\).*loop-back",
        ),
        (says(b"ERROR\r\n"), NoMicroScribeError, "answers, but not as a MicroScribe.*plain text"),
        (says(b"\r\nGrbl 1.1h ['$' for help]\r\n"), NoMicroScribeError, "GRBL board.*stage"),
        (says(b"error:20\r\n"), NoMicroScribeError, "motion controller"),
        (says(bytes.fromhex("01 83 02 C0 F1")), NoMicroScribeError, "Modbus frames.*bath"),
        (says(bytes.fromhex("F8 00 80 FC")), NoMicroScribeError, "baud rate right"),
        (
            says(b""),
            SilentArmError,
            r"nothing answers the sign-on \(asked C5 49 4D 4D 43, got nothing, after 3 s\).*switched",
        ),
        (
            lambda data: {b"BEGIN": b"IMMCMSCR\0", b"\xc8": b""}.get(data, b"IMMC"),
            LinkError,
            "does not answer .asked C8",
        ),
        (
            lambda data: {b"BEGIN": b"MSCR\0", b"\xc8": b"\xc9X\0"}.get(data, b"IMMC"),
            ProtocolError,
            "doesn't begin with C8 .asked C8, got C9 58 00",
        ),
    ],
)
def test_what_is_no_arm_is_refused_with_a_guess(
    change: Callable[[bytes], bytes], error: type[Exception], message: str
) -> None:
    refused(Parrot(change), error, message)


def test_an_arm_that_never_says_the_same_twice_is_refused() -> None:
    replies, turn = UNIT.replies(), iter(range(100))

    def answer(code: int) -> bytes:
        if code == 0xCB:
            return bytes([code]) + str(next(turn)).encode("ascii") + b"\0"
        return replies.get(code, b"")

    refused(ghost(answer), ProtocolError, r"differently each of 3 times.*cable")


def test_nothing_is_known_before_sign_on(rig: Rig) -> None:
    driver = rig.driver()
    asks: list[Callable[[], object]] = [lambda: driver.identity, lambda: driver.info]
    asks += [driver.poll, driver.read, driver.confirm_homed, driver.home, driver.record]
    for ask in asks:
        with pytest.raises(LimitError, match="Sign on first"):
            ask()
    assert rig.ear.heard == b""


# At other rates


class AtRate(Ear):
    """An arm whose session was left at another rate than the link's: it understands only that."""

    def __init__(self, rig: Rig, baud: int) -> None:
        super().__init__(rig.arm)
        self.baud = baud
        self.spoken: list[int] = []
        rig.listener.close()
        rig.listener = Listener(self, rig.clock, lock=rig.lock, name="arm")
        self.link = Link(rig.listener.url, rig.clock, who="arm", baud=115200)
        self.driver = MicroScribe(self.link, rig.clock, rates=(115200, 38400, 9600))
        rig.drivers.append(self.driver)

    def receive(self, connection: Connection, data: bytes) -> None:
        if self.link.baud not in self.spoken:
            self.spoken.append(self.link.baud)
        if self.link.baud == self.baud:
            super().receive(connection, data)
        else:
            connection.send(b"\xf8\x80")  # what comes back at the wrong rate is noise


def test_a_session_at_another_rate_is_found_and_then_only_homing_helps(rig: Rig) -> None:
    rig.arm.faults.inject(ArmFault.OLD_SESSION, 1)
    device = AtRate(rig, 9600)
    driver = device.driver
    driver.sign_on()
    assert device.spoken == [115200, 38400, 9600]
    assert (driver.baud, driver.record()["baud"]) == (9600, 9600)
    assert driver.warnings == ("the arm answers at 9600 baud, not at 115200",)
    assert driver.poll().counts == UNIT.home
    with pytest.raises(NotHomedError, match=r"may have re-homed it.*on its peg and home the arm"):
        driver.confirm_homed()
    with pytest.raises(NotHomedError, match="may have re-homed it"):
        driver.read()
    driver.home()
    driver.read()


# The adapter's latency timer


def shown(root: Path, name: str, text: str) -> None:
    folder = root / "bus" / "usb-serial" / "devices" / name
    folder.mkdir(parents=True)
    (folder / "latency_timer").write_text(text, encoding="ascii")


@pytest.mark.skipif(
    sys.platform == "win32",
    reason="needs links between files: Windows gives them to administrators only",
)
def test_a_slow_adapter_behind_a_link_is_reported_with_the_command_that_helps(
    tmp_path: Path,
) -> None:
    shown(tmp_path / "sys", "ttyUSB3", "16\n")
    (tmp_path / "ttyUSB3").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB3")
    warning = str(latency_warning(str(tmp_path / "by-id"), tmp_path / "sys"))
    assert "ttyUSB3 holds bytes back for 16 ms" in warning
    timer = f"{tmp_path.as_posix()}/sys/bus/usb-serial/devices/ttyUSB3/latency_timer"
    assert f"echo 1 | sudo tee {timer}" in warning


KEYS: dict[str, Any] = {
    r"SYSTEM\CurrentControlSet\Enum\FTDIBUS": ["VID_0403+PID_6001+A1"],
    r"SYSTEM\CurrentControlSet\Enum\FTDIBUS\VID_0403+PID_6001+A1": ["0000"],
    r"SYSTEM\CurrentControlSet\Enum\FTDIBUS\VID_0403+PID_6001+A1\0000\Device Parameters": {
        "PortName": "COM5",
        "LatencyTimer": 16,
    },
}


def test_a_slow_adapter_on_windows_is_reported_with_the_way_to_its_setting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def open_key(_: int, path: str) -> Any:
        if path not in KEYS:
            raise FileNotFoundError(path)
        return contextlib.nullcontext(KEYS[path])

    registry = SimpleNamespace(
        HKEY_LOCAL_MACHINE=0,
        OpenKey=open_key,
        QueryInfoKey=lambda key: (len(key), 0, 0),
        EnumKey=lambda key, at: key[at],
        QueryValueEx=lambda key, name: (key[name], 0),
    )
    monkeypatch.setitem(sys.modules, "winreg", registry)
    warning = str(latency_warning("COM5"))
    assert "COM5 holds bytes back for 16 ms" in warning
    assert "Device Manager, Ports, COM5, Port Settings, Advanced: Latency Timer 1" in warning
    assert latency_warning("COM6") is None


@pytest.mark.parametrize(
    ("port", "latency"),
    [("/dev/ttyUSB0", "1\n"), ("/dev/ttyUSB0", "fast\n"), ("/dev/ttyACM0", "16\n")]
    + [(port, "16\n") for port in ("COM5", "socket://127.0.0.1:5001", "rfc2217://lab:2217")],
)
def test_nothing_is_said_where_nothing_is_wrong_or_known(
    tmp_path: Path, port: str, latency: str
) -> None:
    shown(tmp_path, "ttyUSB0", latency)
    assert latency_warning(port, tmp_path) is None

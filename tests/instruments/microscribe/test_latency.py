"""The adapter's latency timer: told where Linux shows it, with the command that sets it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from instruments.link import Link
from instruments.microscribe.connection import latency_warning
from instruments.microscribe.driver import MicroScribe
from tests.instruments.microscribe.driver_rig import Rig


def shown(root: Path, name: str, text: str) -> None:
    folder = root / "bus" / "usb-serial" / "devices" / name
    folder.mkdir(parents=True)
    (folder / "latency_timer").write_text(text, encoding="ascii")


def test_a_slow_adapter_is_told_with_the_command_that_helps(tmp_path: Path) -> None:
    shown(tmp_path, "ttyUSB0", "16\n")
    warning = latency_warning("/dev/ttyUSB0", tmp_path)
    assert warning is not None
    assert "ttyUSB0 holds bytes back for 16 ms" in warning
    assert (
        f"echo 1 | sudo tee {tmp_path.as_posix()}/bus/usb-serial/devices/ttyUSB0/latency_timer"
        in warning
    )


@pytest.mark.skipif(
    sys.platform == "win32",
    reason="needs links between files: Windows gives them to administrators only",
)
def test_a_link_to_the_port_is_followed(tmp_path: Path) -> None:
    shown(tmp_path / "sys", "ttyUSB3", "2\n")
    (tmp_path / "ttyUSB3").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyUSB3")
    assert "holds bytes back for 2 ms" in str(
        latency_warning(str(tmp_path / "by-id"), tmp_path / "sys")
    )


@pytest.mark.parametrize(
    "port",
    ["/dev/ttyUSB0", "/dev/ttyACM0", "COM5", "socket://127.0.0.1:5001", "rfc2217://lab:2217"],
)
def test_nothing_is_said_where_nothing_is_wrong_or_known(tmp_path: Path, port: str) -> None:
    shown(tmp_path, "ttyUSB0", "1\n")
    assert latency_warning(port, tmp_path) is None


def test_what_cannot_be_read_says_nothing(tmp_path: Path) -> None:
    shown(tmp_path, "ttyUSB0", "fast\n")
    assert latency_warning("/dev/ttyUSB0", tmp_path) is None


def test_the_driver_tells_it(tmp_path: Path, rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    shown(tmp_path, "ttyUSB0", "16\n")
    link = Link(rig.listener.url, rig.clock, who="arm")
    driver = MicroScribe(link, rig.clock, sysfs=tmp_path)
    rig.drivers.append(driver)
    told = [driver.warnings]
    monkeypatch.setattr(link, "url", "/dev/ttyUSB0")
    told.append(driver.warnings)  # before sign-on already, which a slow adapter makes harder
    assert told[0] == ()
    assert len(told[1]) == 1
    assert "latency_timer" in told[1][0]

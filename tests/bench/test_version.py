"""Which versions made a figure: as the libraries say themselves."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import cv2
import pytest
import serial

import bench
from bench.version import LIBRARIES, overwritten, versions
from tests.bench.small_run import write_small_run


def test_versions_are_those_of_pip() -> None:
    assert versions() == {name: version(name) for name in LIBRARIES}
    assert overwritten() == ""
    assert versions(("none of this name",)) == {"none of this name": "unknown"}


@pytest.mark.slow
def test_an_opencv_that_another_package_wrote_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cv2, "__version__", "4.9.0")
    says = f"4.9.0, another package's (pip: {version('opencv-python-headless')})"
    run = bench.read_run(write_small_run(tmp_path))
    assert run.facts["versions"]["opencv-python-headless"] == says
    assert f"Python's cv2 is {says}: uninstall what wrote over it" in capsys.readouterr().out


@pytest.mark.slow
def test_a_serial_that_is_not_pyserial_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    theirs = tmp_path / "serial-0.0.97.dist-info"
    theirs.mkdir()
    (theirs / "METADATA").write_text("Name: serial\nVersion: 0.0.97\n", encoding="utf-8")
    (theirs / "top_level.txt").write_text("serial\n", encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    assert overwritten() == ""  # pyserial was installed after it
    monkeypatch.delattr(serial, "__version__")
    says = "Python's serial is of no version, another package's (pip: 3.5): uninstall serial and"
    assert overwritten() == f"{says} pyserial, and install pyserial again."

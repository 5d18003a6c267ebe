"""Which versions made a figure: as the libraries say themselves."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import cv2
import pytest

import bench
from bench.version import LIBRARIES, other_opencv, versions
from tests.bench.small_run import write_small_run


def test_versions_are_those_of_pip() -> None:
    assert versions() == {name: version(name) for name in LIBRARIES}
    assert other_opencv() == ""
    assert versions(("none of this name",)) == {"none of this name": "unknown"}


@pytest.mark.slow
def test_an_opencv_that_another_package_wrote_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cv2, "__version__", "4.9.0")
    pip = version("opencv-python-headless")
    says = f"4.9.0, another package's (pip: {pip})"
    assert versions()["opencv-python-headless"] == says
    run = bench.read_run(write_small_run(tmp_path))
    assert run.facts["versions"]["opencv-python-headless"] == says
    assert f"OpenCV is {says}" in capsys.readouterr().out

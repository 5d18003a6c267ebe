"""The table of detectors: cheap to list, exact about what it doesn't have."""

from __future__ import annotations

import subprocess
import sys

import pytest

from detector.registry import UnknownDetectorError, available, create


def test_every_name_can_be_created_and_knows_itself() -> None:
    for name, description in available().items():
        assert create(name).name == name
        assert description
        assert "\n" not in description


def test_an_unknown_name_gets_the_nearest() -> None:
    with pytest.raises(UnknownDetectorError, match=r"did you mean 'thesis'\? There are: .*thesis"):
        create("tesis")
    with pytest.raises(UnknownDetectorError, match="no detector is called 'zzz'"):
        create("zzz")


def test_listing_loads_no_picture_library() -> None:
    code = (
        "import sys; from detector.registry import available; available();"
        "sys.exit(any(m in sys.modules for m in ('numpy', 'cv2', 'scipy')))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0

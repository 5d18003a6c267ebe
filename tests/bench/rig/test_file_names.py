"""Names that no file system has: a fault of the rig file in its place; of an argument, one line."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from bench.config import ConfigError
from bench.rig.loading import RIGS, load_rig
from tests.bench.commands import Said

LONG = "x" * 300 + ".toml"


@pytest.mark.skipif(os.name == "nt", reason="Windows says of a long name that there is none")
@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ('calibration = "calibration.toml"', f'calibration = "{LONG}"', "calibration"),
        ("[arm]", f'[arm]\nframe = "{LONG}"', r"arm\.frame"),
        ("[arm]", f'[arm]\nverification = "{LONG}"', r"arm\.verification"),
        ("[operator]", f'[operator]\nurl = "script:{LONG}"\n[operator2]', r"operator"),
        ('calibration = "calibration.toml"', 'calibration = "a\\u0000.toml"', "calibration"),
    ],
)
def test_a_name_that_no_file_has_is_a_fault_in_its_place(
    tmp_path: Path, old: str, new: str, where: str
) -> None:
    text = (RIGS / "emulated.toml").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "rig.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigError, match=rf"rig\.toml:\d+: {where}"):
        load_rig(tmp_path / "rig.toml")


def test_a_name_that_is_no_text_is_refused_in_one_line(said: Said, tmp_path: Path) -> None:
    name = f"{tmp_path}/run\udcff"
    found = said(2, "run six-situations --out {}", name)
    assert "run\\udcff' isn't UTF-8: name it otherwise" in found.err
    assert not list(tmp_path.iterdir())

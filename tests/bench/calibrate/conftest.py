"""A day's pictures and the cameras calibrated from them: drawn once for all files here."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench.calibrate.board_pictures import BOARD_TOML, write_pairs
from tests.bench.commands import Said, teatbench


@pytest.fixture(scope="session")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the board's file, twelve pairs as day1, and cameras.toml with its page."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "board.toml").write_text(BOARD_TOML, encoding="utf-8")
    write_pairs(folder / "day1", 12)
    # good to 1.25 to 5 mm where teats stand
    assert calibrate_cameras(folder, folder / "cameras.toml") == 4
    return folder


@pytest.fixture
def in_lab(lab: Path, said: Said, monkeypatch: pytest.MonkeyPatch) -> Said:
    """As `said`, in the lab's folder: commands name its files alone."""
    monkeypatch.chdir(lab)
    return said


def calibrate_cameras(
    lab: Path, out: Path, *more: str, frames: str = "day1", board: str = "board.toml"
) -> int:
    """The exit code of `calibrate cameras` on a folder of the lab."""
    given = lab / frames, lab / board, "k1 k2", out, more
    return teatbench("calibrate cameras {} --board {} --model {} --out {} {}", *given)

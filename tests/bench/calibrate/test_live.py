"""Live calibration on an emulated rig, boards shown and touched, end to end."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import scipy

from detector.calibration import Part, load_calibration, load_part
from reports.page import KINDS
from tests.bench.calibrate.small_rig import small_calibration, write_rig
from tests.bench.calibrate.touched import placed, there, within
from tests.bench.commands import Said, teatbench
from tests.plain_text import plain_text

pytestmark = pytest.mark.slow

BOARD, HEATED = "chessboard-9x6-40", "heated-circles-7x5-18"


VIEWS = 10


def scripted(folder: Path, views: int) -> str:
    """The rig with an operator who has had enough after so many views."""
    answers = f"otherwise board: go\nboard (view {views + 1}): enough\n"
    (folder / "answers.txt").write_text(answers, encoding="utf-8")
    text = (folder / "small.toml").read_text(encoding="utf-8")
    text = text.replace('url = "emulator:"', 'url = "script:answers.txt"', 1)
    (folder / "scripted.toml").write_text(text, encoding="utf-8")
    return "scripted.toml"


@pytest.fixture(scope="module")
def bench_room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small rig, its cameras calibrated live, and what was said as said.txt."""
    folder = tmp_path_factory.mktemp("room")
    write_rig(folder)
    with pytest.MonkeyPatch.context() as patch:
        lines: list[str] = []
        patch.setattr("bench.cli.calibrate.say", lines.append)
        assert live(folder, "cameras", "--board", BOARD, rig=scripted(folder, VIEWS)) == 4
    (folder / "said.txt").write_text("\n".join(lines), encoding="utf-8")
    return folder


def live(folder: Path, step: str, *more: str, rig: str = "small.toml") -> int:
    return teatbench(
        "calibrate {} --rig {} --out {} {}", step, folder / rig, folder / f"{step}.toml", more
    )


def made(folder: Path, step: str, board: str) -> Part:
    """What a live step wrote with the live cameras; done now where no test has done it yet."""
    if not (folder / f"{step}.toml").exists():
        assert live(folder, step, "--board", board, "--cameras", str(folder / "cameras.toml")) == 0
    return load_part(folder / f"{step}.toml")


def test_the_pair_comes_out_as_it_was_put_in(bench_room: Path) -> None:
    part, put_in = load_part(bench_room / "cameras.toml"), small_calibration()
    assert within(part, "left", {"fx": there(part.left).fc[0] - put_in.left.fc[0]})
    assert placed(part, "stereo", there(part.right_from_left), put_in.right_from_left)
    assert there(part.record).cameras == dict.fromkeys(("left", "right"), "emulated 680 x 512")
    assert "left/01.png" in there(part.record).inputs
    said = (bench_room / "said.txt").read_text(encoding="utf-8").splitlines()
    found = "(found, 54 points|refused: .+)"
    assert re.fullmatch(f"view 1: left {found}; right {found}", said[0])
    assert any(re.match("Enough: .*Still missing: left and right", line) for line in said), said
    assert said[-1].startswith(f"{VIEWS} views in ")


def test_pictures_are_never_written_over(bench_room: Path) -> None:
    left = bench_room / "cameras.pictures" / "left"
    kept = {path: path.stat().st_mtime_ns for path in left.iterdir()}
    rig = scripted(bench_room, 1)
    code = live(bench_room, "cameras", "--board", BOARD, "--replace", rig=rig)
    assert code == 2, "one view is too few"
    assert len(list((bench_room / "cameras.pictures-2" / "left").iterdir())) == 1
    assert {path: path.stat().st_mtime_ns for path in left.iterdir()} == kept


def test_the_table_comes_out_where_it_is(bench_room: Path) -> None:
    part, put_in = made(bench_room, "world", BOARD), small_calibration()
    found = there(part.world_from_right)
    places = np.array([[-250.0, 180.0, 60.0], [-120.0, 300.0, 200.0]])
    apart = found.apply(put_in.world_from_right.inverse().apply(places)) - places
    assert np.linalg.norm(apart, axis=1).max() < 1.5, "mm, among the touched places"
    assert placed(part, "world", found, put_in.world_from_right)
    assert KINDS["emulated"] in plain_text(bench_room / "world.page" / "index.html")
    kept = {path.name for path in (bench_room / "world.pictures").iterdir()}
    assert kept == {
        "left",
        "right",
        "points.csv",
        *(f"position-{n}-{c}-numbered.png" for n in (1, 2) for c in ("left", "right")),
    }


@pytest.mark.weekly
def test_it_still_holds_on_another_day(bench_room: Path, said: Said) -> None:
    files = bench_room / "cameras.toml", bench_room / "small.toml"
    seen = said(0, "calibrate check {} --rig {} --seed 9 --board {}", *files, BOARD).out
    assert "5 views are enough." in seen
    assert "It still holds." in seen


@pytest.mark.weekly
def test_all_live_steps_make_one_calibration_that_is_as_good_as_it_says(bench_room: Path) -> None:
    put_in = small_calibration()
    made(bench_room, "world", BOARD)
    part = made(bench_room, "thermal", HEATED)
    where = there(part.thermal_from_left), there(put_in.thermal_from_left)
    assert placed(part, "thermal pose", *where, "12")
    parts = [str(bench_room / f"{step}.toml") for step in ("cameras", "thermal", "world")]
    whole = bench_room / "calibration-live.toml"
    merge = "calibrate merge {} --out {} --by {} --replace"
    assert teatbench(merge, parts, whole, "A. Tester") == 0
    found = load_calibration(whole)
    assert found.thermal.mirrored == put_in.thermal.mirrored
    assert found.thermal.polarity == put_in.thermal.polarity
    places = np.array([[-300.0, 150.0, 60.0], [-190.0, 235.0, 135.0], [-90.0, 330.0, 200.0]])
    left, right = put_in.project(places)
    off, covariance = found.place(left, right) - places, found.covariance_of(places)
    distances = [float(o @ np.linalg.solve(c, o)) for o, c in zip(off, covariance, strict=True)]
    assert max(distances) < scipy.stats.chi2.ppf(0.9999, 3)
    assert there(found.record).cameras["thermal"].startswith("emulated")


def test_cameras_of_another_rig_are_refused(bench_room: Path, said: Said) -> None:
    cameras = bench_room / "cameras.toml"
    seen = said(3, "calibrate check {} --rig emulated --board {}", cameras, BOARD).err.split()
    note = "'emulated 680 x 512', but the one that answers is 'emulated 1360 x 1024'"
    assert f"made for the left camera {note}" in " ".join(seen)

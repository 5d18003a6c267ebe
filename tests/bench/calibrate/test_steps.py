"""The steps of a calibration as a user goes through them, from pictures to one file."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.rig.loading import BOARDS, shipped
from detector.calibration import dump_calibration, load_calibration, load_part
from tests.bench.calibrate.board_pictures import BOARD, LEFT, RIGHT_FROM_LEFT
from tests.bench.calibrate.conftest import calibrate_cameras
from tests.bench.calibrate.touched import (
    TOUCHED,
    WORLD_FROM_RIGHT,
    placed,
    there,
    within,
    write_touched,
)
from tests.bench.commands import Said, words
from tests.reports.markup import read

pytestmark = pytest.mark.slow

FROM_PAIRS = "calibrate thermal --pairs pairs.csv --image-size 640x480"


def write_pairs_table(path: Path) -> Path:
    rng = np.random.default_rng(5)
    lines = ["thermal_x,thermal_y,left_x,left_y,right_x,right_y"]
    for x, y in rng.uniform((10, 10), (630, 470), (40, 2)):
        lines.append(
            f"{x:.2f},{y:.2f},{0.2 * x + 160:.3f},{0.2 * y + 120:.3f},{0.2 * x + 110:.3f},{0.2 * y + 130:.3f}"
        )
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_cameras_come_out_as_they_were_put_in(lab: Path) -> None:
    part = load_part(lab / "cameras.toml")
    off = np.subtract(there(part.left).fc, LEFT.fc)
    assert within(part, "left", {"fx": off[0], "fy": off[1]})
    assert placed(part, "stereo", there(part.right_from_left), RIGHT_FROM_LEFT)
    assert len(there(part.record).inputs) == 25, "24 pictures and the board"


@pytest.mark.weekly
def test_a_board_by_its_figures_and_a_folder_that_is_not_there(
    lab: Path, tmp_path: Path, in_lab: Said
) -> None:
    out = tmp_path / "new" / "folder" / "c.toml"
    board = f"checkerboard:{BOARD.columns}x{BOARD.rows}:{BOARD.pitch_mm:g}mm"
    seen = in_lab(4, "calibrate cameras day1 --board {} --model {} --out {}", board, ["k1 k2"], out)
    made, known = (there(load_part(path).left) for path in (out, lab / "cameras.toml"))
    assert made.fc == known.fc
    note = re.findall(
        r"^(baseline|focal lengths|reprojection error).* (?:±|to) [0-9.]+", seen.out, re.M
    )
    assert note == ["baseline", *["focal lengths"] * 2, *["reprojection error"] * 2]


def test_the_boards_that_ship_are_named_where_none_is(in_lab: Said) -> None:
    seen = in_lab(2, "calibrate cameras day1 --out never.toml").err
    assert all(name in seen for name in (*shipped(BOARDS), "checkerboard:5x7:30mm"))
    assert (
        "write checkerboard:5x7:30mm" in in_lab(2, "calibrate board checkerboard:5x7 --pdf x").err
    )
    usage = " ".join(in_lab(0, "calibrate cameras --help").out.split())
    assert all(name.split("-")[0] in usage for name in shipped(BOARDS))


def test_its_page_says_what_it_is_good_for(lab: Path) -> None:
    text = (lab / "cameras.page" / "index.html").read_text(encoding="utf-8")
    page = read(text)
    top = page.by_id("verdict").text
    for said in ("Good to", "mm at", "12 pairs of views", "place the board's points", "do next"):
        assert said in top, said
    for section, said in {
        "findings": "No fault left a mark",
        "parameters": "Lens of the left camera",
        "residuals": "Points of the right camera",
        "held-out": "lengths against the print",
        "worth": "What one triangulated point is good to",
        "coverage": "Points by part of the left picture",
        "pictures": "Views used",
        "provenance": "board.toml",
    }.items():
        assert said in page.by_id(section).text, section
    assert text.count("<figure") == 3, "residuals of both cameras, precision by distance"
    assert all(f">{row}</th>" in text for row in ("top", "middle", "bottom"))
    first = page.by_id("findings").text
    assert "One point is good to" in first
    assert "at most 1.25 mm" in first
    assert "enough" in top
    assert text.index('id="worth"') < text.index("<details>") < text.index('id="provenance"')


def test_all_steps_make_one_calibration(lab: Path, in_lab: Said) -> None:
    write_touched(lab / "points.csv")
    write_pairs_table(lab / "pairs.csv")
    who = "A. Tester"
    in_lab(0, "calibrate world points.csv --cameras cameras.toml --out world.toml --by {}", who)
    in_lab(0, f"{FROM_PAIRS} --mirrored --out thermal.toml")
    lens = "[cameras.depth]\nimage_size = [320, 240]\nfc = [420, 420]\ncc = [159.5, 119.5]\n"
    lens += "kc = [0, 0, 0, 0, 0]\n"
    (lab / "depth.toml").write_text(lens, encoding="utf-8")
    parts = "cameras.toml world.toml thermal.toml depth.toml"
    half = in_lab(2, f"calibrate merge {parts} --out calibration.toml").err
    assert "missing block [depth]: a depth camera has a lens and a pose" in half
    pose = "[depth]\nom = [0, 0, 0]\nT = [-50, 40, 0]\n"
    (lab / "depth.toml").write_text(lens + pose, encoding="utf-8")
    in_lab(0, f"calibrate merge {parts} --out calibration.toml --by {{}}", who)
    found = load_calibration(lab / "calibration.toml")
    assert np.abs(found.world_from_right.T - WORLD_FROM_RIGHT.T).max() < 3.0
    assert found.thermal.mirrored
    assert there(found.depth).image_size == (320, 240)
    assert there(found.depth_from_left).T.tolist() == [-50.0, 40.0, 0.0]
    assert there(found.covariance).sd("world", "T3") is not None
    sd = np.sqrt(np.linalg.eigvalsh(found.covariance_of(TOUCHED[:1], 0.05)[0]))
    assert 0.02 < sd[0] < sd[2] < 3.0
    assert there(found.record).by == who
    assert "world.toml: points.csv" in there(found.record).inputs
    page = (lab / "world.page" / "index.html").read_text(encoding="utf-8")
    assert "Good enough. The cameras&#39; points miss the arm" in page


@pytest.mark.weekly
def test_worse_touches_and_pixels_make_a_less_certain_world(lab: Path, in_lab: Said) -> None:
    write_touched(lab / "points3.csv")
    sds: list[float] = []
    for noise in ("", "--touch-sd 2.5", "--pixel-sd 2.5"):
        command = "calibrate world points3.csv --cameras cameras.toml --out w3.toml --replace"
        in_lab(0, f"{command} {noise}")
        sds.append(there(load_part(lab / "w3.toml").covariance).sd("world", "T3") or 0.0)
    assert 0.0 < sds[0] * 1.5 < min(sds[1:])


@pytest.mark.weekly
def test_whose_cameras_they_are_is_on_record(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    more = words("--identity left=L-17 --identity right=R-18 --max-views 10")
    assert calibrate_cameras(lab, lab / "whose.toml", *more) in (1, 4)
    record = there(load_part(lab / "whose.toml").record)
    assert record.cameras == {"left": "L-17", "right": "R-18"}
    assert calibrate_cameras(lab, lab / "nobody.toml", "--identity", "middle=1") == 2
    assert "say left=SERIAL" in capsys.readouterr().err


def test_parts_that_do_not_belong_together_are_refused(lab: Path, in_lab: Said) -> None:
    part = load_part(lab / "cameras.toml")
    other = replace(part, record=replace(there(part.record), by="Somebody else"))
    (lab / "named.toml").write_text(dump_calibration(other), encoding="utf-8")
    write_touched(lab / "points2.csv")
    write_pairs_table(lab / "pairs.csv")
    in_lab(0, "calibrate world points2.csv --cameras cameras.toml --out w.toml")
    in_lab(0, f"{FROM_PAIRS} --out t.toml")
    for parts, why in {
        "named.toml w.toml": "[cameras.thermal] is in none of the files: add the file that"
        " 'teatbench calibrate thermal' wrote",
        "named.toml w.toml t.toml": "was made with another cameras' file",
        "cameras.toml named.toml": "leave one of them out",
    }.items():
        assert why in in_lab(2, f"calibrate merge {parts} --out never.toml").err
    assert not (lab / "never.toml").exists()

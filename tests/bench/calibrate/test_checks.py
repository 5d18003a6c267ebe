"""A calibration held against boards and touched points: it holds, or the page names what is wrong."""

from __future__ import annotations

import html
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.calibrate.world import TouchedPoints, check_points
from bench.config import ConfigError
from detector.calibration import Part, dump_calibration, load_part
from detector.geometry import Camera, Motion
from tests.bench.calibrate.board_pictures import BOARD_TOML, LEFT, RIGHT, RIGHT_FROM_LEFT
from tests.bench.calibrate.conftest import calibrate_cameras
from tests.bench.calibrate.touched import TOUCHED, WORLD_FROM_RIGHT, write_touched
from tests.bench.commands import Said

pytestmark = pytest.mark.slow

NOISE = {"pixel_sd_px": 0.1, "touch_sd_mm": 0.25}
WHOLE = Part(
    left=LEFT, right=RIGHT, right_from_left=RIGHT_FROM_LEFT, world_from_right=WORLD_FROM_RIGHT
)


def touched(seed: int, count: int = 18) -> TouchedPoints:
    rng, points = np.random.default_rng(seed), TOUCHED[:count]
    in_right = WORLD_FROM_RIGHT.inverse().apply(points)
    left, right = LEFT.project(RIGHT_FROM_LEFT.inverse().apply(in_right)), RIGHT.project(in_right)
    return TouchedPoints(
        left + rng.normal(0, 0.1, left.shape),
        right + rng.normal(0, 0.1, right.shape),
        points + rng.normal(0, 0.25, points.shape),
    )


@pytest.mark.parametrize("count", [1, 2, 18])
def test_what_holds_is_not_accused(count: int) -> None:
    for seed in range(40):
        again, findings = check_points(WHOLE, touched(seed, count), **NOISE)
        assert findings == ()
        assert again.missed_mm.shape == (count, 3)


def test_the_expected_distance_is_what_comes_on_the_mean() -> None:
    sets = [check_points(WHOLE, touched(seed), **NOISE)[0] for seed in range(40)]
    seen = np.sqrt(np.mean([np.sum(again.missed_mm**2, axis=1) for again in sets], axis=0))
    np.testing.assert_allclose(sets[0].expected_mm, seen, rtol=0.25)


@pytest.mark.parametrize(("count", "by_mm"), [(1, 30.0), (18, 6.0)])
def test_cameras_that_were_pushed(count: int, by_mm: float) -> None:
    elsewhere = Motion(WORLD_FROM_RIGHT.R, WORLD_FROM_RIGHT.T + np.array([by_mm, 0.0, 0.0]))
    pushed = replace(WHOLE, world_from_right=elsewhere)
    (finding,) = check_points(pushed, touched(1, count), **NOISE)[1]
    assert finding.name == "moved cameras"
    x_mm = float(finding.sentence.partition("(")[2].partition(",")[0])
    assert x_mm == pytest.approx(by_mm, abs=4.0)


def test_points_mistaken_for_each_other() -> None:
    points = touched(2)
    mistaken = replace(points, touched_mm=points.touched_mm[[1, 0, *range(2, 18)]])
    (finding,) = check_points(WHOLE, mistaken, **NOISE)[1]
    assert finding.name == "scattered points"
    assert "points scatter by" in finding.sentence


def test_a_calibration_without_a_world_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"need a whole calibration, with .*\[world\]"):
        check_points(replace(WHOLE, world_from_right=None), touched(1), **NOISE)


def test_by_command_with_its_page(lab: Path, in_lab: Said) -> None:
    points = write_touched(lab / "again.csv")
    in_lab(0, "calibrate world again.csv --cameras cameras.toml --out wc.toml")
    cameras, world = load_part(lab / "cameras.toml"), load_part(lab / "wc.toml")
    whole = replace(cameras, world_from_right=world.world_from_right, covariance=world.covariance)
    (lab / "whole.toml").write_text(dump_calibration(whole), encoding="utf-8")
    check = "calibrate check whole.toml --points again.csv"
    assert "18 points: missed by" in in_lab(0, f"{check} --page points.page").out
    page = (lab / "points.page" / "index.html").read_text(encoding="utf-8")
    assert "It still holds." in page
    assert "Measured less touched" in page
    expected = [
        float(in_lab(0, f"{check} {noise}").out.partition("rms, ")[2].split()[0])
        for noise in ("", "--touch-sd 2.5", "--pixel-sd 2.5")
    ]
    assert expected[0] + 1.0 < min(expected[1:]), "who touches or sees worse may expect worse"
    head, *lines = points.read_text(encoding="utf-8").splitlines()
    cells = (line.rpartition(",") for line in lines)
    pushed = [f"{kept},{float(z_mm) + 40.0}" for kept, _, z_mm in cells]
    points.write_text("\n".join([head, *pushed]), encoding="utf-8")
    seen = in_lab(1, check)
    assert "It no longer holds." in seen.out
    assert "moved cameras: points are measured" in seen.err


def named(page: Path) -> str:
    """What stands in the page's section of faults, as a reader sees it."""
    text = page.read_text(encoding="utf-8")
    start = text.index('id="findings"')
    inline = re.sub(r"</?(a|b|span)\b[^>]*>", "", text[start : text.index("</section>", start)])
    return html.unescape(re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", inline)))


def longer(part: Part) -> Part:
    assert part.right_from_left is not None
    return replace(
        part, right_from_left=Motion(part.right_from_left.R, 1.01 * part.right_from_left.T)
    )


def shifted(part: Part, columns_px: float, rows_px: float) -> Part:
    lens = part.right
    assert isinstance(lens, Camera)
    return replace(part, right=replace(lens, cc=(lens.cc[0] + columns_px, lens.cc[1] + rows_px)))


def test_a_sound_one_accuses_no_camera(lab: Path) -> None:
    assert "No fault left a mark" in named(lab / "cameras.page" / "index.html")


@pytest.mark.parametrize(
    ("fault", "put_in", "seen"),
    [
        (
            "baseline",
            longer,
            r"wrong baseline: the board is measured (0\.9|1\.0)\d % too large at every distance",
        ),
        (
            "columns",
            lambda part: shifted(part, 0.5, 0.0),
            r"shifted columns: the board is measured .* as by 0\.[3-7]\d px",
        ),
        (
            "rows",
            lambda part: shifted(part, 0.0, 0.5),
            r"shifted rows: the right camera's rows are 0\.[45]\d px too high",
        ),
    ],
)
def test_a_calibration_that_went_wrong(
    lab: Path, in_lab: Said, fault: str, put_in: Callable[[Part], Part], seen: str
) -> None:
    part = put_in(load_part(lab / "cameras.toml"))
    (lab / f"{fault}.toml").write_text(dump_calibration(part), encoding="utf-8")
    in_lab(1, f"calibrate check {fault}.toml day1 --board board.toml --page {fault}.page")
    faults = named(lab / f"{fault}.page" / "index.html")
    assert re.search(seen, faults), faults


def test_a_wrong_square_size_against_the_arm(lab: Path, in_lab: Said) -> None:
    (lab / "wrong.toml").write_text(BOARD_TOML.replace("40.0", "39.0"), encoding="utf-8")
    code = calibrate_cameras(lab, lab / "short.toml", board="wrong.toml")
    assert code == 4, "the pictures alone can't tell"
    write_touched(lab / "points3.csv")
    written = in_lab(1, "calibrate world points3.csv --cameras short.toml --out sw.toml")
    faults = named(lab / "sw.page" / "index.html")
    wanted = r"wrong square size: lengths come out 2\.\d\d % too short against the arm"
    assert re.search(wanted, faults), faults
    assert "wrong square size" in written.err

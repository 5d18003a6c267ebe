"""A calibration held against boards and touched points: it holds, or the page names what is wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.calibrate.world import TouchedPoints, check_points
from bench.config import ConfigError
from detector.calibration import Part, dump_calibration, load_part
from detector.geometry import Motion
from tests.bench.calibrate.board_pictures import LEFT, RIGHT, RIGHT_FROM_LEFT
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


@pytest.mark.parametrize("count", [1, 18])
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


@pytest.mark.weekly
def test_by_command_with_its_page(lab: Path, in_lab: Said) -> None:
    points = write_touched(lab / "again.csv")
    in_lab(0, "calibrate world again.csv --cameras cameras.toml --out wc.toml")
    cameras, world = load_part(lab / "cameras.toml"), load_part(lab / "wc.toml")
    whole = replace(cameras, world_from_right=world.world_from_right, covariance=world.covariance)
    (lab / "whole.toml").write_text(dump_calibration(whole), encoding="utf-8")
    check = "calibrate check whole.toml --points again.csv"
    assert "18 points: missed by" in in_lab(0, f"{check} --page points.page").out
    (lab / "a file").touch()
    held = in_lab(3, f"{check} --page {{}}", "a file/page")
    assert held.out.endswith("It still holds.\n"), "its page alone is missing"
    why = "the page can't be written: Not a directory. Name another place."
    assert held.err == f"teatbench: a file/page: {why}\n"
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

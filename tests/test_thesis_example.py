"""The example that puts a run beside the thesis: the file of what was published, and what is worked
out of it and of a run. On a whole run it is tried in tests/bench/report/test_report_points.py.
"""

from __future__ import annotations

import importlib
import json
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.record.reader import RunRecord
from bench.report.tables import published
from bench.report.trials import project_all
from bench.rig.loading import find_rig, load_rig
from bench.scoring.errors import summarise
from bench.script.model import TRIALS, load_script
from detector.calibration import Calibration
from detector.calibration.thesis_rig import HOMOGRAPHY_LEFT, HOMOGRAPHY_RIGHT
from tests.bench.results.test_error_rows import record, trial
from tests.conftest import ROOT, SHARED
from tests.detector.thesis_fits import TEAT_ENDS_MM, WORLD_MATRIX

EXAMPLES = ROOT / "docs" / "examples"
FIGURES = tomllib.loads((EXAMPLES / "thesis.toml").read_text(encoding="utf-8"))
SITUATIONS = {
    one["name"]: (one["section"], one["found"], one["present"]) for one in FIGURES["situations"]
}
MIDDLE = np.array([-185.0, 235.0, 136.0])


def example(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """An example as a program beside the others has it."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module(name)


def markdown_rows(table: str) -> dict[str, tuple[str, ...]]:
    """The rows below a table's head, by their first cell."""
    rows = [
        [cell.strip() for cell in line[1:-2].split("|")]
        for line in table.split("|---|")[-1].splitlines()
        if line.startswith("| ")
    ]
    return {row[0]: tuple(row[1:]) for row in rows}


@pytest.fixture(scope="module")
def printed() -> Mapping[str, Any]:
    if not SHARED.is_dir():
        pytest.skip("needs ../shared, which is absent on this machine")
    return tomllib.loads((SHARED / "seed" / "published.toml").read_text(encoding="utf-8"))


def test_the_figures_are_the_published_ones(printed: Mapping[str, Any]) -> None:
    asked, earlier = printed["requirements"], printed["earlier_system"]
    first, second = printed["table_5_2"], printed["table_5_3"]
    maps, phantom = printed["homography"], printed["phantom"]
    times_s = [asked[f"{most}_detection_time_s"] for most in ("target", "max")]
    for table, key, known in (
        ("asked", "error_mm", asked["max_error_mm"]),
        ("asked", "reliability", asked["reliability"]),
        ("asked", "time_s", times_s),
        ("earlier_system", "plane_mm", earlier["plane_mm"]),
        ("earlier_system", "average_mm", earlier["average_error_mm"]),
        ("earlier_system", "largest_mm", earlier["max_error_mm"]),
        ("earlier_system", "area_within_mm", earlier["area_within_5mm_mm"]),
        ("test_1", "measured_mm", printed["table_5_1"]["teat_ends_mm"]),
        ("test_1", "triangulated_mm", first["teat_ends_mm"]),
        ("test_1", "average_mm", first["published_average_error_mm"]),
        ("test_1", "largest_mm", first["published_max_error_mm"]),
        ("test_2", "triangulated_mm", second["teat_ends_mm"]),
        ("test_2", "average_mm", second["published_average_error_mm"]),
        ("test_2", "largest_mm", second["published_max_error_mm"]),
        ("homography", "left", maps["left"]),
        ("homography", "right", maps["right"]),
        ("homography", "largest_px", maps["max_error_px"]),
        ("world", "matrix", np.array(printed["world"]["transformation"])[:3, :3]),
        ("stand_off", "stated_mm", phantom["stand_off_mm"]),
        ("arm", "accuracy_mm", printed["microscribe"]["accuracy_mm"]),
        ("bath", "range_c", phantom["bath_setpoint_range_c"]),
    ):
        assert np.array_equal(FIGURES[table][key], known), (table, key)
    known = {
        n: (of["section"], of["found"], of["present"]) for n, of in printed["situations"].items()
    }
    assert known == SITUATIONS


def test_what_is_worked_out_is_what_the_fact_sheet_worked_out(printed: Mapping[str, Any]) -> None:
    derived = printed["derived"]
    measured = FIGURES["test_1"]["measured_mm"]
    first, second = (
        summarise(np.subtract(FIGURES[test]["triangulated_mm"], measured))
        for test in ("test_1", "test_2")
    )
    for value, key in (
        (first.components.bias_mm, "table_5_2_signed_mean_mm"),
        (first.components.mean_abs_mm, "table_5_2_mean_absolute_mm"),
        (first.components.max_abs_mm, "table_5_2_max_absolute_mm"),
        (first.radial.mean_mm, "table_5_2_mean_distance_mm"),
        (first.radial.max_mm, "table_5_2_max_distance_mm"),
        (second.components.mean_abs_mm, "table_5_3_mean_absolute_mm"),
        (second.radial.mean_mm, "table_5_3_mean_distance_mm"),
        (second.radial.max_mm, "table_5_3_max_distance_mm"),
    ):
        assert value == pytest.approx(derived[key], abs=0.0051), key
    assert np.linalg.svd(FIGURES["world"]["matrix"], compute_uv=False) == pytest.approx(
        derived["world_transformation_singular_values"], abs=5e-4
    )
    assert FIGURES["stand_off"]["implied_mm"] == pytest.approx(derived["stand_off_mm"], abs=0.6)


def test_scripts_detector_and_figures_agree() -> None:
    script = load_script(TRIALS / "six-situations.toml").script.published.items()
    assert {name: (one.source, one.found, one.present) for name, one in script} == SITUATIONS
    assert np.array_equal(FIGURES["test_1"]["triangulated_mm"], TEAT_ENDS_MM)
    assert np.array_equal(FIGURES["homography"]["left"], HOMOGRAPHY_LEFT)
    assert np.array_equal(FIGURES["homography"]["right"], HOMOGRAPHY_RIGHT)
    assert np.array_equal(FIGURES["world"]["matrix"], WORLD_MATRIX)


def test_a_script_s_own_figure_goes_before_ours(tmp_path: Path) -> None:
    text = (TRIALS / "six-situations.toml").read_text(encoding="utf-8")
    own = "published = { found = 1, present = 2 }"
    changed = text.replace('published = { found = 4, present = 4, source = "5.2.1" }', own)
    assert own in changed
    (tmp_path / "own.toml").write_text(changed, encoding="utf-8")
    found = published(load_script(tmp_path / "own.toml").script)
    counts = [(found[name].found, found[name].present) for name in ("non_vertical", "overlapping")]
    assert counts == [(1, 2), (3, 4)]


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return load_rig(find_rig(None)).calibration


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory, calibration: Calibration) -> RunRecord:
    """25 places 25 mm apart: within 2 mm in the middle, 9 mm off beyond it, one missed."""
    trials = []
    for number, (x, y) in enumerate(product(range(-50, 51, 25), repeat=2), 1):
        end = np.add(MIDDLE, [x, y, 0.0])[None]
        error = [0.0, 2.0 if max(abs(x), abs(y)) <= 25 else 9.0, 0.0]
        found = end[:0] if (x, y) == (50, 50) else end + error
        trials.append(trial(number, f"plane-{number:03d}", 1, end, found, situation="plane_map"))
    return record(tmp_path_factory.mktemp("plane"), trials)


def test_the_plane_s_figures_are_those_of_its_places(
    plane: RunRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    geometry, theirs = example("thesis_geometry", monkeypatch), FIGURES["earlier_system"]

    def figures(**changes: Any) -> dict[str, tuple[str, ...]]:
        rows = geometry.plane(plane.trials, "fused", theirs | changes)
        return {row[0]: row[1:] for row in rows}

    rows = figures()
    assert rows["plane, across and away"] == ("1.4.3.2", "300 x 275 mm", "", "100 x 100 mm", "")
    assert rows["places of a teat, found"][3] == "25, 24 found"
    # (9 * 2 + 15 * 9) / 24
    average = rows["average error"]
    assert average[:4] == ("1.4.3.2", "11.79 mm", "", "6.38 mm (24 of 25 found)")
    assert rows["largest error"][1:4] == ("more than 15 mm", "", "9.00 mm")
    assert rows["smallest error of a place"][1:4] == ("less than 1 mm", "", "2.00 mm")
    # with six more places, 9 mm off: (9 * 2 + 6 * 9) / 15 = 4.8
    name, region = "largest middle region with an average within {} mm", "75 x 100 mm, 4.80 mm"
    assert rows[name.format(5)][1:4] == ("150 x 80 mm", "", f"{region} (15 of 15 found)")
    assert figures(within_mm=4)[name.format(4)][3].startswith("75 x 75 mm, ")
    assert figures(within_mm=1)[name.format(1)][3] == "none"
    small = figures(area_within_mm=[50.0, 50.0])
    assert small["average in the middle 50 x 50 mm"][3] == "2.00 mm (9 of 9 found)"
    alone = [row[4] for row in geometry.plane(plane.trials[-1:], "fused", theirs)]
    assert alone[2:4] == ["not measured (0 of 1 found)", "not measured"]


def test_a_figure_stands_elsewhere_unless_the_run_has_it(
    plane: RunRecord,
    calibration: Calibration,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    program = example("thesis", monkeypatch)
    monkeypatch.setattr(program, "load_calibration", lambda _: calibration)
    whole = {one["what"]: set(one["shown"]) for one in FIGURES["elsewhere"]}
    for situation, kind in (("mine", ""), ("plane_map", "plane"), ("overlapping", "situations")):
        trials = tuple(replace(t, head={**t.head, "situation": situation}) for t in plane.trials)
        run = replace(plane, trials=trials)
        monkeypatch.setattr(program, "bench", SimpleNamespace(read_run=lambda _, run=run: run))
        program.main(plane.folder)
        figures, *_, last = capsys.readouterr().out.split("\n## ")[1:]
        rows = (line.split(" | ") for line in last.splitlines() if line.startswith("| "))
        assert {row[1] for row in rows} - {"what"} == {
            what for what, shown in whole.items() if kind not in shown
        }
        assert ("average error" in markdown_rows(figures)) == (kind == "plane")
        assert ("teats found, all 1" in markdown_rows(figures)) == (kind == "situations")


ENDS = np.array([[-110.2, 284.2, 134.2], [-161.9, 192.6, 137.6], [-260.6, 267.1, 136.3]])


def test_what_lies_on_the_rounded_end_counts_and_what_lies_beside_it_does_not(
    calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = example("thesis_pictures", monkeypatch)
    seen = project_all(calibration, ENDS)
    left, right, thermal = (np.array(seen[camera]) for camera in ("left", "right", "thermal"))
    # above the end, at the middle of the rounded end, beside the teat; a radius is 13 px
    off = np.array([[0.0, -6.0], [0.0, 12.0], [17.0, 0.0]])
    refined = np.array([[0.0, -18.0], [3.0, 4.0], [0.0, 5.0]])
    extra = [[20.0, 20.0]]  # at no teat
    trace: dict[str, Any] = {"thermal": {}, "edges": {}}
    trace["teat ends"] = {"points_px": [*(thermal + off).tolist(), *extra]}
    for stage, by in {"nominations": off, "ends": refined}.items():
        sides = {"left_px": left, "right_px": right}
        trace[stage] = {side: [*(true + by).tolist(), *extra] for side, true in sides.items()}
    one = trial(1, "a", 1, ENDS, ENDS, situation="spurious_teat")
    one = replace(one, detections=({"detector": "fused", "trace": json.dumps(trace)},))
    found = pictures.pictured(one, "fused", calibration)
    on_end = np.array([end.on_end for end in found.ends])
    np.testing.assert_array_equal(on_end[:, 1], [True, True, False])
    np.testing.assert_array_equal(on_end[:, (2, 4)].all(axis=1), [False, True, True])
    off_px = np.array([end.off for end in found.ends])
    np.testing.assert_allclose(off_px[:, 3], [6.0, 12.0, 17.0])
    np.testing.assert_allclose(off_px[:, 4], [18.0, 5.0, 5.0])
    # the same way in both pictures: across the line of sight, some 0.85 mm a pixel
    assert off_px[2, 5] == pytest.approx(17 * 0.85, abs=1.0)
    in_mm, *in_pictures, moved, astray = pictures.counted([found])
    assert (in_mm, in_pictures[1:3]) == ("3 of 3", ["2 of 3", "2 of 3"])
    assert (moved, astray) == ("4 nearer, 2 farther", 1)  # in either picture
    rows = [row[1:3] for row in pictures.by_teat([found])]
    assert rows == [("1", "1 of 1"), ("2", "1 of 1"), ("3", "1 of 1")]


def test_no_answer_is_no_end_and_other_detectors_have_no_such_score(
    calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures = example("thesis_pictures", monkeypatch)
    one = trial(1, "a", 1, ENDS, ENDS, situation="spurious_teat")
    stages: dict[str, Any] = {"thermal": {}, "edges": {}}
    for trace, there in (
        (stages, True),
        (stages | {"ends": {"left_px": [["a"]]}}, True),
        ({}, False),
    ):
        row = {"detector": "fused", "trace": json.dumps(trace)}
        found = pictures.pictured(replace(one, detections=(row,)), "fused", calibration)
        assert (found is not None) == there
        if found:
            off_px = np.array([end.off for end in found.ends])
            assert np.isnan(off_px).all()
            assert not any(end.on_end.any() for end in found.ends)
    assert pictures.pictured(one, "thesis", calibration) is None

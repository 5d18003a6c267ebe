"""The thesis's figures beside ours: the file of what was published, what is worked out of it, and
the chapter of each test that ships.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.record.reader import RunRecord
from bench.report.thesis import (
    PLANE,
    Kind,
    elsewhere_table,
    errors_of_test_mm,
    largest_region_mm,
    places_of,
    published_counts,
    thesis,
    thesis_parts,
)
from bench.rig.loading import find_rig, load_rig
from bench.scoring.errors import summarise
from bench.script.model import TRIALS, load_script
from detector.calibration.thesis_rig import HOMOGRAPHY_LEFT, HOMOGRAPHY_RIGHT
from reports.page import Cell, Part, Table
from tests.bench.results.test_error_rows import record, trial
from tests.conftest import SHARED
from tests.detector.thesis_fits import TEAT_ENDS_MM, WORLD_MATRIX

MIDDLE = np.array([-185.0, 235.0, 136.0])


@pytest.fixture(scope="module")
def printed() -> Mapping[str, Any]:
    if not SHARED.is_dir():
        pytest.skip("needs ../shared, which is absent on this machine")
    return tomllib.loads((SHARED / "seed" / "published.toml").read_text(encoding="utf-8"))


def text_of(cell: str | Cell) -> str:
    return cell if isinstance(cell, str) else cell.text


BESIDE = "Figures of the thesis beside this run"


def rows_of(parts: Iterable[Part], caption: str = BESIDE) -> dict[str, tuple[str, ...]]:
    """The rows of the table with that caption's start, by their first cell."""
    tables = (part for part in parts if isinstance(part, Table))
    table = next(part for part in tables if part.caption.startswith(caption))
    return {text_of(row[0]): tuple(text_of(cell) for cell in row[1:]) for row in table.rows}


def test_the_figures_are_the_published_ones(printed: Mapping[str, Any]) -> None:
    ours, asked, earlier = thesis(), printed["requirements"], printed["earlier_system"]
    first, second = printed["table_5_2"], printed["table_5_3"]
    maps, phantom = printed["homography"], printed["phantom"]
    for figure, known in (
        (ours.asked.error_mm, asked["max_error_mm"]),
        (ours.asked.reliability, asked["reliability"]),
        (ours.asked.time_s, [asked[f"{most}_detection_time_s"] for most in ("target", "max")]),
        (ours.earlier_system.plane_mm, earlier["plane_mm"]),
        (ours.earlier_system.average_mm, earlier["average_error_mm"]),
        (ours.earlier_system.largest_mm, earlier["max_error_mm"]),
        (ours.earlier_system.area_within_mm, earlier["area_within_5mm_mm"]),
        (ours.test_1.measured_mm, printed["table_5_1"]["teat_ends_mm"]),
        (ours.test_1.triangulated_mm, first["teat_ends_mm"]),
        (ours.test_1.average_mm, first["published_average_error_mm"]),
        (ours.test_1.largest_mm, first["published_max_error_mm"]),
        (ours.test_2.triangulated_mm, second["teat_ends_mm"]),
        (ours.test_2.average_mm, second["published_average_error_mm"]),
        (ours.test_2.largest_mm, second["published_max_error_mm"]),
        (ours.homography.left, maps["left"]),
        (ours.homography.right, maps["right"]),
        (ours.homography.largest_px, maps["max_error_px"]),
        (ours.world.matrix, np.array(printed["world"]["transformation"])[:3, :3]),
        (ours.stand_off.stated_mm, phantom["stand_off_mm"]),
        (ours.arm.accuracy_mm, printed["microscribe"]["accuracy_mm"]),
        (ours.bath.range_c, phantom["bath_setpoint_range_c"]),
    ):
        assert np.array_equal(figure, known)
    known = {
        name: (of["section"], of["found"], of["present"])
        for name, of in printed["situations"].items()
    }
    assert {one.name: (one.section, one.found, one.present) for one in ours.situations} == known


def test_what_is_worked_out_is_what_the_fact_sheet_worked_out(printed: Mapping[str, Any]) -> None:
    figures, derived = thesis(), printed["derived"]
    first, second = (summarise(errors_of_test_mm(figures, number)) for number in (1, 2))
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
    assert np.linalg.svd(figures.world.matrix, compute_uv=False) == pytest.approx(
        derived["world_transformation_singular_values"], abs=5e-4
    )
    assert figures.stand_off.implied_mm == pytest.approx(derived["stand_off_mm"], abs=0.6)


def test_scripts_detector_and_figures_agree() -> None:
    figures = thesis()
    script = load_script(TRIALS / "six-situations.toml").script.published.items()
    known = {one.name: (one.found, one.present, one.section) for one in figures.situations}
    assert {name: (one.found, one.present, one.source) for name, one in script} == known
    assert figures.test_1.triangulated_mm == TEAT_ENDS_MM
    maps = figures.homography
    assert (maps.left, maps.right) == (HOMOGRAPHY_LEFT, HOMOGRAPHY_RIGHT)
    assert figures.world.matrix == WORLD_MATRIX


def test_a_script_s_own_figure_goes_before_ours(tmp_path: Path) -> None:
    text = (TRIALS / "six-situations.toml").read_text(encoding="utf-8")
    own = "published = { found = 1, present = 2 }"
    changed = text.replace('published = { found = 4, present = 4, source = "5.2.1" }', own)
    assert own in changed
    (tmp_path / "own.toml").write_text(changed, encoding="utf-8")
    counts = published_counts(load_script(tmp_path / "own.toml").script)
    assert (counts["non_vertical"], counts["overlapping"]) == ((1, 2), (3, 4))


def test_a_figure_is_said_to_be_elsewhere_unless_the_page_has_it() -> None:
    figures = thesis()
    whole = {text_of(row[1]) for row in elsewhere_table(figures).rows}
    assert len(whole) == len(figures.elsewhere)
    kinds: tuple[Kind, ...] = ("situations", "plane")
    for kind in kinds:
        left_out = whole - {text_of(row[1]) for row in elsewhere_table(figures, kind).rows}
        assert left_out == {one.what for one in figures.elsewhere if kind in one.shown}
        assert left_out


@pytest.fixture(scope="module")
def plane(tmp_path_factory: pytest.TempPathFactory) -> RunRecord:
    """25 places 25 mm apart: within 2 mm in the middle, 9 mm off beyond it, one missed."""
    trials = []
    for number, (x, y) in enumerate(product(range(-50, 51, 25), repeat=2), 1):
        end = np.add(MIDDLE, [x, y, 0.0])[None]
        error = [0.0, 2.0 if max(abs(x), abs(y)) <= 25 else 9.0, 0.0]
        found = end[:0] if (x, y) == (50, 50) else end + error
        trials.append(trial(number, f"plane-{number:03d}", 1, end, found, situation=PLANE))
    return record(tmp_path_factory.mktemp("plane"), trials)


def test_the_plane_s_figures_are_those_of_its_places(plane: RunRecord) -> None:
    places = places_of(plane, "fused")
    assert (places.teats.sum(), places.found.sum()) == (25, 24)
    average_mm = places.average_mm(places.within(100.0, 100.0))
    assert average_mm == pytest.approx((9 * 2.0 + 15 * 9.0) / 24)
    assert places.average_mm(places.within(50.0, 50.0)) == pytest.approx(2.0)
    assert places.sentence(places.within(50.0, 50.0)) == "2.00 mm (9 of 9 found)"
    # with six more places, 9 mm off: (9 * 2 + 6 * 9) / 15 = 4.8
    assert largest_region_mm(places, 5.0) == (75.0, 100.0)
    assert largest_region_mm(places, 4.0) == (75.0, 75.0)
    assert largest_region_mm(places, 1.0) is None


def test_the_plane_has_the_chapter_with_the_earlier_system(plane: RunRecord) -> None:
    rules = load_script(TRIALS / "plane-map.toml").script
    calibration = load_rig(find_rig(None)).calibration
    chapter = thesis_parts(plane, rules, calibration)
    rows = rows_of(chapter)
    section = "1.4.3.2"
    assert rows["average error"][:4] == (section, "11.79 mm", "", "6.38 mm (24 of 25 found)")
    assert rows["largest error"][1:4] == ("more than 15 mm", "", "9.00 mm")
    assert rows["largest middle region with an average within 5 mm"][1:4] == (
        "150 x 80 mm",
        "",
        "75 x 100 mm, 4.80 mm (15 of 15 found)",
    )
    trials = tuple(replace(t, head={**t.head, "situation": "mine"}) for t in plane.trials)
    assert not [*thesis_parts(replace(plane, trials=trials), rules, calibration)]

"""What a report says of how errors spread: ellipsoids of several teats, the map over the places,
trends with tilt, repeats, tolerance.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest

from bench.record.reader import RunRecord
from bench.report.accuracy import accuracy_tables, gage_parts, precision_parts
from bench.report.spread import pose_parts, spread_parts, trend_parts
from bench.report.tables import rates, rates_by_situation
from bench.results.error_rows import ErrorRows, error_rows, pose_places, teat_errors
from reports.page import Cell, Figure, Fold, Paragraph, Part, Table
from tests.bench.results.test_error_rows import ENDS, record, set_ups, touched, trial

POSES = 12
BIAS = np.array([[0.0, 3.0, 0.0], [0.0, 0.0, -1.0]])  # of the two teats


@pytest.fixture
def two_teats(tmp_path: Path) -> RunRecord:
    """Two teats at 12 poses, 3 repeats each; the second is found at the first 4 poses only."""
    rng = np.random.default_rng(7)
    trials = []
    for number in range(3 * POSES):
        pose, repeat = divmod(number, 3)
        ends = np.add(ENDS, [10.0 * pose, 5.0 * pose, 0.0])
        found = ends + BIAS + rng.normal(0, [[0.3, 1.0, 0.3]] * 2)
        found = found if pose < 4 else found[:1]
        trials.append(trial(number + 1, f"map-{pose:02d}", repeat + 1, ends, found))
    return record(tmp_path, trials)


Kind = TypeVar("Kind", Figure, Paragraph, Table)


def message(parts: Sequence[Part], kind: type[Kind], start: str) -> Kind:
    """The part of that kind whose caption or text begins so."""
    folded: list[Part] = [inner for part in parts if isinstance(part, Fold) for inner in part.parts]
    of_kind = [part for part in (*parts, *folded) if isinstance(part, kind)]
    heads = [part.text if isinstance(part, Paragraph) else part.caption for part in of_kind]
    return next(p for p, head in zip(of_kind, heads, strict=True) if head.startswith(start))


def table(parts: Sequence[Part], start: str) -> list[tuple[str, ...]]:
    return [
        tuple(cell.text if isinstance(cell, Cell) else cell for cell in row)
        for row in message(parts, Table, start).rows
    ]


def spread(run: RunRecord) -> list[Part]:
    return list(spread_parts(answered(run), "fused", 5.0, np.eye(3)))


def answered(run: RunRecord) -> RunRecord:
    """With a row for each answer, none of which states a covariance."""
    row = {"detector": "fused", "covariance_mm2": None}
    found = [(row,) * t.scores["fused"].counts.found for t in run.trials]
    rows = zip(run.trials, found, strict=True)
    return replace(run, trials=tuple(replace(t, found=answers) for t, answers in rows))


@pytest.mark.slow
def test_ellipsoids_are_drawn_teat_by_teat_and_say_on_how_many_poses(two_teats: RunRecord) -> None:
    parts = spread(two_teats)
    drawn = message(parts, Figure, "Errors with their 95 % ellipsoids")
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", drawn.svg)
    said = {"teat 1, n = 12", "teat 2, n = 4 (too few)", "world x error (mm)"}
    assert said | {"camera z, depth error (mm)"} <= set(texts)
    alt = "Errors with 95 % ellipsoids by teat. teat 1: 12 poses; teat 2: 4 poses, too few."
    assert drawn.alt == alt
    rows = table(parts, "Ellipsoids of the error")
    poses = {row[0]: row[2] for row in rows[::2]}
    assert poses == {"all teats": "12", "teat 1": "12", "teat 2": "4"}
    assert rows[2][3].split(", ")[1].startswith(("2.", "3."))  # the first teat's bias along y
    assert rows[4][4] == "not measured"


@pytest.mark.weekly
def test_too_many_teats_are_one_cloud(tmp_path: Path) -> None:
    ends = ENDS[0] + 40.0 * np.arange(7)[:, None]
    parts = spread(record(tmp_path, [trial(k, f"p{k}", 1, ends, ends + 0.1) for k in range(1, 7)]))
    drawn = message(parts, Figure, "Errors with their 95 % ellipsoids")
    assert drawn.alt == "Errors with 95 % ellipsoids by teat. 7 teats: 42 poses."


@pytest.mark.slow
def test_the_map_has_a_panel_a_teat_and_counts_the_missed(two_teats: RunRecord) -> None:
    parts = list(pose_parts(two_teats, 5.0))
    drawn = message(parts, Figure, "Error over the plane")
    rows = error_rows(two_teats, "fused")
    places, (first, _) = pose_places(rows), teat_errors(rows)
    worst = max(two_teats.trials[:3], key=lambda trial: trial.scores["fused"].radial_mm[0])
    assert first.worst_trials[0] == worst.id
    assert places[0].worst_mm == pytest.approx(worst.scores["fused"].radial_mm[0])
    beyond = sum(place.worst_mm is not None and place.worst_mm > 5.0 for place in places)
    assert drawn.alt == f"24 places: {16 - beyond} within 5 mm, {beyond} beyond, 8 not found"
    assert "Of a pose's repeats the worst is drawn" in drawn.caption
    texts = re.findall(r"<text[^>]*>([^<]*)</text>", drawn.svg)
    titles = [text for text in texts if text.startswith("teat") or text.endswith(" missed")]
    # the second teat was missed at the fifth pose, first in its first repeat
    assert drawn.facts.links.count("#trial-013") >= 1
    assert titles == ["teat 1", "12 found, 0 missed", "teat 2", "4 found, 8 missed"]
    few = replace(two_teats, trials=two_teats.trials[:9])
    parts = list(pose_parts(few, 5.0))
    text = message(parts, Paragraph, "Error over the places, fused").text
    assert text.endswith("6 places of a teat are no map; 9 are the least.")


def tilted(poses: int, slope: float) -> ErrorRows:
    """One teat at that many poses, a repeat each; z is off by so much a degree, all else is noise."""
    rng = np.random.default_rng(3)
    tilt = np.linspace(0.0, 15.0, poses, dtype=np.float64)
    errors = rng.normal(0, 0.1, (poses, 3)) + np.outer(tilt, [0.0, 0.0, slope])
    names = tuple(f"p{k}" for k in range(poses))
    return ErrorRows(
        places_mm=rng.uniform(-100, 100, (poses, 3)),
        found=np.ones(poses, dtype=np.bool_),
        errors_mm=np.asarray(errors, dtype=np.float64),
        time_s=np.asarray(60.0 * np.arange(poses)[::-1], dtype=np.float64),
        bath_c=np.full(poses, 33.0),
        tilt_deg=tilt,
        poses=names,
        trials=names,
        teats=("1",) * poses,
    )


@pytest.mark.slow
def test_a_trend_with_tilt_is_shown_with_its_slope_and_interval() -> None:
    parts = list(trend_parts(tilted(30, 0.2), "fused"))
    rows = {(row[0], row[1]): row for row in table(parts, "Trends of the error")}
    row = rows["z error", "tilt of the teat (°)"]
    assert float(row[5]) == pytest.approx(0.2, abs=0.01)
    low, high = (float(text) for text in row[6].split(" to "))
    assert low < 0.2 < high
    assert float(row[7]) == pytest.approx(0.2 * 15.0, abs=0.1)
    assert float(row[8]) == pytest.approx(max(abs(low), abs(high)) * 15.0, abs=0.02)
    assert row[-1] == "trend shown"
    assert rows["x error", "tilt of the teat (°)"][-1] == "no trend shown"
    assert rows["any error", "bath temperature (K)"][-1] == "not measured: it hardly varied"
    names = {"x (mm)", "y (mm)", "z (mm)", "time (h)", "tilt of the teat (°)"}
    assert {name for _, name in rows} >= names
    drawn = message(parts, Figure, "What each trend makes")
    assert "z error with tilt of the teat" in drawn.caption


@pytest.mark.slow
def test_no_trend_few_poses_and_unknown_tilts_say_what_they_are() -> None:
    parts = list(trend_parts(tilted(8, 0.0), "fused"))
    part = message(parts, Table, "Trends of the error")
    assert "“No trend shown” doesn't say that there is none" in part.note
    assert "could be up to" in part.note
    assert message(parts, Figure, "What each trend makes").caption.endswith("No trend is shown.")
    (few,) = trend_parts(tilted(4, 0.2), "fused")
    assert isinstance(few, Paragraph)
    assert "teats were found in 4 poses, and 5 are the least" in few.text
    unknown = replace(tilted(10, 0.2), tilt_deg=np.full(10, np.nan))
    last = table(list(trend_parts(unknown, "fused")), "Trends of the error")[-1]
    assert last[1] == "tilt of the teat (°)"
    assert last[-1] == "not measured: it isn't known in this run"


def test_axes_distances_and_tolerance_limits(two_teats: RunRecord) -> None:
    parts = list(accuracy_tables(two_teats, "fused", 5.0, np.eye(3)))
    by_teat = {(row[0], row[1]): row for row in table(parts, "Errors along each axis by teat")}
    assert by_teat["1", "world y"][2:4] == ("12", "36")
    assert float(by_teat["1", "world y"][4]) == pytest.approx(3.0, abs=0.5)
    assert {axis for _, axis in by_teat} >= {"world x", "camera z (depth)"}
    y = next(row for row in table(parts, "Errors along each axis, detector") if row[0] == "world y")
    most = float(y[-2])
    assert y[-1] == ("refused" if most >= 5.33 else "between" if most > 4.67 else "accepted")
    far = {row[0]: row for row in table(parts, "Distance to the teat end")}
    assert set(far) == {"all", "map", "teat 1", "teat 2"}
    gospa = np.mean([t.scores["fused"].gospa_mm for t in two_teats.trials])
    assert float(far["all"][-1]) == pytest.approx(gospa, abs=0.005)
    radial = [d for t in two_teats.trials for d in t.scores["fused"].radial_mm]
    assert float(far["all"][-3]) == pytest.approx(np.sort(radial)[-1], abs=0.005)
    limit, farther = table(parts, "Tolerance limits")
    # k(12; 95/95), ISO 16269-6
    assert limit[2:5] == ("12", "not measured: 59 poses are the least", "2.736")
    assert farther[3] == "not measured: 299 poses are the least"


def test_a_truth_without_a_stated_uncertainty_accepts_no_axis(two_teats: RunRecord) -> None:
    unstated = tuple(
        replace(t, truth=tuple({**row, "u_mm": None} for row in t.truth)) for t in two_teats.trials
    )
    parts = list(accuracy_tables(replace(two_teats, trials=unstated), "fused", 50.0, np.eye(3)))
    assert {row[-1] for row in table(parts, "Errors along each axis, detector")} == {"between"}
    note = message(parts, Table, "Errors along each axis, detector").note
    assert "nothing can be accepted and 50.000 mm or more refused" in note
    assert "noise" not in message(parts, Table, "Distance to the teat end").note


def test_rates_stand_for_each_situation_with_their_intervals(two_teats: RunRecord) -> None:
    half = tuple(
        replace(t, head={**t.head, "situation": "far"}) if t.head["number"] > 12 else t
        for t in two_teats.trials
    )
    run = replace(two_teats, trials=half)
    whole = {row[0]: row for row in table([rates(run, "fused")], "Rates")}
    assert whole["recall, teats"][1:4] == ("48", "72", "66.7 %")
    rows = {row[0]: row for row in table([rates_by_situation(run, "fused")], "Rates by situation")}
    # ends of a scene go together: the poses have the intervals
    assert rows["map"][7].replace("\u00a0", " ") == "4 of 4 (40 to 100 %)"
    assert rows["map"][5].replace("\u00a0", " ") == "24 of 24"
    assert rows["far"][5].replace("\u00a0", " ") == "24 of 48"


def repeated(folder: Path, teats: int, cycles: int) -> RunRecord:
    """Two poses, so many cycles; everything is found 1 mm off in x, with noise of 0.1 mm."""
    rng = np.random.default_rng(5)
    made = []
    for number in range(2 * cycles):
        ends = np.add(ENDS[:teats], [100.0 * (number % 2), 0.0, 0.0])
        found = ends + rng.normal([1.0, 0.0, 0.0], 0.1, (teats, 3))
        made.append(trial(number + 1, f"p{number % 2}", number // 2 + 1, ends, found))
    return record(folder, made)


@pytest.mark.parametrize(("teats", "distance"), [(1, "p0 to p1"), (2, "p0: teat 1 to 2")])
def test_repeats_give_iso_9283_and_iso_5725(tmp_path: Path, teats: int, distance: str) -> None:
    parts = list(precision_parts(repeated(tmp_path, teats, 30), "fused"))
    x, y, _ = table(parts, "Repeatability and reproducibility")
    assert (x[0], x[1], x[2]) == ("world x", str(60 * teats), str(2 * teats))
    assert float(x[3]) == pytest.approx(0.1, rel=0.25)
    assert float(y[5]) == pytest.approx(0.1, rel=0.4)
    poses = table(parts, "Pose accuracy and repeatability")
    assert [(row[0], row[2]) for row in poses[:teats]] == [("p0", "30")] * teats
    assert float(poses[0][3]) == pytest.approx(1.0, abs=0.1)  # AP
    far = {row[0]: row for row in table(parts, "Distance accuracy and repeatability")}
    assert float(far[distance][2]) < 0.1  # AD: both are off by the same
    assert float(far[distance][3]) == pytest.approx(3 * 0.1 * np.sqrt(2), rel=0.35)  # RD


def test_few_repeats_say_what_is_missing(tmp_path: Path, two_teats: RunRecord) -> None:
    parts = list(precision_parts(two_teats, "fused"))
    text = message(parts, Paragraph, "AP, RP, AD and RD").text
    assert "of one teat at one pose there are 3 finds at most, and 10 are the least" in text
    single = list(precision_parts(replace(two_teats, trials=two_teats.trials[::3]), "fused"))
    text = message(single, Paragraph, "Repeatability and reproducibility").text
    assert "no teat was found twice at one pose" in text


def test_the_truth_s_own_gage_study_is_reported(tmp_path: Path) -> None:
    run = set_ups(tmp_path)
    with_arm = replace(run, facts={**run.facts, "identities": {"arm": {}}})
    rows = table(list(gage_parts(with_arm, 5.0)), "Gage R&R")
    assert [row[0] for row in rows] == ["x", "y", "z"]
    assert rows[0][1:4] == ("40", "6", "3")
    assert float(rows[0][4]) == pytest.approx(0.10, rel=0.15)
    assert float(rows[0][5]) == pytest.approx(0.30, rel=0.2)
    assert float(rows[0][8]) == pytest.approx(600.0 * float(rows[0][6]) / 10.0, abs=0.4)
    once = record(tmp_path, [touched("p", 1, 1, np.zeros((3, 3)))])
    (why,) = gage_parts(replace(once, facts={**once.facts, "identities": {"arm": {}}}), 5.0)
    assert isinstance(why, Paragraph)
    assert "repeat the poses, or give a second run" in why.text
    assert list(gage_parts(run, 5.0)) == []

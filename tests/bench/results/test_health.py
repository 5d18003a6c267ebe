"""The bench's health over runs: what is measured of a run, kept, charted and warned of."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from bench.record.reader import RunRecord, read_run
from bench.record.writer import Store
from bench.results import health
from bench.results.health import KEPT, QUANTITIES, RunHealth, charts, history, warnings
from bench.scoring.control_chart import BASE
from tests.bench.small_run import KEPT as RUN

BEGAN = datetime(2026, 9, 1, 8, tzinfo=UTC)


def runs_of(
    values: list[float], key: str = "check_offset_mm", days: float = 2.0
) -> list[RunHealth]:
    began = [(BEGAN + timedelta(days=days * k)).isoformat() for k in range(len(values))]
    return [
        RunHealth(f"run-{k:02d}", began[k], "lab", "real", {key: v}, k)
        for k, v in enumerate(values)
    ]


def test_a_check_point_that_moves_is_said_by_its_rate() -> None:
    rng = np.random.default_rng(4)
    still = 0.2 + rng.normal(0.0, 0.02, BASE)
    moving = 0.2 + np.arange(15) * 2.0 / 7.0 * 0.1 + rng.normal(0.0, 0.02, 15)
    (chart,) = charts(runs_of([*still, *moving]))
    assert chart.trend
    assert chart.trend.a_week == pytest.approx(0.1, abs=0.01)
    assert "check point: off by 0.6" in chart.warning
    assert "it has grown by 0.10 mm a week for 30 days (16 runs)" in chart.warning
    assert any(chart.rules[BASE:])


def test_a_value_beyond_the_limits_is_said_and_few_runs_have_none() -> None:
    rng = np.random.default_rng(5)
    usual = (0.2 + rng.normal(0.0, 0.02, BASE)).tolist()
    (few,) = charts(runs_of([*usual[:-2], 9.0], days=0.1))
    assert (few.limits, few.warning) == (None, "")
    (chart,) = charts(runs_of([*usual, 0.4], days=0.1))
    assert chart.warning.endswith("usually 0.20 mm: beyond 3 standard deviations")
    (age,) = charts(runs_of([float(k) for k in range(30)], "calibration_days"))
    assert (age.limits, age.trend) == (None, None)
    both = runs_of(usual) + [replace(one, rig="other") for one in runs_of(usual)]
    assert [chart.rig for chart in charts(both)] == ["lab (real)", "other (real)"]


def test_a_run_is_read_once_and_anew_where_it_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(RUN, tmp_path / "one")
    (found,) = history(tmp_path)
    assert {"stable_min", "disparity_px", "left_blur_px"} & {*found.values}
    assert all(key in QUANTITIES or key.startswith("found by ") for key in found.values)
    read: list[Path] = []

    def reading(run: Path) -> RunRecord:
        read.append(run)
        return read_run(run)

    monkeypatch.setattr(health, "read_run", reading)
    assert history(tmp_path) == [found]
    assert read == []
    (tmp_path / KEPT).write_text("{", encoding="utf-8")
    assert history(tmp_path) == [found]
    (folder / "run.sqlite").touch()
    assert history(tmp_path)[0].values == found.values
    assert read == [folder, folder]
    assert len(json.loads((tmp_path / KEPT).read_text(encoding="utf-8"))["runs"]) == 1
    shutil.rmtree(folder)
    assert history(tmp_path) == history(tmp_path / "nowhere") == []


def test_a_run_on_a_rig_that_another_script_heated_settles_in_no_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(RUN, tmp_path / "1")
    (alone,) = history(tmp_path)
    run = read_run(RUN)
    warm = replace(run, facts={**run.facts, "asked": {"warm": True}})
    monkeypatch.setattr(health, "read_run", lambda _: warm)
    (tmp_path / KEPT).unlink()
    (found,) = history(tmp_path)
    assert {*alone.values} - {*found.values} == {"stable_min"}


def test_runs_of_another_rig_crowd_out_none_of_this_one(tmp_path: Path) -> None:
    for name in ("1", "2", "3"):
        store = Store(Path(shutil.copytree(RUN, tmp_path / name)))
        if name != "1":
            store.fact("rig", "another")
        store.close()
    assert [one.run for one in history(tmp_path, 1, "operated")] == ["1"]
    assert [one.run for one in history(tmp_path, 1)] == ["1", "3"]
    (tmp_path / KEPT).unlink()
    assert [one.rig for one in history(tmp_path)] == ["operated", "another", "another"]


def test_a_few_sentences_warn_before_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = runs_of([0.2] * BASE + [5.0], days=0.1)
    every = dict.fromkeys(QUANTITIES, 1.0)
    many = [
        replace(one, values={**every, **dict.fromkeys(every, v)})
        for one, v in zip(rows, [0.2] * BASE + [500.0], strict=True)
    ]
    monkeypatch.setattr(health, "history", lambda *_: many)
    said = warnings(Path("runs"), "lab")
    assert len(said) == health.MOST_WARNINGS + 1
    assert (
        said[-1]
        == f"and {len(QUANTITIES) - 1 - health.MOST_WARNINGS} more: see 'teatbench runs runs'"
    )
    assert warnings(Path("runs"), "another") == []

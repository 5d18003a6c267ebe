"""`teatbench runs`: whole, old, damaged and foreign folders side by side."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from errno import ENOSPC
from pathlib import Path
from unittest.mock import patch

import pytest

import bench
from bench.cli.arguments import a_run
from bench.console.watching import listed
from bench.record.reader import read_run
from reports.figures.course import control_chart
from tests.bench.commands import Said
from tests.bench.small_run import KEPT


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    folder = tmp_path / "my runs"
    for name in ("first", "second"):
        shutil.copytree(KEPT, folder / name)
    damaged = shutil.copytree(KEPT, folder / "damaged")
    next(damaged.glob("frames/*/left.png")).unlink()
    (folder / "foreign").mkdir()
    (folder / "cut").mkdir()
    (folder / "cut" / "run.sqlite").write_bytes((KEPT / "run.sqlite").read_bytes()[:5000])
    return folder


@pytest.mark.slow
def test_each_run_is_listed_and_each_other_folder_named(said: Said, runs: Path) -> None:
    text = json.loads(said(0, "runs {} --json", runs).out)
    by_name = {Path(run["folder"]).name: run for run in text["runs"]}
    assert set(by_name) == {"first", "second", "damaged"}
    (good,) = by_name["second"]["results"]
    assert good["detector"] == "fused"
    assert good["verdict"] in ("met", "not met", "inconclusive")
    assert good["found"] <= good["visible"]
    assert by_name["damaged"]["results"][0]["verdict"] == "no verdict"
    assert "left.png" in by_name["damaged"]["damage"][0]
    assert by_name["second"]["damage"] == []
    others = {Path(one["folder"]).name: one["why"] for one in text["others"]}
    assert set(others) == {"cut", "foreign"}
    assert "no run.sqlite" in others["foreign"]
    assert sum(len(one["runs"]) for one in text["history"]) == 3


def test_false_ends_are_counted_where_no_teat_is_visible(
    said: Said, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = bench.list_runs(runs)
    (one,) = found.runs[0].results
    only_false = replace(one, visible=0, found=0, false=2, max_error_mm=None)
    first = replace(found.runs[0], results=(only_false,))
    monkeypatch.setattr(bench, "list_runs", lambda _: replace(found, runs=(first,)))
    assert re.search(r"│ not measured │ +2 │ +not measured │", said(0, "runs {}", runs).out)


@pytest.mark.slow
def test_the_page_stands_alone(said: Said, runs: Path) -> None:
    with patch("bench.report.runs.control_chart", wraps=control_chart) as drawn:
        seen = said(0, "runs {}", runs).out
    first, of_last = drawn.call_args.args[4]
    time, day = first.split("\n")
    assert time == of_last, "a chart of one day: the times of its two ends"
    assert re.fullmatch(r"\d{4}-\d\d-\d\d", day)
    assert re.search(r"3 runs, \d{4}-\d\d-\d\d; (?s:.*)not a run: foreign", seen), "one day, once"
    page = (runs / "index.html").read_text(encoding="utf-8")
    assert f"Page: {runs / 'index.html'}" in seen
    assert page.count("data:image/jpeg;base64,") >= 3
    assert all(src.startswith("data:") for src in re.findall(r'src="([^"]+)"', page))
    assert 'id="health"' in page
    assert "http" not in re.sub(r'http-equiv|xmlns="http://www.w3.org/2000/svg"', "", page)
    said(0, "runs {}", runs)  # its own page is no foreign folder
    assert (runs / "index.html").read_text(encoding="utf-8") == page


def test_of_many_runs_the_last_are_shown_one_by_one(
    said: Said, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = bench.list_runs(runs)
    many = replace(found, runs=(found.runs[0],) * 25)
    monkeypatch.setattr(bench, "list_runs", lambda _: many)
    text = said(0, "runs {}", runs).out
    assert "fused, small: 17 earlier → " in re.sub(r"script: ", "small: ", text)
    assert text.count("→") == 8
    page = (runs / "index.html").read_text(encoding="utf-8")
    (steps,) = re.findall(r'<td class="steps">(.*?)</td>', page, re.DOTALL)
    assert "5 earlier" in steps
    assert steps.count('class="chip ') == 20


@pytest.mark.slow
def test_a_report_that_has_no_room_says_so_once(said: Said, runs: Path) -> None:
    with patch("bench.report.page.write_report", side_effect=OSError(ENOSPC, "full")):
        assert said(3, "report {}", runs / "first").err.count("Make room") == 1


def test_a_folder_without_runs_stays_as_it_was(said: Said, tmp_path: Path) -> None:
    assert said(0, "runs {}", tmp_path).out.endswith("Page: not written: no runs are there\n")
    assert not [*tmp_path.iterdir()]
    assert "is one run" in said(2, "runs {}", KEPT).err


def test_a_run_that_was_given_a_name_is_the_latest_only_if_it_was_begun_last(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = str(read_run(runs / "first").facts["wall_started"])
    monkeypatch.chdir(runs.rename(runs.with_name("runs")).parent)
    later, earlier = Path("runs/20990101-000000-demo"), Path("runs/19990101-000000-demo")
    shutil.copytree("runs/first", earlier)
    assert a_run("latest") == Path("runs/second"), f"begun {begun}"
    assert [card["name"] for card in listed(Path("runs"))][:2] == ["second", "first"]
    shutil.copytree("runs/first", later)
    assert a_run("latest") == later


@pytest.mark.slow
def test_a_run_goes_by_its_name_in_runs(
    said: Said, runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(runs.rename(runs.with_name("runs")).parent)
    for command in ("store check {}", "compare latest {}", "report first --no-pdf --baseline {}"):
        said(0, command, "second")
        wrong = said(2, command, "secnd").err
        assert 'did you mean "second"? runs has second, first, damaged' in wrong
    assert 'did you mean "second"' in said(2, "detect secnd").err

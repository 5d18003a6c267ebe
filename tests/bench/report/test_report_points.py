"""The eleven points of a report (metrology.md, last section), in that of a real run; hostile notes;
the same bytes; baseline and extras.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
import sys
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.config import read_calibration
from bench.record.reader import RunRecord, read_run
from bench.report.page import build_page, stored_rules
from bench.results.verdicts import judge
from reports.render import render
from tests.chromium import chromium
from tests.reports.markup import Document, read

HOSTILE = "<img src=x onerror=alert(1)></td></table><script>alert(2)</script>\"'&"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, short_script: Path) -> Path:
    out = tmp_path_factory.mktemp("points")
    assert main(
        ["run", str(short_script), "--out", str(out), "--detector", "thesis", "--detector", "fused"]
    ) in (0, 1, 4)
    (run,) = out.iterdir()
    return run


@pytest.fixture(scope="module")
def document(folder: Path) -> Document:
    return read((folder / "report" / "index.html").read_text(encoding="utf-8"))


def page_of(run: RunRecord, pictures: Path) -> str:
    rules = stored_rules(run.folder)
    return render(
        build_page(
            run,
            rules,
            judge(run, rules),
            read_calibration(run.folder / "calibration.toml"),
            pictures,
        )
    )


POINTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "1 verdict, reason, next action": (
        "verdict",
        ("Not met", "thesis: Error below 5 mm", "What to do next", "How sure that is"),
    ),
    "2 item and bench": (
        "provenance",
        (
            "Item under test: thesis",
            "Item under test: fused",
            "configuration SHA-256",
            "version, machine",
            "bench's commit",
            "seed",
        ),
    ),
    "3 measurand and source": ("reference", ("Measurand:", "apex")),
    "3 the requirement's source": ("requirements", ("thesis, section 1.4.3",)),
    "4 reference": (
        "reference",
        (
            "Uncertainty budget of the touched truth",
            "The arm before and after the trials",
            "World frame",
        ),
    ),
    "4 the bench's own repeatability": (
        "reference",
        ("Gage R&R of the ground truth: not measured", "repeat the poses"),
    ),
    "5 calibration": ("reference", ("The calibration has no record of who made it",)),
    "6 pose set": ("poses", ("How the poses were chosen", "seed of the script")),
    "6 environment": (
        "environment",
        ("room, of the rig file", "20.00 °C", "teats' surface", "set point"),
    ),
    "7 decision rule": (
        "requirements",
        ("accepted up to 4.", "5 % false acceptance", "exact (Clopper-Pearson)"),
    ),
    "8 counts and rates": (
        "results",
        ("found of visible", "95 % interval", "scene success, poses"),
    ),
    "8 every rate by situation": (
        "results",
        (
            "Rates by situation",
            "hidden count right",
            "no time-out",
            "recall, teats",
            "(3\u00a0to\u00a0100\u00a0%)",
        ),
    ),
    "9 errors along the axes of world and camera": (
        "accuracy",
        ("bias", "sd", "rms", "mean |e|", "world z", "camera x (across)", "by teat"),
    ),
    "9 distances": (
        "accuracy",
        ("median", "p95", "p99", "max", "mm a scene", "The truth's noise alone would show"),
    ),
    "9 limits of each axis and of the population": (
        "accuracy",
        ("Along one axis alone", "Tolerance limits", "59 poses are the least"),
    ),
    "9 ellipsoids of each teat": (
        "accuracy",
        (
            "Errors with their 95 % ellipsoids, fused",
            "next pose's mean error, 95 %",
            "teat 4",
            "Hotelling",
        ),
    ),
    "9 trends": (
        "accuracy",
        (
            "tilt of the teat",
            "bath temperature",
            "time (h)",
            "could be up to",
            "doesn't say that there is none",
        ),
    ),
    "9 map": (
        "poses",
        ("Error over the plane, fused", "24 places", "Each teat has a panel of its own"),
    ),
    "9 repeats": (
        "poses",
        (
            "AP, RP, AD and RD (ISO 9283), fused: not measured",
            "Repeatability and reproducibility (ISO 5725), fused",
        ),
    ),
    "9 detectors against each other": (
        "detectors",
        ("fused against thesis", "exact McNemar", "Success of poses", "|z|"),
    ),
    "9 accuracy": (
        "accuracy",
        ("camera z (depth)", "GOSPA", "Ellipsoids", "Trends", "Limit of what can be reached"),
    ),
    "10 latency": (
        "latency",
        (
            "median",
            "p95",
            "max",
            "above 1 s",
            "above 2 s",
            "first call (cold)",
            "start-up",
            "no answer",
        ),
    ),
    "11 deviations": ("deviations", ("None: every trial of the script was done",)),
    "11 raw data and command": (
        "provenance",
        ("run.sqlite", "trials.csv", "record's digest", "teatbench", "The command that repeats it"),
    ),
}


@pytest.mark.parametrize("point", POINTS)
def test_the_report_has_every_point(document: Document, point: str) -> None:
    chapter, words = POINTS[point]
    said = document.by_id(chapter).text
    assert [word for word in words if word.lower() not in said.lower()] == []


def test_checksums_are_those_of_the_files(folder: Path, document: Document) -> None:
    said = document.by_id("provenance").text
    for name in ("script.toml", "rig.toml", "calibration.toml"):
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() in said, name


def test_raw_data_that_is_linked_is_there(folder: Path, document: Document) -> None:
    links = {value for value in document.values("href") if not value.startswith("#")}
    assert {"../run.sqlite", "trials.csv", "run.json", "junit.xml", "../script.toml"} <= links
    assert [link for link in links if not (folder / "report" / link).is_file()] == []


def test_frames_are_jpeg_and_link_their_originals(folder: Path, document: Document) -> None:
    shown = [element.attributes["src"] for element in document.all("img")]
    assert [src for src in shown if not (folder / "report" / src).is_file()] == []
    frames = [src for src in shown if src.endswith("-left.jpg")]
    assert len(frames) == 6
    assert all((folder / "report" / src).read_bytes()[:2] == b"\xff\xd8" for src in frames)
    assert (
        f"../frames/{frames[0].removeprefix('images/').removesuffix('-left.jpg')}/left.png"
        in document.values("href")
    )


def test_frames_are_of_quality_80(folder: Path, document: Document) -> None:
    """The luminance table of ITU-T T.81, K.1 (16, 11, 12, 14 in zigzag order), scaled as libjpeg
    does: (v (200 - 2 q) + 50) / 100.
    """
    for src in (element.attributes["src"] for element in document.all("img")):
        if src.endswith(".jpg"):
            picture = (folder / "report" / src).read_bytes()
            tables = picture.index(b"\xff\xdb")
            assert list(picture[tables + 5 : tables + 9]) == [6, 4, 5, 6], src


def test_faults_of_cameras_are_told(folder: Path, tmp_path: Path) -> None:
    run = read_run(folder)
    marked = dataclasses.replace(
        run, facts={**run.facts, "camera faults": {"left: frozen": 3}, "retries": {"bath": 2}}
    )
    said = read(page_of(marked, tmp_path)).by_id("deviations").text
    assert "left: frozen: 3 times" in said
    assert "bath: 2 times" in said


def test_hostile_notes_come_out_as_text(folder: Path, tmp_path: Path) -> None:
    run = read_run(folder)
    trials = tuple(
        dataclasses.replace(
            trial,
            head={
                **trial.head,
                "note": HOSTILE,
                "situation": HOSTILE,
                "invalid": HOSTILE if trial.head["number"] == 2 else None,
            },
            detections=tuple(
                {**row, "reason": HOSTILE, "wall_stderr": HOSTILE} for row in trial.detections
            ),
        )
        for trial in run.trials
    )
    events = ({"t_s": 1.0, "kind": HOSTILE, "text": HOSTILE},)
    skipped = ({"trial": HOSTILE, "reason": HOSTILE, "number": 1},)
    hostile = dataclasses.replace(run, trials=trials, events=events, skipped=skipped)
    html = page_of(hostile, tmp_path)
    document = read(html)
    assert document.misplaced == []
    assert "<img src=x" not in html
    assert len(document.all("script")) == 1
    assert HOSTILE in document.by_id("trial-001").text
    assert f"Note: {HOSTILE}" in document.by_id("trial-001").text


def test_the_same_run_gives_the_same_bytes(folder: Path) -> None:
    before = {
        path.name: path.read_bytes() for path in (folder / "report").iterdir() if path.is_file()
    }
    assert main(["report", str(folder)]) in (0, 1, 4)
    after = {
        path.name: path.read_bytes() for path in (folder / "report").iterdir() if path.is_file()
    }
    assert after == before


def test_a_baseline_and_a_single_file(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(folder), "--baseline", str(folder), "--single-file"]) in (0, 1, 4)
    page = read((folder / "report" / "index.html").read_text(encoding="utf-8"))
    said = page.by_id("baseline").text
    assert "Largest error of each scene, now against the baseline" in said
    assert "No scene's outcome changed" in said
    alone = folder / "report" / "single-file.html"
    assert alone.stat().st_size < 20_000_000
    assert not re.search(r'src="(?!data:image/)', alone.read_text(encoding="utf-8"))
    assert main(["report", str(folder)]) in (0, 1, 4)
    capsys.readouterr()


def test_a_pdf_needs_a_browser(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("reports.pdf.find_browser", lambda: None)
    assert main(["report", str(folder), "--pdf"]) == 2
    assert "no Chromium, Chrome or Edge was found" in capsys.readouterr().err


@pytest.mark.browser
def test_a_pdf_is_printed_where_a_browser_is(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TEATBENCH_BROWSER", chromium())
    verdict = main(["report", str(folder), "--no-pdf"])
    printed = folder / "report" / "report.pdf"
    assert not printed.exists()
    assert main(["report", str(folder)]) == verdict
    assert f"PDF: {printed}" in capsys.readouterr().out
    assert b"/Title (Six situations: not met)" in printed.read_bytes()
    assert main(["report", str(folder), "--no-pdf"]) == verdict
    assert not printed.exists()  # an older one doesn't stand beside a newer page


def test_a_browser_that_fails_costs_the_pdf_only(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TEATBENCH_BROWSER", sys.executable)
    assert main(["report", str(folder)]) in (0, 1, 4)
    told = capsys.readouterr()
    assert "Report: " in told.out
    assert re.search(r"no PDF: .*report\.pdf: .* ended with code 2 and printed nothing", told.err)
    assert main(["report", str(folder), "--pdf"]) == 2


@pytest.mark.browser
def test_a_script_of_offsets_is_printed_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "thesis-test-2", "--out", str(tmp_path)]) == 1
    (run,) = tmp_path.iterdir()
    assert not (run / "report" / "report.pdf").exists()
    monkeypatch.setenv("TEATBENCH_BROWSER", chromium())
    assert main(["report", str(run), "--pdf"]) == 1
    assert (run / "report" / "report.pdf").read_bytes().startswith(b"%PDF-")
    capsys.readouterr()

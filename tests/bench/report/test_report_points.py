"""The main job on the emulated rig: what a user gets, and the eleven points of its report
(metrology.md, last section); baseline and extras; in a real browser, from disk
without a network.
"""

from __future__ import annotations

import csv
import dataclasses
import hashlib
import io
import itertools
import json
import re
import shutil
import sys
import tomllib
from collections.abc import Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, expect

from bench.cli.main import main
from bench.config import read_calibration
from bench.record.check import check_record
from bench.record.reader import RunRecord, points_mm, read_run
from bench.report.page import fault_parts
from bench.report.tables import truth_known_mm
from bench.report.trials import trial_part
from bench.results.verdicts import latency_of, scored
from bench.rig.loading import find_rig, load_rig
from bench.run.estimate import ASSUMED, estimate, figures, needs, read_durations, took
from bench.run.start import score_recording
from bench.safety.stability import BathState
from bench.script.model import load_script
from instruments.camera.settings import AUTOMATIC, UNSEEN_SIZE
from tests.bench.calibrate.touched import there
from tests.bench.commands import teatbench
from tests.bench.killed_runs import Silent
from tests.bench.small_run import KEPT
from tests.chromium import chromium, launched, violations, weak_texts, window
from tests.conftest import ROOT, first_trials
from tests.reports.markup import Document, read
from tests.test_thesis_example import example, markdown_rows
from tests.undrawn import undrawn

pytestmark = pytest.mark.slow

DECIDED = (0, 1, 4)
DETECTORS = ["--detector", "thesis", "--detector", "fused"]
PAGES = "page-trials page-accuracy page-truth page-bath page-provenance glossary"


@dataclasses.dataclass(frozen=True)
class Done:
    """The main job: six situations, two detectors, recorded; and what was shown."""

    code: int
    run: RunRecord
    recording: Path
    said: str


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory, short_script: Path) -> Done:
    out, recording = (tmp_path_factory.mktemp(name) / name for name in ("points", "recording"))
    command, quarters = "run {} --out {} --record {} --events {} {}", itertools.count(0.0, 0.25)
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as said:
        # whatever the machine takes
        patch.setattr("bench.results.answers.stopwatch_s", lambda: next(quarters))
        events = recording.with_name("events.jsonl")
        code = teatbench(command, short_script, out, recording, events, DETECTORS)
    (run,) = out.iterdir()
    return Done(code, read_run(run), recording, said.getvalue())


@pytest.fixture(scope="module")
def folder(done: Done) -> Path:
    return done.run.folder


@pytest.fixture(scope="module")
def document(folder: Path) -> Document:
    return read((folder / "report" / "index.html").read_text(encoding="utf-8"))


@pytest.fixture(name="undrawn")
def no_figure_is_looked_at() -> Iterator[None]:
    with undrawn():
        yield


@pytest.fixture(scope="module")
def browser(folder: Path) -> Iterator[Browser]:
    """A browser for all tests of the file, begun when the run is over."""
    with launched() as running:
        yield running


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A small run, for tests that write another report."""
    return Path(shutil.copytree(KEPT, tmp_path / KEPT.name))


def test_the_main_job_is_done_and_the_exit_code_is_the_verdict(done: Done) -> None:
    """The bench comes first at the terminal, and no detector spoils another."""
    table = json.loads((done.run.folder / "report" / "run.json").read_text(encoding="utf-8"))
    assert done.code == {"met": 0, "not met": 1, "inconclusive": 4}[table["verdict"]]
    assert done.run.ending == "finished"
    names = "non_vertical overlapping spurious_teat hot_body_at_base hot_body_at_ends cooler_bodies"
    assert [trial.head["situation"] for trial in done.run.trials] == names.split()
    words = ["The bench works: ", "requirement", "thesis meets ", "fused meets ", "Report: file://"]
    places = [done.said.find(word) for word in words]
    assert -1 not in places
    assert places == sorted(places)
    assert "Verdict: " not in done.said
    found = (scored(done.run, name).success for name in ("thesis", "fused"))
    first, second = (f"{100.0 * one.successes / one.trials:.1f} %" for one in found)
    row = rf"reliability +\W +95 % \W \S+ +{first} +\W \S+ +{second}"
    assert first < second
    assert re.search(row, done.said)
    with (done.run.folder / "report" / "trials.csv").open(encoding="utf-8", newline="") as file:
        lines = [line for line in csv.DictReader(file) if line["detector"] == "thesis"]
    assert [line["trial"] for line in lines] == [trial.id for trial in done.run.trials]
    for line, trial in zip(lines, done.run.trials, strict=True):
        assert int(line["found"]) == trial.scores["thesis"].counts.matched
        assert int(line["found"]) + int(line["missed"]) == int(line["visible"])
    head = done.run.head
    assert head is not None
    page = (done.run.folder / "report" / "index.html").read_text(encoding="utf-8")
    assert head.wall_digest in page
    assert teatbench("store check {} --digest {}", done.run.folder, head.wall_digest) == 0


def test_every_capture_is_in_a_stable_bath_and_the_truth_as_good_as_the_arm(done: Done) -> None:
    assert {trial.head["bath_state"] for trial in done.run.trials} == {BathState.STABLE.value}
    assert all(abs(trial.head["bath_c"] - 33.0) <= 0.15 for trial in done.run.trials)
    assert done.run.bath[0, 1] == pytest.approx(20.0, abs=0.1)
    steps = np.diff(done.run.bath[:, 0])
    assert steps.max() <= 1.5, "watched once a second, also while the arm reads and the stage moves"
    rows = [row for trial in done.run.trials for row in trial.truth]
    distances = np.linalg.norm(points_mm(rows) - [json.loads(r["exact_mm"]) for r in rows], axis=1)
    assert len(rows) == 24
    assert 0.02 < distances.mean() < 0.6
    assert all(0.23 < row["u_mm"] < 0.5 for row in rows)


def test_the_recording_scores_the_same(done: Done, tmp_path: Path) -> None:
    again = read_run(score_recording(done.recording, tmp_path, Silent(), ["thesis"]))
    for one, other in zip(done.run.trials, again.trials, strict=True):
        first, second = (t.scores["thesis"].as_dict() for t in (one, other))
        for wall in ("seconds", "in_time", "success"):
            del first[wall], second[wall]
        assert first == second


def test_a_run_takes_as_long_as_estimated_says_what_is_left_and_teaches_the_next(
    done: Done, short_script: Path
) -> None:
    """Of what is emulated nothing is assumed: the bath is simulated, as by a dry run."""
    rig, script, spent = load_rig(find_rig(None)), load_script(short_script), took(done.run)
    expected = needs(rig, script).time
    minutes = round(expected.total_s / 60)
    assert expected.total_s == pytest.approx(spent["total_s"], rel=0.05)
    assert expected.settling_s == pytest.approx(spent["settling_s"], rel=0.05)
    assert done.said.startswith(f"6 trials, about {minutes} min left of the bench's time. Run fol")
    it_took = f"It took {spent['total_s'] / 60:.0f} min of the bench's time; {minutes} min had been"
    assert it_took in done.said
    lines = done.recording.with_name("events.jsonl").read_bytes().splitlines()
    said = [line for line in map(json.loads, lines) if line["what"] == "doing"]
    doing = [line for line in said if line["t_s"] is not None]
    after = [line for line in doing if "left" not in line]
    assert after == doing[-len(after) :], "from the first second on"
    ends = ["going to safe", "all instruments are safe", "writing the report"]
    assert [line["text"] for line in after] == ends
    for line in doing[: -len(after)]:
        left_min = int(re.sub("less than a", "about 0", line["left"]).split()[1])
        due_min = (spent["total_s"] - line["t_s"]) / 60
        assert left_min == pytest.approx(due_min, abs=0.1 * minutes), line
    waits = [re.findall("waiting for the bath: (.*)", line["text"]) for line in doing]
    waiting = [text for texts in waits for text in texts]
    assert waiting[1].endswith("degC, needs 33 ± 0.15")
    assert any(
        re.fullmatch(r"stable for \d+ of \d+ s; .*K.*, needs .*", text) for text in waiting
    ), waiting
    measured, out = figures(done.run, rig, script, spent), done.run.folder.parent
    assert min(measured["start"], measured["detecting"]) > 0.0
    assert read_durations(out, rig) == pytest.approx(measured)
    first, second = (
        estimate(rig, script, {**ASSUMED, **known}).total_s for known in ({}, measured)
    )
    assert abs(second - spent["total_s"]) < 0.5 * abs(first - spent["total_s"])


@pytest.mark.weekly
def test_another_seed_gives_other_noise(done: Done, short_script: Path, tmp_path: Path) -> None:
    teatbench("run {} --seed 2 --out {}", first_trials(short_script, 1), tmp_path)
    (folder,) = tmp_path.iterdir()
    other = read_run(folder)
    assert repr(done.run.bath[: len(other.bath)]) != repr(other.bath)
    assert repr(done.run.trials[0].touches) != repr(other.trials[0].touches)
    one, two = ((run.folder / run.trials[0].frames[0]["path"]) for run in (done.run, other))
    assert one.read_bytes() != two.read_bytes()


POINTS = tomllib.loads((ROOT / "tests/data/report_points.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("chapter", POINTS)
def test_the_report_has_every_point(document: Document, chapter: str) -> None:
    said = document.by_id(chapter).text.lower()
    assert [words for words in POINTS[chapter] if words.lower() not in said] == []


def test_checksums_and_linked_raw_data_are_those_of_the_files(
    folder: Path, document: Document
) -> None:
    said = document.by_id("provenance").text
    for name in ("script.toml", "rig.toml", "calibration.toml"):
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() in said, name
    links = {value for value in document.values("href") if not value.startswith("#")}
    assert {"../run.sqlite", "trials.csv", "run.json", "junit.xml", "../script.toml"} <= links
    assert [link for link in links if not (folder / "report" / link).is_file()] == []


def test_frames_are_jpeg_of_quality_80_and_link_their_originals(
    folder: Path, document: Document
) -> None:
    """The luminance table of ITU-T T.81, K.1 (16, 11, 12, 14 in zigzag order), scaled as libjpeg
    does: (v (200 - 2 q) + 50) / 100.
    """
    shown = [element.attributes["src"] for element in document.all("img")]
    assert [src for src in shown if not (folder / "report" / src).is_file()] == []
    frames = [src for src in shown if src.endswith(".jpg")]
    assert len(set(frames)) == 6 * 3  # those of four trials on the first page too
    for src in frames:
        picture = (folder / "report" / src).read_bytes()
        assert picture[:2] == b"\xff\xd8"
        tables = picture.index(b"\xff\xdb")
        assert list(picture[tables + 5 : tables + 9]) == [6, 4, 5, 6], src
    trial = frames[0].removeprefix("images/").removesuffix("-left.jpg")
    assert f"../frames/{trial}/left.png" in document.values("href")


def test_frames_that_are_not_copied_are_shown_where_they_lie(folder: Path, tmp_path: Path) -> None:
    run, calibration = read_run(folder), read_calibration(folder / "calibration.toml")
    copied = {run.trials[0].id}
    parts = (trial_part(run, t, calibration, tmp_path, copied=copied) for t in run.trials)
    one, other, *_ = parts
    assert len([image for image in one.images if image.src.startswith("images/")]) == 3
    assert {image.src.startswith("../frames/") for image in other.images} == {True}
    shown = {image.camera: image.shown_as for image in other.images}
    assert shown == {"left": "", "right": "", "thermal": "mirrored", "thesis-edges": "inverted"}


def test_notes_faults_and_what_the_rig_file_allows_are_reported(tmp_path: Path) -> None:
    """That text of others stays text is tried in tests/reports/test_page.py and by command."""
    run = read_run(KEPT)
    noted = dataclasses.replace(run.trials[0], head={**run.trials[0].head, "note": "it leaks"})
    calibration = read_calibration(KEPT / "calibration.toml")
    assert "Note: it leaks" in repr(trial_part(run, noted, calibration, tmp_path, copied=()))
    cameras = {note: f"opencv:0 (V4L2); {note}: exposure = 3" for note in (AUTOMATIC, UNSEEN_SIZE)}
    facts: dict[str, Any] = {"identities": {"cameras": {**cameras, "right": "opencv:1"}}}
    facts |= {"camera faults": {"left: frozen": 3}, "retries": {"bath": 2}}
    facts |= {"frame checks": {"frozen": 5}, "frame checks, session 2": {"frozen": 1, "late": 0}}
    said = repr([*fault_parts(dataclasses.replace(run, facts={**run.facts, **facts}))])
    noted_of = [f"{name}: {who}" for name, who in cameras.items()]
    titles = ["cameras adjust themselves (auto = true)", "picture size may change unnoticed (try)"]
    counted = ["left: frozen: 3 times", "bath: 2 times"]
    counted += ["frozen: 6 pictures looked at", "late: not checked"]
    assert [words for words in (*noted_of, *titles, *counted) if words not in said] == []
    assert "right: opencv:1" not in said


def test_the_six_situations_have_all_the_thesis_figures(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the example `thesis.py`: first the thesis's detector, then the other, then the rig."""
    program = example("thesis", monkeypatch)
    program.main(folder)
    parts = capsys.readouterr().out.split("\n## ")[1:]
    titles = ["The thesis and thesis", "The thesis and fused", "The thesis and the rig"]
    assert [part.splitlines()[0] for part in parts] == [*titles, "Without a counterpart here"]
    figures, judged, refined = parts[0].split("\n\n")[1::2]
    rows = markdown_rows(figures)
    found = {name[13:]: row for name, row in rows.items() if name.startswith("teats found, ")}
    counts = "4 of 4, 3 of 4, 4 of 4, 4 of 4, 0 of 4, 3 of 4, 18 of 24"
    assert ", ".join(row[1] for row in found.values()) == counts
    assert found["hot body at the ends"][3].startswith("0 of 4, ")
    mean = "test 1: mean of the signed components: its “average error”"
    assert rows[mean][:3] == ("5.1.1 and 5.1.3", "0.5 mm", "+0.54 mm (n = 4)")
    assert rows["test 1: mean distance to the teat end"][1:3] == ("", "2.09 mm (n = 4)")
    run = read_run(folder)
    upright = [t for t in run.trials if t.head["situation"] not in ("non_vertical", "overlapping")]
    errors = np.concatenate([t.scores["thesis"].errors_mm for t in upright])
    far = f"{np.linalg.norm(errors, axis=1).max():.2f} mm (n = {len(errors)})"
    assert rows["test 1: largest distance to the teat end"][3] == far
    pool, times = scored(run, "thesis"), latency_of(run, "thesis")
    assert rows["reliability"][3].startswith(f"{pool.success.successes} of {pool.success.trials} ")
    assert rows["largest error"][3] == f"{pool.summary().radial.max_mm:.2f} mm"
    assert rows["time of a detection"][3].startswith(f"p95 {times.percentile_s(95):.3f} s, ")
    cells = markdown_rows(judged)
    assert cells["all 6"][:2] == ("18 of 24", f"{pool.counts.matched} of {pool.counts.visible}")
    in_thermal = int(cells["all 6"][2].split(" of ")[0])
    assert in_thermal > int(cells["all 6"][1].split(" of ")[0])  # in mm
    assert sum(int(row[2].split(" of ")[0]) for row in cells.values()) == 2 * in_thermal
    assert cells["hot body at the ends"][2] == "0 of 4"
    assert {*markdown_rows(refined), "all 6"} == set(cells)
    rig = markdown_rows(parts[2])
    assert rig["camera to table: determinant; singular values"][1:4] == (
        "0.911; 1.000, 0.990, 0.920",
        "",
        "1.000; 1.000, 1.000, 1.000",
    )
    assert rig["distance of the teats from the cameras"][1:3] == ("1750 mm", "1034 to 1137 mm")
    # as the fact sheet has it
    assert "the printed ones: 5.8 px on the mean" in rig["homography from thermal to optical"][3]
    known_mm = truth_known_mm(run)
    assert rig["accuracy of the arm"][3] == f"truth known to {known_mm:.2f} mm in 95 %"
    assert rig["bath"][3].endswith(" °C at the captures")
    assert rig["what one pixel is worth"][3].endswith(" mm of depth (Z² / f B)")
    # other cameras are not held against the printed homographies
    calibration = read_calibration(folder / "calibration.toml")
    other = dataclasses.replace(
        calibration, left=dataclasses.replace(calibration.left, fc=(1300.0, 1300.0))
    )
    mapped, *_ = program.rig(run, other, program.FIGURES)
    assert "printed" not in mapped[4]


@pytest.mark.usefixtures("undrawn")
def test_a_baseline(copy: Path) -> None:
    """It is a look, and the page has the digest of the record that has this look."""
    old = shutil.copytree(copy, copy.with_name("old"))
    before = there(check_record(copy).head)
    assert main(["report", str(copy), "--no-pdf", "--baseline", str(old)]) in DECIDED
    after, text = (
        there(check_record(copy).head),
        (copy / "report" / "index.html").read_text("utf-8"),
    )
    assert after.number > before.number
    assert after.wall_digest in text
    page = read(text)
    said = page.by_id("baseline").text
    assert "Largest error of each scene, now against the baseline" in said
    assert "No scene's outcome changed" in said


@pytest.mark.weekly
@pytest.mark.usefixtures("undrawn")
def test_a_pdf_needs_a_browser_that_prints(
    copy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with monkeypatch.context() as without:
        without.setattr("reports.pdf.find_browser", lambda: None)
        assert main(["report", str(copy), "--pdf"]) == 2
    assert "no Chromium, Chrome or Edge was found" in capsys.readouterr().err
    monkeypatch.setenv("TEATBENCH_BROWSER", sys.executable)
    assert main(["report", str(copy)]) in DECIDED, "costs the PDF only"
    note = capsys.readouterr()
    assert "Report: " in note.out
    assert re.search(r"no PDF: .*report\.pdf: .* ended with code 2 and printed nothing", note.err)
    assert main(["report", str(copy), "--pdf"]) == 2


@pytest.mark.weekly
@pytest.mark.browser
@pytest.mark.usefixtures("undrawn")
def test_a_pdf_is_printed_where_a_browser_is(
    copy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TEATBENCH_BROWSER", chromium())
    printed = copy / "report" / "report.pdf"
    monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes it for a terminal
    verdict = main(["report", str(copy)])
    assert verdict in DECIDED
    said = capsys.readouterr()
    assert f"PDF: {printed}" in said.out
    assert all(bar in said.err for bar in ("writing the report", "printing the PDF"))
    assert b"/Title (Short: met)" in printed.read_bytes()
    assert main(["report", str(copy), "--no-pdf"]) == verdict
    assert not printed.exists()  # an older one doesn't stand beside a newer page


@pytest.mark.browser
def test_the_first_page_is_three_screens_and_its_words_are_few(
    browser: Browser, folder: Path
) -> None:
    """With what is folded closed; pictures of four trials, three views each, and the figures."""
    with window(browser, width=1440, height=900) as seen:
        page = seen.open(folder / "report" / "index.html")
        assert page.evaluate("document.documentElement.scrollHeight") <= 3 * 900
        assert len(page.locator("body").inner_text().split()) <= 700
        expect(page.locator(".look")).to_have_count(4)
        expect(page.locator(".look .shot")).to_have_count(12)
        expect(page.locator("#figures figure")).to_have_count(5)
        page.locator(".look a").first.click()
        expect(page.locator(":target")).to_be_visible()  # its fold has opened
        page.emulate_media(media="print")
        shown = "found => found.filter((one) => one.checkVisibility()).map((one) => one.id)"
        pages = page.locator(".chapter.folded")
        for fragment, named in (("", "page-trials"), ("appendix", PAGES)):
            seen.open(folder / "report" / "index.html", fragment)
            assert " ".join(pages.evaluate_all(shown)) == named


@pytest.mark.browser
@pytest.mark.parametrize(("width", "height"), [(1440, 900), (390, 844)])
def test_the_first_screen_says_what_and_why_and_what_next(
    browser: Browser, folder: Path, width: int, height: int
) -> None:
    with window(browser, width=width, height=height) as seen:
        page = seen.open(folder / "report" / "index.html")
        top = page.locator("#verdict").inner_text().lower()
        assert "emulated instruments" in page.locator("body").inner_text().lower()
        for words in ("not met", "error below 5 mm", "how sure", "fused on 6 frame sets"):
            assert words in top, words
        verdict = ("#top-verdict", "#verdict .why", "#verdict .next dt", "#verdict .next dd")
        for part in ("header .kind", "h1", *verdict):
            box = page.locator(part).bounding_box()
            assert box is not None, part
            assert box["y"] + min(box["height"], 24) <= height, part
        links = page.locator("#verdict .looks a")
        expect(links).to_have_count(3)
        links.first.click()
        expect(page.locator("article.trial.here")).to_be_in_viewport()


@pytest.mark.browser
def test_a_browser_shows_all_of_it_without_a_network(browser: Browser, folder: Path) -> None:
    """Every picture, a trial by its link with its frames, nothing beside a telephone's screen, and
    nothing that axe-core finds.
    """
    with window(browser, width=390, height=800) as seen:
        page = seen.open(folder / "report" / "index.html", "trial-004")
        widths = seen.image_widths()
        assert len(widths) == 6 * 4  # by address: those of the first page are trials' too
        assert sorted(set(widths.values())) == [640, 1360], widths
        part = page.locator("#trial-004")
        expect(part).to_be_in_viewport()
        assert "hot-body-at-base" in part.inner_text()
        assert (part.locator("img").count(), part.locator("svg").count() >= 3) == (4, True)
        first = page.locator("#trial-list .entries a").first
        anchor = str(first.get_attribute("href"))
        first.click()
        expect(page).to_have_url(re.compile(f"{re.escape(anchor)}$"))
        expect(page.locator(anchor)).to_contain_text("missed")
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        results = page.locator("[data-searchable] td.tone-bad")
        ends = "found => found.map((one) => one.getBoundingClientRect().right)"
        assert 0.0 < max(results.evaluate_all(ends)) <= 390.0
        assert violations(page, contrast=False) == []
        assert weak_texts(page) == []
        page.emulate_media(color_scheme="dark")
        assert weak_texts(page) == []
        assert seen.network_requests() == []
        assert not [url for url in seen.requests if url.startswith("http")]
        assert seen.complaints == []

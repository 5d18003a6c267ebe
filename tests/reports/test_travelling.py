"""The PDF of a page: what it says of itself, its pages and links; a browser that hangs or is not
there.
"""

import re
import stat
import sys
import time
import zlib
from pathlib import Path

import pytest
from playwright.sync_api import Browser

from reports.pdf import BROWSER, find_browser, print_pdf, travelling
from reports.render import write_report
from reports.trust import PageError
from tests.chromium import chromium, window
from tests.reports.sample import sample_page
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

A4_PT = (210 / 25.4 * 72, 297 / 25.4 * 72)
LINK = b"/A <</S /URI\n/URI (file:///runs/2026%20one/report/trials.csv)>>"
INFO = (
    b"<</Title (Six)\n/Creator (Mozilla/5.0 \\(X11; Linux x86_64\\)"
    b" HeadlessChrome/156.0.0.0)\n/Producer (Skia/PDF m156)>>"
)


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = tmp_path_factory.mktemp("printed")
    page = write_report(sample_page(folder), folder)
    target = print_pdf(page, folder / "report.pdf", chromium(), PATIENCE_S)
    return target.read_bytes()


def strings(pdf: bytes, key: bytes) -> list[str]:
    """The text strings of a key, ISO 32000-1, 7.9.2.2: as they are, or UTF-16 in hexadecimal."""
    found = re.findall(rb"/" + key + rb" (?:\(((?:[^()\\]|\\.)*)\)|<([0-9A-F]+)>)", pdf)
    coded = (bytes.fromhex(digits.decode()).decode("utf-16") for _, digits in found)
    plain = (re.sub(rb"\\(.)", rb"\1", text).decode() for text, _ in found)
    return [one or other for one, other in zip(coded, plain, strict=True)]


@pytest.mark.browser
def test_it_is_titled_by_the_verdict_signed_and_has_an_outline(printed: bytes) -> None:
    assert len(printed) > 100_000  # with its pictures
    titles = strings(printed, b"Title")
    assert titles[0] == "Six situations: not met"
    assert re.search("Verdict.*not met", titles[1], re.IGNORECASE)
    assert {"Requirements", "Accuracy", "Provenance", "Trial 6"} <= set(titles[2:])
    assert strings(printed, b"Author") == ["teatbench"]
    assert b"HeadlessChrome" not in printed


@pytest.mark.browser
def test_six_trials_take_a_few_sheets_of_a4(printed: bytes) -> None:
    boxes = re.findall(rb"/MediaBox \[([^\]]+)\]", printed)
    assert len(boxes) == len(re.findall(rb"/Type /Page\b", printed))
    assert 5 <= len(boxes) <= 9
    for box in boxes:
        sides = tuple(float(value) for value in box.split())
        assert sides == pytest.approx((0, 0, *A4_PT), abs=1.5)


@pytest.mark.browser
def test_its_links_lead_from_where_it_stands(printed: bytes) -> None:
    assert set(strings(printed, b"URI")) == {"trials.csv", "run.json"}
    packed = re.findall(
        rb"/FlateDecode[^>]*>>\s*stream\r?\n(.*?)\r?\nendstream", printed, re.DOTALL
    )
    streams = (zlib.decompressobj().decompress(data) for data in packed)
    assert b"file:" not in printed + b"".join(streams)


@pytest.mark.browser
def test_nothing_is_cut_off_on_paper_and_a_trial_stays_whole(
    browser: Browser, tmp_path: Path
) -> None:
    """At the width that A4 leaves between its margins, 184 mm, in CSS pixels."""
    wide_px = round(184 / 25.4 * 96)
    with window(browser, width=wide_px, scheme="dark") as seen:
        page = seen.open(write_report(sample_page(tmp_path), tmp_path))
        page.emulate_media(media="print")
        sticking_out = page.evaluate(
            """wide => [...document.querySelectorAll('main *')].filter((e) => e.getClientRects().length && !e.closest('svg')
            && e.getBoundingClientRect().right > wide + 1 && !e.closest('.pane')).map((e) => e.outerHTML.slice(0, 80))""",
            wide_px,
        )
        assert sticking_out == []
        heads = page.evaluate(
            "() => [...document.querySelectorAll('thead')].map((e) => getComputedStyle(e).display)"
        )
        assert set(heads) == {"table-header-group"}
        breaks = page.locator(".trial").first.evaluate("e => getComputedStyle(e).breakInside")
        paper = page.evaluate("() => getComputedStyle(document.body).backgroundColor")
        assert (breaks, paper) == ("avoid", "rgb(255, 255, 255)")
        tall = page.locator(".trial").evaluate_all(
            "found => Math.max(...found.map((e) => e.getBoundingClientRect().height))"
        )
        assert tall < (297 - 30) / 2 / 25.4 * 96  # two on a sheet
        assert page.locator(".tools:visible, .filter:visible, #contents:visible").count() == 0


def test_a_link_gets_its_path_and_the_author_his_place_without_a_byte_more() -> None:
    before = b"%PDF-1.4\n" + INFO + LINK
    after = travelling(before, Path("/runs/2026 one/report"))
    deeper = travelling(before, Path("/runs/2026 one/report/pdf"))
    assert len(after) == len(before)
    assert strings(after, b"URI") == ["trials.csv"]
    assert strings(deeper, b"URI") == ["../trials.csv"]
    assert (strings(after, b"Author"), strings(after, b"Creator")) == (["teatbench"], ["teatbench"])
    assert after.replace(b" ", b"").endswith(b"/URI(trials.csv)>>")
    # what has no room stays as it is
    short = b"/Creator (x) /URI (file:///a)"
    assert travelling(short, Path("/somewhere/else/entirely/deep")) == short


@pytest.mark.skipif(sys.platform == "win32", reason="the browser that hangs is a shell script")
def test_a_browser_that_hangs_is_ended(tmp_path: Path) -> None:
    hanging, pid = tmp_path / "browser", tmp_path / "pid"
    hanging.write_text(f"#!/bin/sh\necho $$ > '{pid}'\nexec sleep 3600\n", encoding="utf-8")
    hanging.chmod(hanging.stat().st_mode | stat.S_IXUSR)
    (tmp_path / "index.html").write_text("<p>x", encoding="utf-8")
    began = time.monotonic()
    said = r"report\.pdf: .*browser could not print it: .* timed out after 2\.0 seconds"
    with pytest.raises(PageError, match=said):
        print_pdf(tmp_path / "index.html", tmp_path / "report.pdf", str(hanging), 2.0)
    assert time.monotonic() - began < 600
    assert not (tmp_path / "report.pdf").exists()
    if pid.exists() and Path("/proc").is_dir():
        assert not (Path("/proc") / pid.read_text(encoding="utf-8").strip()).exists()


def test_a_program_that_prints_nothing_is_reported(tmp_path: Path) -> None:
    target = tmp_path / "report.pdf"
    page = write_report(sample_page(tmp_path), tmp_path)
    said = r"report\.pdf: .* ended with code 2 and printed nothing: .*[Uu]nknown option"
    with pytest.raises(PageError, match=said):
        print_pdf(page, target, sys.executable)
    with pytest.raises(PageError, match="could not print it"):
        print_pdf(page, target, str(tmp_path / "no-such-browser"))


@pytest.mark.weekly
def test_the_environment_may_name_the_browser_or_none(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for named, found in (("", None), (sys.executable, sys.executable), ("/no/such/browser", None)):
        monkeypatch.setenv(BROWSER, named)
        assert find_browser() == found
    monkeypatch.setenv("PATH", str(tmp_path))
    for root in ("ProgramFiles", "ProgramFiles(x86)", "LOCALAPPDATA", BROWSER):
        monkeypatch.delenv(root, raising=False)
    assert find_browser() is None or sys.platform == "darwin"

"""Each kind of page that the bench writes, beside the report's own parts, as a browser shows it:
axe finds nothing, no text is weak in either light, nothing sticks out, no two texts overlap.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

import bench
from bench.results.queue import QueueNote
from tests.bench.calibrate.touched import write_touched
from tests.bench.campaign.test_campaigns_compared import written
from tests.bench.commands import teatbench
from tests.bench.small_run import KEPT
from tests.chromium import Scheme, browser_page, violations, weak_texts
from tests.examples import few

pytestmark = [pytest.mark.browser, pytest.mark.slow]

SCHEMES: tuple[Scheme, ...] = ("light", "dark")
ALL_LAID_OUT = """() => {
 for (const one of document.querySelectorAll('details')) one.open = true;
 for (const one of document.querySelectorAll('.trial')) one.style.contentVisibility = 'visible'; }"""
OVERLAPS = """() => { const boxes = [], found = new Set();
 const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
 while (walk.nextNode()) { const text = walk.currentNode.data.trim(), of = walk.currentNode.parentElement;
  if (!text || of.closest('script, style, title, .skip, .pane, .shot, #contents')) continue;
  const range = document.createRange(); range.selectNodeContents(walk.currentNode);
  for (const box of range.getClientRects()) if (box.width > 2 && box.height > 2) boxes.push([box, text]); }
 boxes.forEach(([a, one], i) => boxes.slice(i + 1, i + 60).forEach(([b, other]) => {
  const wide = Math.min(a.right, b.right) - Math.max(a.left, b.left);
  if (wide > 3 && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 4) found.add(`${one} | ${other}`); }));
 return [...found]; }"""


def runs_in(folder: Path) -> Path:
    for name in ("first", "second"):
        shutil.copytree(KEPT, folder / name)
    return folder


def report(folder: Path) -> Path:
    bench.write_report(runs_in(folder) / "first")
    return folder / "first" / "report" / "index.html"


def runs(folder: Path) -> Path:
    return bench.write_runs_page(bench.list_runs(runs_in(folder)))


def queue(folder: Path) -> Path:
    note = QueueNote.begin(folder, "a rig", ["one", "two", "three"])
    for name in ("first", "second"):
        note.runs(shutil.copytree(KEPT, folder / name))
    note.ends("tripped by interlock cold")
    return bench.write_queue_page(folder)[1]


def comparison(folder: Path) -> Path:
    both = runs_in(folder)
    found = bench.compare_runs([both / "first", both / "second"])
    return bench.write_comparison(found, folder / "page")


def campaigns(folder: Path) -> Path:
    both = (written(folder / "old"), written(folder / "new", 12))
    return bench.write_comparison(bench.compare_campaigns(both), folder / "page")


def world(folder: Path) -> Path:
    points, cameras = write_touched(folder / "points.csv"), folder / "cameras.toml"
    part = bench.read_part(bench.load_rig().calibration_path).part
    bench.write_calibration(part, cameras)
    teatbench("calibrate world {} --cameras {} --out {}", points, cameras, folder / "world.toml")
    return folder / "world.page" / "index.html"


PAGES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "report": (report, "Short"),
    "runs": (runs, "Runs"),
    "queue": (queue, "Queue of 3 scripts"),
    "comparison": (comparison, "Comparison of runs"),
    "campaigns": (campaigns, "Comparison of campaigns"),
    "world": (world, "Calibration of the world"),
}


@pytest.mark.parametrize("kind", few(PAGES, 2))
def test_a_page_of_each_kind_can_be_read_by_everybody(kind: str, tmp_path: Path) -> None:
    make, title = PAGES[kind]
    path = make(tmp_path)
    with browser_page() as seen:
        page = seen.open(path)
        assert page.locator("h1").inner_text() == title
        page.evaluate(ALL_LAID_OUT)
        for width in (1440, 1200, 768, 390):
            page.set_viewport_size({"width": width, "height": 900})
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), width
            assert page.evaluate(OVERLAPS) == [], width
        assert violations(page, contrast=False) == []
        for scheme in SCHEMES:
            page.emulate_media(color_scheme=scheme)
            assert weak_texts(page) == []
        assert seen.complaints == []

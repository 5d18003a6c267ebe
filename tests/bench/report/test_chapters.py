"""Pages of chapters: what they leave out, and what a report with a baseline says of its record."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from bench.record.check import check_record
from bench.report.chapters import sections
from reports.page import Paragraph
from tests.bench.commands import teatbench
from tests.bench.small_run import KEPT


def test_a_chapter_without_a_part_is_left_out() -> None:
    chapters = {"figures": ("Figures", iter(())), "time": ("Time", [Paragraph("2 s")])}
    (only,) = sections(chapters, {"time": "of detections"}, folded=True)
    assert (only.id, only.title, only.folded, only.about) == ("time", "Time", True, "of detections")


@pytest.mark.slow
def test_a_report_with_a_baseline_prints_the_digest_of_the_record_that_has_this_look(
    tmp_path: Path,
) -> None:
    old, new = (shutil.copytree(KEPT, tmp_path / name) for name in ("old", "new"))
    before = check_record(new).head
    teatbench("report {} --baseline {} --no-pdf", new, old)
    after = check_record(new).head
    assert before is not None
    assert after is not None
    assert after.number > before.number
    page = (new / "report" / "index.html").read_text(encoding="utf-8")
    assert after.wall_digest in page

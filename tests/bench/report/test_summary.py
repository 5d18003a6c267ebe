"""What a CI page shows: Markdown that a reader of tables takes apart, of a run and a comparison."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.record.reader import read_run
from bench.report.summary import _plain, of_run
from bench.results.status import Reported, status_of
from bench.results.verdicts import judge, stored_rules
from tests.bench.small_run import KEPT


def tables(text: str) -> list[list[list[str]]]:
    """Rows of cells of each table; all rows of one have as many."""
    found: list[list[list[str]]] = [[]]
    for line in text.splitlines():
        if line.startswith("| "):
            found[-1].append([cell.strip() for cell in line.strip("|").split(" | ")])
        elif found[-1]:
            found.append([])
    for rows in found:
        assert len({len(row) for row in rows}) <= 1
        assert not rows or set(rows[1]) == {"---"}
    return [rows for rows in found if rows]


@pytest.mark.weekly
def test_a_run_and_a_comparison_stand_in_one_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("20261101-120000-old", "20261102-120000-new"):
        shutil.copytree(KEPT, tmp_path / "runs" / name)
    monkeypatch.chdir(tmp_path)
    assert main(["report", "latest", "--no-pdf", "--summary", "summary.md"]) in (0, 1, 4)
    assert "20261102-120000-new/report/index.html" in capsys.readouterr().out
    text = (tmp_path / "summary.md").read_text(encoding="utf-8")
    (rows,) = tables(text)
    assert rows[0] == ["requirement", "limit", "fused"]
    assert {row[0] for row in rows[2:]} >= {"error"}
    assert all(row[2][0] in "✓✕?" for row in rows[2:])
    assert text.startswith("### ")
    assert "Run: 20261102-120000-new" in text
    runs = [str(path) for path in sorted((tmp_path / "runs").iterdir()) if path.is_dir()]
    assert main(["compare", *runs, "--gate", "--summary", "summary.md"]) in (0, 1, 4)
    both = (tmp_path / "summary.md").read_text(encoding="utf-8")
    assert both.startswith(text)
    assert len(tables(both)) == 3
    assert main(["report", "latest", "--no-pdf", "--summary", str(tmp_path)]) == 2


def test_what_the_bench_shows_stands_once_beside_two_detectors() -> None:
    run = read_run(KEPT)
    (own,) = judge(run, stored_rules(KEPT))
    both = (own, replace(own, detector="thesis"))
    made = Reported(KEPT, KEPT, run, both, status_of(run, both))
    detectors, bench = tables(of_run(made))
    assert detectors[0] == ["requirement", "limit", "fused", "thesis"]
    assert [row[0] for row in detectors[2:]] == ["error", "time"]
    assert bench[0] == ["of the bench", "limit", "shown"]
    assert [row[0] for row in bench[2:]] == ["bath"]
    (alone,) = tables(of_run(replace(made, judgements=(own,))))
    assert {row[0] for row in alone[2:]} == {"bath", "error", "time"}


@pytest.mark.parametrize("text", ["a|b", "<script>", "[x](y)", "line\nline", "# head", "`c`"])
def test_nothing_that_was_written_by_others_is_markdown(text: str) -> None:
    found = _plain(text)
    assert "\n" not in found
    assert all(found[at - 1] == "\\" for at, one in enumerate(found) if one in "|<>[]#`")

"""Measured figures in README and docs are those of the committed CSV files; `tests.doc_figures`
says how either is made again.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from bench.report.tables import ALL
from tests.bench.commands import Said
from tests.conftest import ROOT
from tests.doc_figures import (
    FIRST,
    MEASURED,
    PATH_TRACED,
    SUMS,
    TABLES,
    campaign_caption,
    families,
    read,
    rendered,
    standing,
)


def page(path: str) -> str:
    """A page on one line, as its sentences are read."""
    return " ".join((ROOT / path).read_text(encoding="utf-8").split())


@pytest.mark.parametrize(("path", "head", "rows"), TABLES)
def test_a_table_is_that_of_its_csv_file(
    path: str, head: str, rows: Callable[[], Iterator[Sequence[str]]]
) -> None:
    """Where it isn't: correct docs/figures/*.csv, then `python -m tests.doc_figures` writes the
    page.
    """
    assert standing((ROOT / path).read_text(encoding="utf-8"), head) == rendered(head, rows())


def test_the_campaign_adds_up() -> None:
    assert campaign_caption() in page(MEASURED)
    rows = {row["family"]: row for row in read("campaign.csv")}
    for name in (FIRST, ALL):
        one = rows[name]
        assert f"{one['found']} of {one['visible']}, {one['false_teats']} false" in page(
            "docs/detectors.md"
        )
    total, parts = rows.pop(ALL), [row for name, row in rows.items() if name != FIRST]
    for key in SUMS:
        assert sum(int(row[key]) for row in parts) == int(total[key])
    mean = sum(int(row["found"]) * float(row["mean_mm"]) for row in parts) / int(total["found"])
    assert mean == pytest.approx(float(total["mean_mm"]), abs=0.01)
    assert max(float(row["max_mm"]) for row in parts) == float(total["max_mm"])


def test_sentences_on_the_path_traced_frames() -> None:
    ours = families(PATH_TRACED, "fused")[ALL]
    assert ours["false"] == "0"
    note = (
        f"{ours['found']} of {ours['visible']}, nothing false, off by {ours['mean_mm']} mm in the"
        f" mean, p95 {ours['p95_mm']} mm, {ours['max_mm']} mm at most"
    )
    assert note in page("docs/detectors.md")


def test_sentence_on_families_left_out() -> None:
    learned = json.loads((ROOT / "detector/fused/learned.json").read_text(encoding="utf-8"))
    each, made = learned["families left out"].values(), learned["made"]
    visible, found, false = (sum(one[key] for one in each) for key in ("visible", "found", "false"))
    note = f"{found} of {visible} ends, {false} false, of {made['scenes']} scenes"
    assert note in page("docs/detectors.md")


@pytest.mark.slow
def test_the_readmes_command_shows_the_readmes_figures(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On frames that are in the project; errors to 0.05 mm, for other builds of the libraries."""
    monkeypatch.chdir(ROOT)
    text = page("README.md")
    command = re.search(r"teatbench (score tests/data/path_traced .*?) ```", text)
    claim = re.search(
        r"On eleven path-traced frame sets, .*? fused finds (?P<found>\d+ of \d+) visible ends,"
        r" nothing false, (?P<mean>[\d.]+) mm off in the mean and (?P<most>[\d.]+) mm at most;"
        r" the thesis's detector (?P<theirs>\d+), with (?P<false>\d+) false\.",
        text,
    )
    assert command is not None
    assert claim is not None
    out = Said(capsys)(1, f"{command[1]} --out {{}}", tmp_path).out  # the thesis's does not meet
    rows = [[cell.strip() for cell in line.split("|")] for line in out.splitlines()]
    ours, theirs = (row[3:-1] for row in rows if row[1:2] == ["all"])
    assert [ours[0], ours[1], ours[2]] == ["11", claim["found"], "0"]
    middle, _, most = (float(value) for value in ours[3].split(","))
    assert middle == pytest.approx(float(claim["mean"]), abs=0.05)
    assert most == pytest.approx(float(claim["most"]), abs=0.05)
    assert [theirs[1].split()[0], theirs[2]] == [claim["theirs"], claim["false"]]

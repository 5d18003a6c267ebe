"""How many statements of a page chance may make wrong, counted from what the page shows; and how a
number is written.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import bench.report
from bench.report.chapters import sections
from bench.report.statements import note_on_statements
from bench.report.wording import MORE, NOT_MEASURED, formatted, number, shown, spanned
from bench.script.model import Rules
from reports.page import Column, Fold, Paragraph, Section, Table

REPORT = Path(bench.report.__path__[0])
RULES = Rules.model_validate(
    {
        "title": "t",
        "detectors": ["fused"],
        "requirements": [
            {"kind": "success", "name": "s", "rate": 0.95},
            {"kind": "false_teats", "name": "f"},
            {"kind": "time", "name": "aim", "limit_s": 1.0, "statistic": "p95"},
            {"kind": "time", "name": "limit", "limit_s": 1.0, "statistic": "p95", "rate": 0.95},
            {"kind": "bath_in_band", "name": "b", "band_k": 1.0},
        ],
    }
)


def test_decisions_intervals_and_p_values_are_counted_wherever_they_stand() -> None:
    rows = [("a", "1 to 2", "0.04"), ("b", NOT_MEASURED, "0.5"), ("c", "", "")]
    interval = Column("95 % interval, two-sided", "right", "mm")
    deep = Table("deep", (Column("what"), interval, Column("p", hint="chance")), tuple(rows))
    rate = Column("rate", unit="k of n, interval")
    bare = Table("bare", (Column("what"), rate), (("a", "1 of 2 (1 to 99 %)"),))
    section = Section("s", "S", (Fold("more", (deep,)), bare), folded=True)
    made, first = note_on_statements((section,), RULES, 2).items
    # three requirements of each detector, two intervals, two p-values
    assert "makes 10 statements" in made
    assert "6 decisions and bounds, one-sided, 2 intervals, two-sided, 2 p-values" in made
    assert "some 0.5 may be wrong" in made
    assert "the only one planned" in first


def test_a_plan_for_looks_is_said() -> None:
    two = RULES.model_copy(update={"looks": 2})
    assert "first look at these poses, of 2 planned" in note_on_statements((), two, 1).items[1]


@given(st.floats(-1e4, 1e4), st.sampled_from(["", ".0f", ".2f", "+.3f"]))
def test_what_rounds_to_zero_has_no_minus(value: float, form: str) -> None:
    texts = (str(shown(value, form)), spanned([value, value]), number(value, "mm", 1))
    assert not any(re.search(r"-0(\.0*)?(?![.\d])| to ", text) for text in texts)


def test_each_table_is_described_once_and_drawn() -> None:
    """Names in the code are those of the file; formats can be used; a title is text or number."""
    described = tomllib.loads((REPORT / "tables.toml").read_text(encoding="utf-8"))
    code = "".join(path.read_text(encoding="utf-8") for path in REPORT.glob("*.py"))
    assert set(re.findall(r'\btable\(\s*"(\w+)"', code)) == set(described)
    for columns in (one["columns"] for one in described.values()):
        for head in columns if isinstance(columns, list) else described[columns]["columns"]:
            if head != MORE:
                assert len({"text", "number"} & set(head)) == 1
                shown(2 if head.get("form") == "+d" else 2.0, head.get("form", ""))


def test_a_chapter_without_a_part_is_left_out() -> None:
    chapters = {"figures": ("Figures", iter(())), "time": ("Time", [Paragraph("2 s")])}
    (only,) = sections(chapters, {"time": "of detections"}, folded=True)
    assert (only.id, only.title, only.folded, only.about) == ("time", "Time", True, "of detections")


@pytest.mark.parametrize(
    ("value", "form", "text"),
    [
        (-1.77e-5, "+.3g", "-0.0000177"),
        (2.5e-6, "+.3g", "+0.0000025"),
        (0.000263, "+.3g", "+0.000263"),
        (-0.001, ".2f", "0.00"),
        (float("nan"), "+.3g", "+nan"),
    ],
)
def test_a_figure_has_no_exponent(value: float, form: str, text: str) -> None:
    assert formatted(value, form) == text

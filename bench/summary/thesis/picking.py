"""Tests 1 and 2 of section 5.1: known ends triangulated from points picked by hand, as picked and put off on purpose, beside ours.

The thesis averages the signed errors of all components; the same is worked out of our errors, beside what it hides.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from bench.planning.offsets import Outcome
from bench.scoring.points import Floats
from bench.summary.thesis.figures import Statistics, Thesis, errors_of_test_mm, statistics
from bench.summary.wording import number
from reports.page import Column, Table

LAYOUT = "table-5-1"  # whose ends those of the test are
ROWS = (
    ("mean of the signed components: the thesis's “average error” of test 1", "signed_mean"),
    ("mean of the components' amounts: that of test 2", "mean_absolute"),
    ("largest component: its “maximum error”", "largest_absolute"),
    ("mean distance to the teat end", "mean_distance"),
    ("largest distance to the teat end", "largest_distance"),
)


def first_test_table(figures: Thesis, ours: Mapping[str, Floats]) -> Table:
    """Test 1 beside our errors (n, 3) on the same ends, by detector."""
    first = figures.test_1
    printed = {"signed_mean": first.average_mm, "largest_absolute": first.largest_mm}
    of_ours = "In this run the same ends (table 5.1's) were found by a detector, in scenes that have them; n counts ends. " if ours else ""
    return _table(f"Test 1, sections {first.section}: known ends", figures, 1, printed, ours, of_ours + first.wrong)


def second_test_table(figures: Thesis, found: Sequence[Outcome]) -> Table:
    """Test 2 beside ours over all directions of its offsets."""
    second = figures.test_2
    printed = {"mean_absolute": second.average_mm, "largest_absolute": second.largest_mm}
    ours = {"every direction": np.concatenate([one.errors_mm for one in found])}
    return _table(f"Test 2, sections {second.section}: ends put off on purpose", figures, 2, printed, ours, second.wrong)


def components_table(figures: Thesis) -> Table:
    """Both tests teat by teat: errors against table 5.1 as the tables give them, beside those printed in table 5.4."""
    first, second = errors_of_test_mm(figures, 1), errors_of_test_mm(figures, 2)
    columns = (
        Column("teat", "right"),
        *(Column(title, "right", "mm") for title in ("5.2 less 5.1: x, y, z", "distance", "5.3 less 5.1: x, y, z", "distance")),
        Column("table 5.4: x, y, z", "right", "mm, amounts as printed"), Column("differs from its tables in"),
    )  # fmt: skip
    rows = []
    for teat, (plain, off, printed) in enumerate(zip(first, second, figures.test_2.errors_mm, strict=True), 1):
        wrong = [axis for axis, value, told in zip("xyz", off.tolist(), printed, strict=True) if round(abs(value), 1) != told]
        rows.append(
            (str(teat), *_vector(plain), *_vector(off), ", ".join(f"{value:g}" for value in printed), ", ".join(wrong) or "nothing")
        )
    return Table("Tables 5.1 to 5.4, teat by teat", columns, tuple(rows))


def _vector(error_mm: Floats) -> tuple[str, str]:
    return ", ".join(f"{value:+.1f}" for value in error_mm), f"{float(np.linalg.norm(error_mm)):.2f}"


def _table(
    caption: str, figures: Thesis, number_of: int, printed: Mapping[str, float], ours: Mapping[str, Floats], note: str
) -> Table:  # fmt: skip
    theirs = statistics(errors_of_test_mm(figures, 1 if number_of == 1 else 2))
    stats = {name: statistics(errors) for name, errors in ours.items()}
    columns = (
        Column("figure"), Column("printed", "right", "mm"), Column("by its tables", "right", f"mm, n = {theirs.n}"),
        *(Column(f"this run, {name}", "right", f"mm, n = {one.n}") for name, one in stats.items()),
    )  # fmt: skip
    rows = tuple(
        (what, f"{printed[key]:g}" if key in printed else "", _figure(theirs, key), *(_figure(one, key) for one in stats.values()))
        for what, key in ROWS
    )
    return Table(caption, columns, rows, note)


def _figure(of: Statistics, key: str) -> str:
    value = getattr(of, key)
    return number(value) if value is None or key != "signed_mean" else f"{value:+.2f}"

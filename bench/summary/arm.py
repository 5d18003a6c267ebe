"""The report's part on the arm: its table frame, its dated verification, and the checks before and after the trials."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from bench.arm.check import AFTER, BEFORE, CHECK_FACT, location_of, shift_mm
from bench.arm.decision import VERIFICATION_FACT, age_of
from bench.arm.facts import FRAME_FACT
from bench.arm.verification import LocationTest, Verification, from_dict
from bench.record import RunRecord
from bench.summary.tables import key_values
from bench.summary.wording import number
from reports.page import Column, Paragraph, Part, Table

COLUMNS = (
    Column("divot"),
    Column("touches", "right"),
    Column("largest deviation", "right", "mm", hint="from the mean of the touches: articulated location error, ASME B89.4.22"),
    Column("2 sd", "right", "mm"),
    Column("least sphere", "right", "mm", hint="its diameter, the form of ISO 10360-12"),
    Column("swing", "right", "°", hint="largest angle between two stylus directions"),
    Column("shift", "right", "mm", hint="of the mean from the known place"),
)


def arm_parts(run: RunRecord) -> Iterator[Part]:
    """Nothing for frames that came without an arm."""
    if "arm" not in run.facts.get("identities", {}):
        return
    yield _frame(run.facts.get(FRAME_FACT))
    dated = run.facts.get(VERIFICATION_FACT)
    if dated:
        yield from _verification(run, from_dict(dated))
    else:
        yield Paragraph("The rig names no dated verification of the arm ('teatbench arm verify').", tone="warn")
    yield from _checks(run)


def _frame(fact: dict[str, Any] | None) -> Part:
    if fact is None:
        return Paragraph("World frame: the arm's own (the rig names no table frame), so the arm must not be moved on the table.")
    residuals = ", ".join(f"{name} {value:.2f} mm" for name, value in fact["residuals_mm"].items())
    entries: list[tuple[str, object]] = [
        ("file", fact["file"]),
        ("made", fact["made"]),
        ("arm", fact["serial_number"]),
        ("largest residual of a check point", None if fact["residual_mm"] is None else number(fact["residual_mm"], "mm")),
        ("residuals", residuals or None),
        ("om, rad", ", ".join(f"{v:.6f}" for v in fact["om"])),
        ("T, mm", ", ".join(f"{v:.3f}" for v in fact["T"])),
    ]
    return key_values("World frame: the table, X_world = R(om) X_arm + T", entries)


def _verification(run: RunRecord, dated: Verification) -> Iterator[Part]:
    rows = tuple(_row(test, None) for test in dated.locations)
    caption = f"Verification of arm {dated.serial_number} on {dated.made:%Y-%m-%d}, {age_of(dated, run.facts).days} days before the run"
    yield Table(caption, COLUMNS, rows, "The tip in one divot at each distance while wrist and elbow swing.")
    if not dated.lengths:
        yield Paragraph("No calibrated length was measured in it.", tone="warn")
        return
    columns = (Column("direction"), Column("calibrated", "right", "mm"), Column("measured", "right", "mm"), Column("error", "right", "mm"))
    lengths = tuple((t.where, f"{t.calibrated_mm:.3f}", f"{t.measured_mm:.2f}", f"{t.error_mm:+.2f}") for t in dated.lengths)
    note = f"Largest error {number(dated.length_mm, 'mm')}; 2 rms {number(dated.length_two_rms_mm, 'mm')}."
    yield Table("A calibrated length, measured in several directions", columns, lengths, note)


def _checks(run: RunRecord) -> Iterator[Part]:
    facts = {when: run.facts[CHECK_FACT.format(when)] for when in (BEFORE, AFTER) if CHECK_FACT.format(when) in run.facts}
    if not facts:
        yield Paragraph("The arm was not checked before and after the trials: the rig names no check point.", tone="warn")
        return
    rows = tuple(_row(location_of(fact, f"check point, {when} the trials"), shift_mm(fact)) for when, fact in facts.items())
    note = ""
    if len(facts) == 2:
        first, last = (location_of(fact, when).centre_mm for when, fact in facts.items())
        note = f"Between the two the check point moved by {float(np.linalg.norm(last - first)):.2f} mm."
    yield Table("The arm before and after the trials", COLUMNS, rows, note)


def _row(test: LocationTest, shift: float | None) -> tuple[str, ...]:
    figures = (f"{test.largest_mm:.2f}", f"{test.two_sd_mm:.2f}", f"{test.sphere_mm:.2f}", f"{test.swing_deg:.0f}")
    return (test.where, str(test.n), *figures, "" if shift is None else f"{shift:.2f}")

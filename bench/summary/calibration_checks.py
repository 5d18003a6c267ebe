"""The page of a check: an existing calibration against a board seen, or points touched, today.

May not know how any of it was computed; it gets results and says them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.calibrating.checkup import PointsAgain
from bench.summary.calibration_parts import finding_parts, measured_table, provenance_parts
from detector.calibration import Record
from detector.calibration.diagnosis import Finding
from detector.calibration.remeasure import Remeasured
from reports.page import Banner, Column, Page, Section, Table


def check_page(again: Remeasured, findings: Sequence[Finding], record: Record, command: str) -> Page:
    """Of `calibrate check`: an existing calibration against a board seen today."""
    figures = f"spacing {again.spacing_rms_mm:.3f} mm, flatness {again.flatness_rms_mm:.3f} mm, rows {again.epipolar_rms_px:.2f} px"
    sentence = "It still holds." if not findings else "It no longer holds: " + "; ".join(f.name for f in findings) + "."
    banner = Banner(
        kind="computed",
        verdict="met" if not findings else "not met",
        tested=f"An existing calibration on {len(again.views)} views of a board.",
        sentence=sentence,
        confidence=f"Rms: {figures}.",
        next_action="Nothing." if not findings else "Calibrate anew (teatbench calibrate cameras), after looking at what is named below.",
    )
    sections = (
        Section("findings", "What was found wrong", tuple(finding_parts(findings, ()))),
        Section("measured", "The board, measured", (measured_table(again),)),
        Section("provenance", "Provenance", tuple(provenance_parts(record, command))),
    )
    return Page("Check of a calibration", f"checked {record.made}", banner, sections)


def check_points_page(again: PointsAgain, findings: Sequence[Finding], record: Record, command: str) -> Page:
    """Of `calibrate check --points`: an existing calibration against points that the arm touched today."""
    rms = float(np.sqrt(np.mean(np.sum(again.missed_mm**2, axis=1))))
    x, y, z = again.missed_mm.mean(axis=0)
    columns = (Column("point", "right"), *(Column(f"d{axis}", "right", "mm") for axis in "xyz"), Column("expected", "right", "mm"))
    rows = tuple(
        (str(n), *(f"{v:+.2f}" for v in row), f"{expected:.2f}")
        for n, (row, expected) in enumerate(zip(again.missed_mm, again.expected_mm, strict=True), 1)
    )
    table = Table("Measured less touched", columns, rows, note="Expected: root of the summed variances of calibration, pixels and touch.")
    banner = Banner(
        kind="computed",
        verdict="met" if not findings else "not met",
        tested=f"An existing calibration on {len(again.missed_mm)} points that the arm touched.",
        sentence="It still holds." if not findings else "It no longer holds: " + "; ".join(f.name for f in findings) + ".",
        confidence=f"Points are missed by {rms:.2f} mm rms; on the mean by {x:+.2f}, {y:+.2f}, {z:+.2f} mm.",
        next_action="Nothing." if not findings else "Look at what is named below, then make the world's step again (calibrate world).",
    )
    sections = (
        Section("findings", "What was found wrong", tuple(finding_parts(findings, ()))),
        Section("points", "The points, measured", (table,)),
        Section("provenance", "Provenance", tuple(provenance_parts(record, command))),
    )
    return Page("Check of a calibration", f"checked {record.made}", banner, sections)

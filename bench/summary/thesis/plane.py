"""The plane of section 1.4.3.2, in which the system before the thesis's was tested: its error there beside ours.

A region is centred on the plane, as the thesis has it. What was missed has no error: each figure says of how many places it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bench.dependence import error_rows, plane_cells
from bench.record import RunRecord
from bench.scoring.points import Bools, Floats
from bench.summary.thesis.figures import Thesis
from bench.summary.wording import NOT_MEASURED, number
from reports.page import Column, Table

PLANE = "plane_map"  # the situation
STEP_MM = 12.5  # half widths of regions are tried in these steps
SLACK_MM = 3.0  # a touched place lies this near to the one that was meant


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Places (n, 2) mm from the middle of the plane; teats and found (n,) there, and their mean and largest distances, 0 where none."""

    at_mm: Floats
    span_mm: Floats
    teats: Floats
    found: Floats
    mean_mm: Floats
    largest_mm: Floats

    def within(self, width_mm: float, depth_mm: float) -> Bools:
        """Those of the centred region."""
        return np.asarray((np.abs(self.at_mm) <= np.array([width_mm, depth_mm]) / 2.0 + SLACK_MM).all(axis=1), dtype=np.bool_)

    def average_mm(self, of: Bools) -> float | None:
        """The mean distance of all that was found there."""
        found = self.found[of].sum()
        return float((self.mean_mm * self.found)[of].sum() / found) if found else None

    def told(self, of: Bools) -> str:
        """``8.11 mm (of 12 found of 15)``."""
        average = self.average_mm(of)
        counted = f"({self.found[of].sum():.0f} of {self.teats[of].sum():.0f} found)"
        return f"{NOT_MEASURED} {counted}" if average is None else f"{average:.2f} mm {counted}"


def places_of(run: RunRecord, detector: str) -> Places:
    """Of the trials of the plane."""
    rows = error_rows(run, detector, PLANE)
    cells = plane_cells(rows)
    at = np.array([(cell.x_mm, cell.y_mm) for cell in cells], dtype=np.float64).reshape(-1, 2)
    low, high = (at.min(axis=0), at.max(axis=0)) if len(at) else (np.zeros(2), np.zeros(2))
    figures = [(cell.teats, cell.found, cell.mean_mm or 0.0, cell.max_mm or 0.0) for cell in cells]
    return Places(at - (low + high) / 2.0, high - low, *np.array(figures, dtype=np.float64).reshape(-1, 4).T)


def largest_region_mm(places: Places, within_mm: float) -> tuple[float, float] | None:
    """Width and depth of the largest centred region whose average error is within so much; None where none is."""
    best: tuple[float, float] | None = None
    for width in np.arange(0.0, places.span_mm[0] + SLACK_MM, 2.0 * STEP_MM).tolist():
        for depth in np.arange(0.0, places.span_mm[1] + SLACK_MM, 2.0 * STEP_MM).tolist():
            average = places.average_mm(places.within(width, depth))
            if average is not None and average <= within_mm and (best is None or width * depth > best[0] * best[1]):
                best = (width, depth)
    return best


def plane_table(run: RunRecord, figures: Thesis) -> Table:
    """A row a figure."""
    theirs = figures.earlier_system
    ours = [places_of(run, detector) for detector in run.detectors]
    width, depth = theirs.area_within_mm
    lines = [
        ("plane, across and away", _area(theirs.plane_mm), [_area(p.span_mm) for p in ours]),
        ("places of a teat, found", "not printed", [f"{p.teats.sum():.0f}, {p.found.sum():.0f} found" for p in ours]),
        ("average error", f"{theirs.average_mm:g} mm", [p.told(np.ones(len(p.teats), dtype=np.bool_)) for p in ours]),
        ("largest error", f"more than {theirs.largest_mm:g} mm", [number(_largest(p), "mm") for p in ours]),
        ("smallest error", f"less than {theirs.smallest_mm:g} mm", [number(_smallest(p), "mm") for p in ours]),
        (f"average in the middle {width:g} x {depth:g} mm", f"{theirs.within_mm:g} mm", [p.told(p.within(width, depth)) for p in ours]),
        (
            f"largest middle region with an average within {theirs.within_mm:g} mm",
            _area(theirs.area_within_mm),
            [_region(p, theirs.within_mm) for p in ours],
        ),
    ]
    columns = (
        Column("figure"), Column(f"earlier system, section {theirs.section}", "right"),
        *(Column(f"this run, {detector}", "right") for detector in run.detectors),
    )  # fmt: skip
    note = f"The thesis quotes these of the optical-only system that it set out to beat. {theirs.wrong}"
    return Table("Error over the plane of section 1.4.3.2", columns, tuple((what, printed, *told) for what, printed, told in lines), note)


def _largest(places: Places) -> float | None:
    return float(places.largest_mm.max()) if places.found.any() else None


def _smallest(places: Places) -> float | None:
    """Of places, each with the mean of its repeats."""
    return float(places.mean_mm[places.found > 0].min()) if places.found.any() else None


def _region(places: Places, within_mm: float) -> str:
    best = largest_region_mm(places, within_mm)
    return "none" if best is None else f"{_area(best)}, {places.told(places.within(*best))}"


def _area(sides: Sequence[float] | Floats) -> str:
    return f"{sides[0]:.0f} x {sides[1]:.0f} mm"

"""What a run's report says of the calibration that it used: its record with its age, and the limit that it sets at each distance.

May not know how a calibration is made.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.calibration_age import CALIBRATION_FACT
from bench.record import RunRecord
from bench.summary.tables import key_values
from bench.summary.wording import NOT_MEASURED
from detector.calibration import Calibration
from detector.geometry import Array
from reports.page import Column, Paragraph, Part, Table

PIXEL_SD_PX = 0.1  # of a point placed well in a picture, in each coordinate
MOST_ROWS = 6


def record_parts(run: RunRecord) -> Iterator[Part]:
    """Who calibrated the cameras, when and with what; nothing for a run that didn't write it down."""
    fact = run.facts.get(CALIBRATION_FACT)
    if fact is None:
        return
    if fact["made"] is None:
        made_from = " The emulated cameras are made from it." if fact["emulated"] else " Its age is not known."
        yield Paragraph(
            f"The calibration has no record of who made it, when and with what.{made_from}", tone="plain" if fact["emulated"] else "warn"
        )
        return
    age = f"{fact['age_days']} days on the day of the run"
    entries: list[tuple[str, object]] = [("made", fact["made"]), ("age", age), ("by", fact["by"] or None), ("with", fact["with_what"])]
    yield key_values("Calibration", [*entries, *((f"{name} camera", who) for name, who in fact["cameras"].items())])


def limit_parts(run: RunRecord, calibration: Calibration) -> Iterator[Part]:
    """What no detector on this rig and calibration can do better, by the distance of this run's teat ends."""
    ends = np.array([[row["x_mm"], row["y_mm"], row["z_mm"]] for trial in run.trials for row in trial.truth]).reshape(-1, 3)
    if not len(ends):
        yield Paragraph(f"What the geometry allows: {NOT_MEASURED}.")
        return
    yield limit_table(ends, calibration)


def limit_table(ends_mm: Array, calibration: Calibration) -> Table:
    """The limit at world points (n, 3), n > 0, told by distance from the right camera."""
    depth = calibration.world_from_right.inverse().apply(ends_mm)[:, 2]
    per_px = calibration.depth_per_disparity_px_mm(ends_mm)
    own, seen = (_worst_mm(calibration, ends_mm, sd) for sd in (0.0, PIXEL_SD_PX))
    known = calibration.covariance is not None
    edges = np.unique(np.quantile(depth, np.linspace(0.0, 1.0, min(MOST_ROWS, len(depth)) + 1)))
    bins = np.clip(np.searchsorted(edges, depth, side="right") - 1, 0, max(len(edges) - 2, 0))
    rows = []
    for number in np.unique(bins):
        at = bins == number
        texts = (f"{depth[at].min():.0f} to {depth[at].max():.0f}", str(int(at.sum())), f"{per_px[at].max():.1f}")
        rows.append((*texts, f"{own[at].max():.2f}" if known else NOT_MEASURED, f"{seen[at].max():.2f}"))
    columns = (
        Column("distance", "right", "mm"), Column("teat ends", "right"),
        Column("one pixel of disparity", "right", "mm", hint="of depth: Z² / (f B)"),
        Column("calibration alone", "right", "mm", hint="expanded uncertainty (k = 2) of a point, along its worst direction"),
        Column(f"with {PIXEL_SD_PX:g} px noise", "right", "mm", hint="the same with noise of the pixels besides"),
    )  # fmt: skip
    told = "" if known else " This calibration states no uncertainty, so that its own share is not in it."
    note = f"What can be reached on this rig at best: k = 2, worst direction, the farthest of each row.{told}"
    return Table("Limit of what can be reached, by distance from the cameras", columns, tuple(rows), note)


def _worst_mm(calibration: Calibration, ends_mm: Array, pixel_sd_px: float) -> Array:
    """Expanded uncertainty (n,) along each point's worst direction; 0 for a point that a camera can't see."""
    found = np.nan_to_num(calibration.covariance_of(ends_mm, pixel_sd_px))
    return np.asarray(2.0 * np.sqrt(np.clip(np.linalg.eigvalsh(found)[:, -1], 0.0, None)))

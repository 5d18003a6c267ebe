"""The report's tables of accuracy: errors along axes, distances, and what the next pose stays below; pooled, by situation and by teat.

May not judge: the verdict is on the distance, and stands with the requirements. What was never measured is "not measured".
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from math import sqrt

import numpy as np

from bench.dependence import ErrorRows, error_rows
from bench.record import RunRecord
from bench.scoring.errors import AxisSummary, ErrorSummary, summarise
from bench.scoring.limits import acceptance_limit_mm, error_without_noise_mm, refusal_limit_mm
from bench.scoring.points import Floats
from bench.scoring.pool import Pool
from bench.scoring.tolerance import distribution_free_n, normal_k, quantile_bounds
from bench.summary.tables import situations
from bench.summary.wording import NOT_MEASURED, number
from bench.verdicts import scored, truth_u_mm
from reports.page import Cell, Column, Paragraph, Part, Table

MM = ("bias", "sd", "rms", "mean |e|", "max |e|")
DISTANCES = ("mean", "median", "rms", "p95", "p99", "max")
SHARES = (0.95, 0.99)  # of poses, that a tolerance limit covers
CONFIDENCE = 0.95


def accuracy_tables(run: RunRecord, detector: str, limit_mm: float, camera_from_world: Floats) -> Iterator[Part]:
    """All of one detector; ``camera_from_world`` (3, 3) turns into the right camera's axes."""
    pool = scored(run, detector)
    u_mm = truth_u_mm([run], pool, detector)
    yield _axes(pool, detector, limit_mm, u_mm, camera_from_world)
    rows = error_rows(run, detector)
    if len(rows.teat_names) > 1:
        yield _axes_by_teat(rows, detector, camera_from_world)
    yield _distances(run, rows, pool, detector, u_mm)
    yield _tolerance(pool, detector)


def _axes(pool: Pool, detector: str, limit_mm: float, u_mm: float | None, camera_from_world: Floats) -> Table:
    accept = None if u_mm is None else acceptance_limit_mm(limit_mm, u_mm, "axis")
    refuse = refusal_limit_mm(limit_mm, u_mm or 0.0)
    columns = (
        Column("axis"), Column("n", "right"), *(Column(name, "right", "mm") for name in MM),
        Column("max |e| is", hint="against the limit along this axis alone"),
    )  # fmt: skip
    summaries = _six(pool.summary(), pool.summary(camera_from_world))
    rows: list[tuple[str | Cell, ...]] = []
    for name, a in summaries:
        rows.append((name, str(a.n), *_figures(a), _against(a.max_abs_mm, accept, refuse)))
    upto = "nothing can be" if accept is None else f"up to {accept:.3f} mm is"
    known = "u isn't stated" if u_mm is None else f"u = {u_mm:.3g} mm"
    note = (
        "bias² + sd² = rms²; camera axes are the right camera's. "
        f"Along one axis alone {upto} accepted and {refuse:.3f} mm or more refused (T = {limit_mm:g} mm, {known}); "
        "the verdict is on the distance."
    )
    return Table(f"Errors along each axis, detector {detector}", columns, tuple(rows), note)


def _axes_by_teat(rows: ErrorRows, detector: str, camera_from_world: Floats) -> Table:
    columns = (
        Column("teat"), Column("axis"), Column("poses", "right"), Column("n", "right"), *(Column(name, "right", "mm") for name in MM)
    )  # fmt: skip
    lines: list[tuple[str, ...]] = []
    for teat in rows.teat_names:
        own = rows.of_teat(teat)
        poses = str(len(set(own.of_found(own.poses))))
        six = _six(summarise(own.errors_mm), summarise(own.errors_mm, camera_from_world))
        lines += [(teat, name, poses, str(axis.n), *_figures(axis)) for name, axis in six]
    return Table(f"Errors along each axis by teat, detector {detector}", columns, tuple(lines))


def _six(world: ErrorSummary, camera: ErrorSummary) -> list[tuple[str, AxisSummary]]:
    return [
        *((f"world {name}", axis) for name, axis in (("x", world.x), ("y", world.y), ("z", world.z))),
        *((f"camera {name}", axis) for name, axis in (("x (across)", camera.x), ("y (down)", camera.y), ("z (depth)", camera.z))),
    ]


def _figures(axis: AxisSummary) -> Iterator[str]:
    return (number(value) for value in (axis.bias_mm, axis.sd_mm, axis.rms_mm, axis.mean_abs_mm, axis.max_abs_mm))


def _against(largest: float | None, accept: float | None, refuse: float) -> Cell:
    if largest is None:
        return Cell(NOT_MEASURED, "muted")
    if accept is not None and largest <= accept:
        return Cell("accepted", "good")
    return Cell("refused", "bad") if largest >= refuse else Cell("between", "warn")


def _distances(run: RunRecord, rows: ErrorRows, pool: Pool, detector: str, u_mm: float | None) -> Table:
    """Of the found teats, with GOSPA where whole scenes are meant, which charges for the others too."""
    columns = (
        Column("of"), Column("n", "right"), *(Column(title, "right", "mm") for title in DISTANCES),
        Column("GOSPA", "right", "mm a scene", hint="charges missed and false teats too; p = 2, c = the scene's gate"),
    )  # fmt: skip
    scenes = [("all", pool), *((name, scored(run, detector, name)) for name in situations(run))]
    lines = [(name, *_radial(part.summary()), _mm(_gospa(part))) for name, part in scenes]
    if len(rows.teat_names) > 1:
        lines += [(f"teat {teat}", *_radial(summarise(rows.of_teat(teat).errors_mm)), "") for teat in rows.teat_names]
    note = (
        "Distances are over found teats only; GOSPA, which also charges missed and false teats: "
        f"mean {number(_gospa(pool), 'mm')} a scene. Percentiles are observed values.{_without_noise(pool, u_mm)}"
    )
    return Table(f"Distance to the teat end, detector {detector}", columns, tuple(lines), note)


def _without_noise(pool: Pool, u_mm: float | None) -> str:
    """What the truth's own uncertainty adds to what is seen."""
    seen = pool.summary().radial.rms_mm
    if seen is None or not u_mm:
        return ""
    left = error_without_noise_mm(seen, u_mm)
    rest = "the noise explains all that was seen" if left is None else f"without it the rms is {left:.2f} mm"
    return f" The truth's noise alone would show {sqrt(3.0) * u_mm:.2f} mm rms (u = {u_mm:.3g} mm along an axis): {rest}."


def _radial(summary: ErrorSummary) -> tuple[str, ...]:
    r = summary.radial
    return (str(r.n), *(number(value) for value in (r.mean_mm, r.median_mm, r.rms_mm, r.p95_mm, r.p99_mm, r.max_mm)))


def _mm(value: float | None) -> str:
    return NOT_MEASURED if value is None else f"{value:.2f}"


def _gospa(pool: Pool) -> float | None:
    return float(np.mean([score.gospa_mm for score in pool.scores])) if pool.scores else None


def _tolerance(pool: Pool, detector: str) -> Part:
    """One value a pose, its worst: repeats share a pose's error."""
    worst = _worst_of_poses(pool.error_poses, np.linalg.norm(pool.errors_mm, axis=1))
    n = len(worst)
    if n < 2:
        return Paragraph(f"Tolerance limits, {detector}: {NOT_MEASURED}; teats were found in {n} poses, and 2 are the least.")
    columns = (
        Column("covers"), Column("with"), Column("poses", "right"),
        Column("any distribution", "right", "mm", hint="an order statistic of the poses' worst distances (ISO 16269-6)"),
        Column("k", "right"), Column("if they were normal", "right", "mm", hint="mean + k sd of the poses' worst distances"),
    )  # fmt: skip
    lines = []
    for share in SHARES:
        _, upper = quantile_bounds(worst, share, CONFIDENCE)
        k = normal_k(n, share, CONFIDENCE)
        free = f"{upper:.2f}" if upper is not None else f"{NOT_MEASURED}: {distribution_free_n(share, CONFIDENCE)} poses are the least"
        normal = f"{worst.mean() + k * worst.std(ddof=1):.2f}"
        lines.append((f"{100 * share:g} % of poses", f"{100 * CONFIDENCE:g} % confidence", str(n), free, f"{k:.3f}", normal))
    note = "Of poses where teats were found, each with its worst distance. Distances are seldom normal; that column is to compare with."
    return Table(f"Tolerance limits of the distance, detector {detector}", columns, tuple(lines), note)


def _worst_of_poses(poses: Sequence[Hashable], distances: Floats) -> Floats:
    worst: dict[Hashable, float] = {}
    for pose, distance in zip(poses, distances.tolist(), strict=True):
        worst[pose] = max(worst.get(pose, 0.0), distance)
    return np.array(list(worst.values()), dtype=np.float64)

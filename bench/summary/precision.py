"""The report's parts on repeats: ISO 9283 of poses and distances, ISO 5725's components, and the gage study of the truth itself.

What a run can't tell is "not measured", with what it would take. May not judge.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations

import numpy as np

from bench.dependence import ErrorRows, error_rows, run_precision
from bench.gauging import truth_gage
from bench.record import RunRecord
from bench.scoring.gage import GageStudy
from bench.scoring.points import Floats
from bench.scoring.repeatability import Precision, distance_accuracy, drift_mm, pose_accuracy
from bench.summary.wording import NOT_MEASURED, number
from reports.page import Column, Paragraph, Part, Table

CYCLES_FROM = 10  # repeats of a pose: ISO 9283 asks for 30, and fewer than these say nothing
MOST_ROWS = 60
Errors = Mapping[tuple[str, str], Mapping[str, Floats]]  # by pose and teat, then by trial: error and true place, (2, 3)


def precision_parts(run: RunRecord, detector: str) -> Iterator[Part]:
    """All of one detector."""
    rows = error_rows(run, detector)
    yield _components(rows, detector)
    ends = {key: of for key, of in _ends(rows).items() if len(of) >= CYCLES_FROM}
    if not ends:
        most = max((len(of) for of in _ends(rows).values()), default=0)
        told = f"of one teat at one pose there are {most} finds at most, and {CYCLES_FROM} are the least (the standard asks for 30)."
        yield Paragraph(f"AP, RP, AD and RD (ISO 9283), {detector}: {NOT_MEASURED}; {told}")
        return
    yield _poses(ends, detector)
    yield from _distances(ends, detector)


def gage_parts(run: RunRecord, limit_mm: float) -> Iterator[Part]:
    """Repeatability and reproducibility of the ground truth, where ends were touched in several set-ups; nothing without an arm."""
    if "arm" not in run.facts.get("identities", {}):
        return
    found = truth_gage([run])
    if found.studies is None:
        yield Paragraph(f"Gage R&R of the ground truth: {NOT_MEASURED}; {found.why}.")
        return
    columns = (
        Column("axis"), Column("ends", "right"), Column("set-ups", "right"), Column("touches", "right"),
        Column("repeatability", "right", "mm", hint="touch after touch"),
        Column("reproducibility", "right", "mm", hint="set-up after set-up, the interaction with the end included"),
        Column("gage R&R", "right", "mm"), Column("between ends", "right", "mm"),
        Column("of the tolerance", "right", "%", hint="6 gage over the whole width: below 10 % is good, above 30 % not acceptable"),
        Column("ndc", "right", hint="how many sizes of part it can tell apart"),
    )  # fmt: skip
    lines = tuple(_gage_row(axis, study, limit_mm) for axis, study in zip("xyz", found.studies, strict=True))
    left = f" {found.left_out} ends had too few touches or set-ups, and are left out." if found.left_out else ""
    note = (
        "Standard deviations, crossed analysis of variance (AIAG MSA, 4th edition; ISO 22514-7): an end at a pose is a part, a repeat of "
        f"the pose a set-up. The tolerance is ± {limit_mm:g} mm.{left}"
    )
    yield Table("Gage R&R of the ground truth", columns, lines, note)


def _gage_row(axis: str, study: GageStudy, limit_mm: float) -> tuple[str, ...]:
    sizes = (axis, str(study.parts), str(study.appraisers), str(study.repeats))
    figures = (f"{value:.3f}" for value in (study.repeatability, study.reproducibility, study.gage, study.part))
    return (*sizes, *figures, f"{100.0 * study.share_of_tolerance(2.0 * limit_mm):.1f}", str(study.distinct_categories))


def _components(rows: ErrorRows, detector: str) -> Part:
    along = run_precision(rows)
    if along[0].s_r is None:
        return Paragraph(f"Repeatability and reproducibility (ISO 5725), {detector}: {NOT_MEASURED}; no teat was found twice at one pose.")
    columns = (
        Column("axis"), Column("n", "right"), Column("teats at poses", "right"),
        Column("s_r", "right", "mm", hint="repeatability: within a pose"), Column("s_L", "right", "mm", hint="between teats and poses"),
        Column("s_R", "right", "mm", hint="reproducibility: the root of s_r² + s_L²"),
    )  # fmt: skip
    note = "Standard deviations of the error (ISO 5725-2, 7.4.5). A set-up is a teat at a pose; its repeats are taken without a change."
    lines = tuple(_component_row(axis, found) for axis, found in zip(("world x", "world y", "world z"), along, strict=True))
    return Table(f"Repeatability and reproducibility, {detector} (ISO 5725)", columns, lines, note)


def _component_row(axis: str, found: Precision) -> tuple[str, ...]:
    return (axis, str(found.n), str(found.groups), *(number(value, digits=3) for value in (found.s_r, found.s_between, found.s_R)))


def _ends(rows: ErrorRows) -> Errors:
    """What was found, in order of time."""
    found: dict[tuple[str, str], dict[str, Floats]] = {}
    columns = (rows.of_found(rows.poses), rows.of_found(rows.teats), rows.of_found(rows.trials))
    for pose, teat, trial, error, place in zip(*columns, rows.errors_mm, rows.places_mm[rows.found], strict=True):
        found.setdefault((pose, teat), {})[trial] = np.array([error, place])
    return dict(sorted(found.items()))


def _poses(ends: Errors, detector: str) -> Table:
    columns = (
        Column("pose"), Column("teat"), Column("n", "right"),
        Column("AP", "right", "mm"), Column("AP along x", "right", "mm"), Column("along y", "right", "mm"),
        Column("along z", "right", "mm"),
        Column("RP", "right", "mm"), Column("drift of AP", "right", "mm"),
    )  # fmt: skip
    rows = []
    for (pose, teat), of in list(ends.items())[:MOST_ROWS]:
        errors = np.array([end[0] for end in of.values()])
        at = pose_accuracy(errors, np.zeros(3))
        drift = drift_mm(errors, np.zeros(3), max(2, len(errors) // 3))
        along = at.ap_xyz_mm or (None, None, None)
        rows.append((pose, teat, str(at.n), number(at.ap_mm), *(number(value) for value in along), number(at.rp_mm), number(drift)))
    note = "Of what was found, against the truth of the same trial. RP: mean distance from their own mean, and three standard deviations."
    return Table(f"Pose accuracy and repeatability, {detector} (ISO 9283)", columns, tuple(rows), note + _left_out(len(ends)))


def _distances(ends: Errors, detector: str) -> Iterator[Part]:
    """Of two teats in one scene; of one teat between two poses, cycle by cycle."""
    several = len({teat for _, teat in ends}) > 1
    pairs = [(a, b) for a, b in combinations(ends, 2) if (a[0] == b[0] if several else a[1] == b[1])]
    lines = []
    for a, b in pairs[:MOST_ROWS]:
        off = _distance_errors(ends[a], ends[b], same_trial=several)
        if len(off) < CYCLES_FROM:
            continue
        found = distance_accuracy(off, 0.0)
        what = f"{a[0]}: teat {a[1]} to {b[1]}" if several else f"{a[0]} to {b[0]}"
        lines.append((what, str(found.n), number(found.ad_mm), number(found.rd_mm)))
    if not lines:
        yield Paragraph(f"AD and RD (ISO 9283), {detector}: {NOT_MEASURED}; no distance was found {CYCLES_FROM} times.")
        return
    columns = (Column("distance"), Column("n", "right"), Column("AD", "right", "mm"), Column("RD", "right", "mm"))
    note = "The distance found less the true one of the same trials; AD is the amount of its mean, RD three standard deviations."
    yield Table(f"Distance accuracy and repeatability, {detector} (ISO 9283)", columns, tuple(lines), note + _left_out(len(pairs)))


def _distance_errors(a: Mapping[str, Floats], b: Mapping[str, Floats], *, same_trial: bool) -> Floats:
    """Distance found less true distance (n,), of the same trials, or of the k-th of one and the k-th of the other."""
    both = [(a[trial], b[trial]) for trial in a if trial in b] if same_trial else list(zip(a.values(), b.values(), strict=False))
    ends = np.array(both, dtype=np.float64).reshape(-1, 2, 2, 3)  # pair, a or b, error or place
    true = np.linalg.norm(ends[:, 0, 1] - ends[:, 1, 1], axis=1)
    seen = np.linalg.norm(ends.sum(axis=2)[:, 0] - ends.sum(axis=2)[:, 1], axis=1)
    return np.asarray(seen - true)


def _left_out(of: int) -> str:
    return f" The first {MOST_ROWS} of {of}." if of > MOST_ROWS else ""

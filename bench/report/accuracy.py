"""The report's tables of accuracy (axes, distances, tolerance limits) and of repeats: ISO 9283 for
poses and distances, ISO 5725's components, and the gage study of the truth.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from itertools import combinations
from math import sqrt

import numpy as np

from bench.record.reader import RunRecord
from bench.report.tables import situations
from bench.report.wording import NOT_MEASURED, number
from bench.results.error_rows import ErrorRows, error_rows, run_precision, truth_gage
from bench.results.verdicts import scored, truth_u_mm
from bench.scoring.errors import (
    AxisSummary,
    ErrorSummary,
    Floats,
    normal_k,
    quantile_bounds,
    summarise,
)
from bench.scoring.guard_band import (
    axis_acceptance_limit_mm,
    error_without_noise_mm,
    refusal_limit_mm,
)
from bench.scoring.pool import Pool
from bench.scoring.precision import GageStudy, Precision, distance_accuracy, drift_mm, pose_accuracy
from bench.scoring.rates import zero_failure_n
from reports.parts import Cell, Paragraph, Part, Table, columns

MM = ">bias [mm] | >sd [mm] | >rms [mm] | >mean |e| [mm] | >max |e| [mm]"
DISTANCES = ">mean [mm] | >median [mm] | >rms [mm] | >p95 [mm] | >p99 [mm] | >max [mm]"
SHARES = (0.95, 0.99)  # of poses, that a tolerance limit covers
CONFIDENCE = 0.95


def accuracy_tables(
    run: RunRecord, detector: str, limit_mm: float, camera_from_world: Floats
) -> Iterator[Part]:
    """All of one detector; ``camera_from_world`` (3, 3) turns into the right camera's axes."""
    pool = scored(run, detector)
    u_mm = truth_u_mm([run], pool, detector)
    yield _axes(pool, detector, limit_mm, u_mm, camera_from_world)
    rows = error_rows(run, detector)
    if len(rows.teat_names) > 1:
        yield _axes_by_teat(rows, detector, camera_from_world)
    yield _distances(run, rows, pool, detector, u_mm)
    yield _tolerance(pool, detector)


def _axes(
    pool: Pool, detector: str, limit_mm: float, u_mm: float | None, camera_from_world: Floats
) -> Table:
    accept = None if u_mm is None else axis_acceptance_limit_mm(limit_mm, u_mm)
    refuse = refusal_limit_mm(limit_mm, u_mm or 0.0)
    last = "max |e| is # against the limit along this axis alone"
    heads = columns("axis | >n", MM, last)
    summaries = _six(pool.summary(), pool.summary(camera_from_world))
    rows: list[tuple[str | Cell, ...]] = []
    for name, a in summaries:
        rows.append((name, str(a.n), *_figures(a), _against(a.max_abs_mm, accept, refuse)))
    upto = "nothing can be" if accept is None else f"up to {accept:.3f} mm is"
    known = "u isn't stated" if u_mm is None else f"u = {u_mm:.3g} mm"
    note = (
        f"bias² + sd² = rms²; camera axes are the right camera's. Along one axis alone {upto}"
        f" accepted and {refuse:.3f} mm or more refused (T = {limit_mm:g} mm, {known}); the verdict"
        " is on the distance."
    )
    return Table(f"Errors along each axis, detector {detector}", heads, tuple(rows), note)


def _axes_by_teat(rows: ErrorRows, detector: str, camera_from_world: Floats) -> Table:
    heads = columns("teat | axis | >poses | >n", MM)
    lines: list[tuple[str, ...]] = []
    for teat in rows.teat_names:
        own = rows.of_teat(teat)
        poses = str(len(set(own.of_found(own.poses))))
        six = _six(summarise(own.errors_mm), summarise(own.errors_mm, camera_from_world))
        lines += [(teat, name, poses, str(axis.n), *_figures(axis)) for name, axis in six]
    return Table(f"Errors along each axis by teat, detector {detector}", heads, tuple(lines))


def _six(world: ErrorSummary, camera: ErrorSummary) -> list[tuple[str, AxisSummary]]:
    return [
        *(
            (f"world {name}", axis)
            for name, axis in (("x", world.x), ("y", world.y), ("z", world.z))
        ),
        *(
            (f"camera {name}", axis)
            for name, axis in (
                ("x (across)", camera.x),
                ("y (down)", camera.y),
                ("z (depth)", camera.z),
            )
        ),
    ]


def _figures(axis: AxisSummary) -> Iterator[str]:
    return (
        number(value)
        for value in (axis.bias_mm, axis.sd_mm, axis.rms_mm, axis.mean_abs_mm, axis.max_abs_mm)
    )


def _against(largest: float | None, accept: float | None, refuse: float) -> Cell:
    if largest is None:
        return Cell(NOT_MEASURED, "muted")
    if accept is not None and largest <= accept:
        return Cell("accepted", "good")
    return Cell("refused", "bad") if largest >= refuse else Cell("between", "warn")


def _distances(
    run: RunRecord, rows: ErrorRows, pool: Pool, detector: str, u_mm: float | None
) -> Table:
    """Of the found teats; GOSPA of whole scenes charges for the others too."""
    heads = columns(
        "of | >n",
        DISTANCES,
        ">GOSPA [mm a scene] # charges missed and false teats too; p = 2, c = the scene's gate",
    )
    scenes = [("all", pool), *((name, scored(run, detector, name)) for name in situations(run))]
    lines = [(name, *_radial(part.summary()), _mm(_gospa(part))) for name, part in scenes]
    if len(rows.teat_names) > 1:
        lines += [
            (f"teat {teat}", *_radial(summarise(rows.of_teat(teat).errors_mm)), "")
            for teat in rows.teat_names
        ]
    note = (
        "Distances are over found teats only; GOSPA, which also charges missed and false teats:"
        f" mean {number(_gospa(pool), 'mm')} a scene. Percentiles are observed"
        f" values.{_without_noise(pool, u_mm)}"
    )
    return Table(f"Distance to the teat end, detector {detector}", heads, tuple(lines), note)


def _without_noise(pool: Pool, u_mm: float | None) -> str:
    """What the truth's own uncertainty adds to what is seen."""
    seen = pool.summary().radial.rms_mm
    if seen is None or not u_mm:
        return ""
    left = error_without_noise_mm(seen, u_mm)
    rest = (
        "the noise explains all that was seen"
        if left is None
        else f"without it the rms is {left:.2f} mm"
    )
    return (
        f" The truth's noise alone would show {sqrt(3.0) * u_mm:.2f} mm rms (u = {u_mm:.3g} mm"
        f" along an axis): {rest}."
    )


def _radial(summary: ErrorSummary) -> tuple[str, ...]:
    r = summary.radial
    return (
        str(r.n),
        *(
            number(value)
            for value in (r.mean_mm, r.median_mm, r.rms_mm, r.p95_mm, r.p99_mm, r.max_mm)
        ),
    )


def _mm(value: float | None) -> str:
    return NOT_MEASURED if value is None else f"{value:.2f}"


def _gospa(pool: Pool) -> float | None:
    return float(np.mean([score.gospa_mm for score in pool.scores])) if pool.scores else None


def _tolerance(pool: Pool, detector: str) -> Part:
    """One value a pose, its worst: repeats share a pose's error."""
    worst = _worst_of_poses(pool.error_poses, np.linalg.norm(pool.errors_mm, axis=1))
    n = len(worst)
    if n < 2:
        return Paragraph(
            f"Tolerance limits, {detector}: {NOT_MEASURED}; teats were found in {n} poses, and 2"
            " are the least."
        )
    heads = columns(
        "covers | with | >poses",
        ">any distribution [mm] # an order statistic of the poses' worst distances (ISO 16269-6)",
        ">k",
        ">if they were normal [mm] # mean + k sd of the poses' worst distances",
    )
    lines = []
    for share in SHARES:
        _, upper = quantile_bounds(worst, share, CONFIDENCE)
        k = normal_k(n, share, CONFIDENCE)
        free = (
            f"{upper:.2f}"
            if upper is not None
            else f"{NOT_MEASURED}: {zero_failure_n(share, CONFIDENCE)} poses are the least"
        )
        normal = f"{worst.mean() + k * worst.std(ddof=1):.2f}"
        lines.append(
            (
                f"{100 * share:g} % of poses",
                f"{100 * CONFIDENCE:g} % confidence",
                str(n),
                free,
                f"{k:.3f}",
                normal,
            )
        )
    note = (
        "Of poses where teats were found, each with its worst distance. Distances are seldom"
        " normal; that column is to compare with."
    )
    return Table(
        f"Tolerance limits of the distance, detector {detector}", heads, tuple(lines), note
    )


def _worst_of_poses(poses: Sequence[Hashable], distances: Floats) -> Floats:
    worst: dict[Hashable, float] = {}
    for pose, distance in zip(poses, distances.tolist(), strict=True):
        worst[pose] = max(worst.get(pose, 0.0), distance)
    return np.array(list(worst.values()), dtype=np.float64)


CYCLES_FROM = 10  # repeats of a pose: ISO 9283 asks for 30, and fewer than these say nothing
MOST_ROWS = 60
# by pose and teat, then by trial: error and true place, (2, 3)
Errors = Mapping[tuple[str, str], Mapping[str, Floats]]


def precision_parts(run: RunRecord, detector: str) -> Iterator[Part]:
    """All of one detector."""
    rows = error_rows(run, detector)
    yield _components(rows, detector)
    ends = {key: of for key, of in _ends(rows).items() if len(of) >= CYCLES_FROM}
    if not ends:
        most = max((len(of) for of in _ends(rows).values()), default=0)
        told = (
            f"of one teat at one pose there are {most} finds at most, and {CYCLES_FROM} are the"
            " least (the standard asks for 30)."
        )
        yield Paragraph(f"AP, RP, AD and RD (ISO 9283), {detector}: {NOT_MEASURED}; {told}")
        return
    yield _poses(ends, detector)
    yield from _distance_parts(ends, detector)


def gage_parts(run: RunRecord, limit_mm: float) -> Iterator[Part]:
    """Gage R&R of a truth that was touched in several set-ups; nothing without an arm."""
    if "arm" not in run.facts.get("identities", {}):
        return
    found = truth_gage([run])
    if found.studies is None:
        yield Paragraph(f"Gage R&R of the ground truth: {NOT_MEASURED}; {found.why}.")
        return
    heads = columns(
        "axis | >ends | >set-ups | >touches",
        ">repeatability [mm] # touch after touch",
        ">reproducibility [mm] # set-up after set-up, the interaction with the end included",
        ">gage R&R [mm] | >between ends [mm]",
        (
            ">of the tolerance [%] # 6 gage over the whole width: below 10 % is good, above 30 %"
            " not acceptable"
        ),
        ">ndc # how many sizes of part it can tell apart",
    )
    lines = tuple(
        _gage_row(axis, study, limit_mm) for axis, study in zip("xyz", found.studies, strict=True)
    )
    left = (
        f" {found.left_out} ends had too few touches or set-ups, and are left out."
        if found.left_out
        else ""
    )
    note = (
        "Standard deviations, crossed analysis of variance (AIAG MSA, 4th edition; ISO 22514-7):"
        " an end at a pose is a part, a repeat of the pose a set-up. The tolerance is ±"
        f" {limit_mm:g} mm.{left}"
    )
    yield Table("Gage R&R of the ground truth", heads, lines, note)


def _gage_row(axis: str, study: GageStudy, limit_mm: float) -> tuple[str, ...]:
    sizes = (axis, str(study.parts), str(study.appraisers), str(study.repeats))
    figures = (
        f"{value:.3f}"
        for value in (study.repeatability, study.reproducibility, study.gage, study.part)
    )
    return (
        *sizes,
        *figures,
        f"{100.0 * study.share_of_tolerance(2.0 * limit_mm):.1f}",
        str(study.distinct_categories),
    )


def _components(rows: ErrorRows, detector: str) -> Part:
    along = run_precision(rows)
    if along[0].s_r is None:
        return Paragraph(
            f"Repeatability and reproducibility (ISO 5725), {detector}: {NOT_MEASURED}; no teat was"
            " found twice at one pose."
        )
    heads = columns(
        "axis | >n | >teats at poses",
        ">s_r [mm] # repeatability: within a pose",
        ">s_L [mm] # between teats and poses",
        ">s_R [mm] # reproducibility: the root of s_r² + s_L²",
    )
    note = (
        "Standard deviations of the error (ISO 5725-2, 7.4.5). A set-up is a teat at a pose; its"
        " repeats are taken without a change."
    )
    lines = tuple(
        _component_row(axis, found)
        for axis, found in zip(("world x", "world y", "world z"), along, strict=True)
    )
    return Table(f"Repeatability and reproducibility, {detector} (ISO 5725)", heads, lines, note)


def _component_row(axis: str, found: Precision) -> tuple[str, ...]:
    return (
        axis,
        str(found.n),
        str(found.groups),
        *(number(value, digits=3) for value in (found.s_r, found.s_between, found.s_R)),
    )


def _ends(rows: ErrorRows) -> Errors:
    """What was found, in order of time."""
    found: dict[tuple[str, str], dict[str, Floats]] = {}
    columns = (rows.of_found(rows.poses), rows.of_found(rows.teats), rows.of_found(rows.trials))
    for pose, teat, trial, error, place in zip(
        *columns, rows.errors_mm, rows.places_mm[rows.found], strict=True
    ):
        found.setdefault((pose, teat), {})[trial] = np.array([error, place])
    return dict(sorted(found.items()))


def _poses(ends: Errors, detector: str) -> Table:
    heads = columns(
        "pose | teat | >n | >AP [mm] | >AP along x [mm] | >along y [mm] | >along z [mm]",
        ">RP [mm] | >drift of AP [mm]",
    )
    rows = []
    for (pose, teat), of in list(ends.items())[:MOST_ROWS]:
        errors = np.array([end[0] for end in of.values()])
        at = pose_accuracy(errors, np.zeros(3))
        drift = drift_mm(errors, np.zeros(3), max(2, len(errors) // 3))
        along = at.ap_xyz_mm or (None, None, None)
        rows.append(
            (
                pose,
                teat,
                str(at.n),
                number(at.ap_mm),
                *(number(value) for value in along),
                number(at.rp_mm),
                number(drift),
            )
        )
    note = (
        "Of what was found, against the truth of the same trial. RP: mean distance from their own"
        " mean, and three standard deviations."
    )
    return Table(
        f"Pose accuracy and repeatability, {detector} (ISO 9283)",
        heads,
        tuple(rows),
        note + _left_out(len(ends)),
    )


def _distance_parts(ends: Errors, detector: str) -> Iterator[Part]:
    """Of two teats in one scene; of one teat between two poses, cycle by cycle."""
    several = len({teat for _, teat in ends}) > 1
    pairs = [
        (a, b) for a, b in combinations(ends, 2) if (a[0] == b[0] if several else a[1] == b[1])
    ]
    lines = []
    for a, b in pairs[:MOST_ROWS]:
        off = _distance_errors(ends[a], ends[b], same_trial=several)
        if len(off) < CYCLES_FROM:
            continue
        found = distance_accuracy(off, 0.0)
        what = f"{a[0]}: teat {a[1]} to {b[1]}" if several else f"{a[0]} to {b[0]}"
        lines.append((what, str(found.n), number(found.ad_mm), number(found.rd_mm)))
    if not lines:
        yield Paragraph(
            f"AD and RD (ISO 9283), {detector}: {NOT_MEASURED}; no distance was found {CYCLES_FROM}"
            " times."
        )
        return
    heads = columns("distance | >n | >AD [mm] | >RD [mm]")
    note = (
        "The distance found less the true one of the same trials; AD is the amount of its mean, RD"
        " three standard deviations."
    )
    yield Table(
        f"Distance accuracy and repeatability, {detector} (ISO 9283)",
        heads,
        tuple(lines),
        note + _left_out(len(pairs)),
    )


def _distance_errors(
    a: Mapping[str, Floats], b: Mapping[str, Floats], *, same_trial: bool
) -> Floats:
    """Distance found less true distance (n,), of the same trials or of the k-th of each."""
    both = (
        [(a[trial], b[trial]) for trial in a if trial in b]
        if same_trial
        else list(zip(a.values(), b.values(), strict=False))
    )
    ends = np.array(both, dtype=np.float64).reshape(-1, 2, 2, 3)  # pair, a or b, error or place
    true = np.linalg.norm(ends[:, 0, 1] - ends[:, 1, 1], axis=1)
    seen = np.linalg.norm(ends.sum(axis=2)[:, 0] - ends.sum(axis=2)[:, 1], axis=1)
    return np.asarray(seen - true)


def _left_out(of: int) -> str:
    return f" The first {MOST_ROWS} of {of}." if of > MOST_ROWS else ""

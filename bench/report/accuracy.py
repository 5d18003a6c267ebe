"""The report's tables of accuracy (axes, distances, tolerance limits, what the geometry allows) and
of repeats: ISO 9283 for poses and distances, ISO 5725's components, the gage study of the truth.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from bench.record.reader import RunRecord, points_mm
from bench.report.tables import situations
from bench.report.wording import NOT_MEASURED, Heading, number, spanned, table
from bench.results.error_rows import ErrorRows, error_rows, run_precision, truth_gage
from bench.results.verdicts import scored, truth_u_mm
from bench.scoring.errors import ErrorSummary, Floats, normal_k, quantile_bound, summarise
from bench.scoring.guard_band import axis_acceptance_limit_mm, refusal_limit_mm
from bench.scoring.joint import JointCovariance, mean_square, radial_95_mm
from bench.scoring.precision import NORMAL_RP, STUDY_SDS, distance_accuracy, drift_mm, pose_accuracy
from bench.scoring.rates import zero_failure_n
from bench.scoring.scene import Pool
from detector.calibration import Calibration
from instruments.world.situations import spoken
from reports.page import Cell, Paragraph, Part, Table
from textfiles.text import plural

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
        lines = []
        for teat in rows.teat_names:
            own = rows.of_teat(teat)
            poses = len(set(own.of_found(own.poses)))
            six = _six(summarise(own.errors_mm), summarise(own.errors_mm, camera_from_world))
            lines += [(teat, name, poses, *figures) for name, *figures in six]
        yield table("axes_by_teat", lines, detector=detector)
    yield _distances(run, rows, pool, detector)
    yield _tolerance(pool, detector)
    said = Counter(
        one.partition(": ")[2] if one.startswith(("left out at ", "unsure at ")) else one
        for trial in run.trials
        for row in trial.detections
        if row["detector"] == detector and row["reason"]
        for one in str(row["reason"]).split("; ")
    )
    if said:
        yield table("said_of_answers", said.most_common(), detector=detector)


def _axes(
    pool: Pool, detector: str, limit_mm: float, u_mm: float | None, camera_from_world: Floats
) -> Table:
    accept = None if u_mm is None else axis_acceptance_limit_mm(limit_mm, u_mm)
    refuse = refusal_limit_mm(limit_mm, u_mm or 0.0)

    def against(largest: float | None) -> Cell:
        if largest is None:
            return Cell(NOT_MEASURED, "muted")
        if accept is not None and largest <= accept:
            return Cell("accepted", "good")
        return Cell("refused", "bad") if largest >= refuse else Cell("between", "warn")

    six = _six(pool.summary(), pool.summary(camera_from_world))
    rows = [(*figures, against(figures[-1])) for figures in six]
    upto = "nothing can be" if accept is None else f"up to {accept:.3f} mm is"
    known = "u isn't stated" if u_mm is None else f"u = {u_mm:.3g} mm"
    return table(
        "axes", rows, detector=detector, upto=upto, refuse=refuse, limit_mm=limit_mm, known=known
    )


AXES = (
    *("world x", "world y", "world z"),
    *("camera x (across)", "camera y (down)", "camera z (depth)"),
)


def _six(world: ErrorSummary, camera: ErrorSummary) -> Iterator[tuple[Any, ...]]:
    """Name, and figures of ``tables.toml``, of each axis of world and camera."""
    six = (world.x, world.y, world.z, camera.x, camera.y, camera.z)
    for name, a in zip(AXES, six, strict=True):
        yield name, a.n, a.bias_mm, a.sd_mm, a.rms_mm, a.mean_abs_mm, a.max_abs_mm


def _distances(run: RunRecord, rows: ErrorRows, pool: Pool, detector: str) -> Table:
    """Of the found teats; GOSPA of whole scenes charges for the others too."""

    def radial(errors: ErrorSummary) -> tuple[float | None, ...]:
        r = errors.radial
        return r.n, r.mean_mm, r.median_mm, r.rms_mm, r.p95_mm, r.p99_mm, r.max_mm

    def gospa(of: Pool) -> float | None:
        return float(np.mean([score.gospa_mm for score in of.scores])) if of.scores else None

    scenes = {"all": pool} | {name: scored(run, detector, name) for name in situations(run)}
    lines = [(spoken(name), *radial(part.summary()), gospa(part)) for name, part in scenes.items()]
    if len(rows.teat_names) > 1:
        lines += [
            (f"teat {teat}", *radial(summarise(rows.of_teat(teat).errors_mm)), "")
            for teat in rows.teat_names
        ]
    charged, noise = number(gospa(pool), "mm"), _without_noise(rows)
    return table("distances", lines, detector=detector, gospa=charged, without_noise=noise)


def _without_noise(rows: ErrorRows) -> str:
    """What the truth's own uncertainty adds to what is seen."""
    if rows.truth is None or not rows.truth.covariances_mm2.any():
        return ""
    seen = mean_square(rows.errors_mm, rows.truth)
    low, high = seen.interval_mm
    rest = f"without it the rms is {low:.2f} to {high:.2f} mm (95 %, two-sided)"
    if not low:
        rest = f"without it the rms is at most {high:.2f} mm (97.5 %, one-sided): it may be all"
        rest += " that was seen"
    return (
        f" The truth's noise alone would show {seen.truth_rms_mm:.2f} mm rms, at most"
        f" {seen.truth_most_mm:.2f} mm (95 %, one-sided), much of it common to all ends: {rest}."
    )


def _tolerance(pool: Pool, detector: str) -> Part:
    """One value a pose, its worst: repeats share a pose's error."""
    of_poses: dict[object, float] = {}
    for pose, mm in zip(pool.error_poses, np.linalg.norm(pool.errors_mm, axis=1), strict=True):
        of_poses[pose] = max(of_poses.get(pose, 0.0), float(mm))
    worst, n = np.array(list(of_poses.values()), dtype=np.float64), len(of_poses)
    if n < 2:
        return Paragraph(
            f"Tolerance limits, {detector}: {NOT_MEASURED}; teats were found in"
            f" {plural(n, 'pose')}, and 2 are the least."
        )
    lines = []
    for share in SHARES:
        upper = quantile_bound(worst, share, CONFIDENCE)
        k = normal_k(n, share, CONFIDENCE)
        few = f"{NOT_MEASURED}: {zero_failure_n(share, CONFIDENCE)} poses are the least"
        says = (f"{100 * share:g} % of poses", f"{100 * CONFIDENCE:g} % confidence, one-sided")
        free = few if upper is None else upper
        lines.append((*says, n, free, k, worst.mean() + k * worst.std(ddof=1)))
    return table("tolerance", lines, detector=detector)


PIXEL_SD_PX = 0.1  # of a point placed well in a picture, in each coordinate
MOST_DISTANCES = 6


def limit_parts(run: RunRecord, calibration: Calibration) -> Iterator[Part]:
    """The best that any detector can reach on this calibration."""
    ends = points_mm(row for trial in run.trials for row in trial.truth)
    if not len(ends):
        yield Paragraph(NOT_MEASURED)
        yield Paragraph(f"What the geometry allows: {NOT_MEASURED}.")
        return
    worth = spanned(calibration.depth_per_disparity_px_mm(ends), ".1f", "mm")
    yield Paragraph(f"One pixel of disparity is {worth} of depth at these teats (Z² / f B).")
    yield limit_table(ends, calibration)


def limit_table(ends_mm: Floats, calibration: Calibration) -> Table:
    """The limit at world points (n, 3), n > 0, by distance from the right camera."""
    depth = calibration.world_from_right.inverse().apply(ends_mm)[:, 2]
    per_px = calibration.depth_per_disparity_px_mm(ends_mm)
    # expanded, along the worst direction; 0 where a camera can't see it
    own, seen = (
        2.0 * np.sqrt(np.clip(np.linalg.eigvalsh(np.nan_to_num(covariance))[:, -1], 0.0, None))
        for covariance in (calibration.covariance_of(ends_mm, sd) for sd in (0.0, PIXEL_SD_PX))
    )
    known = calibration.covariance is not None
    shares = np.linspace(0.0, 1.0, min(MOST_DISTANCES, len(depth)) + 1)
    edges = np.unique(np.quantile(depth, shares))
    bins = np.clip(np.searchsorted(edges, depth, side="right") - 1, 0, max(len(edges) - 2, 0))
    rows = []
    for at in (bins == one for one in np.unique(bins)):
        alone = own[at].max() if known else None
        figures = (int(at.sum()), per_px[at].max(), alone, seen[at].max())
        rows.append((spanned(depth[at], ".0f"), *figures))
    text = " This calibration states no uncertainty, so that its own share is not in it."
    hint = "the same with noise of the pixels besides"
    more = [Heading(f"with {PIXEL_SD_PX:g} px noise", "right", "mm", hint, ".2f")]
    return table("limit_by_distance", rows, more=more, unstated="" if known else text)


CYCLES_FROM = 10  # repeats of a pose: ISO 9283 asks for 30, and fewer than these say nothing
MOST_ROWS = 60
# by pose and teat, then by trial: the number of the found row
Ends = Mapping[tuple[str, str], Mapping[str, int]]


def precision_parts(run: RunRecord, detector: str) -> Iterator[Part]:
    """All of one detector."""
    rows = error_rows(run, detector)
    yield _components(rows, detector)
    found: dict[tuple[str, str], dict[str, int]] = {}
    columns = map(rows.of_found, (rows.poses, rows.teats, rows.trials))
    for row, (pose, teat, trial) in enumerate(zip(*columns, strict=True)):
        found.setdefault((pose, teat), {})[trial] = row
    ends = {key: of for key, of in sorted(found.items()) if len(of) >= CYCLES_FROM}
    if not ends:
        most = max(map(len, found.values()), default=0)
        yield Paragraph(
            f"AP, RP, AD and RD (ISO 9283), {detector}: {NOT_MEASURED}; of one teat at one pose"
            f" there are {plural(most, 'find')} at most, and {CYCLES_FROM} are the least (the"
            " standard asks for 30)."
        )
        return
    yield _poses(ends, rows, detector)
    yield _pairs(ends, rows, detector)


def gage_parts(run: RunRecord, limit_mm: float) -> Iterator[Part]:
    """Gage R&R of a truth that was touched in several set-ups; nothing without an arm."""
    if "arm" not in run.facts.get("identities", {}):
        return
    found = truth_gage([run])
    if found.studies is None:
        yield Paragraph(f"Gage R&R of the ground truth: {NOT_MEASURED}; {found.why}.")
        return
    lines = []
    for axis, s, shared in zip("xyz", found.studies, found.common_mm, strict=True):
        sizes, share = (s.parts, s.appraisers, s.repeats), s.share_of_tolerance(2.0 * limit_mm)
        sd_mm = (s.repeatability, s.reproducibility, s.gage, s.part)
        whole = 100.0 * STUDY_SDS * float(np.hypot(s.gage, shared)) / (2.0 * limit_mm)
        figures = (100.0 * share, s.distinct_categories, shared, whole)
        lines.append((axis, *sizes, *sd_mm, *figures))
    left = f" {found.left_out} ends had too few touches or set-ups, and are left out."
    yield table("gage", lines, limit_mm=limit_mm, left_out=left if found.left_out else "")


def _components(rows: ErrorRows, detector: str) -> Part:
    along = run_precision(rows)
    if along[0].s_r is None:
        return Paragraph(
            f"Repeatability and reproducibility (ISO 5725), {detector}: {NOT_MEASURED}; no teat was"
            " found twice at one pose."
        )
    lines = []
    for axis, of in zip("xyz", along, strict=True):
        sds = (number(sd, digits=3) for sd in (of.s_r, of.s_between, of.s_R))
        lines.append((f"world {axis}", of.n, of.groups, *sds))
    return table("iso_5725", lines, detector=detector)


def _poses(ends: Ends, rows: ErrorRows, detector: str) -> Table:
    lines = []
    for (pose, teat), of in list(ends.items())[:MOST_ROWS]:
        numbers = list(of.values())
        errors, truth = rows.errors_mm[numbers], _truth_of(rows, numbers)
        ap, rp_mm = pose_accuracy(errors)
        drift = drift_mm(errors, max(2, len(errors) // 3))
        shared = radial_95_mm(truth.of_mean(np.full(len(errors), 1.0 / len(errors)), fresh=True))
        fresh = NORMAL_RP * float(np.sqrt(np.trace(truth.fresh.mean(axis=0)) / 3.0))
        lines.append(
            (pose, teat, len(errors), np.linalg.norm(ap), *ap, rp_mm, drift, shared, fresh)
        )
    return table("iso_9283_poses", lines, detector=detector, left_out=_left_out(len(ends)))


def _truth_of(rows: ErrorRows, numbers: Sequence[int]) -> JointCovariance:
    return JointCovariance.exact(len(numbers)) if rows.truth is None else rows.truth.of(numbers)


def _pairs(ends: Ends, rows: ErrorRows, detector: str) -> Part:
    """Of two teats in one scene; of one teat between two poses, cycle by cycle."""
    several = len({teat for _, teat in ends}) > 1
    places = rows.places_mm[rows.found]
    pairs = [
        (a, b) for a, b in combinations(ends, 2) if (a[0] == b[0] if several else a[1] == b[1])
    ]
    lines = []
    for a, b in pairs[:MOST_ROWS]:
        # of the same trials, or of the k-th of each pose
        both = [(ends[a][trial], ends[b][trial]) for trial in ends[a] if trial in ends[b]]
        if not several:
            both = list(zip(ends[a].values(), ends[b].values(), strict=False))
        if len(both) < CYCLES_FROM:
            continue
        of_a, of_b = (list(numbers) for numbers in zip(*both, strict=True))
        apart, error = (points[of_a] - points[of_b] for points in (places, rows.errors_mm))
        true = np.linalg.norm(apart, axis=1)
        ad_mm, rd_mm = distance_accuracy(np.linalg.norm(apart + error, axis=1) - true)
        way = apart.mean(axis=0) / max(float(np.linalg.norm(apart.mean(axis=0))), 1e-12)
        weights = np.repeat([1.0, -1.0], len(both)) / len(both)
        of_mean = _truth_of(rows, of_a + of_b).of_mean(weights, fresh=True)
        of_truth = 1.96 * float(np.sqrt(way @ of_mean @ way))
        what = f"{a[0]}: teat {a[1]} to {b[1]}" if several else f"{a[0]} to {b[0]}"
        lines.append((what, len(both), ad_mm, rd_mm, of_truth))
    if not lines:
        return Paragraph(
            f"AD and RD (ISO 9283), {detector}: {NOT_MEASURED}; no distance was found {CYCLES_FROM}"
            " times."
        )
    return table("iso_9283_distances", lines, detector=detector, left_out=_left_out(len(pairs)))


def _left_out(of: int) -> str:
    return f" The first {MOST_ROWS} of {of}." if of > MOST_ROWS else ""

"""The report's part on how errors spread: teat by teat, over time, as ellipsoids, and whether they depend on anything.

May not judge: none of this is a requirement. It says where to look.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bench.record import RunRecord, TrialRecord
from bench.scoring.ellipsoid import LEAST, Ellipsoid, bias_ellipsoid, bias_test, consistency, pose_means, prediction_ellipsoid
from bench.scoring.points import Floats
from bench.scoring.trends import LEAST as LEAST_GROUPS
from bench.scoring.trends import Trend, trends
from bench.summary.covariances import claimed_mm2
from bench.summary.wording import NOT_MEASURED
from reports.figures import error_drift, teat_boxes
from reports.page import Cell, Column, Figure, Paragraph, Part, Table


@dataclass(frozen=True, slots=True)
class _Found:
    """One teat end that was found: trial, teat, error (3,), place (3,), and the covariance (3, 3) claimed with the truth's own."""

    trial: TrialRecord
    teat: str
    error_mm: Floats
    place_mm: Floats
    covariance_mm2: Floats | None


def spread_parts(run: RunRecord, detector: str, limit_mm: float, anchors: dict[str, str]) -> Iterator[Part]:
    """Everything of one detector; ``anchors`` is each trial's link by its id."""
    found = list(_found(run, detector))
    distances = [float(np.linalg.norm(one.error_mm)) for one in found]
    teats = sorted({str(row["teat"]) for trial in run.counted for row in trial.truth})
    each = [[d for one, d in zip(found, distances, strict=True) if one.teat == teat] for teat in teats]
    boxes = teat_boxes(teats, each, limit_mm, name=f"teats-{detector}")
    yield Figure(
        boxes, f"Distance by teat, {detector}", "; ".join(f"{t}: {len(e)} found" for t, e in zip(teats, each, strict=True)) or "none"
    )
    timed = [(one, d) for one, d in zip(found, distances, strict=True) if one.trial.head["captured_s"] is not None]
    if timed:
        minutes = [one.trial.head["captured_s"] / 60.0 for one, _ in timed]
        links = [anchors[one.trial.id] for one, _ in timed]
        drift = error_drift(minutes, [d for _, d in timed], limit_mm, links=links, name=f"drift-{detector}")
        yield Figure(
            drift, f"Drift: distance over the time of the run, {detector}; each point opens its trial", f"{len(timed)} points", True
        )
    yield from _ellipsoids(found, detector)
    yield from _trends(found, detector)


def _found(run: RunRecord, detector: str) -> Iterator[_Found]:
    for trial in run.counted:
        score = trial.scores.get(detector)
        if score is None:
            continue
        answers = [row for row in trial.found if row["detector"] == detector]
        for (answer, truth), error in zip(score.match.pairs, score.errors_mm, strict=True):
            row = trial.truth[truth]
            place = np.array([row["x_mm"], row["y_mm"], row["z_mm"]])
            yield _Found(trial, str(row["teat"]), np.asarray(error), place, claimed_mm2(answers[answer], row))


def _ellipsoids(found: Sequence[_Found], detector: str) -> Iterator[Part]:
    """Of the mean error of each pose, since repeats of a pose share its error."""
    errors = np.array([one.error_mm for one in found]).reshape(-1, 3)
    means = pose_means(errors, [one.trial.pose for one in found]) if found else errors
    if len(means) < LEAST:
        yield Paragraph(f"Ellipsoids, {detector}: {NOT_MEASURED}; teats were found in {len(means)} poses, and {LEAST} are the least.")
        return
    wanted = (("the next pose's mean error, 95 %", prediction_ellipsoid(means)), ("the bias, 95 % confidence", bias_ellipsoid(means)))
    rows = tuple(_ellipsoid_row(name, body) for name, body in wanted if body is not None)
    test = bias_test(means)
    told = "" if test.p_value is None else f"Is there a bias? Hotelling's T² = {test.t_squared:.2f}, p = {test.p_value:.3g}. "
    columns = (
        Column("holds"), Column("poses", "right"), Column("centre x, y, z", "right", "mm"),
        Column("half axes", "right", "mm"), Column("longest axis along", "right", hint="unit vector in the world frame"),
    )  # fmt: skip
    yield Table(f"Ellipsoids of the error, {detector}", columns, rows, told + _consistent(found))


def _ellipsoid_row(name: str, body: Ellipsoid) -> tuple[str, ...]:
    def told(values: Floats, digits: int) -> str:
        return ", ".join(f"{value:.{digits}f}" for value in values)

    return (name, str(body.n), told(body.centre_mm, 2), told(body.half_axes_mm, 2), told(body.directions[0], 2))


def _consistent(found: Sequence[_Found]) -> str:
    stated = [(one.error_mm, one.covariance_mm2) for one in found if one.covariance_mm2 is not None]
    if not stated:
        return "The detector states no covariances."
    errors, covariances = zip(*stated, strict=True)
    held = consistency(np.array(errors), np.array(covariances))
    if held.ratio is None:
        return ""
    return (
        f"Stated covariances, with the truth's: mean e' C⁻¹ e / 3 is {held.ratio:.2f} over {held.n} ends, where 1 is as stated and chance "
        f"leaves {held.low:.2f} to {held.high:.2f}; above, the detector claims to be surer than it is; below, it is too modest."
    )


def _trends(found: Sequence[_Found], detector: str) -> Iterator[Part]:
    poses = [one.trial.pose for one in found]
    if len(set(poses)) < LEAST_GROUPS:
        yield Paragraph(f"Trends, {detector}: {NOT_MEASURED}; {LEAST_GROUPS} poses are the least.")
        return
    places = np.array([one.place_mm for one in found])
    heads = [one.trial.head for one in found]
    quantities = {f"{axis} (mm)": places[:, k] for k, axis in enumerate("xyz")}
    quantities |= {"time (h)": _column([h["captured_s"] for h in heads], 1.0 / 3600.0), "bath (K)": _column([h["bath_c"] for h in heads])}
    strata = [f"{one.trial.pose} {one.teat}" for one in found]
    within = {"time (h)": strata, "bath (K)": strata}
    lines = trends(
        quantities, np.array([one.error_mm for one in found]), poses, within=within, within_groups=[one.trial.id for one in found]
    )
    columns = (
        Column("error"), Column("against"), Column("n", "right"), Column("slope", "right", "mm per unit"),
        Column("over the whole range", "right", "mm"), Column("p (Holm)", "right"), Column("significant"),
    )  # fmt: skip
    rows = tuple(_trend_row(line) for line in lines if line.slope is not None)
    missing = sorted({line.quantity for line in lines if line.slope is None})
    note = "Errors of one pose are not independent: the slope's error is the jackknife over poses; time and bath are asked within poses."
    more = f" Not measured, for it hardly varied or in too few poses: {', '.join(missing)}." if missing else ""
    yield Table(f"Trends of the error, {detector}", columns, rows, note + more)


def _trend_row(line: Trend) -> tuple[str | Cell, ...]:
    """Of a line that was measured: where there is a slope there is all that comes with it."""
    p = line.p_value if line.p_holm is None else line.p_holm
    slope, low, high, over = (float(np.nan if value is None else value) for value in (line.slope, line.low, line.high, line.over_span_mm))
    sure = Cell("yes", "warn") if line.significant else Cell("no", "muted")
    return (
        line.response,
        line.quantity,
        str(line.n),
        f"{slope:+.4f} ± {(high - low) / 2.0:.4f}",
        f"{over:+.2f}",
        "" if p is None else f"{p:.3g}",
        sure,
    )


def _column(values: Sequence[float | None], factor: float = 1.0) -> Floats:
    return np.array([np.nan if value is None else value * factor for value in values], dtype=np.float64)

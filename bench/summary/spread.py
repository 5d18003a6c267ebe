"""The report's part on how errors spread: teat by teat, over time, and as ellipsoids, drawn and as figures.

May not judge: none of this is a requirement. It says where to look.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from bench.dependence import ErrorRows, TeatErrors, error_rows, run_bias, teat_errors
from bench.record import RunRecord
from bench.scoring.ellipsoid import LEAST, BiasTest, Ellipsoid, consistency, prediction_ellipsoid
from bench.scoring.points import Floats
from bench.summary.anchors import id_of
from bench.summary.covariances import claimed_mm2
from bench.summary.trends import trend_parts
from bench.summary.wording import NOT_MEASURED
from reports.figures import MOST_GROUPS, ErrorGroup, error_drift, error_regions, teat_boxes
from reports.page import Column, Figure, Paragraph, Part, Table

CORNERS = 49  # of a drawn ellipse
VIEWS = (("world x", "world y"), ("world x", "world z"), ("camera x, across", "camera z, depth"))


def spread_parts(run: RunRecord, detector: str, limit_mm: float, anchors: Mapping[str, str], camera_from_world: Floats) -> Iterator[Part]:
    """Everything of one detector; ``anchors`` is each trial's link by its id, the rotation (3, 3) that into the right camera's axes."""
    rows = error_rows(run, detector)
    distances = np.linalg.norm(rows.errors_mm, axis=1)
    yield _boxes(run, rows, distances, limit_mm, detector)
    yield from _drift(rows, distances, limit_mm, anchors, detector)
    teats = teat_errors(rows)
    yield _drawn(teats, limit_mm, anchors, camera_from_world, detector)
    yield from _ellipsoids(run, rows, teats, detector)
    yield from trend_parts(rows, detector)


def _boxes(run: RunRecord, rows: ErrorRows, distances: Floats, limit_mm: float, detector: str) -> Figure:
    names = sorted({str(row["teat"]) for trial in run.counted for row in trial.truth})
    of = np.array(rows.of_found(rows.teats))
    each = [distances[of == name] if len(of) else distances for name in names]
    alt = "; ".join(f"{name}: {len(errors)} found" for name, errors in zip(names, each, strict=True)) or "none"
    return Figure(teat_boxes(names, each, limit_mm, name=f"teats-{id_of(detector)}"), f"Distance by teat, {detector}", alt)


def _drift(rows: ErrorRows, distances: Floats, limit_mm: float, anchors: Mapping[str, str], detector: str) -> Iterator[Figure]:
    minutes = rows.quantities["time_s"] / 60.0
    timed = np.isfinite(minutes)
    if not timed.any():
        return
    links = [anchors[trial] for trial, known in zip(rows.of_found(rows.trials), timed, strict=True) if known]
    svg = error_drift(minutes[timed], distances[timed], limit_mm, links=links, name=f"drift-{id_of(detector)}")
    caption = f"Drift: distance over the time of the run, {detector}; each point opens its trial"
    yield Figure(svg, caption, f"{int(timed.sum())} points")


def _drawn(teats: Sequence[TeatErrors], limit_mm: float, anchors: Mapping[str, str], camera_from_world: Floats, detector: str) -> Figure:
    """Each teat's pose means with its 95 % ellipsoid; more teats than can be told apart are one group."""
    apart = len(teats) <= MOST_GROUPS
    clouds = [(f"teat {one.teat}", one.means_mm, one.worst_trials) for one in teats] if apart else [_together(teats)]
    groups = [
        ErrorGroup(name, _flat(means, camera_from_world), _outlines(means, camera_from_world), tuple(anchors[t] for t in trials))
        for name, means, trials in clouds
    ]
    svg = error_regions(groups, VIEWS, limit_mm, name=f"regions-{id_of(detector)}")
    counts = "; ".join(f"{name}: {len(means)} poses{'' if len(means) >= LEAST else ', too few'}" for name, means, _ in clouds) or "none"
    told = (
        f"Errors with their 95 % ellipsoids, {detector}: from above, from the front, and along the view. A point is a teat's mean error at "
        f"one pose, and opens its worst trial; n counts poses. A line holds the next pose's error with 95 %; below {LEAST} poses "
        "there is none. The red circle is the limit's sphere."
    )
    return Figure(svg, told, f"Errors with 95 % ellipsoids by teat. {counts}.", wide=True)


def _together(teats: Sequence[TeatErrors]) -> tuple[str, Floats, tuple[str, ...]]:
    return f"{len(teats)} teats", np.concatenate([one.means_mm for one in teats]), tuple(t for one in teats for t in one.worst_trials)


def _flat(means_mm: Floats, camera_from_world: Floats) -> tuple[Floats, Floats, Floats]:
    return means_mm[:, [0, 1]], means_mm[:, [0, 2]], (means_mm @ camera_from_world.T)[:, [0, 2]]


def _outlines(means_mm: Floats, camera_from_world: Floats) -> tuple[Floats, ...]:
    world, camera = prediction_ellipsoid(means_mm), prediction_ellipsoid(means_mm @ camera_from_world.T)
    if world is None or camera is None:
        return ()
    return world.outline_mm(0, 1, CORNERS), world.outline_mm(0, 2, CORNERS), camera.outline_mm(0, 2, CORNERS)


def _ellipsoids(run: RunRecord, rows: ErrorRows, teats: Sequence[TeatErrors], detector: str) -> Iterator[Part]:
    """Of the mean error of each pose, since repeats of a pose share its error; then teat by teat."""
    whole = run_bias(rows)
    if whole.test.n < LEAST:
        yield Paragraph(f"Ellipsoids, {detector}: {NOT_MEASURED}; teats were found in {whole.test.n} poses, and {LEAST} are the least.")
        return
    several = len(teats) > 1
    bodies = [("all teats" if several else "the teat", whole), *((f"teat {one.teat}", one.bias) for one in teats if several)]
    lines = [
        _ellipsoid_row(who, what, body, bias.test)
        for who, bias in bodies
        for what, body in (("next pose's mean error, 95 %", bias.next_error), ("bias, 95 % confidence", bias.bias))
    ]
    columns = (
        Column("of"), Column("holds"), Column("poses", "right"), Column("centre x, y, z", "right", "mm"),
        Column("half axes", "right", "mm"), Column("longest axis along", "right", hint="unit vector in the world frame"),
        Column("is there a bias?", "right", hint="p of Hotelling's T²: below 0.05 the mean error isn't zero"),
    )  # fmt: skip
    test = whole.test
    told = "" if test.p_value is None else f"Is there a bias? Hotelling's T² = {test.t_squared:.2f}, p = {test.p_value:.3g}. "
    yield Table(f"Ellipsoids of the error, {detector}", columns, tuple(lines), told + _consistent(run, detector))


def _ellipsoid_row(who: str, what: str, body: Ellipsoid | None, test: BiasTest) -> tuple[str, ...]:
    if body is None:
        return (who, what, str(test.n), NOT_MEASURED, NOT_MEASURED, "", f"{NOT_MEASURED}: {LEAST} poses are the least")

    def told(values: Floats, digits: int) -> str:
        return ", ".join(f"{value:.{digits}f}" for value in values)

    p = NOT_MEASURED if test.p_value is None else f"p = {test.p_value:.3g}"
    return (who, what, str(body.n), told(body.centre_mm, 2), told(body.half_axes_mm, 2), told(body.directions[0], 2), p)


def _consistent(run: RunRecord, detector: str) -> str:
    stated = list(_stated(run, detector))
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


def _stated(run: RunRecord, detector: str) -> Iterator[tuple[Floats, Floats]]:
    """Error (3,) and the covariance (3, 3) that it should scatter by, of each found teat that the detector states one for."""
    for trial in run.counted:
        score = trial.scores.get(detector)
        answers = [row for row in trial.found if row["detector"] == detector]
        for (answer, truth), error in zip(score.match.pairs, score.errors_mm, strict=True) if score else ():
            covariance = claimed_mm2(answers[answer], trial.truth[truth])
            if covariance is not None:
                yield np.asarray(error), covariance

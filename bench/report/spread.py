"""The report's parts on how errors spread: over poses and places, as trends, teat by teat, over
time, and as ellipsoids. Stated covariances are compared with the errors. None of it is a
requirement.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from bench.record.reader import RunRecord
from bench.record.schema import Row
from bench.report.accuracy import precision_parts
from bench.report.wording import NOT_MEASURED, id_of
from bench.results.error_rows import (
    ErrorRows,
    PosePlace,
    TeatErrors,
    error_rows,
    pose_places,
    run_bias,
    run_trends,
    teat_errors,
)
from bench.scoring.errors import Floats
from bench.scoring.regions import (
    LEAST_POSES,
    BiasTest,
    Ellipsoid,
    consistency,
    prediction_ellipsoid,
)
from bench.scoring.trends import LEAST_TREND_POSES, Trend
from reports.figures import (
    MOST_GROUPS,
    ErrorGroup,
    Slope,
    TeatPlaces,
    error_drift,
    error_map,
    error_maps,
    error_regions,
    slope_intervals,
    teat_boxes,
)
from reports.parts import Cell, Figure, Notes, Paragraph, Part, Table, columns


def claimed_mm2(answer: Row, truth: Row) -> Floats | None:
    """Covariance (3, 3) mm^2 of answer less truth; None where the detector states none."""
    stated = covariance_of(answer)
    if stated is None:
        return None
    own = covariance_of(truth)
    if own is None:
        own = np.eye(3) * float(truth["u_mm"] or 0.0) ** 2
    total = stated + own
    return total if np.all(np.linalg.eigvalsh(total) > 0.0) else None


def covariance_of(row: Row) -> Floats | None:
    """The covariance (3, 3) of a row, mm^2; None where there is none or it is malformed."""
    text = row["covariance_mm2"]
    matrix = np.array(json.loads(text) if text else [], dtype=np.float64)
    return matrix if matrix.shape == (3, 3) and np.isfinite(matrix).all() else None


POSE_SET = "pose set"
MAP_FROM = 9  # places: fewer make no map


def pose_parts(run: RunRecord, limit_mm: float, anchors: Mapping[str, str]) -> Iterator[Part]:
    """How the poses were chosen, and what depends on the place. ``anchors``: links by trial."""
    chosen = run.facts.get(POSE_SET)
    if chosen:
        yield Notes(
            f"How the poses were chosen (order: {chosen['order']}; seed of the script:"
            f" {chosen['seed']})",
            tuple(chosen["chosen"]),
        )
    else:
        yield Paragraph("The poses are those of the recording; how they were chosen isn't in it.")
    for detector in run.detectors:
        yield from _map(error_rows(run, detector), detector, limit_mm, anchors)
        yield from precision_parts(run, detector)


def _map(
    rows: ErrorRows, detector: str, limit_mm: float, anchors: Mapping[str, str]
) -> Iterator[Part]:
    """Each pose once, with the worst of its repeats."""
    places = pose_places(rows)
    if len(places) < MAP_FROM:
        yield Paragraph(
            f"Error over the places, {detector}: {len(places)} places of a teat are no map;"
            f" {MAP_FROM} are the least."
        )
        return
    teats = [
        _teat_places(teat, [place for place in places if place.teat == teat], anchors)
        for teat in rows.teat_names
    ]
    within, beyond = (
        sum(
            place.worst_mm is not None and (place.worst_mm <= limit_mm) is inside
            for place in places
        )
        for inside in (True, False)
    )
    missed = sum(place.found < place.repeats for place in places)
    alt = (
        f"{len(places)} places: {within} within {limit_mm:g} mm, {beyond} beyond, {missed} not"
        " found"
    )
    repeated = max(place.repeats for place in places) > 1
    more = (
        " Of a pose's repeats the worst is drawn, and a triangle where any of them missed the teat."
        if repeated
        else ""
    )
    caption = (
        f"Error over the plane, {detector}; the area of a disc is the error, and each mark opens"
        f" its trial. {alt}.{more}"
    )
    if len(teats) == 1:
        svg = error_map(teats[0], limit_mm, name=f"map-{id_of(detector)}")
    else:
        svg = error_maps(teats, limit_mm, name=f"map-{id_of(detector)}")
        caption += (
            " Each teat has a panel of its own, all on one scale; y points away from the cameras,"
            " z up."
        )
    yield Figure(svg, caption, alt, wide=True)


def _teat_places(teat: str, places: Sequence[PosePlace], anchors: Mapping[str, str]) -> TeatPlaces:
    found = [place for place in places if place.worst_mm is not None]
    missed = [place.place_mm for place in places if place.found < place.repeats]
    return TeatPlaces(
        teat,
        np.array([place.place_mm for place in found], dtype=np.float64).reshape(-1, 3),
        np.array([place.worst_mm for place in found], dtype=np.float64),
        np.array(missed, dtype=np.float64).reshape(-1, 3),
        tuple(anchors[place.worst_trial] for place in found if place.worst_trial is not None),
        tuple(anchors[place.missed_trial] for place in places if place.missed_trial is not None),
    )


# A quantity of the rows: what it is called, its unit in the report, and how many of its own units
# that is.
QUANTITIES = {
    "x_mm": ("x", "mm", 1.0),
    "y_mm": ("y", "mm", 1.0),
    "z_mm": ("z", "mm", 1.0),
    "time_s": ("time", "h", 3600.0),
    "bath_c": ("bath temperature", "K", 1.0),
    "tilt_deg": ("tilt of the teat", "°", 1.0),
}
NOTE = (
    "Errors of one pose are not independent, so the slope's error is the jackknife over poses;"
    " where poses are repeated, time and bath are asked within them. All p-values of the table are"
    " adjusted together (Holm).\n“No trend shown” doesn't say that there is none: it says that"
    " chance alone explains what was seen. As far as these poses tell, a trend may still make, over"
    " the whole range, as much as the column “could be up to” says; more poses over a wider range"
    " narrow it."
)


def trend_parts(rows: ErrorRows, detector: str) -> Iterator[Part]:
    """A figure and a table of all lines; a sentence where there are too few poses for any."""
    poses = len(set(rows.of_found(rows.poses)))
    if poses < LEAST_TREND_POSES:
        yield Paragraph(
            f"Trends, {detector}: {NOT_MEASURED}; teats were found in {poses} poses, and"
            f" {LEAST_TREND_POSES} are the least."
        )
        return
    lines = run_trends(rows)
    slopes = [_slope(line) for line in lines if line.slope is not None]
    shown = [f"{slope.response} with {slope.against}" for slope in slopes if slope.shown]
    told = f"Trend shown: {', '.join(shown)}." if shown else "No trend is shown."
    caption = f"What each trend makes of its quantity's whole range, {detector}. {told}"
    yield Figure(
        slope_intervals(slopes, name=f"trends-{id_of(detector)}"), caption, told, wide=True
    )
    measured = (_row(line) for line in lines if line.slope is not None)
    heads = columns(
        "error | against | >n",
        ">poses # independent units; within poses: trials",
        ">range [of the unit] | >slope [mm per unit] | >95 % interval [mm per unit]",
        ">over the range [mm]",
        ">could be up to [mm] # over the range, either way, 95 %",
        ">p (Holm) | trend",
    )
    yield Table(f"Trends of the error, {detector}", heads, (*measured, *_not_measured(lines)), NOTE)


def _slope(line: Trend) -> Slope:
    slope, low, high = _figures(line)
    return Slope(
        QUANTITIES[line.quantity][0],
        _response(line),
        slope * line.span,
        low * line.span,
        high * line.span,
        line.significant,
    )


def _row(line: Trend) -> tuple[str | Cell, ...]:
    name, unit, factor = QUANTITIES[line.quantity]
    start = (
        _response(line),
        f"{name} ({unit})",
        str(line.n),
        str(line.groups),
        f"{line.span / factor:.3g}",
    )
    slope, low, high = _figures(line)
    most = max(abs(low), abs(high)) * line.span
    p = line.p_value if line.p_holm is None else line.p_holm
    told = Cell("trend shown", "warn") if line.significant else Cell("no trend shown", "muted")
    interval = f"{low * factor:+.3g} to {high * factor:+.3g}"
    return (
        *start,
        f"{slope * factor:+.3g}",
        interval,
        f"{slope * line.span:+.2f}",
        f"{most:.2f}",
        "" if p is None else f"{p:.3g}",
        told,
    )


def _not_measured(lines: Sequence[Trend]) -> Iterator[tuple[str | Cell, ...]]:
    """One row for each quantity that no line could be drawn against."""
    for quantity, line in {line.quantity: line for line in lines if line.slope is None}.items():
        name, unit, factor = QUANTITIES[quantity]
        span = f"{line.span / factor:.3g}" if line.n else ""
        why = Cell(f"{NOT_MEASURED}: {_why_not(line)}", "muted")
        yield (
            "any error",
            f"{name} ({unit})",
            str(line.n),
            str(line.groups),
            span,
            "",
            "",
            "",
            "",
            "",
            why,
        )


def _figures(line: Trend) -> tuple[float, float, float]:
    """Slope, low and high of a line that was measured."""
    slope, low, high = line.slope, line.low, line.high
    if slope is None or low is None or high is None:
        raise ValueError(f"the trend of {line.response} with {line.quantity} has no slope")
    return slope, low, high


def _response(line: Trend) -> str:
    return line.response if line.response == "distance" else f"{line.response} error"


def _why_not(line: Trend) -> str:
    if not line.n:
        return "it isn't known in this run"
    return (
        f"in {line.groups} poses, {LEAST_TREND_POSES} are the least"
        if line.groups < LEAST_TREND_POSES
        else "it hardly varied"
    )


CORNERS = 49  # of a drawn ellipse
VIEWS = (("world x", "world y"), ("world x", "world z"), ("camera x, across", "camera z, depth"))


def spread_parts(
    run: RunRecord,
    detector: str,
    limit_mm: float,
    anchors: Mapping[str, str],
    camera_from_world: Floats,
) -> Iterator[Part]:
    """All of one detector. ``anchors``: links by trial; ``camera_from_world``: rotation."""
    rows = error_rows(run, detector)
    distances = np.linalg.norm(rows.errors_mm, axis=1)
    yield _boxes(run, rows, distances, limit_mm, detector)
    yield from _drift(rows, distances, limit_mm, anchors, detector)
    teats = teat_errors(rows)
    yield _drawn(teats, limit_mm, anchors, camera_from_world, detector)
    yield from _ellipsoids(run, rows, teats, detector)
    yield from trend_parts(rows, detector)


def _boxes(
    run: RunRecord, rows: ErrorRows, distances: Floats, limit_mm: float, detector: str
) -> Figure:
    names = sorted({str(row["teat"]) for trial in run.counted for row in trial.truth})
    of = np.array(rows.of_found(rows.teats))
    each = [distances[of == name] if len(of) else distances for name in names]
    alt = (
        "; ".join(f"{name}: {len(errors)} found" for name, errors in zip(names, each, strict=True))
        or "none"
    )
    return Figure(
        teat_boxes(names, each, limit_mm, name=f"teats-{id_of(detector)}"),
        f"Distance by teat, {detector}",
        alt,
    )


def _drift(
    rows: ErrorRows, distances: Floats, limit_mm: float, anchors: Mapping[str, str], detector: str
) -> Iterator[Figure]:
    minutes = rows.quantities["time_s"] / 60.0
    timed = np.isfinite(minutes)
    if not timed.any():
        return
    links = [
        anchors[trial]
        for trial, known in zip(rows.of_found(rows.trials), timed, strict=True)
        if known
    ]
    svg = error_drift(
        minutes[timed], distances[timed], limit_mm, links=links, name=f"drift-{id_of(detector)}"
    )
    caption = f"Drift: distance over the time of the run, {detector}; each point opens its trial"
    yield Figure(svg, caption, f"{int(timed.sum())} points")


def _drawn(
    teats: Sequence[TeatErrors],
    limit_mm: float,
    anchors: Mapping[str, str],
    camera_from_world: Floats,
    detector: str,
) -> Figure:
    """Each teat's pose means with its 95 % ellipsoid; too many teats are one group."""
    apart = len(teats) <= MOST_GROUPS
    clouds = (
        [(f"teat {one.teat}", one.means_mm, one.worst_trials) for one in teats]
        if apart
        else [_together(teats)]
    )
    groups = [
        ErrorGroup(
            name,
            _flat(means, camera_from_world),
            _outlines(means, camera_from_world),
            tuple(anchors[t] for t in trials),
        )
        for name, means, trials in clouds
    ]
    svg = error_regions(groups, VIEWS, limit_mm, name=f"regions-{id_of(detector)}")
    counts = (
        "; ".join(
            f"{name}: {len(means)} poses{'' if len(means) >= LEAST_POSES else ', too few'}"
            for name, means, _ in clouds
        )
        or "none"
    )
    told = (
        f"Errors with their 95 % ellipsoids, {detector}: from above, from the front, and along the"
        " view. A point is a teat's mean error at one pose, and opens its worst trial; n counts"
        f" poses. A line holds the next pose's error with 95 %; below {LEAST_POSES} poses there is"
        " none. The red circle is the limit's sphere."
    )
    return Figure(svg, told, f"Errors with 95 % ellipsoids by teat. {counts}.", wide=True)


def _together(teats: Sequence[TeatErrors]) -> tuple[str, Floats, tuple[str, ...]]:
    return (
        f"{len(teats)} teats",
        np.concatenate([one.means_mm for one in teats]),
        tuple(t for one in teats for t in one.worst_trials),
    )


def _flat(means_mm: Floats, camera_from_world: Floats) -> tuple[Floats, Floats, Floats]:
    return means_mm[:, [0, 1]], means_mm[:, [0, 2]], (means_mm @ camera_from_world.T)[:, [0, 2]]


def _outlines(means_mm: Floats, camera_from_world: Floats) -> tuple[Floats, ...]:
    world, camera = (
        prediction_ellipsoid(means_mm),
        prediction_ellipsoid(means_mm @ camera_from_world.T),
    )
    if world is None or camera is None:
        return ()
    return (
        world.outline_mm(0, 1, CORNERS),
        world.outline_mm(0, 2, CORNERS),
        camera.outline_mm(0, 2, CORNERS),
    )


def _ellipsoids(
    run: RunRecord, rows: ErrorRows, teats: Sequence[TeatErrors], detector: str
) -> Iterator[Part]:
    """Of each pose's mean error, since repeats of a pose share its error; then by teat."""
    whole = run_bias(rows)
    if whole.test.n < LEAST_POSES:
        yield Paragraph(
            f"Ellipsoids, {detector}: {NOT_MEASURED}; teats were found in {whole.test.n} poses, and"
            f" {LEAST_POSES} are the least."
        )
        return
    several = len(teats) > 1
    bodies = [
        ("all teats" if several else "the teat", whole),
        *((f"teat {one.teat}", one.bias) for one in teats if several),
    ]
    lines = [
        _ellipsoid_row(who, what, body, bias.test)
        for who, bias in bodies
        for what, body in (
            ("next pose's mean error, 95 %", bias.next_error),
            ("bias, 95 % confidence", bias.bias),
        )
    ]
    heads = columns(
        "of | holds | >poses | >centre x, y, z [mm] | >half axes [mm]",
        ">longest axis along # unit vector in the world frame",
        ">is there a bias? # p of Hotelling's T²: below 0.05 the mean error isn't zero",
    )
    test = whole.test
    told = (
        ""
        if test.p_value is None
        else f"Is there a bias? Hotelling's T² = {test.t_squared:.2f}, p = {test.p_value:.3g}. "
    )
    yield Table(
        f"Ellipsoids of the error, {detector}",
        heads,
        tuple(lines),
        told + _consistent(run, detector),
    )


def _ellipsoid_row(who: str, what: str, body: Ellipsoid | None, test: BiasTest) -> tuple[str, ...]:
    if body is None:
        return (
            who,
            what,
            str(test.n),
            NOT_MEASURED,
            NOT_MEASURED,
            "",
            f"{NOT_MEASURED}: {LEAST_POSES} poses are the least",
        )

    def told(values: Floats, digits: int) -> str:
        return ", ".join(f"{value:.{digits}f}" for value in values)

    p = NOT_MEASURED if test.p_value is None else f"p = {test.p_value:.3g}"
    return (
        who,
        what,
        str(body.n),
        told(body.centre_mm, 2),
        told(body.half_axes_mm, 2),
        told(body.directions[0], 2),
        p,
    )


def _consistent(run: RunRecord, detector: str) -> str:
    stated = list(_stated(run, detector))
    if not stated:
        return "The detector states no covariances."
    errors, covariances = zip(*stated, strict=True)
    held = consistency(np.array(errors), np.array(covariances))
    if held.ratio is None:
        return ""
    return (
        f"Stated covariances, with the truth's: mean e' C⁻¹ e / 3 is {held.ratio:.2f} over {held.n}"
        f" ends, where 1 is as stated and chance leaves {held.low:.2f} to {held.high:.2f}; above,"
        " the detector claims to be surer than it is; below, it is too modest."
    )


def _stated(run: RunRecord, detector: str) -> Iterator[tuple[Floats, Floats]]:
    """Error (3,) and stated covariance (3, 3) of each found teat that has one."""
    for trial in run.counted:
        score = trial.scores.get(detector)
        answers = [row for row in trial.found if row["detector"] == detector]
        for (answer, truth), error in (
            zip(score.match.pairs, score.errors_mm, strict=True) if score else ()
        ):
            covariance = claimed_mm2(answers[answer], trial.truth[truth])
            if covariance is not None:
                yield np.asarray(error), covariance

"""The report's parts on how errors spread: over poses and places, as trends, teat by teat, over
time, and as ellipsoids. Stated covariances are compared with the errors. None of it is a
requirement.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import compress

import numpy as np

from bench.record.reader import RunRecord
from bench.report.accuracy import precision_parts
from bench.report.tables import covariance_of
from bench.report.trials import anchors_of
from bench.report.wording import NOT_MEASURED, formatted, id_of, table
from bench.results.answers import LEFT_OUT
from bench.results.error_rows import (
    Bias,
    ErrorRows,
    TeatErrors,
    error_rows,
    pose_places,
    run_bias,
    run_trends,
    teat_errors,
)
from bench.results.verdicts import scored_trials
from bench.scoring.comparison import holm
from bench.scoring.errors import Floats
from bench.scoring.joint import radial_95_mm
from bench.scoring.spread import (
    LEAST_POSES,
    LEAST_SPAN_U,
    LEAST_TREND_POSES,
    Ellipsoid,
    Trend,
    consistency,
    prediction_ellipsoid,
)
from bench.truth.joint import End, joint_truth
from reports.figures.course import Slope, slope_intervals
from reports.figures.errors import error_drift, teat_boxes
from reports.figures.plane import (
    MOST_GROUPS,
    ErrorGroup,
    TeatPlaces,
    error_map,
    error_maps,
    error_regions,
)
from reports.frames import places_of
from reports.page import Cell, Figure, Fold, Notes, Paragraph, Part
from textfiles.text import plural

POSE_SET = "pose set"
MAP_FROM = 9  # places: fewer make no map


def pose_parts(run: RunRecord, limit_mm: float) -> Iterator[Part]:
    """How the poses were chosen, and what depends on the place."""
    chosen = run.facts.get(POSE_SET)
    if chosen:
        how = f"order: {chosen['order']}; seed of the script: {chosen['seed']}"
        yield Notes(f"How the poses were chosen ({how})", tuple(chosen["chosen"]))
    else:
        yield Paragraph("The poses are those of the recording; how they were chosen isn't in it.")
    for detector in run.detectors:
        yield _map(run, detector, limit_mm)
        yield from precision_parts(run, detector)


def _map(run: RunRecord, detector: str, limit_mm: float) -> Part:
    """Each pose once, with the worst of its repeats."""
    rows, anchors = error_rows(run, detector), anchors_of(run)
    places = pose_places(rows)
    if len(places) < MAP_FROM:
        return Paragraph(
            f"Error over the places, {detector}: {len(places)} places of a teat are no map;"
            f" {MAP_FROM} are the least."
        )
    found = [place for place in places if place.worst_mm is not None]
    missed = [place for place in places if place.found < place.repeats]
    teats = [
        TeatPlaces(
            teat,
            [place.place_mm for place in found if place.teat == teat],
            [float(place.worst_mm or 0.0) for place in found if place.teat == teat],
            [place.place_mm for place in missed if place.teat == teat],
            tuple(anchors[str(place.worst_trial)] for place in found if place.teat == teat),
            tuple(anchors[str(place.missed_trial)] for place in missed if place.teat == teat),
        )
        for teat in rows.teat_names
    ]
    within = sum((place.worst_mm or 0.0) <= limit_mm for place in found)
    alt = (
        f"{len(places)} places: {within} within {limit_mm:g} mm, {len(found) - within} beyond,"
        f" {len(missed)} not found"
    )
    caption = (
        f"Error over the plane, {detector}; the area of a disc is the error, and each mark opens"
        f" its trial. {alt}."
    )
    if any(place.repeats > 1 for place in places):
        caption += (
            " Of a pose's repeats the worst is drawn, and a triangle where any of them missed the"
            " teat."
        )
    name = f"map-{id_of(detector)}"
    if len(teats) == 1:
        svg = error_map(teats[0], limit_mm, name=name)
    else:
        svg = error_maps(teats, limit_mm, name=name)
        caption += (
            " Each teat has a panel of its own, all on one scale; y points away from the cameras,"
            " z up."
        )
    return Figure(svg, caption, alt, wide=True)


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


def trend_parts(rows: ErrorRows, detector: str) -> Iterator[Part]:
    """A figure and a table of all lines; a sentence where there are too few poses for any."""
    poses = len(set(rows.of_found(rows.poses)))
    if poses < LEAST_TREND_POSES:
        yield Paragraph(
            f"Trends, {detector}: {NOT_MEASURED}; teats were found in {plural(poses, 'pose')}, and"
            f" {LEAST_TREND_POSES} are the least."
        )
        return
    slopes, measured, unmeasured = [], [], {}
    for line in run_trends(rows):
        name, unit, factor = QUANTITIES[line.quantity]
        response = line.response if line.response == "distance" else f"{line.response} error"
        sizes = (f"{name} ({unit})", line.n, line.groups)
        span = line.span / factor
        if line.slope is None or line.low is None or line.high is None:
            why = Cell(f"{NOT_MEASURED}: {_why_not(line)}", "muted")
            row = ("any error", *sizes, span if line.n else "", *[""] * 6, why)
            unmeasured[line.quantity] = row  # one row for each
            continue
        effect, low, high = (value * line.span for value in (line.slope, line.low, line.high))
        slopes.append(Slope(name, response, effect, low, high, line.significant))
        ends = (formatted(end * factor, "+.3g") for end in (line.low, line.high))
        interval = " to ".join(ends)
        p = line.p_value if line.p_holm is None else line.p_holm
        text = Cell("trend shown", "warn") if line.significant else Cell("no trend shown", "muted")
        most, truth = max(abs(low), abs(high)), line.truth * line.span
        drawn = (span, line.slope * factor, interval, effect, most, truth, p, text)
        measured.append((response, *sizes, *drawn))
    shown = [f"{slope.response} with {slope.against}" for slope in slopes if slope.shown]
    says = f"Trend shown: {', '.join(shown)}." if shown else "No trend is shown."
    svg = slope_intervals(slopes, name=f"trends-{id_of(detector)}")
    caption = f"What each trend makes of its quantity's whole range, {detector}. {says}"
    yield Figure(svg, caption, says, wide=True)
    lines = (*measured, *unmeasured.values())
    listed = table("trends", lines, detector=detector)
    yield Fold(f"Trends in figures, {detector}", (listed,))


def _why_not(line: Trend) -> str:
    if not line.n:
        return "it isn't known in this run"
    if line.groups < LEAST_TREND_POSES:
        return f"in {line.groups} poses, {LEAST_TREND_POSES} are the least"
    if line.least_span:
        return (
            f"it varied by {line.span:.1f} mm only; {line.least_span:.1f} mm are needed, as"
            f" {LEAST_SPAN_U:g} times the truth's uncertainty"
        )
    return "it hardly varied"


CORNERS = 49  # of a drawn ellipse
BIAS_LEVEL = 0.05
# a view's names of its axes, whether it is the camera's, and the axes
VIEWS = (
    (("world x", "world y"), False, (0, 1)),
    (("world x", "world z"), False, (0, 2)),
    (("camera x, across", "camera z, depth"), True, (0, 2)),
)


def spread_parts(
    run: RunRecord, detector: str, limit_mm: float, camera_from_world: Floats
) -> Iterator[Part]:
    """All of one detector; ``camera_from_world`` (3, 3) turns into the right camera's axes."""
    rows, anchors = error_rows(run, detector), anchors_of(run)
    distances = np.linalg.norm(rows.errors_mm, axis=1)
    names = sorted({str(row["teat"]) for trial in run.counted for row in trial.truth})
    of = np.array(rows.of_found(rows.teats), dtype=np.str_)
    each = [distances[of == name] for name in names]
    alt = "; ".join(f"{name}: {len(mm)} found" for name, mm in zip(names, each, strict=True))
    who = places_of(run.detectors)[detector]
    svg = teat_boxes(names, each, limit_mm, who=who, name=f"teats-{id_of(detector)}")
    yield Figure(svg, f"Distance by teat, {detector}", alt or "none")
    minutes = rows.time_s[rows.found] / 60.0
    timed = np.isfinite(minutes)
    if timed.any():
        links = [anchors[trial] for trial in compress(rows.of_found(rows.trials), timed)]
        yield Figure(
            error_drift(
                *(minutes[timed], distances[timed], limit_mm),
                links=links,
                who=who,
                name=f"drift-{id_of(detector)}",
            ),
            f"Drift: distance over the time of the run, {detector}; each point opens its trial",
            plural(int(timed.sum()), "point"),
        )
    teats = teat_errors(rows)
    yield _drawn(run, detector, teats, limit_mm, camera_from_world)
    yield from _ellipsoids(run, rows, teats, detector)
    yield from trend_parts(rows, detector)


def _drawn(
    run: RunRecord, detector: str, teats: Sequence[TeatErrors], limit_mm: float, turn: Floats
) -> Figure:
    """Each teat's pose means with its 95 % ellipsoid, or of all together where teats are many."""
    anchors = anchors_of(run)
    clouds = [
        (f"teat {one.teat}", one.means_mm, one.worst_trials, one.bias.common_mm2) for one in teats
    ]
    if len(clouds) > MOST_GROUPS:
        together = np.concatenate([one.means_mm for one in teats])
        worst = tuple(trial for one in teats for trial in one.worst_trials)
        shared = [one.bias.common_mm2 for one in teats if one.bias.common_mm2 is not None]
        largest = max(shared, key=np.trace, default=None)
        clouds = [(f"{len(clouds)} teats", together, worst, largest)]
    groups = []
    for name, means, trials, common in clouds:
        frames = means, means @ turn.T
        turned = None if common is None else turn @ common @ turn.T
        bodies = [
            prediction_ellipsoid(points, common_mm2=of)
            for points, of in zip(frames, (common, turned), strict=True)
        ]
        outlines = [
            body.outline_mm(*axes, CORNERS)
            for _, in_camera, axes in VIEWS
            if (body := bodies[in_camera]) is not None
        ]
        flat = [frames[in_camera][:, axes] for _, in_camera, axes in VIEWS]
        outlined = outlines if len(outlines) == len(VIEWS) else []
        groups.append(ErrorGroup(name, flat, outlined, tuple(anchors[trial] for trial in trials)))
    views = [names for names, _, _ in VIEWS]
    svg = error_regions(groups, views, limit_mm, name=f"regions-{id_of(detector)}")
    counts = "; ".join(
        f"{name}: {plural(len(means), 'pose')}{'' if len(means) >= LEAST_POSES else ', too few'}"
        for name, means, *_ in clouds
    )
    text = (
        f"Errors with their 95 % ellipsoids, {detector}: from above, from the front, and along the"
        " view. A point is a teat's mean error at one pose, and opens its worst trial; n counts"
        f" poses. A line holds the next pose's error with 95 %; below {LEAST_POSES} poses there is"
        " none. The red circle is the limit's sphere."
    )
    alt = f"Errors with 95 % ellipsoids by teat. {counts or 'none'}."
    return Figure(svg, text, alt, wide=True)


def _ellipsoids(
    run: RunRecord, rows: ErrorRows, teats: Sequence[TeatErrors], detector: str
) -> Iterator[Part]:
    """Of each pose's mean error, since repeats of a pose share its error; then by teat."""
    whole = run_bias(rows)
    test = whole.test
    if test.n < LEAST_POSES:
        yield Paragraph(
            f"Ellipsoids, {detector}: {NOT_MEASURED}; teats were found in"
            f" {plural(test.n, 'pose')}, and {LEAST_POSES} are the least."
        )
        return
    yield Paragraph(_mean_error(rows, whole, detector))
    bodies = {"all teats": whole} | {f"teat {one.teat}": one.bias for one in teats}
    if len(teats) == 1:
        bodies = {"the teat": whole}
    lines = []
    # the tests of single teats are adjusted together
    p_values = {who: bias.test.p_value for who, bias in bodies.items()}
    known = {who: p for who, p in p_values.items() if p is not None}
    of_teats = [who for who in known if who.startswith("teat ")]
    known |= zip(of_teats, holm([known[who] for who in of_teats]), strict=True)
    for who, bias in bodies.items():
        p = known.get(who)
        lines.append((who, *_ellipsoid("next pose's mean error, 95 %", bias.next_error, bias, p)))
        lines.append((who, *_ellipsoid("bias, 95 % confidence", bias.bias, bias, p)))
    text = ""
    if test.p_value is not None:
        text = f"Is there a bias? Hotelling's T² = {test.t_squared:.2f}, p = {test.p_value:.3g}. "
    note = text + _consistent(run, detector)
    listed = table("ellipsoids", lines, note=note, detector=detector)
    yield Fold(f"Ellipsoids in figures, {detector}", (listed,))


def _mean_error(rows: ErrorRows, whole: Bias, detector: str) -> str:
    """How much of it is the detector's: what the truths share is in all errors alike."""
    mean_mm = float(np.linalg.norm(whole.means_mm.mean(axis=0)))
    shared, p_value = whole.common_mm2, whole.test.p_value
    chance = "" if p_value is None else f"; {'a' if p_value < BIAS_LEVEL else 'no'} bias is shown"
    if rows.truth is None or shared is None or not shared.any():
        return (
            f"Mean error over {plural(whole.test.n, 'pose')}, {detector}: {mean_mm:.2f} mm{chance}."
        )
    parts = rows.truth.by_source(rows.of_mean)
    largest = sorted(parts, key=lambda source: -parts[source])
    named = ", ".join(f"{source} {parts[source]:.2f} mm" for source in largest)
    return (
        f"Mean error of detector and truth together over {plural(whole.test.n, 'pose')},"
        f" {detector}: {mean_mm:.2f} mm, of which the truth may be {radial_95_mm(shared):.2f} mm"
        f" (95 %; u along an axis of what all its ends share: {named}){chance}."
    )


def _ellipsoid(
    what: str, body: Ellipsoid | None, bias: Bias, p_value: float | None
) -> tuple[object, ...]:
    test = bias.test
    if body is None:
        few = f"{NOT_MEASURED}: {LEAST_POSES} poses are the least"
        return what, test.n, None, None, "", few
    p = None if p_value is None else f"p = {p_value:.3g}"
    return what, body.n, body.centre_mm, body.half_axes_mm, body.directions[0], p


def _consistent(run: RunRecord, detector: str) -> str:
    stated = list(_stated(run, detector))
    if not stated:
        return "The detector states no covariances."
    left_out = run.facts["items"].get(detector, {}).get(LEFT_OUT)
    left_out = f" They leave out: {left_out or 'the detector does not say what'}."
    errors, covariances, ends = zip(*stated, strict=True)
    truth = joint_truth(run, ends)
    held = consistency(np.array(errors), np.array(covariances), truth=truth)
    if held.ratio is None:
        return left_out.strip()
    return (
        f"Stated covariances, with the truth's: mean e' C⁻¹ e / 3 is {held.ratio:.2f} over {held.n}"
        f" ends, where 1 is as stated and chance leaves {held.low:.2f} to {held.high:.2f} (95 %,"
        " two-sided, with what the truths share); above,"
        f" the detector claims to be surer than it is; below, it is too modest.{left_out}"
    )


def _stated(run: RunRecord, detector: str) -> Iterator[tuple[Floats, Floats, End]]:
    """Error (3,) of each found teat, its stated covariance (3, 3) mm² with the truth's, and it."""
    for trial in scored_trials(run, detector):
        score = trial.scores[detector]
        answers = [row for row in trial.found if row["detector"] == detector]
        for (answer, truth), error in zip(score.match.pairs, score.errors_mm, strict=True):
            own, stated = covariance_of(trial.truth[truth]), covariance_of(answers[answer])
            if stated is None:
                continue
            u_mm = float(trial.truth[truth]["u_mm"] or 0.0)
            total = stated + (u_mm**2 * np.eye(3) if own is None else own)
            if np.all(np.linalg.eigvalsh(total) > 0.0):
                yield np.asarray(error), total, (trial, trial.truth[truth])

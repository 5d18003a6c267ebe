"""The quality page of a calibration step, and the page of a check of an existing calibration."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np

from bench.calibrate.cameras import LEAST_LOOKED_AT as LEAST_LOOKED_AT
from bench.calibrate.cameras import PAIR, WORKING_MM, CamerasResult, PairsResult, ThermalResult
from bench.calibrate.views import BoardViews
from bench.calibrate.world import PointsAgain, WorldResult
from bench.report.chapters import Chapters, page_of
from bench.report.wording import (
    NOT_MEASURED,
    Heading,
    hints,
    key_values,
    listed,
    number,
    spanned,
    table,
)
from bench.results.cameras_agree import NEXT_UNSEEN, CamerasCheck
from bench.scoring.decisions import Decision, Verdict
from detector.calibration import Record
from detector.calibration.bundle import LENS, POSE
from detector.calibration.cameras import SIDES, CameraFit, Coverage
from detector.calibration.diagnosis import Finding, MeasuredBoard
from detector.geometry import Array
from reports.figures.errors import per_axis_errors
from reports.figures.precision import precision_by_distance, residual_field
from reports.page import (
    Banner,
    Cell,
    Code,
    Figure,
    Kind,
    Notes,
    Page,
    Paragraph,
    Part,
    Score,
    Scoreboard,
    Table,
)
from reports.page import Verdict as PageVerdict
from textfiles.text import plural

UNITS = {"fx": "px", "fy": "px", "cx": "px", "cy": "px", "om": "rad", "T": "mm"}
MARGIN_MM = 100.0  # of the working volume beyond what was touched
DISTANCES_M = np.linspace(0.7, 1.8, 23)
HOLDS = "It still holds."
CHECK = "Check of a calibration"
Row = tuple[str, str, tuple[Score | None, ...]]
PageOf = Callable[[Record, str], Page]  # of a step's record, and the command that repeats it
LIMIT_MM = 5.0  # of a teat end's error, where a script names no other
ENOUGH_MM = LIMIT_MM / 4.0  # the test uncertainty ratio 4:1


def _page(
    title: str,
    chapters: Chapters,
    *,
    scores: Sequence[Row],
    columns: tuple[str, ...] = ("Found",),
    findings: Sequence[Finding] | None = (),
    missing: tuple[str, ...] | None = None,
    first: str = "",
    **banner: Any,
) -> PageOf:
    """A step's page: scores and findings (None: not looked for), then the chapter ``first``; the
    rest folds. ``missing`` views may be None; ``banner`` are fields of a `Banner`.
    """
    rows = [*scores]
    wrong: list[Part] = []
    if findings is not None:
        names = ", ".join(finding.name for finding in findings)
        score = Score("not met" if names else "met", names or "none", "")
        rows.insert(0 if title == CHECK else 1, ("Faults", "none", (score,)))
        sound = "No fault left a mark that is both significant and large enough to matter."
        named = tuple(f"{finding.name}: {finding.sentence}" for finding in findings)
        wrong = [Notes("What was found wrong", named) if named else Paragraph(sound, tone="good")]
    if missing is not None:
        score = Score("met", "enough", "")
        if missing:
            score = Score("inconclusive", f"{len(missing)} missing", "see below")
            wrong.append(Notes("What the views don't show yet", missing))
        rows.append(("Views", "every part, tilt and distance", (score,)))
    heads = ("Looked at", "Good enough is")
    board = Scoreboard("Is it good enough?", columns, tuple(rows), heads, hints("calibration"))
    out = {"findings": ("What came out", (board, *wrong))}
    shown = out | ({first: chapters[first]} if first else {})
    behind = {anchor: chapter for anchor, chapter in chapters.items() if anchor != first}
    failed = any(score and score.verdict == "not met" for *_, found in rows for score in found)
    banner = {"kind": "computed", "verdict": "not met" if failed else "no verdict", **banner}

    def page(record: Record, command: str) -> Page:
        who = {"day": record.made, "by": record.by or "not stated", "with": record.with_what}
        files = [(name, Cell(digest, mono=True)) for name, digest in record.inputs.items()]
        made = (
            key_values("Made", {**who, **record.cameras}),
            table("inputs", files),
            Code("The command that repeats it", command),
        )
        folded = {**behind, "provenance": ("Provenance", made)}
        day = f"{'checked' if title == CHECK else 'made'} {record.made}"
        return page_of(title, day, Banner(**banner), shown, folded)

    return page


def held(mm: float) -> PageVerdict:
    """Against `ENOUGH_MM`; up to `LIMIT_MM` it depends on how good the detector is."""
    return "met" if mm <= ENOUGH_MM else "inconclusive" if mm <= LIMIT_MM else "not met"


def with_kind(page: Page, used: Collection[str], emulated: Collection[str]) -> Page:
    """``page`` with what the instruments ``used`` are."""
    there = {*used} & {*emulated}
    kind: Kind = "mixed" if there else "real"
    kind = "emulated" if there == {*used} else kind
    return replace(page, banner=replace(page.banner, kind=kind))


def _enough(name: str, mm: float, value: str, shows: str = "") -> Row:
    """A row whose limit is `ENOUGH_MM`."""
    return name, f"at most {ENOUGH_MM:g} mm", (Score(held(mm), value, shows),)


def _figure_only(name: str, value: str, shows: str = "") -> Row:
    """A row without a limit."""
    measured = value != NOT_MEASURED
    return name, "no limit", (Score("no verdict" if measured else "not measured", value, shows),)


def good(findings: Sequence[Finding], mm: float) -> tuple[PageVerdict, str]:
    """Verdict and the sentence's beginning."""
    if findings:
        return "not met", f"Not good enough: {', '.join(finding.name for finding in findings)}."
    verdict, said = held(mm), f"Not good enough: more than {LIMIT_MM:g} mm off."
    if verdict == "inconclusive":
        said = f"Good enough for a coarse look only: it uses up {100 * mm / LIMIT_MM:.0f} % of the"
        said += " error that a detector may make."
    return verdict, "Good enough." if verdict == "met" else said


def cameras_page(result: CamerasResult, at_mm: float = WORKING_MM) -> PageOf:
    """Of `calibrate cameras`, judged at the distance where teats stand, wherever boards were."""
    near, far = result.shown_mm
    good_mm = float(result.good_to_mm(np.array([at_mm]))[0])
    pairs, board = result.views.pairs(), result.views.board
    not_shown = result.not_shown(at_mm)
    missing = (*still_missing(result.coverage), *not_shown)
    where = ", where teats stand and more tilted" if not_shown else ", nearer and more tilted"
    halves = NOT_MEASURED
    confidence = (
        "Too few pairs of views for a split-half comparison (10 are needed): nothing was held out."
    )
    if (of := result.halves) is not None:
        apart = np.concatenate([of.disagree_mm(pair.left_px, pair.right_px) for pair in pairs])
        halves = f"{_rms(apart):.2f} mm apart"
        confidence = "Two calibrations, each from half of the views, place the board's points"
        confidence += f" {halves} (rms)."
    fits = {"left": result.joint, "right": result.joint}
    verdict, _ = good(result.findings, good_mm)
    at = f"at {at_mm / 1000:.2f} m, worst direction"
    scores = (
        _enough("One point is good to", good_mm, f"{good_mm:.2f} mm", at),
        _figure_only("Two halves of the views", halves),
        _figure_only("Corners miss by", f"{result.joint.fit.rms_px:.2f} px"),
    )
    return _page(
        "Calibration of the stereo pair",
        {
            "parameters": ("Parameters", _parameters(result)),
            "residuals": ("Where corners miss", _residuals(fits, result.views)),
            "held-out": ("Measured again, from views not used", _held_out(result)),
            "worth": ("What a point is worth", _worth(result, (near / 1000.0, far / 1000.0))),
            "coverage": ("What the views show", _coverage(result.coverage)),
            "pictures": ("Pictures", _pictures(result.views, result.joint)),
        },
        scores=scores,
        findings=result.findings,
        missing=missing,
        first="worth",
        verdict=verdict,
        tested=(
            f"Stereo pair from {len(pairs)} pairs of views of a {board.columns} x {board.rows}"
            f" {board.kind}."
        ),
        sentence=cameras_sentence(result, at_mm),
        confidence=confidence,
        next_action=(
            _next(result.findings, missing, "teatbench calibrate world")
            if result.findings or good_mm <= ENOUGH_MM
            else f"Take more pairs of views{where}, and calibrate anew."
        ),
    )


def cameras_sentence(result: CamerasResult, at_mm: float = WORKING_MM) -> str:
    """Whether the pair is good enough where teats stand, with its limit."""
    good_mm = float(result.good_to_mm(np.array([at_mm]))[0])
    return (
        f"{good(result.findings, good_mm)[1]} Good to {good_mm:.2f} mm at {at_mm / 1000:.2f} m; at"
        f" most {ENOUGH_MM:g} mm is asked for, a quarter of the {LIMIT_MM:g} mm that a teat end may"
        " be off."
    )


def thermal_page(result: ThermalResult) -> PageOf:
    """Of `calibrate thermal` with a board."""
    fit, views, shown = result.joint.fit, result.views, {"thermal": result.coverage}
    missing = still_missing(shown)
    place = ", ".join(_sd(fit.sd("thermal", name), 2) for name in POSE[3:])
    return _page(
        "Calibration of the thermal camera",
        {
            "parameters": ("Parameters", [_lens(result.joint, "thermal")]),
            "residuals": ("Where points miss", _residuals({"thermal": result.joint}, views)),
            "homographies": ("Homographies for the thesis's algorithm", _homographies(result)),
            "coverage": ("What the views show", _coverage(shown)),
            "pictures": ("Pictures", _pictures(views, result.joint)),
        },
        scores=(
            _figure_only("Corners miss by", f"{fit.rms_px:.2f} px", "over both cameras"),
            _figure_only("Its place is known to", f"{place} mm", "x, y, z"),
        ),
        missing=missing,
        first="residuals",
        tested=(
            f"Thermal camera from {plural(len(result.joint.view_rms_px('thermal')), 'view')} of a"
            f" heated board ({views.board.kind})."
        ),
        sentence=(
            f"No limit is set for it. Points miss by {fit.rms_px:.2f} px on average over both"
            " cameras; a part of a pixel is what to expect."
        ),
        confidence=f"Its place is known to {place} mm (x, y, z; one standard deviation).",
        next_action=_next((), missing, "teatbench calibrate world"),
    )


def pairs_page(result: PairsResult) -> PageOf:
    """Of `calibrate thermal` with a table of point pairs."""
    left, right = both = (result.left, result.right)
    tables = []
    for side, mapped in zip(("left", "right"), both, strict=True):
        counts = ["yes" if kept else Cell("no: outlier", "warn") for kept in mapped.inliers]
        rows = list(zip(count(1), mapped.missed_px, counts, strict=False))
        tables.append(table("point_pairs", rows, side=side))
    kept = [f"{mapped.inliers.sum()} of {len(mapped.inliers)}" for mapped in both]
    counted = tuple(Score("no verdict", text, "") for text in kept)
    missed = tuple(Score("no verdict", f"{m.rms_px:.2f} px", "") for m in both)
    return _page(
        "Homographies from point pairs",
        {"pairs": ("Point pairs", tables)},
        scores=(("Pairs that count", "no limit", counted), ("They miss by", "no limit", missed)),
        columns=("Thermal to left", "Thermal to right"),
        findings=None,
        tested=f"Homographies from {len(left.inliers)} point pairs.",
        sentence=(
            f"{int(left.inliers.sum())} and {int(right.inliers.sum())} pairs count; they miss by"
            f" {left.rms_px:.2f} and {right.rms_px:.2f} px rms."
        ),
        confidence=(
            "A homography is right on the plane of its points only; off it, it misses the more the"
            " farther."
        ),
        next_action=(
            "Calibrate the thermal camera on a heated board where you can: it then holds at every"
            " distance."
        ),
    )


def world_page(result: WorldResult) -> PageOf:
    """Of `calibrate world`."""
    fit, comparison = result.fit, result.fit.comparison
    out_mm = comparison.held_out_mm
    held_out = {name: None if mm is None else f"{mm:.3f}" for name, mm in out_mm.items()}
    models = table(
        "world_fits",
        [(f.model, f.fre_mm, held_out[f.model], f.singular_values) for f in comparison.fits],
    )
    residuals = table(
        "world_residuals",
        [(n, *row, np.linalg.norm(row)) for n, row in enumerate(comparison.rigid.residuals_mm, 1)],
    )
    volume = working_volume_mm(fit.touched_mm)
    there = fit.target_error_mm(volume)
    places = volume.reshape(3, 9, 3)
    expected = table(
        "world_expected",
        np.column_stack([places[0, :, 1:], there.reshape(3, 9).T]),
        more=(Heading(f"x = {x:.0f} mm", "right", "mm", form=".2f") for x in places[:, 0, 0]),
        margin_mm=MARGIN_MM,
    )
    touched = spanned(fit.target_error_mm(fit.touched_mm), ".2f", "mm")
    worst = float(there.max())
    verdict, said = good(result.findings, worst)
    left_out = number(out_mm["rigid"], "mm rms")
    where = f"{touched} at the touched places"
    scores = (
        _enough("Anywhere in the working volume", worst, f"up to {worst:.2f} mm", where),
        _figure_only("Points miss the arm's by", f"{comparison.rigid.fre_mm:.2f} mm rms"),
        _figure_only("A point left out is off by", left_out),
    )
    alt = f"{plural(len(fit.touched_mm), 'point')}, {comparison.rigid.fre_mm:.2f} mm rms"
    caption = "Where the arm touched, less where the cameras see it, along the world's axes"
    rigid_mm = comparison.rigid.residuals_mm
    shown = _touched(rigid_mm, ENOUGH_MM, "good enough", "residuals", caption, alt)
    return _page(
        "Calibration of the world",
        {
            "residuals": ("What touched points miss by", [shown]),
            "fits": ("Fits", [models, residuals]),
            "volume": ("Over the working volume", [expected]),
        },
        scores=scores,
        findings=result.findings,
        first="residuals",
        verdict=verdict,
        tested=f"World from {plural(len(fit.touched_mm), 'point')} that the arm touched.",
        sentence=(
            f"{said} The cameras' points miss the arm's by {comparison.rigid.fre_mm:.2f} mm rms;"
            f" a point left out of the fit: {left_out}."
        ),
        confidence=(
            f"A point is expected to be {touched} off at the touched places, and up to"
            f" {worst:.2f} mm in the working volume."
        ),
        next_action=(
            _next(result.findings, (), "teatbench calibrate merge")
            if result.findings or worst <= ENOUGH_MM
            else "Touch more points, spread wider and at two heights, and make this step anew."
        ),
    )


def _touched(
    missed_mm: Array, bound_mm: float, bound: str, name: str, caption: str, alt: str
) -> Figure:
    """What touched points (n, 3) are off by, along each axis."""
    errors, point = [missed_mm], "one touched point"
    svg = per_axis_errors(["touched points"], errors, bound_mm, point=point, bound=bound, name=name)
    return Figure(svg, caption, alt, wide=True)


def check_page(again: MeasuredBoard, findings: Sequence[Finding]) -> PageOf:
    """Of `calibrate check`: an existing calibration against a board seen today."""
    return _check(
        {"measured": ("The board, measured", [_measured_table(again)])},
        findings,
        scores=(
            _figure_only("Lengths against the print", f"{100 * (again.scale[0] - 1.0):+z.2f} %"),
            _figure_only("Distance of neighbours off by", f"{again.spacing_rms_mm:.3f} mm"),
            _figure_only("Board flat to", f"{again.flatness_rms_mm:.3f} mm"),
            _figure_only("Rows off by", f"{again.epipolar_rms_px:.2f} px"),
        ),
        tested=f"An existing calibration on {plural(len(again.views), 'view')} of a board.",
        confidence=(
            f"{plural(len(again.views), 'view')} of a board today. A fault is named only where it"
            " is significant and large enough to matter."
        ),
        cure="Calibrate anew (teatbench calibrate cameras), after looking at what is named below.",
        undecided=len(again.views) < LEAST_LOOKED_AT,
    )


def check_points_page(again: PointsAgain, findings: Sequence[Finding]) -> PageOf:
    """Of `calibrate check --points`: an existing calibration against points touched today."""
    rms = np.sqrt(np.mean(np.sum(again.missed_mm**2, axis=1)))
    rows = np.column_stack([again.missed_mm, again.expected_mm])
    points = table("points_again", [(n, *row) for n, row in enumerate(rows, 1)])
    expected = _rms(again.expected_mm)
    caption = "Where the cameras see it, less where the arm touched, along the world's axes"
    alt = f"{plural(len(rows), 'point')}, {rms:.2f} mm rms"
    shown = _touched(again.missed_mm, expected, "expected", "missed", caption, alt)
    return _check(
        {
            "points": ("What touched points miss by", [shown]),
            "measured": ("The points, measured", [points]),
        },
        findings,
        scores=(_figure_only("Points missed by", f"{rms:.2f} mm", f"{expected:.2f} mm expected"),),
        first="points",
        tested=f"An existing calibration on {plural(len(rows), 'point')} that the arm touched.",
        confidence=(
            f"Points are missed by {rms:.2f} mm rms; on the mean by"
            f" {listed(again.missed_mm.mean(axis=0), '+.2f')} mm."
        ),
        cure="Look at what is named below, then make the world's step again (calibrate world).",
        undecided=len(again.missed_mm) < LEAST_LOOKED_AT,
    )


def check_ends_page(found: CamerasCheck, decision: Decision) -> PageOf:
    """Of `calibrate check --ends`."""
    off = decision.verdict is Verdict.NOT_MET
    rows = [(one.name, one.value, one.uncertainty, one.poses) for one in found.offsets]
    shown = table("ends_again", rows, measured=found.measured, ends=found.ends)
    return _check(
        {"ends": ("Where the cameras show touched ends", [shown])},
        [Finding("cameras off", decision.sentence)] if off else [],
        scores=[_figure_only(o.name, f"{o.value:+z.2f} px", "") for o in found.offsets[:1]],
        first="ends",
        tested=f"An existing calibration on {found.ends} teat ends that the arm touched.",
        confidence=decision.sentence,
        cure="Look for a camera that was knocked, then calibrate again.",
        undecided=decision.verdict is not Verdict.MET and not off,
    )


def _check(
    chapters: Chapters,
    findings: Sequence[Finding],
    *,
    cure: str,
    undecided: bool = False,
    **said: Any,
) -> PageOf:
    """``said``: what else `_page` takes."""
    verdict, sentence, then = "met", HOLDS, "Nothing: go on measuring with it."
    if undecided:
        verdict, sentence, then = "inconclusive", "Not decided.", NEXT_UNSEEN
    if findings:
        named = "; ".join(finding.name for finding in findings)
        verdict, sentence, then = "not met", f"It no longer holds: {named}.", cure
    said = {"verdict": verdict, "sentence": sentence, "next_action": then, **said}
    return _page(CHECK, chapters, findings=findings, **said)


def _next(findings: Sequence[Finding], missing: Sequence[str], then: str) -> str:
    if findings:
        return "Cure what is named below, and calibrate anew."
    return f"Better still: {missing[0]}. Then: {then}." if missing else f"Go on with: {then}."


def still_missing(shown: Mapping[str, Coverage]) -> tuple[str, ...]:
    """What views of each camera still lack, as instructions."""
    return tuple(f"{name}: {text}" for name, each in shown.items() for text in each.missing)


def _parameters(result: CamerasResult) -> Iterator[Part]:
    """Both lenses and the motion between them, with standard deviations."""
    for camera in PAIR:
        yield _lens(result.joint, camera, result.alone[camera])

    joint, fixed = result.joint.fit, result.fixed.fit
    motions = (result.pair.right_from_left, fixed.rig.from_reference["right"])
    rows = []
    for name, *both in zip(POSE, *((*motion.om, *motion.T) for motion in motions), strict=True):
        digits = 3 if name.startswith("T") else 5
        value, other = (f"{number:.{digits}f}" for number in both)
        rows.append((name, UNITS[name[:-1]], value, _sd(joint.sd("right", name), digits), other))
    yield table("stereo", rows, joint_px=joint.rms_px, fixed_px=fixed.rms_px)


def _lens(fit: CameraFit, camera: str, alone: CameraFit | None = None) -> Table:
    """One camera's lens; beside it what the camera alone gave, where that is known."""

    lenses = [of.fit.rig.cameras[camera] for of in (fit, alone) if of is not None]
    rows = []
    for name, *each in zip(LENS, *((*of.fc, *of.cc, *of.kc) for of in lenses), strict=True):
        digits = 5 if name[0] in "kp" else 3
        value, *other = (f"{number:.{digits}f}" for number in each)
        sd = _sd(fit.fit.sd(camera, name), digits)
        rows.append((name, UNITS.get(name, ""), value, sd, *other))
    more = [] if alone is None else [Heading("alone", "right")]
    return table("lens", rows, more=more, camera=camera)


def _sd(value: float | None, digits: int) -> str:
    return "fixed" if value is None else f"{value:.{digits}f}"


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _residuals(fits: Mapping[str, CameraFit], views: BoardViews) -> Iterator[Part]:
    """Where the corners lie, and which way they miss."""
    for camera, fit in fits.items():
        pairs = [
            (s.pixels_px, r)
            for s, r in zip(fit.sightings, fit.fit.residuals_px, strict=True)
            if s.camera == camera
        ]
        at, miss = (np.concatenate(arrays) for arrays in zip(*pairs, strict=True))
        (x, y), (dx, dy), size = at.T, miss.T, views.image_size[camera]
        svg = residual_field(x, y, dx, dy, size, name=f"residuals-{camera}")
        rms, mean = np.sqrt(np.mean(np.sum(miss**2, axis=1))), listed(miss.mean(axis=0), "+.3f")
        alt = f"{plural(len(miss), 'point')}, rms {rms:.3f} px, mean {mean} px"
        yield Figure(svg, f"Points of the {camera} camera: seen less predicted", alt)


def _held_out(result: CamerasResult) -> Iterator[Part]:
    """Spacing, flatness and rows from views not used."""
    again = result.held_out
    if again is None:
        yield Paragraph(
            "Not measured: fewer than 10 pairs of views, so that none could be held out.",
            tone="warn",
        )
        return
    (scale, scale_sd), (bend, bend_sd), (row, row_sd) = again.scale, again.bend, again.epipolar
    pitch, rows_px = again.board.pitch_mm, again.epipolar_rms_px
    entries = {
        "lengths against the print": f"{scale:.5f} ± {scale_sd:.5f} (1 sd)",
        "distance of neighbours": f"{again.spacing_rms_mm:.3f} mm rms from {pitch:g} mm",
        "flatness": f"{again.flatness_rms_mm:.3f} mm rms",
        "bend of the board": f"{bend:+z.3f} ± {bend_sd:.3f} mm, middle over rim",
        "rows against each other": f"{row:+z.3f} ± {row_sd:.3f} px, {rows_px:.3f} px rms",
    }
    whose = "Each half of the views, measured with the calibration that the other half made"
    yield key_values(whose, entries)
    if result.halves is not None:
        apart = _rms(np.array(list(result.halves.differences.values())))
        yield Paragraph(
            f"The two halves' parameters differ by {apart:.2f} of their combined standard"
            " deviations (rms; 1 is expected)."
        )
    yield _measured_table(again)


def _measured_table(again: MeasuredBoard) -> Table:
    """A board measured again, view by view."""
    rows = [
        (v.name, v.depth_mm, v.scale, *map(_rms, (v.spacing_mm, v.off_plane_mm, v.epipolar_px)))
        for v in again.views
    ]
    return table("board_again", rows)


def _worth(result: CamerasResult, seen_m: tuple[float, float]) -> Iterator[Part]:
    """What a point is good to by distance, and what a pixel of disparity is worth."""
    good = result.good_to_mm(1000.0 * DISTANCES_M)
    words = "; ".join(
        f"{good[i]:.2f} mm at {DISTANCES_M[i]:.2f} m" for i in (0, len(good) // 2, len(good) - 1)
    )
    svg = precision_by_distance(DISTANCES_M, good, seen_m)
    yield Figure(svg, "What one triangulated point is good to", words, wide=True)
    pair = result.pair
    focal = 0.5 * (pair.left.fc[0] + pair.right.fc[0])
    per_px = 1e6 / (focal * float(np.linalg.norm(pair.right_from_left.T)))
    worth = ", ".join(f"{z**2 * per_px:.1f} mm at {z:g} m" for z in (1.0, 1.2, 1.5, 1.75))
    yield Paragraph(
        f"An error of one pixel of disparity is an error in depth of {worth}. That is the geometry"
        " of this pair, whatever the method."
    )


def _coverage(shown: Mapping[str, Coverage]) -> Iterator[Part]:
    """Points by part of the picture, tilts and distances."""
    for camera, coverage in shown.items():
        sides = [side.split(" edge")[0].removeprefix("its ") for side in SIDES]
        tilts = ", ".join(f"{n} {side}" for side, n in zip(sides, coverage.tilted, strict=True))
        span = coverage.distances_mm
        far = "unknown" if span is None else spanned(span, ".0f", "mm")
        rows = zip(("top", "middle", "bottom"), *zip(*coverage.corners, strict=True), strict=True)
        seen = coverage.views
        yield table("coverage", rows, camera=camera, views=seen, far=far, tilts=tilts)


def _pictures(views: BoardViews, fit: CameraFit) -> Iterator[Part]:
    """Views used, and what was left out with its reason."""
    rows = []
    for camera in views.found:
        errors = fit.view_rms_px(camera)
        for name, found in views.found[camera].items():
            missed = f"{errors[name]:.3f}" if name in errors else None
            rows.append((camera, name, len(found.ids), found.edges_px, missed))
    yield table("views", rows)
    reasons = tuple(f"{r.camera} {r.view}: {r.reason}" for r in views.refused)
    none = Paragraph("No picture was left out.", tone="good")
    yield Notes("Left out", reasons) if reasons else none


def working_volume_mm(touched_mm: Array) -> Array:
    """Points (27, 3) over the box of the touched places, `MARGIN_MM` larger on every side."""
    low, high = touched_mm.min(axis=0) - MARGIN_MM, touched_mm.max(axis=0) + MARGIN_MM
    grid = np.meshgrid(*np.linspace(low, high, 3).T, indexing="ij")
    return np.column_stack([axis.reshape(-1) for axis in grid])


def _homographies(result: ThermalResult) -> Iterator[Part]:
    """The homographies and the plane they hold on."""
    maps = result.homographies
    yield Paragraph(
        f"Derived at a plane {maps.plane_depth_mm or 0.0:.0f} mm before the right camera, parallel"
        " to its picture; wrong elsewhere."
    )
    for side, H in (("left", maps.left), ("right", maps.right)):
        lines = ("  ".join(f"{v: .6g}" for v in row) for row in H)
        yield Code(f"thermal to {side}", "\n".join(lines))

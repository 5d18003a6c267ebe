"""Parts on calibration: what a run's report says of the one that it used, with the limit that it
sets at each distance; and the tables, figures and notes of a calibration's quality page.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from bench.calibrate.cameras import PAIR, CamerasResult, ThermalResult
from bench.calibrate.views import BoardViews
from bench.record.reader import RunRecord
from bench.report.tables import ends_mm, key_values
from bench.report.wording import NOT_MEASURED
from bench.script.calibration_age import CALIBRATION_FACT
from detector.calibration import Calibration, Record
from detector.calibration.bundle import LENS, POSE
from detector.calibration.cameras import Calibrated
from detector.calibration.coverage import SIDES, Coverage
from detector.calibration.diagnosis import Finding, Remeasured
from detector.geometry import Array
from reports.figures import precision_by_distance, residual_field
from reports.parts import Cell, Code, Figure, KeyValues, Notes, Paragraph, Part, Table, columns

PIXEL_SD_PX = 0.1  # of a point placed well in a picture, in each coordinate
MOST_ROWS = 6


def record_parts(run: RunRecord) -> Iterator[Part]:
    """Who calibrated the cameras, when and with what; nothing where the run has no record."""
    fact = run.facts.get(CALIBRATION_FACT)
    if fact is None:
        return
    if fact["made"] is None:
        made_from = (
            " The emulated cameras are made from it."
            if fact["emulated"]
            else " Its age is not known."
        )
        yield Paragraph(
            f"The calibration has no record of who made it, when and with what.{made_from}",
            tone="plain" if fact["emulated"] else "warn",
        )
        return
    age = f"{fact['age_days']} days on the day of the run"
    entries: list[tuple[str, object]] = [
        ("made", fact["made"]),
        ("age", age),
        ("by", fact["by"] or None),
        ("with", fact["with_what"]),
    ]
    yield key_values(
        "Calibration",
        [*entries, *((f"{name} camera", who) for name, who in fact["cameras"].items())],
    )


def limit_parts(run: RunRecord, calibration: Calibration) -> Iterator[Part]:
    """The best that any detector can reach on this calibration, by distance."""
    ends = ends_mm(run.trials)
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
        texts = (
            f"{depth[at].min():.0f} to {depth[at].max():.0f}",
            str(int(at.sum())),
            f"{per_px[at].max():.1f}",
        )
        rows.append(
            (*texts, f"{own[at].max():.2f}" if known else NOT_MEASURED, f"{seen[at].max():.2f}")
        )
    heads = columns(
        ">distance [mm] | >teat ends",
        ">one pixel of disparity [mm] # of depth: Z² / (f B)",
        (
            ">calibration alone [mm] # expanded uncertainty (k = 2) of a point, along its worst"
            " direction"
        ),
        f">with {PIXEL_SD_PX:g} px noise [mm] # the same with noise of the pixels besides",
    )
    told = (
        ""
        if known
        else " This calibration states no uncertainty, so that its own share is not in it."
    )
    note = (
        "What can be reached on this rig at best: k = 2, worst direction, the farthest of each"
        f" row.{told}"
    )
    return Table(
        "Limit of what can be reached, by distance from the cameras", heads, tuple(rows), note
    )


def _worst_mm(calibration: Calibration, ends_mm: Array, pixel_sd_px: float) -> Array:
    """Expanded uncertainty (n,) along the worst direction; 0 where a camera can't see it."""
    found = np.nan_to_num(calibration.covariance_of(ends_mm, pixel_sd_px))
    return np.asarray(2.0 * np.sqrt(np.clip(np.linalg.eigvalsh(found)[:, -1], 0.0, None)))


UNITS = {"fx": "px", "fy": "px", "cx": "px", "cy": "px", "om": "rad", "T": "mm"}
MARGIN_MM = 100.0  # of the working volume beyond what was touched
DISTANCES_M = np.linspace(0.7, 1.8, 23)


def still_missing(shown: Mapping[str, Coverage]) -> tuple[str, ...]:
    """What views of each camera still lack, as instructions."""
    return tuple(
        f"{camera}: {text}" for camera, coverage in shown.items() for text in coverage.missing
    )


def finding_parts(
    findings: Sequence[Finding], missing: Mapping[str, Coverage] | Sequence[str]
) -> Iterator[Part]:
    """What is wrong by name, and what the views lack."""
    if findings:
        yield Notes("Named", tuple(f"{finding.name}: {finding.sentence}" for finding in findings))
    else:
        yield Paragraph(
            "Nothing: no fault left a mark that is both significant and large enough to matter.",
            tone="good",
        )
    texts = still_missing(missing) if isinstance(missing, Mapping) else tuple(missing)
    if texts:
        yield Notes("What the views don't show yet", texts)


def parameter_parts(result: CamerasResult) -> Iterator[Part]:
    """Both lenses and the motion between them, with standard deviations."""
    for camera in PAIR:
        yield parameters(
            result.joint,
            camera,
            result.joint.fit.rig.cameras[camera].kc,
            alone=result.alone[camera],
        )
    motion = result.pair.right_from_left
    rows = []
    for name, value in zip(POSE, (*motion.om, *motion.T), strict=True):
        fixed, joint = result.fixed.fit, result.joint.fit
        other = dict(
            zip(
                POSE,
                (*fixed.rig.from_reference["right"].om, *fixed.rig.from_reference["right"].T),
                strict=True,
            )
        )[name]
        digits = 3 if name.startswith("T") else 5
        rows.append(
            (
                name,
                UNITS[name[:-1]],
                f"{value:.{digits}f}",
                sd_text(joint.sd("right", name), digits),
                f"{other:.{digits}f}",
            )
        )
    heads = columns("parameter | unit | >joint | >sd | >with lenses fixed")
    joint_px, fixed_px = result.joint.fit.rms_px, result.fixed.fit.rms_px
    note = (
        f"Corners miss by {joint_px:.3f} px rms jointly, by {fixed_px:.3f} px with the lenses as"
        " each camera alone has them."
    )
    yield Table(
        "Right camera against left: X_right = R(om) X_left + T", heads, tuple(rows), note=note
    )


def parameters(
    fit: Calibrated, camera: str, kc: Sequence[float], alone: Calibrated | None = None
) -> Table:
    """One camera's lens; beside it what the camera alone gave, where that is told."""
    lens = fit.fit.rig.cameras[camera]
    values = dict(zip(LENS, (*lens.fc, *lens.cc, *kc), strict=True))
    rows = []
    for name, value in values.items():
        digits = 5 if name[0] in "kp" else 3
        row: tuple[str | Cell, ...] = (
            name,
            UNITS.get(name, ""),
            f"{value:.{digits}f}",
            sd_text(fit.fit.sd(camera, name), digits),
        )
        if alone is not None:
            other = alone.fit.rig.cameras[camera]
            single = dict(zip(LENS, (*other.fc, *other.cc, *other.kc), strict=True))[name]
            row = (*row, f"{single:.{digits}f}")
        rows.append(row)
    heads = columns("parameter | unit | >value | >sd", *([] if alone is None else [">alone"]))
    return Table(f"Lens of the {camera} camera", heads, tuple(rows))


def sd_text(value: float | None, digits: int) -> str:
    """A standard deviation, or that there is none."""
    return "fixed" if value is None else f"{value:.{digits}f}"


def mm_text(value: float | None) -> str:
    """A length, or that there is none."""
    return NOT_MEASURED if value is None else f"{value:.3f}"


def residual_parts(fits: Mapping[str, Calibrated], views: BoardViews) -> Iterator[Part]:
    """Where the corners lie, and which way they miss."""
    for camera, fit in fits.items():
        pairs = [
            (s.pixels_px, r)
            for s, r in zip(fit.sightings, fit.fit.residuals_px, strict=True)
            if s.camera == camera
        ]
        at, miss = (np.concatenate(arrays) for arrays in zip(*pairs, strict=True))
        svg = residual_field(
            at[:, 0],
            at[:, 1],
            miss[:, 0],
            miss[:, 1],
            views.image_size[camera],
            name=f"residuals-{camera}",
        )
        yield Figure(svg, f"Corners of the {camera} camera: seen less predicted", _misses(miss))


def _misses(miss: Array) -> str:
    rms = np.sqrt(np.mean(np.sum(miss**2, axis=1)))
    return (
        f"{len(miss)} points, rms {rms:.3f} px, mean {miss[:, 0].mean():+.3f},"
        f" {miss[:, 1].mean():+.3f} px"
    )


def held_out_parts(result: CamerasResult) -> Iterator[Part]:
    """Spacing, flatness and rows from views not used."""
    if result.held_out is None:
        yield Paragraph(
            "Not measured: fewer than 10 pairs of views, so that none could be held out.",
            tone="warn",
        )
        return
    again = result.held_out
    scale, scale_sd = again.scale
    bend, bend_sd = again.bend
    row, row_sd = again.epipolar
    entries = (
        ("lengths against the print", f"{scale:.5f} ± {scale_sd:.5f} (1 sd)"),
        (
            "distance of neighbours",
            f"{again.spacing_rms_mm:.3f} mm rms from {again.board.pitch_mm:g} mm",
        ),
        ("flatness", f"{again.flatness_rms_mm:.3f} mm rms"),
        ("bend of the board", f"{bend:+.3f} ± {bend_sd:.3f} mm, middle over rim"),
        (
            "rows against each other",
            f"{row:+.3f} ± {row_sd:.3f} px, {again.epipolar_rms_px:.3f} px rms",
        ),
    )
    yield KeyValues(
        "Each half of the views, measured with the calibration that the other half made", entries
    )
    if result.halves is not None:
        apart = np.sqrt(np.mean(np.array(list(result.halves.differences.values())) ** 2))
        yield Paragraph(
            f"The two halves' parameters differ by {apart:.2f} of their combined standard"
            " deviations (rms; 1 is expected)."
        )
    yield measured_table(again)


def measured_table(again: Remeasured) -> Table:
    """A board measured again, view by view."""
    heads = columns(
        "view | >distance [mm] | >scale | >spacing [mm rms] | >flatness [mm rms]", ">rows [px rms]"
    )

    def rms(values: Array) -> str:
        return f"{np.sqrt(np.mean(values**2)):.3f}"

    rows = tuple(
        (
            v.name,
            f"{v.depth_mm:.0f}",
            f"{v.scale:.5f}",
            rms(v.spacing_mm),
            rms(v.off_plane_mm),
            rms(v.epipolar_px),
        )
        for v in again.views
    )
    return Table("View by view", heads, rows, searchable=True)


def worth_parts(result: CamerasResult, seen_m: tuple[float, float]) -> Iterator[Part]:
    """What a point is good to by distance, and what a pixel of disparity is worth."""
    good = result.good_to_mm(1000.0 * DISTANCES_M)
    words = "; ".join(
        f"{good[i]:.2f} mm at {DISTANCES_M[i]:.2f} m" for i in (0, len(good) // 2, len(good) - 1)
    )
    yield Figure(
        precision_by_distance(DISTANCES_M, good, seen_m),
        "What one triangulated point is good to",
        words,
        wide=True,
    )
    pair = result.pair
    focal, baseline = (
        0.5 * (pair.left.fc[0] + pair.right.fc[0]),
        float(np.linalg.norm(pair.right_from_left.T)),
    )
    per_px = [
        f"{z:.1f} m: {(1000 * z) ** 2 / (focal * baseline):.1f} mm" for z in (1.0, 1.2, 1.5, 1.75)
    ]
    yield Paragraph(
        "One pixel of disparity is worth, in depth: "
        + ", ".join(per_px)
        + ". No method on this pair does better a pixel."
    )


def coverage_parts(shown: Mapping[str, Coverage]) -> Iterator[Part]:
    """Corners by part of the picture, tilts and distances."""
    for camera, coverage in shown.items():
        rows = tuple(tuple(str(int(count)) for count in row) for row in coverage.corners)
        heads = columns(">far left | >left | >right | >far right")
        tilts = ", ".join(
            f"{count} {side.split(' edge')[0].removeprefix('its ')}"
            for side, count in _sides(coverage)
        )
        span = (
            "unknown"
            if coverage.distances_mm is None
            else "{:.0f} to {:.0f} mm".format(*coverage.distances_mm)
        )
        note = (
            f"{coverage.views} views; distances {span}; tilted towards the cameras by an edge:"
            f" {tilts}."
        )
        yield Table(f"Corners by part of the {camera} picture", heads, rows, note=note)


def _sides(coverage: Coverage) -> list[tuple[str, int]]:
    return list(zip(SIDES, coverage.tilted, strict=True))


def picture_parts(views: BoardViews, fit: Calibrated) -> Iterator[Part]:
    """Views used, and what was left out with its reason."""
    rows: list[tuple[str | Cell, ...]] = []
    for camera in views.found:
        errors = fit.view_rms_px(camera)
        for name, found in views.found[camera].items():
            edges = "" if found.edges_px is None else "{:.1f}, {:.1f}".format(*found.edges_px)
            rows.append(
                (
                    camera,
                    name,
                    str(len(found.ids)),
                    edges,
                    f"{errors[name]:.3f}" if name in errors else NOT_MEASURED,
                )
            )
    heads = columns("camera | view | >points | >edges [px] | >misses by [px rms]")
    yield Table("Views used", heads, tuple(rows), searchable=True)
    left_out = tuple(f"{r.camera} {r.view}: {r.reason}" for r in views.refused)
    yield (
        Notes("Left out", left_out)
        if left_out
        else Paragraph("No picture was left out.", tone="good")
    )


def working_volume_mm(touched_mm: Array) -> Array:
    """Points (27, 3) over the box of the touched places, `MARGIN_MM` larger on every side."""
    low, high = touched_mm.min(axis=0) - MARGIN_MM, touched_mm.max(axis=0) + MARGIN_MM
    grid = np.meshgrid(*np.linspace(low, high, 3).T, indexing="ij")
    return np.column_stack([axis.reshape(-1) for axis in grid])


def target_table(volume_mm: Array, errors_mm: Array) -> Table:
    """Expected target errors (27,) at `working_volume_mm`: rows y and z, columns x."""
    x = [volume_mm[9 * at, 0] for at in range(3)]
    heads = columns(">y [mm] | >z [mm]", *(f">x = {value:.0f} mm [mm]" for value in x))
    rows = tuple(
        (
            f"{volume_mm[at, 1]:.0f}",
            f"{volume_mm[at, 2]:.0f}",
            *(f"{errors_mm[9 * across + at]:.2f}" for across in range(3)),
        )
        for at in range(9)
    )
    note = (
        f"The box of the touched places, {MARGIN_MM:.0f} mm larger on every side. Fitzpatrick, West"
        " and Maurer 1998, eq. 46."
    )
    return Table("Expected target error, rms", heads, rows, note=note)


def homography_parts(result: ThermalResult) -> Iterator[Part]:
    """The homographies and the plane they hold on."""
    maps = result.homographies
    text = (
        f"Derived at a plane {maps.plane_depth_mm or 0.0:.0f} mm before the right camera, parallel"
        " to its picture; wrong elsewhere."
    )
    yield Paragraph(text)
    for side, H in (("left", maps.left), ("right", maps.right)):
        yield Code(
            f"thermal to {side}", "\n".join("  ".join(f"{v: .6g}" for v in row) for row in H)
        )


def provenance_parts(record: Record, command: str) -> Iterator[Part]:
    """Who, when, with what, from which files, and the command."""
    yield KeyValues(
        "Made",
        (
            ("day", record.made),
            ("by", record.by or "not told"),
            ("with", record.with_what),
            *record.cameras.items(),
        ),
    )
    rows = tuple((name, Cell(digest, mono=True)) for name, digest in record.inputs.items())
    yield Table("Inputs", columns("file | SHA-256"), rows)
    yield Code("The command that repeats it", command)

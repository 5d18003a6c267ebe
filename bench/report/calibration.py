"""The quality page of a calibration step, and the page of a check of an existing calibration."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bench.calibrate.cameras import CamerasResult, PairsResult, ThermalResult
from bench.calibrate.views import BoardViews
from bench.calibrate.world import PointsAgain, WorldResult
from bench.report.calibration_parts import (
    coverage_parts,
    finding_parts,
    held_out_parts,
    homography_parts,
    measured_table,
    mm_text,
    parameter_parts,
    parameters,
    picture_parts,
    provenance_parts,
    residual_parts,
    sd_text,
    still_missing,
    target_table,
    working_volume_mm,
    worth_parts,
)
from detector.calibration import Record
from detector.calibration.bundle import POSE
from detector.calibration.diagnosis import Finding
from detector.calibration.remeasure import Remeasured
from reports.page import Banner, Page, Section
from reports.parts import Cell, Table, Verdict, columns

NAMED_MM = 1200.0  # about where the thesis's teats stand


def cameras_page(result: CamerasResult, record: Record, command: str) -> Page:
    """Of `calibrate cameras`."""
    near, far = _depths_m(result)
    at_mm = min(max(NAMED_MM, 1000 * near), 1000 * far)
    good_mm = float(result.good_to_mm(np.array([at_mm]))[0])
    pairs = len(result.views.pairs())
    sections = (
        Section(
            "findings",
            "What was found wrong",
            tuple(finding_parts(result.findings, still_missing(result.coverage))),
        ),
        Section("parameters", "Parameters", tuple(parameter_parts(result))),
        Section(
            "residuals",
            "Where corners miss",
            tuple(residual_parts({"left": result.joint, "right": result.joint}, result.views)),
        ),
        Section("held-out", "Measured again, from views not used", tuple(held_out_parts(result))),
        Section("worth", "What a point is worth", tuple(worth_parts(result, (near, far)))),
        Section("coverage", "What the views show", tuple(coverage_parts(result.coverage))),
        Section("pictures", "Pictures", tuple(picture_parts(result.views, result.joint))),
        Section("provenance", "Provenance", tuple(provenance_parts(record, command))),
    )
    banner = Banner(
        kind="computed",
        verdict=_verdict(result.findings),
        tested=f"Stereo pair from {pairs} pairs of views of a {_board(result.views)}.",
        sentence=(
            f"Good to {good_mm:.2f} mm at {at_mm / 1000:.2f} m (k = 2, worst direction, one point,"
            " corners as noisy as these)."
        ),
        confidence=_halves_sentence(result),
        next_action=_next(
            result.findings, still_missing(result.coverage), "teatbench calibrate world"
        ),
    )
    return Page("Calibration of the stereo pair", f"made {record.made}", banner, sections)


def thermal_page(result: ThermalResult, record: Record, command: str) -> Page:
    """Of `calibrate thermal` with a board."""
    fit = result.joint.fit
    place = [sd_text(fit.sd("thermal", name), 2) for name in POSE[3:]]
    sections = (
        Section(
            "findings",
            "What was found wrong",
            tuple(finding_parts((), {"thermal": result.coverage})),
        ),
        Section(
            "parameters",
            "Parameters",
            (parameters(result.joint, "thermal", result.joint.fit.rig.cameras["thermal"].kc),),
        ),
        Section(
            "residuals",
            "Where points miss",
            tuple(residual_parts({"thermal": result.joint}, result.views)),
        ),
        Section(
            "homographies",
            "Homographies for the thesis's algorithm",
            tuple(homography_parts(result)),
        ),
        Section(
            "coverage", "What the views show", tuple(coverage_parts({"thermal": result.coverage}))
        ),
        Section("pictures", "Pictures", tuple(picture_parts(result.views, result.joint))),
        Section("provenance", "Provenance", tuple(provenance_parts(record, command))),
    )
    banner = Banner(
        kind="computed",
        verdict="no verdict",
        tested=(
            f"Thermal camera from {len(result.joint.view_rms_px('thermal'))} views of a heated"
            f" {result.views.board.kind}."
        ),
        sentence=f"Points miss by {fit.rms_px:.2f} px rms over both cameras.",
        confidence=f"Its place is known to {', '.join(place)} mm (x, y, z; 1 sd).",
        next_action=_next(
            (), still_missing({"thermal": result.coverage}), "teatbench calibrate world"
        ),
    )
    return Page("Calibration of the thermal camera", f"made {record.made}", banner, sections)


def pairs_page(result: PairsResult, record: Record, command: str) -> Page:
    """Of `calibrate thermal` with a table of point pairs."""
    tables = tuple(
        Table(
            f"Pairs, thermal to {side}",
            columns(">pair | >misses by [px] | counts"),
            tuple(
                (str(n), f"{missed:.2f}", "yes" if kept else Cell("no: outlier", "warn"))
                for n, (missed, kept) in enumerate(rows, 1)
            ),
        )
        for side, mapped in (("left", result.left), ("right", result.right))
        for rows in [list(zip(mapped.missed_px, mapped.inliers, strict=True))]
    )
    kept = (int(result.left.inliers.sum()), int(result.right.inliers.sum()))
    banner = Banner(
        kind="computed",
        verdict="no verdict",
        tested=f"Homographies from {len(result.left.inliers)} point pairs.",
        sentence=(
            f"{kept[0]} and {kept[1]} pairs count; they miss by {result.left.rms_px:.2f} and"
            f" {result.right.rms_px:.2f} px rms."
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
    sections = (
        Section("pairs", "Point pairs", tables),
        Section("provenance", "Provenance", tuple(provenance_parts(record, command))),
    )
    return Page("Homographies from point pairs", f"made {record.made}", banner, sections)


def world_page(result: WorldResult, record: Record, command: str) -> Page:
    """Of `calibrate world`."""
    fit, comparison = result.fit, result.fit.comparison
    target = fit.target_error_mm(fit.touched_mm)
    held_out = comparison.held_out_mm["rigid"]
    models = Table(
        "Fits of triangulated to touched points; rigid is used, the others are a diagnosis",
        columns("fit | >residual [mm rms] | >held out [mm rms] | >singular values"),
        tuple(
            (
                f.model,
                f"{f.fre_mm:.3f}",
                mm_text(comparison.held_out_mm[f.model]),
                ", ".join(f"{v:.4f}" for v in f.singular_values),
            )
            for f in comparison.fits
        ),
        note="Where affine is much better, the stereo calibration is off.",
    )
    heads = columns(">point | >dx [mm] | >dy [mm] | >dz [mm] | >distance [mm]")
    residuals = Table(
        "Touched less mapped",
        heads,
        tuple(
            (str(n), *(f"{v:+.3f}" for v in row), f"{np.linalg.norm(row):.3f}")
            for n, row in enumerate(comparison.rigid.residuals_mm, 1)
        ),
    )
    volume = working_volume_mm(fit.touched_mm)
    there = fit.target_error_mm(volume)
    near = (
        f"Expected target error {target.min():.2f} to {target.max():.2f} mm at the touched places"
    )
    worst = f"{near}, up to {there.max():.2f} mm in the working volume."
    banner = Banner(
        kind="computed",
        verdict=_verdict(result.findings),
        tested=f"World from {len(fit.touched_mm)} points that the arm touched.",
        sentence=(
            f"Mapped points miss the arm's by {comparison.rigid.fre_mm:.3f} mm rms, a point left"
            f" out by {mm_text(held_out)} mm rms."
        ),
        confidence=worst,
        next_action=_next(result.findings, (), "teatbench calibrate merge"),
    )
    sections = (
        Section("findings", "What was found wrong", tuple(finding_parts(result.findings, ()))),
        Section("fits", "Fits", (models, residuals)),
        Section("volume", "Over the working volume", (target_table(volume, there),)),
        Section("provenance", "Provenance", tuple(provenance_parts(record, command))),
    )
    return Page("Calibration of the world", f"made {record.made}", banner, sections)


def _verdict(findings: Sequence[Finding]) -> Verdict:
    return "not met" if findings else "no verdict"


def _next(findings: Sequence[Finding], missing: Sequence[str], then: str) -> str:
    if findings:
        return "Cure what is named below, and calibrate anew."
    return f"Better still: {missing[0]}. Then: {then}." if missing else f"{then}."


def _depths_m(result: CamerasResult) -> tuple[float, float]:
    spans = [shown.distances_mm for shown in result.coverage.values() if shown.distances_mm]
    return min(near for near, _ in spans) / 1000.0, max(far for _, far in spans) / 1000.0


def _halves_sentence(result: CamerasResult) -> str:
    if result.halves is None:
        return (
            "Too few pairs of views for a split-half comparison (10 are needed): nothing was held"
            " out."
        )
    pairs = result.views.pairs()
    apart = np.concatenate(
        [result.halves.disagree_mm(pair.left_px, pair.right_px) for pair in pairs]
    )
    return (
        "Two calibrations, each from half of the views, place the board's points"
        f" {np.sqrt(np.mean(apart**2)):.2f} mm apart (rms)."
    )


def _board(views: BoardViews) -> str:
    return f"{views.board.columns} x {views.board.rows} {views.board.kind}"


def check_page(
    again: Remeasured, findings: Sequence[Finding], record: Record, command: str
) -> Page:
    """Of `calibrate check`: an existing calibration against a board seen today."""
    figures = (
        f"spacing {again.spacing_rms_mm:.3f} mm, flatness {again.flatness_rms_mm:.3f} mm, rows"
        f" {again.epipolar_rms_px:.2f} px"
    )
    sentence = (
        "It still holds."
        if not findings
        else "It no longer holds: " + "; ".join(f.name for f in findings) + "."
    )
    banner = Banner(
        kind="computed",
        verdict="met" if not findings else "not met",
        tested=f"An existing calibration on {len(again.views)} views of a board.",
        sentence=sentence,
        confidence=f"Rms: {figures}.",
        next_action=(
            "Nothing."
            if not findings
            else (
                "Calibrate anew (teatbench calibrate cameras), after looking at what is named"
                " below."
            )
        ),
    )
    sections = (
        Section("findings", "What was found wrong", tuple(finding_parts(findings, ()))),
        Section("measured", "The board, measured", (measured_table(again),)),
        Section("provenance", "Provenance", tuple(provenance_parts(record, command))),
    )
    return Page("Check of a calibration", f"checked {record.made}", banner, sections)


def check_points_page(
    again: PointsAgain, findings: Sequence[Finding], record: Record, command: str
) -> Page:
    """Of `calibrate check --points`: an existing calibration against points touched today."""
    rms = float(np.sqrt(np.mean(np.sum(again.missed_mm**2, axis=1))))
    x, y, z = again.missed_mm.mean(axis=0)
    heads = columns(">point | >dx [mm] | >dy [mm] | >dz [mm] | >expected [mm]")
    rows = tuple(
        (str(n), *(f"{v:+.2f}" for v in row), f"{expected:.2f}")
        for n, (row, expected) in enumerate(zip(again.missed_mm, again.expected_mm, strict=True), 1)
    )
    table = Table(
        "Measured less touched",
        heads,
        rows,
        note="Expected: root of the summed variances of calibration, pixels and touch.",
    )
    banner = Banner(
        kind="computed",
        verdict="met" if not findings else "not met",
        tested=f"An existing calibration on {len(again.missed_mm)} points that the arm touched.",
        sentence=(
            "It still holds."
            if not findings
            else "It no longer holds: " + "; ".join(f.name for f in findings) + "."
        ),
        confidence=(
            f"Points are missed by {rms:.2f} mm rms; on the mean by {x:+.2f}, {y:+.2f},"
            f" {z:+.2f} mm."
        ),
        next_action=(
            "Nothing."
            if not findings
            else "Look at what is named below, then make the world's step again (calibrate world)."
        ),
    )
    sections = (
        Section("findings", "What was found wrong", tuple(finding_parts(findings, ()))),
        Section("points", "The points, measured", (table,)),
        Section("provenance", "Provenance", tuple(provenance_parts(record, command))),
    )
    return Page("Check of a calibration", f"checked {record.made}", banner, sections)

"""What the thesis printed of its rig and asked of its detector, beside this run: homography, stand-off, a pixel, arm, bath, time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.detecting.latency import latency_of
from bench.record import RunRecord
from bench.scoring.points import Floats
from bench.scoring.rates import percent
from bench.summary.overlays import project_all
from bench.summary.thesis.figures import Thesis
from bench.summary.wording import NOT_MEASURED, number
from bench.verdicts import scored
from detector.calibration import Calibration
from detector.calibration.thesis_rig import LEFT, RIGHT
from detector.geometry import apply_homography
from reports.page import Column, Table

Row = tuple[str, str, str, str, str]


def rig_table(run: RunRecord, figures: Thesis, calibration: Calibration) -> Table:
    """A row a figure: what, section, printed, this run, what is wrong or to be known."""
    columns = (Column("figure"), Column("section"), Column("thesis"), Column("this run"), Column("what is wrong in it"))
    rows = (*_asked(run, figures), *_geometry(run, figures, calibration), *_reference(run, figures, calibration))
    return Table("Other figures of the thesis beside this run", columns, rows)


def _asked(run: RunRecord, figures: Thesis) -> Iterator[Row]:
    asked = figures.asked
    found, present = sum(one.found for one in figures.situations), sum(one.present for one in figures.situations)
    pools = {name: scored(run, name) for name in run.detectors}
    far = {name: pool.summary().radial.max_mm for name, pool in pools.items()}
    yield (
        "largest error of the detector", asked.section, f"below {asked.error_mm:g} mm asked; none measured",
        _each({name: number(value, "mm") for name, value in far.items()}), asked.wrong_error,
    )  # fmt: skip
    rates = {name: f"{pool.success}, poses that succeeded" for name, pool in pools.items()}
    share = f"“100 % or near” asked; {found} of {present} teats found in section 5.2 ({percent(found / present)})"
    yield ("reliability", asked.section, share, _each(rates), asked.wrong_reliability)
    times = {name: latency_of(run, name) for name in run.detectors}
    seconds = {name: f"p95 {number(t.p95_s, 's', 3)}, longest {number(max(t.seconds, default=None), 's', 3)}" for name, t in times.items()}
    aim, most = asked.time_s
    yield ("time of a detection", asked.section, f"{aim:g} s, at most {most:g} s asked; none measured", _each(seconds), asked.wrong_time)


def _geometry(run: RunRecord, figures: Thesis, calibration: Calibration) -> Iterator[Row]:
    ends = np.array([[row["x_mm"], row["y_mm"], row["z_mm"]] for trial in run.counted for row in trial.truth]).reshape(-1, 3)
    maps, off = figures.homography, figures.stand_off
    promised = f"at most {maps.largest_px:g} px, {maps.largest_mm:g} mm at {maps.at_mm:g} mm"
    yield ("homography from thermal to optical", maps.section, promised, _homographies(ends, figures, calibration), maps.wrong)
    depth = calibration.world_from_right.inverse().apply(ends)[:, 2] if len(ends) else np.zeros(0)
    told = f"{depth.min():.0f} to {depth.max():.0f} mm" if len(depth) else NOT_MEASURED
    yield ("distance of the teats from the cameras", off.section, f"{off.stated_mm:g} mm", told, off.wrong)
    worth = calibration.depth_per_disparity_px_mm(ends) if len(ends) else np.zeros(0)
    pixel = f"{worth.min():.1f} to {worth.max():.1f} mm of depth (Z² / f B)" if len(worth) else NOT_MEASURED
    one = figures.one_pixel
    yield ("what one pixel is worth", one.section, f"{one.error_mm:g} mm", pixel, one.wrong)


def _homographies(ends_mm: Floats, figures: Thesis, calibration: Calibration) -> str:
    """How far each map puts the true ends of this run from where the optical cameras see them."""
    seen = project_all(calibration, ends_mm)
    thermal = seen["thermal"]
    if thermal is None or not len(ends_mm):
        return f"{NOT_MEASURED}: the calibration has no thermal lens, or there is no truth"
    own = calibration.homographies
    sets = {"the calibration's": (own.left, own.right)}
    if (calibration.left, calibration.right) == (LEFT, RIGHT):  # the printed matrices are of those cameras only
        sets["the printed ones"] = (np.array(figures.homography.left), np.array(figures.homography.right))
    return _each({name: _off_px(thermal, seen["left"], seen["right"], *maps) for name, maps in sets.items()})


def _off_px(thermal: Floats, left: Floats | None, right: Floats | None, by_left: Floats, by_right: Floats) -> str:
    pairs = [(apply_homography(H, thermal), at) for H, at in ((by_left, left), (by_right, right)) if at is not None]
    off = np.concatenate([np.linalg.norm(mapped - at, axis=1) for mapped, at in pairs])
    off = off[np.isfinite(off)]
    return f"{off.mean():.1f} px on the mean, {off.max():.1f} px at most" if len(off) else NOT_MEASURED


def _reference(run: RunRecord, figures: Thesis, calibration: Calibration) -> Iterator[Row]:
    world, arm, bath = figures.world, figures.arm, figures.bath
    yield (
        "camera to table: determinant and singular values", world.section, _stretch(np.array(world.matrix)),
        _stretch(calibration.world_from_right.R), world.wrong,
    )  # fmt: skip
    known = [row["u_mm"] for trial in run.counted for row in trial.truth if row["u_mm"] is not None]
    told = f"truth known to {max(known):.2f} mm along an axis (k = 1)" if known else NOT_MEASURED
    yield ("accuracy of the arm", arm.section, f"{arm.accuracy_mm[0]:g} mm, {arm.accuracy_mm[1]:g} mm", told, arm.wrong)
    temps = [trial.head["bath_c"] for trial in run.trials if trial.head["bath_c"] is not None]
    span = f"{min(temps):.2f} to {max(temps):.2f} °C at the captures" if temps else NOT_MEASURED
    yield ("bath", bath.section, f"{bath.range_c[0]:g} to {bath.range_c[1]:g} °C", span, bath.wrong)


def _stretch(matrix: Floats) -> str:
    values = ", ".join(f"{value:.3f}" for value in np.linalg.svd(matrix, compute_uv=False))
    return f"{np.linalg.det(matrix):.3f}; {values}"


def _each(told: dict[str, str]) -> str:
    """One alone as it is; several with their names."""
    return "; ".join(f"{name}: {text}" for name, text in told.items()) if len(told) > 1 else next(iter(told.values()), NOT_MEASURED)

"""Of `thesis.py`, the plane map, beside the optical-only system that the thesis set out to beat,
and the rig's cameras, arm and bath.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from scipy.special import chdtri

import bench
from detector import Array, Calibration, apply_homography
from detector.calibration.thesis_rig import LEFT, RIGHT

STEP_MM = 25.0  # by which the sides of regions are tried
SLACK_MM = 3.0  # a touched place lies this near to the one that was meant
NONE = "not measured"
Row = tuple[str, str, str, str, str, str]


def area(sides_mm: Sequence[float]) -> str:
    return f"{sides_mm[0]:.0f} x {sides_mm[1]:.0f} mm"


def plane(trials: Sequence[Any], detector: str, theirs: Mapping[str, Any]) -> Iterator[Row]:
    """The map's figures in the order of the thesis's; ``theirs`` are those of `thesis.toml`."""
    places, distances = [], []
    for trial in trials:
        score = trial.scores[detector]
        teats = (teat for _, teat in score.match.pairs)
        found = dict(zip(teats, score.radial_mm, strict=True))
        for number, row in enumerate(trial.truth):
            if row["visible"]:
                places.append((row["x_mm"], row["y_mm"]))
                distances.append(found.get(number, np.nan))
    at, far = np.array(places).round(2), np.array(distances)
    low, high = at.min(axis=0), at.max(axis=0)

    def average(sides_mm: Iterable[float]) -> tuple[float, str]:
        """Of all that was found in the centred region."""
        inside = np.abs(at - (low + high) / 2.0) <= np.array([*sides_mm]) / 2.0 + SLACK_MM
        of = far[inside.all(axis=1)]
        found = of[np.isfinite(of)]
        mean = float(found.mean()) if len(found) else np.inf
        text = f"{mean:.2f} mm" if len(found) else NONE
        return mean, f"{text} ({len(found)} of {len(of)} found)"

    def shown(values: Any) -> str:
        return f"{values[0]:.2f} mm" if len(values) else NONE

    known = np.sort(far[np.isfinite(far)])
    repeats = [far[(at == place).all(axis=1)] for place in np.unique(at, axis=0)]
    means = sorted(np.nanmean(one) for one in repeats if np.isfinite(one).any())
    region, within = theirs["area_within_mm"], f"{theirs['within_mm']:g} mm"
    sizes = product(*(np.arange(0.0, span + SLACK_MM, STEP_MM).tolist() for span in high - low))
    good = [size for size in sizes if average(size)[0] <= theirs["within_mm"]]
    best = max(good, key=lambda size: size[0] * size[1], default=None)
    ours = {
        "plane, across and away": (area(theirs["plane_mm"]), area(high - low)),
        "places of a teat, found": ("not printed", f"{len(far)}, {len(known)} found"),
        "average error": (f"{theirs['average_mm']:g} mm", average(high - low)[1]),
        "largest error": (f"more than {theirs['largest_mm']:g} mm", shown(known[::-1])),
        "smallest error of a place": (f"less than {theirs['smallest_mm']:g} mm", shown(means)),
        f"average in the middle {area(region)}": (within, average(region)[1]),
        f"largest middle region with an average within {within}": (
            area(region),
            f"{area(best)}, {average(best)[1]}" if best else "none",
        ),
    }
    for what, (printed, measured) in ours.items():
        wrong = theirs["wrong"] if what == "average error" else ""
        yield what, theirs["section"], printed, "", measured, wrong


def spanned(values: Any, form: str, unit: str) -> str:
    return f"{min(values):{form}} to {max(values):{form}} {unit}" if len(values) else NONE


def homographies(ends: Array, calibration: Calibration, printed: Mapping[str, Any]) -> str:
    """How far each map puts the true ends from where the optical cameras see them."""
    lens, pose = calibration.thermal.lens, calibration.thermal_from_right
    if lens is None or pose is None or not len(ends):
        return f"{NONE}: the calibration has no thermal lens, or there is no truth"
    thermal = lens.project(pose.apply(calibration.world_from_right.inverse().apply(ends)))
    own = calibration.homographies
    maps = {"the calibration's": (own.left, own.right)}
    if (calibration.left, calibration.right) == (LEFT, RIGHT):  # the printed ones' cameras
        maps["the printed ones"] = np.array(printed["left"]), np.array(printed["right"])
    sentences = []
    for name, pair in maps.items():
        seen = zip(pair, calibration.project(ends), strict=True)
        off = np.concatenate([apply_homography(H, thermal) - at for H, at in seen])
        px = np.linalg.norm(off, axis=1)
        px = px[np.isfinite(px)]
        ours = f"{px.mean():.1f} px on the mean, {px.max():.1f} px at most" if len(px) else NONE
        sentences.append(f"{name}: {ours}")
    return "; ".join(sentences)


def stretch(matrix: Array) -> str:
    """Determinant; singular values."""
    values = ", ".join(f"{value:.3f}" for value in np.linalg.svd(matrix, compute_uv=False))
    return f"{np.linalg.det(matrix):.3f}; {values}"


def truth_known(run: bench.RunRecord) -> str:
    """Within which distance the least certain end lies with 95 % (Satterthwaite)."""
    far = []
    for row in (row for one in run.counted for row in one.truth if row["u_mm"] is not None):
        own = row.get("covariance_mm2")
        c = np.array(json.loads(own)) if own else row["u_mm"] ** 2 * np.eye(3)
        mean, square = np.trace(c), np.sum(c * c)
        far.append(np.sqrt(square / mean * chdtri(mean**2 / square, 0.05)) if mean else 0.0)
    return f"truth known to {max(far):.2f} mm in 95 %" if far else NONE


def rig(
    run: bench.RunRecord, calibration: Calibration, figures: Mapping[str, Any]
) -> Iterator[Row]:
    """Geometry, arm and bath."""
    rows = [row for one in run.counted for row in one.truth]
    ends = np.array([[row[f"{axis}_mm"] for axis in "xyz"] for row in rows]).reshape(-1, 3)
    depth, worth = np.empty((2, 0))
    if len(ends):
        depth = calibration.world_from_right.inverse().apply(ends)[:, 2]
        worth = calibration.depth_per_disparity_px_mm(ends)
    bath = [one.head["bath_c"] for one in run.trials if one.head["bath_c"] is not None]
    maps, off, matrix = figures["homography"], figures["stand_off"], figures["world"]["matrix"]
    known = f"at most {maps['largest_px']:g} px, {maps['largest_mm']:g} mm at {maps['at_mm']:g} mm"
    away = f"{off['stated_mm']:g} mm", spanned(off["implied_mm"], ".0f", "mm")
    pixel = spanned(worth, ".1f", "mm of depth (Z² / f B)")
    accuracy = "{:g} mm, {:g} mm".format(*figures["arm"]["accuracy_mm"])
    water = spanned(figures["bath"]["range_c"], "g", "°C")
    table = calibration.world_from_right.R
    values = {
        "homography": (known, "", homographies(ends, calibration, maps)),
        "stand_off": (*away, spanned(depth, ".0f", "mm")),
        "one_pixel": (f"{figures['one_pixel']['error_mm']:g} mm", "", pixel),
        "world": (stretch(np.array(matrix)), "", stretch(table)),
        "arm": (accuracy, "", truth_known(run)),
        "bath": (water, "", spanned(bath, ".2f", "°C at the captures")),
    }
    for key, (printed, by_tables, ours) in values.items():
        of = figures[key]
        yield of["what"], of["section"], printed, by_tables, ours, of["wrong"]

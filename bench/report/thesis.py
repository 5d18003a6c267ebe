"""What the thesis printed beside what was measured: the chapter of a run, which has it by its
situations or by the ends of its layout.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from bench.record.reader import RunRecord, points_mm
from bench.report.tables import situations, truth_known_mm
from bench.report.trials import project_all
from bench.report.wording import NOT_MEASURED, listed, number, spanned, table
from bench.results.error_rows import error_rows
from bench.results.thesis_pictures import GATE_PX, PICTURES, RADIUS_MM, ImageDistances, in_pictures
from bench.results.verdicts import latency_of, scored
from bench.scoring.errors import Bools, ErrorSummary, Floats, summarise
from bench.scoring.rates import percent
from bench.script.model import Rules, Script
from detector.calibration import Calibration
from detector.calibration.thesis_rig import LEFT, RIGHT
from detector.geometry import apply_homography
from instruments.world.situations import spoken
from reports.page import Part, Table

Kind = Literal["situations", "plane"]  # of a report, where a figure is shown
# tables of thesis.toml by name, their arrays as tuples
Thesis = SimpleNamespace
Situation = SimpleNamespace
LAYOUT = "table-5-1"  # whose ends those of the test are
SIGNED_MEAN = "components.bias_mm"
# of an `ErrorSummary`: the components as the thesis averages them, and the distances
STATISTICS = {
    SIGNED_MEAN: "mean of the signed components: the thesis's “average error” of test 1",
    "components.mean_abs_mm": "mean of the components' amounts: that of test 2",
    "components.max_abs_mm": "largest component: its “maximum error”",
    "radial.mean_mm": "mean distance to the teat end",
    "radial.max_mm": "largest distance to the teat end",
}
PLANE = "plane_map"  # the situation
STEP_MM = 12.5  # half widths of regions are tried in these steps
SLACK_MM = 3.0  # a touched place lies this near to the one that was meant
NOTE = (
    "The thesis judged one picture a situation by eye. Here a teat is found when an answer lies"
    " within the gate of its end, and every frame set counts; “as many” are the frame sets in which"
    " at least the thesis's share of the visible teats was found."
)
# figure, section, printed, by its tables, this run, what is wrong in it or to be known
Row = tuple[str, str, str, str, str, str]


@cache
def thesis() -> Thesis:
    """The published figures as printed, defects included, each with its section."""

    def named(value: Any) -> Any:
        if isinstance(value, dict):
            return SimpleNamespace(**{key: named(one) for key, one in value.items()})
        return tuple(map(named, value)) if isinstance(value, list) else value

    found: Thesis = named(tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8")))
    return found


def errors_of_test_mm(figures: Thesis, number: Literal[1, 2]) -> Floats:
    """Errors (4, 3) of the first or the second test, from its tables: triangulated less touched."""
    found = (figures.test_1 if number == 1 else figures.test_2).triangulated_mm
    return np.asarray(np.subtract(found, figures.test_1.measured_mm), dtype=np.float64)


def thesis_parts(run: RunRecord, rules: Rules, calibration: Calibration) -> Iterator[Part]:
    """The chapter of a scored run that is one of the thesis's tests; else nothing."""
    figures = thesis()
    known = [one for one in figures.situations if one.name in situations(run)]
    kinds: list[Kind] = ["situations"] if known else []
    kinds += ["plane"] if PLANE in situations(run) else []
    if not kinds or not any(trial.scores for trial in run.counted):
        return
    rows = [*_situations(run, known)] if known else []
    # situations whose every trial shows the ends of table 5.1 upright, in place
    trials = rules.trials if isinstance(rules, Script) else ()
    others = {trial.situation for trial in trials if trial.layout != LAYOUT}
    same_ends = [s for s in dict.fromkeys(one.situation for one in trials) if s not in others]
    if known and same_ends:
        errors = {
            d: np.concatenate([scored(run, d, name).errors_mm for name in same_ends])
            for d in run.detectors
        }
        rows += _first_test(figures, errors)
    rows += _plane(run, figures) if "plane" in kinds else ()
    rows += [*_asked(run, figures), *_rig(run, figures, calibration)]
    # What was printed, what its tables give, and what this run measured
    yield table("thesis", rows, note=NOTE if known else "")
    if known:
        yield from _pictured(run, known, calibration)
    yield elsewhere_table(figures, *kinds)


def elsewhere_table(figures: Thesis, *shown: Kind) -> Table:
    """Printed figures that a page with these tests doesn't have, and their counterparts."""
    rest = [one for one in figures.elsewhere if not set(one.shown) & set(shown)]
    return table(
        "thesis_elsewhere", [(one.section, one.what, one.printed, one.where) for one in rest]
    )


def published_counts(rules: Rules) -> dict[str, tuple[int, int]]:
    """(found, present) of the thesis by situation; what the script names comes first."""
    known = {one.name: (one.found, one.present) for one in thesis().situations}
    return known | {name: (one.found, one.present) for name, one in rules.published.items()}


def _each(sentence: Mapping[str, str]) -> str:
    """One alone as it is; several with their names."""
    if len(sentence) > 1:
        return "; ".join(f"{name}: {text}" for name, text in sentence.items())
    return next(iter(sentence.values()), NOT_MEASURED)


def _situations(run: RunRecord, known: Sequence[Situation]) -> Iterator[Row]:
    """A row a situation, and one for all of them."""

    def ours(detector: str, of: Sequence[Situation]) -> str:
        """``9 of 12, 2 false; as many in 1 of 3``."""
        each = [(one, s.counts) for one in of for s in scored(run, detector, one.name).scores]
        if not each:
            return NOT_MEASURED
        found, visible, false = (
            sum(getattr(counts, what) for _, counts in each)
            for what in ("matched", "visible", "false")
        )
        many = sum(of.matched * one.present >= one.found * of.visible for one, of in each)
        return f"{found} of {visible}, {false} false; as many in {many} of {len(each)}"

    rows = [(spoken(one.name), one.section, [one], one.seen) for one in known]
    for name, section, of, seen in [*rows, (f"all {len(known)}", "5.2", known, "")]:
        printed = f"{sum(one.found for one in of)} of {sum(one.present for one in of)}"
        found = _each({detector: ours(detector, of) for detector in run.detectors})
        yield f"teats found, {name}", section, printed, "", found, seen


def _pictured(
    run: RunRecord, known: Sequence[Situation], calibration: Calibration
) -> Iterator[Part]:
    """Of a detector with the thesis's stages: counts by the pictures, and refined ends by teat."""
    for detector in run.detectors:
        if (seen := in_pictures(run.counted, detector, calibration)) is None:
            continue
        within = {one.name: scored(run, detector, one.name).counts.matched for one in known}

        def counts(name: str, of: Sequence[Situation], found_mm: int) -> Iterator[object]:
            rows = np.any([seen.of(one.name) for one in of], axis=0)
            n, nearer, farther = int(rows.sum()), *seen.moved(rows)
            yield name
            yield f"{sum(one.found for one in of)} of {sum(one.present for one in of)}"
            yield f"{found_mm} of {n}"
            for k in range(len(PICTURES)):
                yield f"{int(seen.on_end[rows, k].sum())} of {n}"
            yield f"{nearer} nearer, {farther} farther"
            yield sum(seen.astray.get(one.name, 0) for one in of)

        whole = [(f"all {len(known)}", known, sum(within.values()))]
        each = [(spoken(one.name), [one], within[one.name]) for one in known]
        yield table(
            "thesis_pictures",
            [tuple(counts(*row)) for row in (*each, *whole)],
            detector=detector,
            radius_mm=RADIUS_MM,
        )
        yield table(
            "thesis_refined", list(_by_teat(seen, known)), detector=detector, gate_px=GATE_PX
        )


def _by_teat(seen: ImageDistances, known: Sequence[Situation]) -> Iterator[tuple[object, ...]]:
    for one in known:
        each = zip(seen.situations, seen.teats, strict=True)
        for teat in dict.fromkeys(t for s, t in each if s == one.name):
            rows = seen.of(one.name, teat)
            values = np.hstack([seen.off_px, seen.off_mm])[rows]
            found = values[np.isfinite(values[:, 1])]
            medians = [None] * values.shape[1] if not len(found) else np.median(found, axis=0)
            plain = [None if v is None or not np.isfinite(v) else float(v) for v in medians]
            yield spoken(one.name), teat, f"{len(found)} of {len(values)}", *plain


def _first_test(figures: Thesis, ours: Mapping[str, Floats]) -> Iterator[Row]:
    """Test 1 (known ends) beside our errors (n, 3), by detector."""
    test = figures.test_1
    printed = {SIGNED_MEAN: test.average_mm, "components.max_abs_mm": test.largest_mm}
    theirs = summarise(errors_of_test_mm(figures, 1))
    stats = {name: summarise(errors) for name, errors in ours.items()}
    same = "In this run the same ends (table 5.1's) were found by a detector, in scenes that have"
    same += " them; n counts ends. "
    for key, what in STATISTICS.items():
        said = f"{printed[key]:g} mm" if key in printed else ""
        sentence = _each({name: _figure(one, key) for name, one in stats.items()})
        wrong = f"{same}{test.wrong}" if key == SIGNED_MEAN else ""
        yield f"test 1: {what}", test.section, said, _figure(theirs, key), sentence, wrong


def _figure(of: ErrorSummary, key: str) -> str:
    value: float | None = attrgetter(key)(of)
    if value is None:
        return NOT_MEASURED
    text = f"{value:+z.2f}" if key == SIGNED_MEAN else number(value)
    return f"{text} mm (n = {of.n})"


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Places (n, 2) mm from the plane's middle; teats, found, mean and largest error there."""

    at_mm: Floats
    span_mm: Floats
    teats: NDArray[np.intp]
    found: NDArray[np.intp]
    mean_mm: Floats
    largest_mm: Floats

    def within(self, width_mm: float, depth_mm: float) -> Bools:
        """Those of the centred region."""
        half_mm = np.array([width_mm, depth_mm]) / 2.0 + SLACK_MM
        return np.asarray((np.abs(self.at_mm) <= half_mm).all(axis=1), dtype=np.bool_)

    def average_mm(self, of: Bools) -> float | None:
        """The mean distance of all that was found there."""
        found = self.found[of].sum()
        return float((self.mean_mm * self.found)[of].sum() / found) if found else None

    def sentence(self, of: Bools) -> str:
        """``8.11 mm (of 12 found of 15)``."""
        counts = f"({self.found[of].sum():.0f} of {self.teats[of].sum():.0f} found)"
        return f"{number(self.average_mm(of), 'mm')} {counts}"


def places_of(run: RunRecord, detector: str) -> Places:
    """Of the trials of the plane; places are the same within 0.01 mm."""
    rows = error_rows(run, detector, PLANE)
    at, place = np.unique(rows.places_mm[:, :2].round(2), axis=0, return_inverse=True)
    here, distance = place.ravel()[rows.found], np.linalg.norm(rows.errors_mm, axis=1)
    teats, found = (np.bincount(of, minlength=len(at)) for of in (place.ravel(), here))
    mean = np.bincount(here, distance, minlength=len(at)) / np.maximum(found, 1)
    largest = np.zeros(len(at))
    np.maximum.at(largest, here, distance)
    low, high = (at.min(axis=0), at.max(axis=0)) if len(at) else (np.zeros(2), np.zeros(2))
    return Places(at - (low + high) / 2.0, high - low, teats, found, mean, largest)


def largest_region_mm(places: Places, within_mm: float) -> tuple[float, float] | None:
    """Sides of the largest centred region with an average error within so much; or None."""
    sides = (np.arange(0.0, span + SLACK_MM, 2.0 * STEP_MM).tolist() for span in places.span_mm)
    averages = {(w, d): places.average_mm(places.within(w, d)) for w, d in product(*sides)}
    good = [size for size, mm in averages.items() if mm is not None and mm <= within_mm]
    return max(good, key=lambda size: size[0] * size[1], default=None)


def _plane(run: RunRecord, figures: Thesis) -> Iterator[Row]:
    """Of the earlier system that the thesis quotes."""
    theirs = figures.earlier_system
    width, depth = theirs.area_within_mm
    printed = {
        "plane, across and away": _area(theirs.plane_mm),
        "places of a teat, found": "not printed",
        "average error": f"{theirs.average_mm:g} mm",
        "largest error": f"more than {theirs.largest_mm:g} mm",
        "smallest error": f"less than {theirs.smallest_mm:g} mm",
        f"average in the middle {width:g} x {depth:g} mm": f"{theirs.within_mm:g} mm",
    }
    within = f"largest middle region with an average within {theirs.within_mm:g} mm"
    printed[within] = _area(theirs.area_within_mm)

    def ours(p: Places) -> tuple[str, ...]:
        best, found = largest_region_mm(p, theirs.within_mm), p.found > 0
        return (
            _area(p.span_mm),
            f"{p.teats.sum():.0f}, {p.found.sum():.0f} found",
            p.sentence(np.ones(len(p.teats), dtype=np.bool_)),
            number(float(p.largest_mm.max()) if found.any() else None, "mm"),
            # of places, each with the mean of its repeats
            number(float(p.mean_mm[found].min()) if found.any() else None, "mm"),
            p.sentence(p.within(width, depth)),
            "none" if best is None else f"{_area(best)}, {p.sentence(p.within(*best))}",
        )

    sentence = {detector: ours(places_of(run, detector)) for detector in run.detectors}
    remark = "The thesis quotes these of the optical-only system that it set out to beat."
    for at, (what, figure) in enumerate(printed.items()):
        measured = _each({name: texts[at] for name, texts in sentence.items()})
        yield what, theirs.section, figure, "", measured, "" if at else f"{remark} {theirs.wrong}"


def _area(sides: Sequence[float] | Floats) -> str:
    return f"{sides[0]:.0f} x {sides[1]:.0f} mm"


def _asked(run: RunRecord, figures: Thesis) -> Iterator[Row]:
    """What the thesis asked of a detector."""
    asked, of = figures.asked, figures.situations
    pools = {name: scored(run, name) for name in run.detectors}
    far = {name: number(pool.summary().radial.max_mm, "mm") for name, pool in pools.items()}
    printed = f"below {asked.error_mm:g} mm asked; none measured"
    yield "largest error of the detector", asked.section, printed, "", _each(far), asked.wrong_error
    rates = {name: f"{pool.success}, poses that succeeded" for name, pool in pools.items()}
    found, present = sum(one.found for one in of), sum(one.present for one in of)
    printed = f"“100 % or near” asked; {found} of {present} teats found in section 5.2"
    printed += f" ({percent(found / present)})"
    yield "reliability", asked.section, printed, "", _each(rates), asked.wrong_reliability
    seconds = {}
    for name in run.detectors:
        times = latency_of(run, name)
        longest = number(max(times.seconds, default=None), "s", 3)
        seconds[name] = f"p95 {number(times.percentile_s(95), 's', 3)}, longest {longest}"
    aim, most = asked.time_s
    printed = f"{aim:g} s, at most {most:g} s asked; none measured"
    yield "time of a detection", asked.section, printed, "", _each(seconds), asked.wrong_time


def _rig(run: RunRecord, figures: Thesis, calibration: Calibration) -> Iterator[Row]:
    """Geometry, arm and bath."""
    ends = points_mm(row for trial in run.counted for row in trial.truth)
    maps, off = figures.homography, figures.stand_off
    printed = f"at most {maps.largest_px:g} px, {maps.largest_mm:g} mm at {maps.at_mm:g} mm"
    mapped = _homographies(ends, figures, calibration)
    yield "homography from thermal to optical", maps.section, printed, "", mapped, maps.wrong
    depth = calibration.world_from_right.inverse().apply(ends)[:, 2] if len(ends) else ends
    what, stated = "distance of the teats from the cameras", f"{off.stated_mm:g} mm"
    implied, ours = (spanned(one, ".0f", "mm") for one in (off.implied_mm, depth))
    yield what, off.section, stated, implied, ours, off.wrong
    one, pixel = figures.one_pixel, NOT_MEASURED
    if len(ends):
        worth = calibration.depth_per_disparity_px_mm(ends)
        pixel = f"{spanned(worth, '.1f', 'mm')} of depth (Z² / f B)"
    yield "what one pixel is worth", one.section, f"{one.error_mm:g} mm", "", pixel, one.wrong
    world, arm, bath = figures.world, figures.arm, figures.bath
    what = "camera to table: determinant and singular values"
    printed, ours = map(_stretch, (np.array(world.matrix), calibration.world_from_right.R))
    yield what, world.section, printed, "", ours, world.wrong
    known_mm = truth_known_mm(run)
    sentence = NOT_MEASURED if known_mm is None else f"truth known to {known_mm:.2f} mm in 95 %"
    printed = f"{arm.accuracy_mm[0]:g} mm, {arm.accuracy_mm[1]:g} mm"
    yield "accuracy of the arm", arm.section, printed, "", sentence, arm.wrong
    temps = [trial.head["bath_c"] for trial in run.trials if trial.head["bath_c"] is not None]
    span = f"{spanned(temps, unit='°C')} at the captures" if temps else NOT_MEASURED
    yield "bath", bath.section, spanned(bath.range_c, "g", "°C"), "", span, bath.wrong


def _homographies(ends_mm: Floats, figures: Thesis, calibration: Calibration) -> str:
    """How far each map puts the true ends of this run from where the optical cameras see them."""
    seen = project_all(calibration, ends_mm)
    thermal = seen["thermal"]
    if thermal is None or not len(ends_mm):
        return f"{NOT_MEASURED}: the calibration has no thermal lens, or there is no truth"
    own, theirs = calibration.homographies, figures.homography
    sets = {"the calibration's": (own.left, own.right)}
    # the printed matrices are of those cameras only
    if (calibration.left, calibration.right) == (LEFT, RIGHT):
        sets["the printed ones"] = (np.array(theirs.left), np.array(theirs.right))
    sentence = dict.fromkeys(sets, NOT_MEASURED)
    for name, matrices in sets.items():
        pairs = zip(matrices, (seen["left"], seen["right"]), strict=True)
        off = [apply_homography(H, thermal) - at for H, at in pairs if at is not None]
        px = np.linalg.norm(np.concatenate(off), axis=1)
        if len(px := px[np.isfinite(px)]):
            sentence[name] = f"{px.mean():.1f} px on the mean, {px.max():.1f} px at most"
    return _each(sentence)


def _stretch(matrix: Floats) -> str:
    values = listed(np.linalg.svd(matrix, compute_uv=False), ".3f")
    return f"{np.linalg.det(matrix):.3f}; {values}"

"""The chapter "Beside the thesis": figures that the thesis printed, worked out of its tables, and
measured in this run. A run has it by its situations or by the ends of its layout.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bench.record.reader import RunRecord
from bench.report.overlays import project_all
from bench.report.tables import ends_mm, situations
from bench.report.wording import NOT_MEASURED, number
from bench.results.error_rows import error_rows, plane_cells
from bench.results.latency import latency_of
from bench.results.thesis_figures import (
    Kind,
    Situation,
    Statistics,
    Thesis,
    errors_of_test_mm,
    statistics,
    thesis,
)
from bench.results.verdicts import scored
from bench.scoring.errors import Bools, Floats
from bench.scoring.rates import percent
from bench.script.model import Rules, Script
from bench.script.pixel_offsets import Outcome
from detector.calibration import Calibration
from detector.calibration.thesis_rig import LEFT, RIGHT
from detector.geometry import apply_homography
from reports.page import Section
from reports.parts import Column, Part, Table, columns

LAYOUT = "table-5-1"  # whose ends those of the test are
ROWS = (
    ("mean of the signed components: the thesis's “average error” of test 1", "signed_mean"),
    ("mean of the components' amounts: that of test 2", "mean_absolute"),
    ("largest component: its “maximum error”", "largest_absolute"),
    ("mean distance to the teat end", "mean_distance"),
    ("largest distance to the teat end", "largest_distance"),
)


def first_test_table(figures: Thesis, ours: Mapping[str, Floats]) -> Table:
    """Test 1 beside our errors (n, 3) on the same ends, by detector."""
    first = figures.test_1
    printed = {"signed_mean": first.average_mm, "largest_absolute": first.largest_mm}
    of_ours = (
        "In this run the same ends (table 5.1's) were found by a detector, in scenes that have"
        " them; n counts ends. "
        if ours
        else ""
    )
    return _table(
        f"Test 1, sections {first.section}: known ends",
        figures,
        1,
        printed,
        ours,
        of_ours + first.wrong,
    )


def second_test_table(figures: Thesis, found: Sequence[Outcome]) -> Table:
    """Test 2 beside ours over all directions of its offsets."""
    second = figures.test_2
    printed = {"mean_absolute": second.average_mm, "largest_absolute": second.largest_mm}
    ours = {"every direction": np.concatenate([one.errors_mm for one in found])}
    return _table(
        f"Test 2, sections {second.section}: ends put off on purpose",
        figures,
        2,
        printed,
        ours,
        second.wrong,
    )


def components_table(figures: Thesis) -> Table:
    """Both tests by teat: errors against table 5.1 from the tables, and as printed in 5.4."""
    first, second = errors_of_test_mm(figures, 1), errors_of_test_mm(figures, 2)
    heads = columns(
        ">teat | >5.2 less 5.1: x, y, z [mm] | >distance [mm]",
        ">5.3 less 5.1: x, y, z [mm] | >distance [mm]",
        ">table 5.4: x, y, z [mm, amounts as printed] | differs from its tables in",
    )
    rows = []
    for teat, (plain, off, printed) in enumerate(
        zip(first, second, figures.test_2.errors_mm, strict=True), 1
    ):
        wrong = [
            axis
            for axis, value, told in zip("xyz", off.tolist(), printed, strict=True)
            if round(abs(value), 1) != told
        ]
        rows.append(
            (
                str(teat),
                *_vector(plain),
                *_vector(off),
                ", ".join(f"{value:g}" for value in printed),
                ", ".join(wrong) or "nothing",
            )
        )
    return Table("Tables 5.1 to 5.4, teat by teat", heads, tuple(rows))


def _vector(error_mm: Floats) -> tuple[str, str]:
    return (
        ", ".join(f"{value:+.1f}" for value in error_mm),
        f"{float(np.linalg.norm(error_mm)):.2f}",
    )


def _table(
    caption: str,
    figures: Thesis,
    number_of: int,
    printed: Mapping[str, float],
    ours: Mapping[str, Floats],
    note: str,
) -> Table:
    theirs = statistics(errors_of_test_mm(figures, 1 if number_of == 1 else 2))
    stats = {name: statistics(errors) for name, errors in ours.items()}
    heads = columns(
        "figure | >printed [mm]",
        f">by its tables [mm, n = {theirs.n}]",
        *(Column(f"this run, {name}", "right", f"mm, n = {one.n}") for name, one in stats.items()),
    )
    rows = tuple(
        (
            what,
            f"{printed[key]:g}" if key in printed else "",
            _figure(theirs, key),
            *(_figure(one, key) for one in stats.values()),
        )
        for what, key in ROWS
    )
    return Table(caption, heads, rows, note)


def _figure(of: Statistics, key: str) -> str:
    value = getattr(of, key)
    return number(value) if value is None or key != "signed_mean" else f"{value:+.2f}"


PLANE = "plane_map"  # the situation
STEP_MM = 12.5  # half widths of regions are tried in these steps
SLACK_MM = 3.0  # a touched place lies this near to the one that was meant


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Places (n, 2) mm from the plane's middle; teats, found, mean and largest error there."""

    at_mm: Floats
    span_mm: Floats
    teats: Floats
    found: Floats
    mean_mm: Floats
    largest_mm: Floats

    def within(self, width_mm: float, depth_mm: float) -> Bools:
        """Those of the centred region."""
        return np.asarray(
            (np.abs(self.at_mm) <= np.array([width_mm, depth_mm]) / 2.0 + SLACK_MM).all(axis=1),
            dtype=np.bool_,
        )

    def average_mm(self, of: Bools) -> float | None:
        """The mean distance of all that was found there."""
        found = self.found[of].sum()
        return float((self.mean_mm * self.found)[of].sum() / found) if found else None

    def told(self, of: Bools) -> str:
        """``8.11 mm (of 12 found of 15)``."""
        average = self.average_mm(of)
        counted = f"({self.found[of].sum():.0f} of {self.teats[of].sum():.0f} found)"
        return f"{NOT_MEASURED} {counted}" if average is None else f"{average:.2f} mm {counted}"


def places_of(run: RunRecord, detector: str) -> Places:
    """Of the trials of the plane."""
    rows = error_rows(run, detector, PLANE)
    cells = plane_cells(rows)
    at = np.array([(cell.x_mm, cell.y_mm) for cell in cells], dtype=np.float64).reshape(-1, 2)
    low, high = (at.min(axis=0), at.max(axis=0)) if len(at) else (np.zeros(2), np.zeros(2))
    figures = [(cell.teats, cell.found, cell.mean_mm or 0.0, cell.max_mm or 0.0) for cell in cells]
    return Places(
        at - (low + high) / 2.0, high - low, *np.array(figures, dtype=np.float64).reshape(-1, 4).T
    )


def largest_region_mm(places: Places, within_mm: float) -> tuple[float, float] | None:
    """Width and depth of the largest centred region whose average error is within so much; None
    where none is.
    """
    best: tuple[float, float] | None = None
    for width in np.arange(0.0, places.span_mm[0] + SLACK_MM, 2.0 * STEP_MM).tolist():
        for depth in np.arange(0.0, places.span_mm[1] + SLACK_MM, 2.0 * STEP_MM).tolist():
            average = places.average_mm(places.within(width, depth))
            if (
                average is not None
                and average <= within_mm
                and (best is None or width * depth > best[0] * best[1])
            ):
                best = (width, depth)
    return best


def plane_table(run: RunRecord, figures: Thesis) -> Table:
    """A row a figure."""
    theirs = figures.earlier_system
    ours = [places_of(run, detector) for detector in run.detectors]
    width, depth = theirs.area_within_mm
    lines = [
        ("plane, across and away", _area(theirs.plane_mm), [_area(p.span_mm) for p in ours]),
        (
            "places of a teat, found",
            "not printed",
            [f"{p.teats.sum():.0f}, {p.found.sum():.0f} found" for p in ours],
        ),
        (
            "average error",
            f"{theirs.average_mm:g} mm",
            [p.told(np.ones(len(p.teats), dtype=np.bool_)) for p in ours],
        ),
        (
            "largest error",
            f"more than {theirs.largest_mm:g} mm",
            [number(_largest(p), "mm") for p in ours],
        ),
        (
            "smallest error",
            f"less than {theirs.smallest_mm:g} mm",
            [number(_smallest(p), "mm") for p in ours],
        ),
        (
            f"average in the middle {width:g} x {depth:g} mm",
            f"{theirs.within_mm:g} mm",
            [p.told(p.within(width, depth)) for p in ours],
        ),
        (
            f"largest middle region with an average within {theirs.within_mm:g} mm",
            _area(theirs.area_within_mm),
            [_region(p, theirs.within_mm) for p in ours],
        ),
    ]
    heads = columns(f"figure | >earlier system, section {theirs.section}", *_this_run(run))
    note = (
        "The thesis quotes these of the optical-only system that it set out to beat."
        f" {theirs.wrong}"
    )
    return Table(
        "Error over the plane of section 1.4.3.2",
        heads,
        tuple((what, printed, *told) for what, printed, told in lines),
        note,
    )


def _this_run(run: RunRecord) -> Iterator[Column]:
    return (Column(f"this run, {detector}", "right") for detector in run.detectors)


def _largest(places: Places) -> float | None:
    return float(places.largest_mm.max()) if places.found.any() else None


def _smallest(places: Places) -> float | None:
    """Of places, each with the mean of its repeats."""
    return float(places.mean_mm[places.found > 0].min()) if places.found.any() else None


def _region(places: Places, within_mm: float) -> str:
    best = largest_region_mm(places, within_mm)
    return "none" if best is None else f"{_area(best)}, {places.told(places.within(*best))}"


def _area(sides: Sequence[float] | Floats) -> str:
    return f"{sides[0]:.0f} x {sides[1]:.0f} mm"


Row = tuple[str, str, str, str, str]


def rig_table(run: RunRecord, figures: Thesis, calibration: Calibration) -> Table:
    """A row a figure: what, section, printed, this run, what is wrong or to be known."""
    heads = columns("figure | section | thesis | this run | what is wrong in it")
    rows = (
        *_asked(run, figures),
        *_geometry(run, figures, calibration),
        *_reference(run, figures, calibration),
    )
    return Table("Other figures of the thesis beside this run", heads, rows)


def _asked(run: RunRecord, figures: Thesis) -> Iterator[Row]:
    asked = figures.asked
    found, present = (
        sum(one.found for one in figures.situations),
        sum(one.present for one in figures.situations),
    )
    pools = {name: scored(run, name) for name in run.detectors}
    far = {name: pool.summary().radial.max_mm for name, pool in pools.items()}
    yield (
        "largest error of the detector",
        asked.section,
        f"below {asked.error_mm:g} mm asked; none measured",
        _each({name: number(value, "mm") for name, value in far.items()}),
        asked.wrong_error,
    )
    rates = {name: f"{pool.success}, poses that succeeded" for name, pool in pools.items()}
    share = (
        f"“100 % or near” asked; {found} of {present} teats found in section 5.2"
        f" ({percent(found / present)})"
    )
    yield ("reliability", asked.section, share, _each(rates), asked.wrong_reliability)
    times = {name: latency_of(run, name) for name in run.detectors}
    seconds = {
        name: (
            f"p95 {number(t.p95_s, 's', 3)}, longest {number(max(t.seconds, default=None), 's', 3)}"
        )
        for name, t in times.items()
    }
    aim, most = asked.time_s
    yield (
        "time of a detection",
        asked.section,
        f"{aim:g} s, at most {most:g} s asked; none measured",
        _each(seconds),
        asked.wrong_time,
    )


def _geometry(run: RunRecord, figures: Thesis, calibration: Calibration) -> Iterator[Row]:
    ends = ends_mm(run.counted)
    maps, off = figures.homography, figures.stand_off
    promised = f"at most {maps.largest_px:g} px, {maps.largest_mm:g} mm at {maps.at_mm:g} mm"
    yield (
        "homography from thermal to optical",
        maps.section,
        promised,
        _homographies(ends, figures, calibration),
        maps.wrong,
    )
    depth = calibration.world_from_right.inverse().apply(ends)[:, 2] if len(ends) else np.zeros(0)
    told = f"{depth.min():.0f} to {depth.max():.0f} mm" if len(depth) else NOT_MEASURED
    yield (
        "distance of the teats from the cameras",
        off.section,
        f"{off.stated_mm:g} mm",
        told,
        off.wrong,
    )
    worth = calibration.depth_per_disparity_px_mm(ends) if len(ends) else np.zeros(0)
    pixel = (
        f"{worth.min():.1f} to {worth.max():.1f} mm of depth (Z² / f B)"
        if len(worth)
        else NOT_MEASURED
    )
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
    # the printed matrices are of those cameras only
    if (calibration.left, calibration.right) == (LEFT, RIGHT):
        sets["the printed ones"] = (
            np.array(figures.homography.left),
            np.array(figures.homography.right),
        )
    return _each(
        {name: _off_px(thermal, seen["left"], seen["right"], *maps) for name, maps in sets.items()}
    )


def _off_px(
    thermal: Floats, left: Floats | None, right: Floats | None, by_left: Floats, by_right: Floats
) -> str:
    pairs = [
        (apply_homography(H, thermal), at)
        for H, at in ((by_left, left), (by_right, right))
        if at is not None
    ]
    off = np.concatenate([np.linalg.norm(mapped - at, axis=1) for mapped, at in pairs])
    off = off[np.isfinite(off)]
    return (
        f"{off.mean():.1f} px on the mean, {off.max():.1f} px at most" if len(off) else NOT_MEASURED
    )


def _reference(run: RunRecord, figures: Thesis, calibration: Calibration) -> Iterator[Row]:
    world, arm, bath = figures.world, figures.arm, figures.bath
    yield (
        "camera to table: determinant and singular values",
        world.section,
        _stretch(np.array(world.matrix)),
        _stretch(calibration.world_from_right.R),
        world.wrong,
    )
    known = [row["u_mm"] for trial in run.counted for row in trial.truth if row["u_mm"] is not None]
    told = f"truth known to {max(known):.2f} mm along an axis (k = 1)" if known else NOT_MEASURED
    yield (
        "accuracy of the arm",
        arm.section,
        f"{arm.accuracy_mm[0]:g} mm, {arm.accuracy_mm[1]:g} mm",
        told,
        arm.wrong,
    )
    temps = [trial.head["bath_c"] for trial in run.trials if trial.head["bath_c"] is not None]
    span = f"{min(temps):.2f} to {max(temps):.2f} °C at the captures" if temps else NOT_MEASURED
    yield ("bath", bath.section, f"{bath.range_c[0]:g} to {bath.range_c[1]:g} °C", span, bath.wrong)


def _stretch(matrix: Floats) -> str:
    values = ", ".join(f"{value:.3f}" for value in np.linalg.svd(matrix, compute_uv=False))
    return f"{np.linalg.det(matrix):.3f}; {values}"


def _each(told: dict[str, str]) -> str:
    """One alone as it is; several with their names."""
    return (
        "; ".join(f"{name}: {text}" for name, text in told.items())
        if len(told) > 1
        else next(iter(told.values()), NOT_MEASURED)
    )


NOTE = (
    "The thesis judged one picture a situation by eye. Here a teat is found when an answer lies"
    " within the gate of its end, and every frame set counts; “as many” are the frame sets in which"
    " at least the thesis's share of the visible teats was found."
)


def known_situations(run: RunRecord, figures: Thesis) -> list[Situation]:
    """Those of the run that the thesis has figures of, in the thesis's order."""
    here = set(situations(run))
    return [one for one in figures.situations if one.name in here]


def situation_table(run: RunRecord, figures: Thesis) -> Table:
    """A row a situation, and one for all of them."""
    known = known_situations(run, figures)
    found, present = sum(one.found for one in known), sum(one.present for one in known)
    all_of = Situation(
        name=f"all {len(known)}", section="5.2", found=found, present=present, seen=""
    )
    heads = columns("situation | section | >thesis found", *_this_run(run), "what the thesis saw")
    rows = [
        (
            one.name,
            one.section,
            f"{one.found} of {one.present}",
            *(_ours(run, detector, of) for detector in run.detectors),
            one.seen,
        )
        for one, of in [*((one, [one]) for one in known), (all_of, known)]
    ]
    return Table("Teats found in the situations of section 5.2", heads, tuple(rows), NOTE)


def _ours(run: RunRecord, detector: str, of: Sequence[Situation]) -> str:
    """``9 of 12, with 2 false; as many in 1 of 3``."""
    matched = visible = false = as_many = sets = 0
    for one in of:
        found = scored(run, detector, one.name)
        counts = found.counts
        matched, visible, false = (
            matched + counts.matched,
            visible + counts.visible,
            false + counts.false,
        )
        sets += len(found.scores)
        as_many += sum(
            s.counts.matched * one.present >= one.found * s.counts.visible for s in found.scores
        )
    return (
        f"{matched} of {visible}, {false} false; as many in {as_many} of {sets}"
        if sets
        else NOT_MEASURED
    )


def thesis_chapter(run: RunRecord, rules: Rules, calibration: Calibration) -> tuple[Section, ...]:
    """The chapter of a scored run that is one of the thesis's tests; else none."""
    figures = thesis()
    kinds: list[Kind] = ["situations"] if known_situations(run, figures) else []
    kinds += ["plane"] if PLANE in situations(run) else []
    if not kinds or not any(trial.scores for trial in run.counted):
        return ()
    return (
        Section(
            "published", "Beside the thesis", tuple(_parts(run, rules, calibration, figures, kinds))
        ),
    )


def elsewhere_table(figures: Thesis, *shown: Kind) -> Table:
    """Printed figures that a page with these tests doesn't have, and their counterparts."""
    heads = columns("section | figure | printed | counterpart")
    rest = [one for one in figures.elsewhere if not set(one.shown) & set(shown)]
    rows = tuple((one.section, one.what, one.printed, one.where) for one in rest)
    return Table("Printed figures without a counterpart on this page", heads, rows)


def _parts(
    run: RunRecord, rules: Rules, calibration: Calibration, figures: Thesis, kinds: list[Kind]
) -> Iterator[Part]:
    if "situations" in kinds:
        yield situation_table(run, figures)
        if same_ends := _with_ends_of_table_5_1(rules):
            errors = {
                d: np.concatenate([scored(run, d, name).errors_mm for name in same_ends])
                for d in run.detectors
            }
            yield first_test_table(figures, errors)
    if "plane" in kinds:
        yield plane_table(run, figures)
    yield rig_table(run, figures, calibration)
    yield elsewhere_table(figures, *kinds)


def _with_ends_of_table_5_1(rules: Rules) -> list[str]:
    """Situations whose every trial shows the ends of table 5.1 upright, in place."""
    if not isinstance(rules, Script):
        return []
    layouts = {
        trial.situation: {t.layout for t in rules.trials if t.situation == trial.situation}
        for trial in rules.trials
    }
    return [situation for situation, of in layouts.items() if of == {LAYOUT}]


def published_counts(rules: Rules) -> dict[str, tuple[int, int]]:
    """(found, present) of the thesis by situation; what the script names comes first."""
    known = {one.name: (one.found, one.present) for one in thesis().situations}
    return known | {name: (one.found, one.present) for name, one in rules.published.items()}

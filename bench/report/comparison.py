"""A comparison as words and numbers, as a page of its own, and as chapters of a report: a run
against an older one, and the detectors of one run against its first.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from bench.config import ConfigError
from bench.files import write_synced
from bench.record.check import NOT_AS_WRITTEN
from bench.record.reader import RunRecord
from bench.report.tables import key_values
from bench.report.wording import NOT_MEASURED
from bench.results.comparison import Comparison, Side, compare_folders, compare_sides
from bench.results.error_rows import truth_gage
from bench.scoring.comparison import PairedDifference, Row, ScenePair, why_failed
from bench.scoring.decisions import Verdict, overall
from bench.scoring.scene import SceneScore
from reports.figures import change_scatter
from reports.page import Banner, Kind, Page, Section
from reports.parts import (
    Cell,
    Column,
    Figure,
    KeyValues,
    Notes,
    Paragraph,
    Part,
    Table,
    Tone,
    columns,
)
from reports.parts import Verdict as PageVerdict
from reports.render import write_report

SUCCESS = (
    ("situation", ""),
    ("poses", ""),
    ("lost", ""),
    ("won", ""),
    ("change", "% points"),
    ("p", ""),
    ("false", ""),
    ("missed", ""),
)
DISTANCE = (
    ("situation", ""),
    ("teats", ""),
    ("change", "mm"),
    ("p", ""),
    ("|x|", "mm"),
    ("|y|", "mm"),
    ("|z|", "mm"),
)
LEGEND = (
    "All differences are new less old, with their intervals. Lost and won: poses that only the old "
    "or only the new one got right (exact McNemar; the interval is Tango's). Distance: mean over "
    "poses of the distance to the end, of teats that both found; a teat's change counts up to the "
    "limit (the interval is Gaffke's, which allows for poses that were not run; p by sign flips). "
    "|x|, |y|, |z|: of the absolute error along the world's axes. The p-values of situations are "
    "adjusted after Holm."
)
DIFFER = {
    "kind": "kind",
    "rig": "rig",
    "script": "script",
    "seed": "seed",
    "calibration": "calibration_sha256",
}
NOT_KNOWN = "not known"
WORDS: dict[Verdict, PageVerdict] = {
    Verdict.MET: "not worse",
    Verdict.NOT_MET: "worse",
    Verdict.INCONCLUSIVE: "inconclusive",
}
TOLD = {
    Verdict.MET: "The new one is not worse:",
    Verdict.NOT_MET: "THE NEW ONE IS WORSE:",
    Verdict.INCONCLUSIVE: "Whether the new one is worse can't be told:",
}


def heading(comparison: Comparison) -> str:
    """Who is compared with whom."""
    return f"{comparison.new.label} (new) against {comparison.old.label} (old)"


def verdict_told(comparison: Comparison) -> str:
    """The gate's verdict as a sentence."""
    return TOLD[comparison.compared.gate.verdict]


def notes(comparison: Comparison) -> Iterator[str]:
    """What has to be known before the figures are believed."""
    n = len(comparison.pairs)
    if comparison.same_frames == n:
        yield f"{n} scenes, each in the very same frames."
    else:
        yield (
            f"{n} scenes; {n - comparison.same_frames} of them in different frames of the same"
            " pose, so their noise differs as well."
        )
    if comparison.only_old or comparison.only_new:
        yield (
            f"Without a counterpart, and not compared: {comparison.only_old} trials of the old run,"
            f" {comparison.only_new} of the new."
        )
    if comparison.elsewhere:
        yield (
            f"{comparison.elsewhere} trials of the old run have a namesake in the new one with its"
            " teats elsewhere: not compared."
        )
    yield from _unlike(comparison)
    yield from _truth(comparison)
    yield (
        f"Intervals: {100 * comparison.compared.confidence:g} %. Margin:"
        f" {comparison.compared.gate.margin_mm:g} mm."
    )


def _unlike(comparison: Comparison) -> Iterator[str]:
    """What else differs between the two runs than the detector."""
    old, new = comparison.old.run.facts, comparison.new.run.facts
    for what, key in DIFFER.items():
        a, b = old.get(key), new.get(key)
        if a != b:
            yield f"The runs also differ in {what}: {_short(a)} (old), {_short(b)} (new)."


def _truth(comparison: Comparison) -> Iterator[str]:
    """How well the truth of two touched runs agrees: each run is a set-up."""
    old, new = comparison.old.run, comparison.new.run
    found = truth_gage((old, new)) if old.folder.resolve() != new.folder.resolve() else None
    if found is None or found.studies is None:
        return
    width_mm = 2.0 * comparison.pairs[0].old.limit_mm
    first = found.studies[0]
    within, between, share = (
        ", ".join(f"{value:.{digits}f}" for value in values)
        for values, digits in (
            ([study.repeatability for study in found.studies], 3),
            ([study.reproducibility for study in found.studies], 3),
            ([100.0 * study.share_of_tolerance(width_mm) for study in found.studies], 0),
        )
    )
    yield (
        f"The truth itself (gage R&R along x, y, z; {first.parts} ends touched {first.repeats}"
        f" times in each run): repeatability {within} mm, reproducibility {between} mm, setting the"
        f" phantom up again included; {share} % of the tolerance of {width_mm:g} mm."
    )


def _short(value: object) -> str:
    return NOT_KNOWN if value is None else str(value)[:40]


def success_rows(comparison: Comparison) -> Iterator[tuple[str, ...]]:
    """The rows under SUCCESS: all, then each situation."""
    confidence = comparison.compared.confidence
    for row in _rows(comparison):
        won, p = row.success, row.success.p_value if row.success_holm is None else row.success_holm
        counts = (f"{row.new.false - row.old.false:+d}", f"{row.new.missed - row.old.missed:+d}")
        name = row.situation or "all"
        yield (
            name,
            str(row.poses),
            str(won.only_old),
            str(won.only_new),
            _percent_points(row, confidence),
            _p(p),
            *counts,
        )


def distance_rows(comparison: Comparison, *, wide: bool = False) -> Iterator[tuple[str, ...]]:
    """The rows under DISTANCE: all, then each situation. ``wide`` adds the axes' intervals."""
    for row in _rows(comparison):
        p = row.radial.p_value if row.radial_holm is None else row.radial_holm
        axes = (
            difference_told(axis if wide else replace(axis, low=None, high=None))
            for axis in row.axes
        )
        yield (row.situation or "all", str(row.teats), difference_told(row.radial), _p(p), *axes)


def _rows(comparison: Comparison) -> tuple[Row, ...]:
    found = comparison.compared
    return (found.pooled, *(found.situations if len(found.situations) > 1 else ()))


def difference_told(difference: PairedDifference) -> str:
    """``+0.12 (-0.03 to +0.27)``; without an interval where there is none."""
    if difference.mean is None:
        return NOT_MEASURED
    if difference.low is None or difference.high is None:
        return f"{difference.mean:+.3f}"
    return f"{difference.mean:+.3f} ({difference.low:+.3f} to {difference.high:+.3f})"


def as_json(found: Sequence[Comparison]) -> list[dict[str, Any]]:
    """Plain numbers and text; every figure that is printed, unrounded."""
    return [_one(comparison) for comparison in found]


def _one(comparison: Comparison) -> dict[str, Any]:
    found = comparison.compared
    return {
        "old": {"run": str(comparison.old.run.folder), "detector": comparison.old.detector},
        "new": {"run": str(comparison.new.run.folder), "detector": comparison.new.detector},
        "scenes": len(comparison.pairs),
        "same_frames": comparison.same_frames,
        "only_old": comparison.only_old,
        "only_new": comparison.only_new,
        "elsewhere": comparison.elsewhere,
        "confidence": found.confidence,
        "gate": {
            "verdict": WORDS[found.gate.verdict],
            "reasons": list(found.gate.reasons),
            "margin_mm": found.gate.margin_mm,
        },
        "rows": [_numbers(row, found.confidence) for row in (found.pooled, *found.situations)],
    }


def _numbers(row: Row, confidence: float) -> dict[str, Any]:
    success = {
        "difference": row.success.difference,
        "interval": row.success.interval(confidence),
        "p_value": row.success.p_value,
    }
    return {**asdict(row), "success": {**asdict(row.success), **success}}


def _percent_points(row: Row, confidence: float) -> str:
    span, difference = row.success.interval(confidence), row.success.difference
    if span is None or difference is None:
        return NOT_MEASURED
    return f"{100 * difference:+.1f} ({100 * span[0]:+.1f} to {100 * span[1]:+.1f})"


def _p(value: float | None) -> str:
    if value is None:
        return ""
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


NEXT = {
    Verdict.MET: "The new one may replace the old one as far as these scenes go.",
    Verdict.NOT_MET: (
        "Look at the scenes below that changed, in the report of the new run, before the new one is"
        " used."
    ),
    Verdict.INCONCLUSIVE: "Compare on more poses, as many as the reasons name.",
}
TONES: dict[Verdict, Tone] = {
    Verdict.MET: "good",
    Verdict.NOT_MET: "bad",
    Verdict.INCONCLUSIVE: "warn",
}


def write_comparison(found: Sequence[Comparison], folder: Path) -> Path:
    """Write ``index.html`` and ``comparison.json``; return the page's path. Raises ConfigError."""
    try:
        path = write_report(comparison_page(found), folder)
        write_synced(
            folder / "comparison.json",
            (json.dumps(as_json(found), indent=1, ensure_ascii=False) + "\n").encode(),
        )
    except OSError as error:
        raise ConfigError.plain(f"{folder}: the comparison can't be written: {error}") from error
    return path


def comparison_page(found: Sequence[Comparison]) -> Page:
    """The page: a section a comparison."""
    verdict = overall(comparison.compared.gate.verdict for comparison in found)
    worst = [one for one in found if one.compared.gate.verdict is verdict] or list(found)
    first = found[0]
    banner = Banner(
        kind=_kind(found),
        verdict=WORDS[verdict],
        tested=f"{'; '.join(heading(one) for one in found)}.",
        sentence=f"{verdict_told(worst[0])} {_listed(worst[0].compared.gate.reasons)}",
        confidence=" ".join(notes(first)),
        next_action=NEXT[verdict],
    )
    sections = tuple(
        Section(
            f"comparison-{number}",
            heading(one) if len(found) > 1 else "Differences",
            tuple(comparison_parts(one)),
        )
        for number, one in enumerate(found, 1)
    )
    alarm = (
        f"{NOT_AS_WRITTEN}: no figure below holds."
        if any(one.old.run.damage or one.new.run.damage for one in found)
        else ""
    )
    return Page(
        "Comparison of detectors",
        "Paired differences on the same scenes",
        banner,
        sections,
        alarm=alarm,
    )


def comparison_parts(comparison: Comparison) -> Iterator[Part]:
    """What a page says of one comparison; a run's report can take the same."""
    gate = comparison.compared.gate
    yield Paragraph(f"{verdict_told(comparison)} {_listed(gate.reasons)}", tone=TONES[gate.verdict])
    yield Table(
        "Success of poses, and what was counted",
        _columns(SUCCESS),
        tuple(success_rows(comparison)),
        LEGEND,
    )
    yield Table(
        "Distance to the teat end", _columns(DISTANCE), tuple(distance_rows(comparison, wide=True))
    )
    yield Notes("Of this comparison", tuple(notes(comparison)))
    yield _changed(comparison)
    yield key_values(
        "Compared",
        [("old run", comparison.old.run.folder.name), ("new run", comparison.new.run.folder.name)],
    )


def _columns(titles: Sequence[tuple[str, str]]) -> tuple[Column, ...]:
    return tuple(
        Column(title, "right" if n else "left", unit) for n, (title, unit) in enumerate(titles)
    )


def _changed(comparison: Comparison) -> Table:
    """Scenes whose outcome changed, and those whose error changed most."""
    heads = columns("scene | situation | old | new | >change of the largest error [mm]")
    by_change = sorted(
        comparison.pairs,
        key=lambda pair: (pair.old.success == pair.new.success, -abs(_growth(pair) or 0.0)),
    )
    shown = [pair for pair in by_change if pair.old.success != pair.new.success or _growth(pair)][
        :50
    ]
    cells = tuple(
        (pair.scene, pair.situation, _outcome(pair.old), _outcome(pair.new), _growth_told(pair))
        for pair in shown
    )
    note = "" if cells else "No scene's outcome changed, and no error."
    return Table(
        "Scenes that changed (at most 50, changed outcomes first)",
        heads,
        cells,
        note,
        searchable=len(cells) > 10,
    )


def _growth(pair: ScenePair) -> float | None:
    if not pair.old.radial_mm or not pair.new.radial_mm:
        return None
    return max(pair.new.radial_mm) - max(pair.old.radial_mm)


def _growth_told(pair: ScenePair) -> Cell:
    growth = _growth(pair)
    return Cell("not measured" if growth is None else f"{growth:+.3f}", sort=growth)


def _outcome(score: SceneScore) -> Cell:
    return Cell("success", "good") if score.success else Cell(why_failed(score), "bad")


def _kind(found: Sequence[Comparison]) -> Kind:
    kinds: set[Kind] = {side.run.facts["kind"] for one in found for side in (one.old, one.new)}
    if len(kinds) == 1:
        return kinds.pop()
    return "mixed" if kinds & {"emulated", "mixed"} else "recorded"


def _listed(reasons: Sequence[str], most: int = 5) -> str:
    more = f"; and {len(reasons) - most} more" if len(reasons) > most else ""
    return f"{'; '.join(reasons[:most])}{more}."


def baseline_section(baseline: Path, folder: Path, damage: tuple[str, ...] = ()) -> Section:
    """The run in ``folder`` (new) against ``baseline`` (old). Raises ConfigError."""
    found = compare_folders([baseline, folder], damage=damage)
    parts = tuple(
        part
        for number, one in enumerate(found, 1)
        for part in (*_figure(one, number), *comparison_parts(one))
    )
    return Section("baseline", "Against the baseline", parts)


def detectors_section(run: RunRecord) -> tuple[Section, ...]:
    """Each later scored detector against the first, on the same frames."""
    first, *others = (Side(run, name) for name in run.detectors)
    compared = [
        compare_sides(first, other)
        for other in others
        if {t.id for t in first.trials} & {t.id for t in other.trials}
    ]
    if not compared:
        return ()
    parts = tuple(part for one in compared for part in _of_one_run(one))
    return (Section("detectors", "Detectors compared", parts),)


def _of_one_run(found: Comparison) -> Iterator[Part]:
    """Without a filter, since that of the trials is the page's, and without the runs' names."""
    old, new = found.old.detector, found.new.detector
    yield Paragraph(
        f"{new} against {old}, in the same frames: {old} is the old one, {new} the new."
    )
    for part in comparison_parts(found):
        if isinstance(part, Table):
            yield replace(part, caption=f"{part.caption}: {new} against {old}", searchable=False)
        elif not isinstance(part, KeyValues):
            yield part


def _figure(found: Comparison, number: int) -> Iterator[Part]:
    both = [
        (max(p.old.radial_mm), max(p.new.radial_mm), p.new.limit_mm)
        for p in found.pairs
        if p.old.radial_mm and p.new.radial_mm
    ]
    if not both:
        return
    old, new, limits = zip(*both, strict=True)
    svg = change_scatter(old, new, max(limits), name=f"change-{number}")
    worse = sum(b > a for a, b in zip(old, new, strict=True))
    alt = (
        f"{len(both)} scenes that both found teats in: the largest error grew in {worse}, shrank in"
        f" {sum(b < a for a, b, _ in both)}"
    )
    yield Figure(
        svg,
        f"Largest error of each scene, now against the baseline, {found.new.detector}. {alt}.",
        alt,
    )

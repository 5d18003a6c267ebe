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
from bench.report.wording import NOT_MEASURED, key_values, listed, table
from bench.results.comparison import Comparison, Side, compare_folders, compare_sides
from bench.results.error_rows import truth_gage
from bench.scoring.comparison import PairedDifference, Row, ScenePair, why_failed
from bench.scoring.decisions import Verdict, overall
from bench.scoring.scene import SceneScore
from instruments.world.situations import spoken
from reports.figures import change_scatter
from reports.page import (
    Banner,
    Cell,
    Figure,
    KeyValues,
    Kind,
    Notes,
    Page,
    Paragraph,
    Part,
    Section,
    Table,
    Tone,
)
from reports.page import Verdict as PageVerdict
from reports.render import write_report

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
# of a gate's verdict: the page's word, the sentence, what to do next, the tone
GATE: dict[Verdict, tuple[PageVerdict, str, str, Tone]] = {
    Verdict.MET: (
        "not worse",
        "The new one is not worse:",
        "The new one may replace the old one as far as these scenes go.",
        "good",
    ),
    Verdict.NOT_MET: (
        "worse",
        "THE NEW ONE IS WORSE:",
        (
            "Look at the scenes below that changed, in the report of the new run, before the new"
            " one is used."
        ),
        "bad",
    ),
    Verdict.INCONCLUSIVE: (
        "inconclusive",
        "Whether the new one is worse can't be told:",
        "Compare on more poses, as many as the reasons name.",
        "warn",
    ),
}


def heading(comparison: Comparison) -> str:
    """Who is compared with whom."""
    return f"{comparison.new.label} (new) against {comparison.old.label} (old)"


def verdict_text(comparison: Comparison) -> str:
    """The gate's verdict as a sentence."""
    return GATE[comparison.compared.gate.verdict][1]


def notes(comparison: Comparison) -> Iterator[str]:
    """What has to be known before the figures are believed."""
    n, gate = len(comparison.pairs), comparison.compared.gate
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
    for what, key in DIFFER.items():
        facts = [side.run.facts.get(key) for side in (comparison.old, comparison.new)]
        if facts[0] != facts[1]:
            a, b = ("not known" if fact is None else str(fact)[:40] for fact in facts)
            yield f"The runs also differ in {what}: {a} (old), {b} (new)."
    yield from _truth(comparison)
    yield (f"Intervals: {100 * comparison.compared.confidence:g} %. Margin: {gate.margin_mm:g} mm.")


def _truth(comparison: Comparison) -> Iterator[str]:
    """How well the truth of two touched runs agrees: each run is a set-up."""
    old, new = comparison.old.run, comparison.new.run
    found = truth_gage((old, new)) if old.folder.resolve() != new.folder.resolve() else None
    if found is None or found.studies is None:
        return
    width_mm, first = 2.0 * comparison.pairs[0].old.limit_mm, found.studies[0]
    within = listed((study.repeatability for study in found.studies), ".3f")
    between = listed((study.reproducibility for study in found.studies), ".3f")
    share = listed((100.0 * s.share_of_tolerance(width_mm) for s in found.studies), ".0f")
    yield (
        f"The truth itself (gage R&R along x, y, z; {first.parts} ends touched {first.repeats}"
        f" times in each run): repeatability {within} mm, reproducibility {between} mm, setting the"
        f" phantom up again included; {share} % of the tolerance of {width_mm:g} mm."
    )


def success_table(comparison: Comparison) -> Table:
    """Poses and what was counted: all, then each situation."""
    confidence, rows = comparison.compared.confidence, []
    for row in _rows(comparison):
        won, change = row.success, row.success.difference
        span = won.interval(confidence)
        points = (
            None
            if span is None or change is None
            else f"{100 * change:+.1f} ({100 * span[0]:+.1f} to {100 * span[1]:+.1f})"
        )
        p = _p(won.p_value if row.success_holm is None else row.success_holm)
        counts = (row.new.false - row.old.false, row.new.missed - row.old.missed)
        name = spoken(row.situation) if row.situation else "all"
        rows.append((name, row.poses, won.only_old, won.only_new, points, p, *counts))
    heads = "situation | >poses | >lost | >won | >change [% points] | >p | >false ~+d | >missed ~+d"
    return table("Success of poses, and what was counted", heads, rows, LEGEND)


def distance_table(comparison: Comparison, *, wide: bool = False) -> Table:
    """Distances and axes: all, then each situation. ``wide`` adds the axes' intervals."""
    rows = []
    for row in _rows(comparison):
        p = _p(row.radial.p_value if row.radial_holm is None else row.radial_holm)
        axes = row.axes if wide else [replace(axis, low=None, high=None) for axis in row.axes]
        change, *along = map(_difference, (row.radial, *axes))
        name = spoken(row.situation) if row.situation else "all"
        rows.append((name, row.teats, change, p, *along))
    heads = "situation | >teats | >change [mm] | >p | >|x| [mm] | >|y| [mm] | >|z| [mm]"
    return table("Distance to the teat end", heads, rows)


def _rows(comparison: Comparison) -> tuple[Row, ...]:
    found = comparison.compared
    return (found.pooled, *(found.situations if len(found.situations) > 1 else ()))


def _difference(difference: PairedDifference) -> str:
    """``+0.12 (-0.03 to +0.27)``; without an interval where there is none."""
    if difference.mean is None:
        return NOT_MEASURED
    if difference.low is None or difference.high is None:
        return f"{difference.mean:+.3f}"
    return f"{difference.mean:+.3f} ({difference.low:+.3f} to {difference.high:+.3f})"


def _p(value: float | None) -> str:
    if value is None:
        return ""
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def as_json(found: Sequence[Comparison]) -> list[dict[str, Any]]:
    """Plain numbers and text; every figure that is printed, unrounded."""
    return [
        {
            "old": {"run": str(one.old.run.folder), "detector": one.old.detector},
            "new": {"run": str(one.new.run.folder), "detector": one.new.detector},
            "scenes": len(one.pairs),
            "same_frames": one.same_frames,
            "only_old": one.only_old,
            "only_new": one.only_new,
            "elsewhere": one.elsewhere,
            "confidence": one.compared.confidence,
            "gate": {
                "verdict": GATE[one.compared.gate.verdict][0],
                "reasons": list(one.compared.gate.reasons),
                "margin_mm": one.compared.gate.margin_mm,
            },
            "rows": [
                _numbers(row, one.compared.confidence)
                for row in (one.compared.pooled, *one.compared.situations)
            ],
        }
        for one in found
    ]


def _numbers(row: Row, confidence: float) -> dict[str, Any]:
    success = row.success
    note = {"difference": success.difference, "interval": success.interval(confidence)}
    note["p_value"] = success.p_value
    return {**asdict(row), "success": {**asdict(success), **note}}


def write_comparison(found: Sequence[Comparison], folder: Path) -> Path:
    """Write ``index.html`` and ``comparison.json``; return the page's path. Raises ConfigError."""
    text = json.dumps(as_json(found), indent=1, ensure_ascii=False)
    try:
        path = write_report(comparison_page(found), folder)
        write_synced(folder / "comparison.json", f"{text}\n".encode())
    except OSError as error:
        raise ConfigError.plain(f"{folder}: the comparison can't be written: {error}") from error
    return path


def comparison_page(found: Sequence[Comparison]) -> Page:
    """The page: a section a comparison."""
    gate = overall(comparison.compared.gate.verdict for comparison in found)
    worst = next((one for one in found if one.compared.gate.verdict is gate), found[0])
    verdict, _, then, _ = GATE[gate]
    runs = [side.run for one in found for side in (one.old, one.new)]
    kinds: set[Kind] = {run.facts["kind"] for run in runs}
    mixed: Kind = "mixed" if kinds & {"emulated", "mixed"} else "recorded"
    banner = Banner(
        kind=kinds.pop() if len(kinds) == 1 else mixed,
        verdict=verdict,
        tested=f"{'; '.join(heading(one) for one in found)}.",
        sentence=_sentence(worst),
        confidence=" ".join(notes(found[0])),
        next_action=then,
    )
    sections = tuple(
        Section(
            f"comparison-{number}",
            heading(one) if len(found) > 1 else "Differences",
            tuple(comparison_parts(one)),
        )
        for number, one in enumerate(found, 1)
    )
    damaged = any(run.damage for run in runs)
    return Page(
        "Comparison of detectors",
        "Paired differences on the same scenes",
        banner,
        sections,
        alarm=f"{NOT_AS_WRITTEN}: no figure below holds." if damaged else "",
    )


def _sentence(comparison: Comparison, most: int = 5) -> str:
    reasons = comparison.compared.gate.reasons
    more = f"; and {len(reasons) - most} more" if len(reasons) > most else ""
    return f"{verdict_text(comparison)} {'; '.join(reasons[:most])}{more}."


def comparison_parts(comparison: Comparison) -> Iterator[Part]:
    """What a page says of one comparison; a run's report can take the same."""
    tone = GATE[comparison.compared.gate.verdict][3]
    yield Paragraph(_sentence(comparison), tone=tone)
    yield success_table(comparison)
    yield distance_table(comparison, wide=True)
    yield Notes("Of this comparison", tuple(notes(comparison)))
    yield _changed(comparison)
    old, new = comparison.old.run.folder.name, comparison.new.run.folder.name
    yield key_values("Compared", {"old run": old, "new run": new})


def _changed(comparison: Comparison) -> Table:
    """Scenes whose outcome changed, and those whose error changed most."""

    def growth(pair: ScenePair) -> float | None:
        if not pair.old.radial_mm or not pair.new.radial_mm:
            return None
        return max(pair.new.radial_mm) - max(pair.old.radial_mm)

    def outcome(score: SceneScore) -> Cell:
        return Cell("success", "good") if score.success else Cell(why_failed(score), "bad")

    changes = [
        (pair.old.success == pair.new.success, growth(pair), pair) for pair in comparison.pairs
    ]
    shown = sorted(
        (change for change in changes if not change[0] or change[1]),
        key=lambda change: (change[0], -abs(change[1] or 0.0)),
    )
    rows = []
    for _, grown, pair in shown[:50]:
        change = Cell(NOT_MEASURED if grown is None else f"{grown:+.3f}", sort=grown)
        rows.append(
            (pair.scene, spoken(pair.situation), outcome(pair.old), outcome(pair.new), change)
        )
    return table(
        "Scenes that changed (at most 50, changed outcomes first)",
        "scene | situation | old | new | >change of the largest error [mm]",
        rows,
        "" if rows else "No scene's outcome changed, and no error.",
        searchable=len(rows) > 10,
    )


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
    parts = tuple(
        part
        for other in others
        if {t.id for t in first.trials} & {t.id for t in other.trials}
        for part in _of_one_run(compare_sides(first, other))
    )
    return (Section("detectors", "Detectors compared", parts),) if parts else ()


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
    alt = (
        f"{len(both)} scenes that both found teats in: the largest error grew in"
        f" {sum(b > a for a, b, _ in both)}, shrank in {sum(b < a for a, b, _ in both)}"
    )
    yield Figure(
        svg,
        f"Largest error of each scene, now against the baseline, {found.new.detector}. {alt}.",
        alt,
    )

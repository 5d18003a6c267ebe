"""A comparison as words and numbers, as a page of its own, and as chapters of a report: a run
against an older one, and the detectors of one run against its first.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields, is_dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from bench.config import several, writing
from bench.record.check import NOT_AS_WRITTEN
from bench.record.reader import RunRecord
from bench.report.chapters import page_of
from bench.report.glossary import terms
from bench.report.wording import NOT_MEASURED, hints, key_values, listed, p_text, table
from bench.results.comparison import Comparison, Side, compare_folders, compare_sides
from bench.results.error_rows import truth_gage
from bench.scoring.comparison import (
    ALPHA,
    ComparisonRow,
    PairedDifference,
    ScenePair,
    chance_text,
    common_errors,
    fewest_that_show,
    poses_needed,
    why_failed,
)
from bench.scoring.decisions import Verdict, overall
from bench.scoring.errors import Floats, numbered
from bench.scoring.scene import SceneScore
from instruments.world.situations import spoken
from reports.figures.errors import change_by_situation, change_scatter
from reports.frames import places_of
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
    Score,
    Scoreboard,
    Table,
    Tone,
)
from reports.page import Verdict as PageVerdict
from reports.render import write_report
from textfiles.text import capital, plural, sentence

JSON_VERSION = 1
DIFFER = {
    "kind": "kind",
    "rig": "rig",
    "script": "script",
    "seed": "seed",
    "calibration": "calibration_sha256",
    "program": "program",
    "perturbations": "perturbations",
}
# of a gate's verdict: the page's word, the sentence, what to do next, the tone
GATE: dict[Verdict, tuple[PageVerdict, str, str, Tone]] = {
    Verdict.MET: (
        "not worse",
        "The new one is not worse:",
        "As far as these scenes go, {new} may replace {old}.",
        "good",
    ),
    Verdict.NOT_MET: (
        "worse",
        "THE NEW ONE IS WORSE:",
        (
            "Open 'Scenes that changed' below, and those trials in the report of {run}, before"
            " {new} is used."
        ),
        "bad",
    ),
    Verdict.INCONCLUSIVE: (
        "inconclusive",
        "Whether the new one is worse can't be decided:",
        "Compare on more poses, as many as the reasons name.",
        "warn",
    ),
}


CAPPED = "†"  # beside a change of which a part counts as the limit
MOST_REASONS = 5  # in a sentence


def heading(comparison: Comparison) -> str:
    """Who is compared with whom."""
    return f"{comparison.new.label} (new) against {comparison.old.label} (old)"


def verdict_text(comparison: Comparison) -> str:
    """The gate's verdict as a sentence."""
    return GATE[comparison.compared.gate.verdict][1]


def notes(comparison: Comparison) -> Iterator[str]:
    """What has to be known before the figures are believed."""
    n, frames = len(comparison.pairs), ", each in the very same frames."
    if others := n - comparison.same_frames:
        frames = f"; {others} of them in different frames of the same pose, so their noise differs"
        frames += " as well."
    yield f"{plural(n, 'scene')}{frames}"
    if comparison.only_old or comparison.only_new:
        yield (
            "Without a counterpart, and not compared:"
            f" {plural(comparison.only_old, 'trial')} of the old run, {comparison.only_new} of the"
            " new."
        )
    if comparison.elsewhere:
        yield (
            f"With a namesake in the new run whose teats are elsewhere, and not compared:"
            f" {plural(comparison.elsewhere, 'trial')} of the old run."
        )
    for what, key in DIFFER.items():
        facts = [side.run.facts.get(key) for side in (comparison.old, comparison.new)]
        if facts[0] != facts[1]:
            a, b = ("not known" if fact is None else str(fact)[:40] for fact in facts)
            yield f"The runs also differ in {what}: {a} (old), {b} (new)."
    yield from _truth(comparison)
    if capped := capped_text(comparison):
        yield capped
    confidence, gate = comparison.compared.confidence, comparison.compared.gate
    yield f"Intervals: {100 * confidence:g} %. Margin: {gate.margin_mm:g} mm."


def _truth(comparison: Comparison) -> Iterator[str]:
    """How well the truth of two touched runs agrees: each run is a set-up."""
    old, new = comparison.old.run, comparison.new.run
    same = {pair.pose for pair in comparison.pairs}
    found = truth_gage((old, new), same) if old.folder.resolve() != new.folder.resolve() else None
    if found is None or found.studies is None:
        return
    width_mm, first = 2.0 * comparison.pairs[0].old.limit_mm, found.studies[0]
    within = listed((study.repeatability for study in found.studies), ".3f")
    between = listed((study.reproducibility for study in found.studies), ".3f")
    share = listed((100.0 * s.share_of_tolerance(width_mm) for s in found.studies), ".0f")
    yield (
        f"The truth itself (gage R&R along x, y, z; {first.parts} ends touched {first.repeats}"
        f" times in each run): repeatability {within} mm, reproducibility {between} mm, setting the"
        f" phantom up again included; {share} % of the tolerance of {width_mm:g} mm. Common to all"
        f" touches, and in none of these: u = {listed(found.common_mm, '.3f')} mm."
    )


def success_table(comparison: Comparison) -> Table:
    """Poses and what was counted: all, then each situation."""
    confidence, rows = comparison.compared.confidence, []
    for row in _rows(comparison):
        won, change = row.success, row.success.difference
        span, points = won.interval(confidence), None
        if span is not None and change is not None:
            points = f"{100 * change:+z.0f} ({100 * span[0]:+z.0f} to {100 * span[1]:+z.0f})"
        p = p_text(won.p_value if row.success_holm is None else row.success_holm)
        counts = (row.new.false - row.old.false, row.new.missed - row.old.missed)
        rows.append((_name(row), row.poses, won.only_old, won.only_new, points, p, *counts))
    return table("compared_success", rows)


def distance_table(comparison: Comparison, *, wide: bool = False) -> Table:
    """Distances and axes: all, then each situation. ``wide`` adds the axes' intervals."""
    rows = []
    for row in _rows(comparison):
        p = p_text(row.radial.p_value if row.radial_holm is None else row.radial_holm)
        axes = row.axes if wide else [replace(axis, low=None, high=None) for axis in row.axes]
        change, *along = map(_difference, (row.radial, *axes))
        rows.append((_name(row), row.teats, change, p, *along))
    return table("compared_distance", rows, note=capped_text(comparison))


def _rows(comparison: Comparison) -> tuple[ComparisonRow, ...]:
    found = comparison.compared
    return (found.pooled, *(found.situations if len(found.situations) > 1 else ()))


def _name(row: ComparisonRow) -> str:
    return spoken(row.situation) if row.situation else "all"


def capped_text(comparison: Comparison) -> str:
    """What the mark of a capped change means, and how many there are; empty for none."""
    radial, limit = comparison.compared.pooled.radial, comparison.pairs[0].old.limit_mm
    if not radial.capped:
        return ""
    return (
        f"{CAPPED} {radial.capped} of {plural(radial.rows, 'teat')} changed by more than the limit"
        f" of {limit:g} mm, and count as {limit:g} mm."
    )


def _mean(difference: PairedDifference) -> str:
    """``+0.12 mm`` of one that was measured."""
    return f"{difference.mean:+z.2f} mm{CAPPED if difference.capped else ''}"


def _difference(difference: PairedDifference) -> str:
    """``+0.12 (-0.03 to +0.27)``; without an interval where there is none."""
    if difference.mean is None:
        return NOT_MEASURED
    mean = f"{difference.mean:+z.2f}{CAPPED if difference.capped else ''}"
    if difference.low is None or difference.high is None:
        return mean
    return f"{mean} ({difference.low:+z.2f} to {difference.high:+z.2f})"


def as_json(found: Sequence[Comparison]) -> dict[str, Any]:
    """Plain numbers and text; every figure that is printed, unrounded (docs/json.md)."""
    whole, counted = [], ("same_frames", "only_old", "only_new", "elsewhere")
    for one in found:
        compared, gate = one.compared, one.compared.gate
        rate = {} if gate.margin_rate is None else {"margin_rate": gate.margin_rate}
        rows = []
        for row in (compared.pooled, *compared.situations):
            won = row.success
            more = {"difference": won.difference, "interval": won.interval(compared.confidence)}
            success = {**asdict(won), **more, "p_value": won.p_value}
            rows.append({**asdict(row), "success": success})
        said = {"verdict": GATE[gate.verdict][0], "reasons": list(worded(one, gate.reasons))}
        whole.append(
            {
                "old": {"run": str(one.old.run.folder), "detector": one.old.detector},
                "new": {"run": str(one.new.run.folder), "detector": one.new.detector},
                "scenes": len(one.pairs),
                **{key: getattr(one, key) for key in counted},
                "identical": compared.identical,
                "confidence": compared.confidence,
                "gate": {**said, "margin_mm": gate.margin_mm, **rate},
                "rows": rows,
            }
        )
    return {"schema_version": JSON_VERSION, "comparisons": whole}


def write_comparison(found: Sequence[Comparison], folder: Path | str) -> Path:
    """Write ``index.html`` and ``comparison.json``; return the page's path. Raises ConfigError."""
    found, folder = several("found", found, 1), Path(folder)
    text = json.dumps(as_json(found), indent=1, ensure_ascii=False)
    with writing(folder):
        more = [("comparison.json", f"{text}\n".encode())]
        return write_report(comparison_page(found), folder, more)


def comparison_page(found: Sequence[Comparison]) -> Page:
    """The page: what came out of each comparison on the first screen, then how and why, folded."""
    gate = overall(comparison.compared.gate.verdict for comparison in found)
    runs = [side.run for one in found for side in (one.old, one.new)]
    kinds: set[Kind] = {run.facts["kind"] for run in runs}
    mixed: Kind = "mixed" if kinds & {"emulated", "mixed"} else "recorded"
    each = tuple((_matter(one), GATE[one.compared.gate.verdict][0]) for one in found)

    def lines(of: Callable[[Comparison], str]) -> str:
        """Each comparison's, with its name where they differ."""
        said = [of(one) for one in found]
        named = [f"{_matter(one)}: {text}" for one, text in zip(found, said, strict=True)]
        return said[0] if len(set(said)) == 1 else "\n".join(named)

    banner = Banner(
        kind=kinds.pop() if len(kinds) == 1 else mixed,
        verdict=GATE[gate][0],
        tested="\n".join(dict.fromkeys(map(_tested, found))),
        sentence="\n".join(map(_outcome, found)),
        confidence=lines(_sure),
        next_action=lines(_next),
        each=each if len(each) > 1 else (),
    )
    # what came out of all comparisons comes before what folds
    shown: dict[str, tuple[str, Sequence[Part]]] = {}
    folded: dict[str, tuple[str, Sequence[Part]]] = {}
    for number, one in enumerate(found, 1):
        whose = f": {_matter(one)}" if len(found) > 1 else ""
        came_out = (_scoreboard(one), _by_situation(one, number))
        shown |= {f"comparison-{number}": (f"What came out{whose}", came_out)}
        sentence, success, distance, how, changed, names = comparison_parts(one)
        reasons = gate_reasons(one)
        more = [Notes("All reasons", reasons)] if len(reasons) > MOST_REASONS else []
        why = "Why this verdict, and how it was compared"
        folded |= {
            f"changed-{number}": (f"Scenes that changed{whose}", [changed]),
            f"tables-{number}": (f"Each situation in figures{whose}", [success, distance]),
            f"how-{number}": (f"{why}{whose}", [sentence, *more, how, names]),
        }
    compared = "runs" if found[0].compared.gate.margin_rate is None else "campaigns"
    if all(one.old.run.folder.resolve() == one.new.run.folder.resolve() for one in found):
        compared = "detectors"
    damaged = any(run.damage for run in runs)
    page = page_of(
        f"Comparison of {compared}",
        "Paired differences on the same scenes",
        banner,
        shown,
        folded,
        alarm=f"{NOT_AS_WRITTEN}: no figure below holds." if damaged else "",
    )
    said = {term: f"{term.name} {term.meaning}" for term in terms()}
    same = tuple(term for term, text in said.items() if worded(found[0], text) == text)
    return replace(worded(found[0], page), glossary=same)


Text = TypeVar("Text")


def worded(one: Comparison, value: Text) -> Text:
    """A text or page in the words of its kind: campaigns have scenes, runs have poses."""
    return value if one.compared.gate.margin_rate is None else _of_scenes(value)


def _of_scenes(value: Any) -> Any:
    if isinstance(value, str) and not isinstance(value, Enum):
        return re.sub(r"\bpose(?=s?\b)", "scene", re.sub(r"\bPose(?=s?\b)", "Scene", value))
    if isinstance(value, tuple | list):
        return type(value)(map(_of_scenes, value))
    if isinstance(value, Mapping):
        return {_of_scenes(key): _of_scenes(one) for key, one in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        parts = {field.name: getattr(value, field.name) for field in fields(value) if field.init}
        changed = {name: new for name, old in parts.items() if (new := _of_scenes(old)) != old}
        return replace(value, **changed) if changed else value
    return value


def printed(one: Comparison) -> tuple[str, Mapping[str, Table], Sequence[str], Sequence[str]]:
    """Heading, tables by name, sentences and the gate's reasons, `worded`."""
    tables = {"success": success_table(one), "distance to the teat end": distance_table(one)}
    said = [*notes(one), verdict_text(one)]
    return worded(one, (heading(one), tables, said, gate_reasons(one)))


def gate_reasons(one: Comparison) -> tuple[str, ...]:
    """The gate's reasons, situations by their spoken names."""
    called = {row.situation: spoken(row.situation or "") for row in one.compared.situations}
    reasons = []
    for reason in one.compared.gate.reasons:
        head, middle, rest = reason.partition(" the ")
        name = called.get(head.removeprefix("in "))
        reasons.append(f"in {name}{middle}{rest}" if name else reason)
    return tuple(reasons)


def _called(one: Comparison) -> tuple[str, str]:
    """What the first screen calls the old and the new one: by what they differ in."""
    old, new = one.old, one.new
    if old.detector != new.detector:
        return old.detector, new.detector
    items = (side.run.facts["items"].get(side.detector, {}) for side in (old, new))
    was, now = (item.get("version") for item in items)
    if was != now and was and now:
        return f"{old.detector} {was}", f"{new.detector} {now}"
    return "the old run", "the new run"


def _short(one: Comparison) -> tuple[str, str]:
    old, new = _called(one)
    return old.removeprefix("the "), new.removeprefix("the ")


def _matter(one: Comparison) -> str:
    """The comparison's name beside others on the page."""
    old, new = one.old.detector, one.new.detector
    return new if old == new else f"{new} against {old}"


def _outcome(one: Comparison) -> str:
    """Who is better, by how much, how sure: short sentences."""
    old, new = _called(one)
    row, verdict = one.compared.pooled, one.compared.gate.verdict
    won, change = row.success, row.radial
    same = f"{one.new.detector}: " if one.old.detector == one.new.detector else ""
    if one.compared.identical:
        return f"{same}{sentence(one.compared.gate.reasons[0])}"
    said = {
        Verdict.MET: f"{same}{new} is not worse than {old}.",
        Verdict.NOT_MET: f"{same}{new} is worse than {old}.",
    }.get(verdict, f"{same}{new} was not worse than {old} here, but too little was compared.")
    if one.old.run.damage or one.new.run.damage:
        return f"{same}{NOT_AS_WRITTEN}, so nothing is decided."
    right = (won.both + won.only_old, won.both + won.only_new)
    poses = f"Of {plural(row.poses, 'pose')} {old} got {right[0]} right, {new} {right[1]}"
    if right[0] == right[1]:
        poses = f"Both got {right[0]} of {plural(row.poses, 'pose')} right"
    else:
        why = chance_text(won.only_old + won.only_new, "in which they differ")
        poses += ", more than chance explains" if won.p_value < ALPHA else f", {why}"
    if change.mean is None:
        return f"{said} {poses}. No teat was found by both, so no distance was compared."
    before, now = (_mean_mm(errors, one) for errors in common_errors(one.pairs)[:2])
    if abs(change.mean) < 0.0005:
        return f"{said} {poses}. Their points lie equally far from the teat ends, {now} on average."
    far = f"{new}'s points lie {now} from the teat ends on average, {old}'s {before}"
    if change.p_value is not None and change.p_value >= ALPHA:
        far += f", {chance_text(change.poses, 'in which both found teats')}"
    return f"{said} {poses}. {capital(far) if far.startswith('the ') else far}."


def _tested(one: Comparison) -> str:
    """Which runs, on what, and what was left out."""
    row, n = one.compared.pooled, len(one.pairs)
    which = "in the same frames" if one.same_frames == n else "each with frames of its own"
    if one.same_frames not in (0, n):
        which = f"{n - one.same_frames} of them in other frames"
    left = one.only_old + one.only_new
    missing = f" {plural(left, 'trial')} without a counterpart left out." if left else ""
    sets = f"{plural(n, 'frame set')} of {plural(row.poses, 'pose')}, {which}"
    names = heading(one)
    if one.old.run.folder.resolve() == one.new.run.folder.resolve():
        within = f" in {one.old.run.folder.resolve().name}"
        names = f"{names.replace(within, '')}, both{within}"
    return f"{names}: {sets}.{missing}"


def _sure(one: Comparison) -> str:
    """What the intervals say, and how many poses would say more."""
    change, confidence = one.compared.pooled.radial, 100 * one.compared.confidence
    if change.low is None or change.high is None:
        return "No distance was compared."
    if change.poses < fewest_that_show():
        few = f"{plural(change.poses, 'pose')} in which both found teats"
        return f"{few} can show nothing by themselves: {fewest_that_show()} can."
    span = f"{change.low:+z.2f} to {change.high:+z.2f} mm"
    return (
        f"For all such poses, not only these {change.poses}, the mean distance changes by {span},"
        f" {confidence:g} % sure."
    )


def _next(one: Comparison) -> str:
    gate, row = one.compared.gate, one.compared.pooled
    old, new = (name.replace(" run", " one") for name in _called(one))
    then = GATE[gate.verdict][2].format(old=old, new=new, run=one.new.run.folder.name)
    if gate.verdict is not Verdict.INCONCLUSIVE or row.radial.high is None:
        return then
    looks = 1 if one.look is None else 1 + len(one.look.after)
    chance = (1.0 - one.compared.confidence) / 2.0 ** (1 + looks)
    needed = poses_needed(one.pairs, gate.margin_mm, chance)
    if needed is None or needed <= row.radial.poses:
        return then
    return f"Compare on more poses: {needed} with such changes decide it."


def _scoreboard(one: Comparison) -> Scoreboard:
    """What the gate looks at, line by line: both sides, and what the new one may be worse by."""
    names = _short(one)
    row, margin = one.compared.pooled, one.compared.gate.margin_mm
    won, poses = row.success, row.poses
    allowed = one.compared.gate.margin_rate
    rows: list[tuple[str, str, tuple[Score | None, ...]]] = []

    def add(
        name: str, limit: str, old: str | None, verdict: PageVerdict, new: str, shows: str = ""
    ) -> None:
        before = None if old is None else Score("no verdict", old, "")
        rows.append((name, limit, (before, Score(verdict, new, shows))))

    lost = any(pair.old.success and not pair.new.success for pair in one.pairs)
    span = won.interval(one.compared.confidence)
    change = "" if span is None else f" ({100 * span[0]:+z.0f} to {100 * span[1]:+z.0f} % points)"
    verdict: PageVerdict = "worse" if lost else "not worse"
    if allowed is not None and span is not None:
        verdict = "not worse" if -span[0] <= allowed else "inconclusive"
        verdict = "worse" if -(won.difference or 0.0) > allowed and won.p_value < ALPHA else verdict
    limit = "none lost" if allowed is None else f"{100 * allowed:g} % points"
    before, now = (f"{won.both + only} of {poses}" for only in (won.only_old, won.only_new))
    shows = f"{won.only_old or 'none'} lost, {won.only_new or 'none'} won{change}"
    add("Poses right", limit, before, verdict, now, shows)
    for name, what in (("Teats missed", "missed"), ("False teats", "false")):
        few, many = getattr(row.old, what), getattr(row.new, what)
        word = "more" if many > few else "fewer"
        shows = f"{abs(many - few)} {word}" if many != few else "as many"
        verdict = "no verdict" if allowed is not None else "worse" if many > few else "not worse"
        add(name, "" if allowed is not None else "none more", str(few), verdict, str(many), shows)
    before, now = (_mean_mm(errors, one) for errors in common_errors(one.pairs)[:2])
    shows = f"change {_difference(row.radial)} mm"
    shows = "no teat found by both" if row.radial.mean is None else shows
    limit = f"{margin:g} mm farther"
    add("Distance to the teat end", limit, before, _change_verdict(row.radial, margin), now, shows)
    along = [(axis.mean, name, axis) for axis, name in zip(row.axes, "xyz", strict=True)]
    if known := [(mm, name, axis) for mm, name, axis in along if mm is not None]:
        mm, name, axis = max(known, key=lambda one: one[0])
        verdict = "worse" if mm > margin else "not worse"
        most, along_it = f"{margin:g} mm larger", f"along {name}"
        add("Error along one axis", most, None, verdict, _mean(axis), along_it)
    there = [(r.radial.mean, r) for r in one.compared.situations if r.radial.mean is not None]
    if len(there) > 1:
        mm, worst = max(there, key=lambda pair: pair[0])
        sure = worst.radial_holm is not None and worst.radial_holm < ALPHA
        verdict = "not worse" if mm <= margin else "worse" if sure else "inconclusive"
        why = chance_text(worst.radial.poses, "of it", len(one.compared.situations))
        note = f", {why}" if verdict == "inconclusive" else ""
        which = f"{spoken(worst.situation or '')}{note}"
        add("Worst situation", limit, None, verdict, _mean(worst.radial), which)
    heads = ("Compared", "May be worse by")
    return Scoreboard(f"{names[0]} and {names[1]}", names, tuple(rows), heads, hints("comparison"))


def _change_verdict(change: PairedDifference, margin_mm: float) -> PageVerdict:
    if change.mean is None or change.high is None:
        return "not measured"
    if change.mean > margin_mm:
        return "worse"
    return "inconclusive" if change.high > margin_mm else "not worse"


def _mean_mm(errors_mm: Floats, one: Comparison) -> str:
    """The mean distance over poses, of teats that both found."""
    if not len(errors_mm):
        return NOT_MEASURED
    codes = numbered(common_errors(one.pairs)[2])
    means = np.bincount(codes, np.linalg.norm(errors_mm, axis=1)) / np.bincount(codes)
    return f"{means.mean():.2f} mm"


def _by_situation(comparison: Comparison, number: int) -> Figure:
    rows = _rows(comparison)
    names = [*map(_name, rows)]
    won = [(row.success, row.poses) for row in rows]
    right = [(of.both + of.only_old, of.both + of.only_new, n) for of, n in won]
    spans = [(row.radial.mean, row.radial.low, row.radial.high) for row in rows]
    change = [
        None if mean is None or low is None or high is None else (mean, low, high)
        for mean, low, high in spans
    ]
    margin_mm, called = comparison.compared.gate.margin_mm, _short(comparison)
    (old, new), name = _called(comparison), f"situations-{number}"
    sides = comparison.old.detector, comparison.new.detector
    places = places_of(sides)
    who = places[sides[0]], places[sides[1]]
    svg = change_by_situation(names, right, change, margin_mm, called=called, who=who, name=name)
    alt = "; ".join(
        f"{name}: {a} and {b} of {plural(n, 'pose')} right, distance {_difference(row.radial)}"
        for name, (a, b, n), row in zip(names, right, rows, strict=True)
    )
    caption = (
        f"Left: share of poses that each got right. Right: how much farther {new}'s points lie from"
        f" the teat ends than {old}'s, with {100 * comparison.compared.confidence:g} % intervals;"
        " one that stays left of the margin is not worse."
    )
    if capped := capped_text(comparison):
        caption += f" {capped}"
    return Figure(svg, caption, alt, wide=True)


def comparison_parts(comparison: Comparison) -> Iterator[Part]:
    """What a page says of one comparison; a run's report can take the same."""
    tone = GATE[comparison.compared.gate.verdict][3]
    reasons = gate_reasons(comparison)
    more = f"; and {len(reasons) - MOST_REASONS} more" if len(reasons) > MOST_REASONS else ""
    yield Paragraph(
        f"{verdict_text(comparison)} {'; '.join(reasons[:MOST_REASONS])}{more}.", tone=tone
    )
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

    grown = [
        (pair.old.success == pair.new.success, growth(pair), pair) for pair in comparison.pairs
    ]
    shown = [one for one in grown if not one[0] or one[1]]
    shown.sort(key=lambda one: (one[0], -abs(one[1] or 0.0)))
    rows = []
    for _, mm, pair in shown[:50]:
        change = Cell(NOT_MEASURED if mm is None else f"{mm:+z.2f}", sort=mm)
        both = (outcome(pair.old), outcome(pair.new))
        rows.append((pair.scene, spoken(pair.situation), *both, change))
    note = "" if rows else "No scene's outcome changed, and no error."
    return table("changed_scenes", rows, note=note, searchable=len(rows) > 10)


def baseline_parts(baseline: Path, folder: Path, damage: tuple[str, ...] = ()) -> Iterator[Part]:
    """The run in ``folder`` (new) against ``baseline`` (old). Raises ConfigError."""
    for number, one in enumerate(compare_folders([baseline, folder], damage=damage), 1):
        pairs = [
            (max(p.old.radial_mm), max(p.new.radial_mm), p.new.limit_mm)
            for p in one.pairs
            if p.old.radial_mm and p.new.radial_mm
        ]
        if pairs:
            old, new, limits = zip(*pairs, strict=True)
            svg = change_scatter(old, new, max(limits), name=f"change-{number}")
            alt = (
                f"{plural(len(pairs), 'scene')} that both found teats in: the largest error grew in"
                f" {sum(b > a for a, b, _ in pairs)}, shrank in {sum(b < a for a, b, _ in pairs)}"
            )
            of = f"Largest error of each scene, now against the baseline, {one.new.detector}."
            yield Figure(svg, f"{of} {alt}.", alt)
        yield from comparison_parts(one)


def detectors_parts(run: RunRecord) -> Iterator[Part]:
    """Each later scored detector against the first, on the same frames."""
    first, *others = (Side(run, name) for name in run.detectors)
    for other in others:
        if {t.id for t in first.trials} & {t.id for t in other.trials}:
            found = compare_sides(first, other)
            old, new = found.old.detector, found.new.detector
            yield Paragraph(
                f"{new} against {old}, in the same frames: {old} is the old one, {new} the new."
            )
            for part in comparison_parts(found):
                if isinstance(part, Table):
                    yield replace(
                        part, caption=f"{part.caption}: {new} against {old}", searchable=False
                    )
                elif not isinstance(part, KeyValues):
                    yield part

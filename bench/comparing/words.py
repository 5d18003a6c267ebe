"""A comparison in words and plain numbers: one place, so that terminal, page and JSON say the same."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any

from bench.comparing.runs import Comparison
from bench.gauging import truth_gage
from bench.scoring.comparison import Row
from bench.scoring.decisions import Verdict
from bench.scoring.paired import PairedDifference
from bench.summary.wording import NOT_MEASURED
from reports.parts import Verdict as PageVerdict

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
DISTANCE = (("situation", ""), ("teats", ""), ("change", "mm"), ("p", ""), ("|x|", "mm"), ("|y|", "mm"), ("|z|", "mm"))
LEGEND = (
    "All differences are new less old, with their intervals. Lost and won: poses that only the old "
    "or only the new one got right (exact McNemar; the interval is Tango's). Distance: mean over "
    "poses of the distance to the end, of teats that both found; a teat's change counts up to the "
    "limit (the interval is Gaffke's, which allows for poses that were not run; p by sign flips). "
    "|x|, |y|, |z|: of the absolute error along the world's axes. The p-values of situations are "
    "adjusted after Holm."
)
DIFFER = {"kind": "kind", "rig": "rig", "script": "script", "seed": "seed", "calibration": "calibration_sha256"}
NOT_KNOWN = "not known"
WORDS: dict[Verdict, PageVerdict] = {Verdict.MET: "not worse", Verdict.NOT_MET: "worse", Verdict.INCONCLUSIVE: "inconclusive"}
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
        yield f"{n} scenes; {n - comparison.same_frames} of them in different frames of the same pose, so their noise differs as well."
    if comparison.only_old or comparison.only_new:
        yield f"Without a counterpart, and not compared: {comparison.only_old} trials of the old run, {comparison.only_new} of the new."
    if comparison.elsewhere:
        yield f"{comparison.elsewhere} trials of the old run have a namesake in the new one with its teats elsewhere: not compared."
    yield from _unlike(comparison)
    yield from _truth(comparison)
    yield f"Intervals: {100 * comparison.compared.confidence:g} %. Margin: {comparison.compared.gate.margin_mm:g} mm."


def _unlike(comparison: Comparison) -> Iterator[str]:
    """What else differs between the two runs than the detector."""
    old, new = comparison.old.run.facts, comparison.new.run.facts
    for what, key in DIFFER.items():
        a, b = old.get(key), new.get(key)
        if a != b:
            yield f"The runs also differ in {what}: {_short(a)} (old), {_short(b)} (new)."


def _truth(comparison: Comparison) -> Iterator[str]:
    """How well the truth of the two runs agrees, where their ends were touched: each run is a set-up."""
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
        f"The truth itself (gage R&R along x, y, z; {first.parts} ends touched {first.repeats} times in each run): repeatability "
        f"{within} mm, reproducibility {between} mm, setting the phantom up again included; {share} % of the tolerance of {width_mm:g} mm."
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
        yield (name, str(row.poses), str(won.only_old), str(won.only_new), _percent_points(row, confidence), _p(p), *counts)


def distance_rows(comparison: Comparison, *, wide: bool = False) -> Iterator[tuple[str, ...]]:
    """The rows under DISTANCE: all, then each situation. ``wide`` gives the axes their intervals too."""
    for row in _rows(comparison):
        p = row.radial.p_value if row.radial_holm is None else row.radial_holm
        axes = (difference_told(axis if wide else replace(axis, low=None, high=None)) for axis in row.axes)
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
        "gate": {"verdict": WORDS[found.gate.verdict], "reasons": list(found.gate.reasons), "margin_mm": found.gate.margin_mm},
        "rows": [_numbers(row, found.confidence) for row in (found.pooled, *found.situations)],
    }


def _numbers(row: Row, confidence: float) -> dict[str, Any]:
    success = {"difference": row.success.difference, "interval": row.success.interval(confidence), "p_value": row.success.p_value}
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

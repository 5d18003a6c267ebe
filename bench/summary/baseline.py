"""The report's chapters that compare: a run against an older one of the same scenes, and the detectors of one run against its first."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from bench.comparing.page import comparison_parts
from bench.comparing.runs import Comparison, Side, compare_folders, compare_sides
from bench.record import RunRecord
from reports.figures import change_scatter
from reports.page import Figure, KeyValues, Paragraph, Part, Section, Table


def baseline_section(baseline: Path, folder: Path, damage: tuple[str, ...] = ()) -> Section:
    """The run in ``folder`` (new) against that in ``baseline`` (old). Raises ConfigError where they have nothing in common."""
    found = compare_folders([baseline, folder], damage=damage)
    parts = tuple(part for number, one in enumerate(found, 1) for part in (*_figure(one, number), *comparison_parts(one)))
    return Section("baseline", "Against the baseline", parts)


def detectors_section(run: RunRecord) -> tuple[Section, ...]:
    """Each later detector against the first, on the same frames; none where there are no two that were scored."""
    first, *others = (Side(run, name) for name in run.detectors)
    compared = [compare_sides(first, other) for other in others if {t.id for t in first.trials} & {t.id for t in other.trials}]
    if not compared:
        return ()
    parts = tuple(part for one in compared for part in _of_one_run(one))
    return (Section("detectors", "Detectors compared", parts),)


def _of_one_run(found: Comparison) -> Iterator[Part]:
    """Without a filter, since that of the trials is the page's, and without the runs' names."""
    old, new = found.old.detector, found.new.detector
    yield Paragraph(f"{new} against {old}, in the same frames: {old} is the old one, {new} the new.")
    for part in comparison_parts(found):
        if isinstance(part, Table):
            yield replace(part, caption=f"{part.caption}: {new} against {old}", searchable=False)
        elif not isinstance(part, KeyValues):
            yield part


def _figure(found: Comparison, number: int) -> Iterator[Part]:
    both = [(max(p.old.radial_mm), max(p.new.radial_mm), p.new.limit_mm) for p in found.pairs if p.old.radial_mm and p.new.radial_mm]
    if not both:
        return
    old, new, limits = zip(*both, strict=True)
    svg = change_scatter(old, new, max(limits), name=f"change-{number}")
    worse = sum(b > a for a, b in zip(old, new, strict=True))
    alt = f"{len(both)} scenes that both found teats in: the largest error grew in {worse}, shrank in {sum(b < a for a, b, _ in both)}"
    yield Figure(svg, f"Largest error of each scene, now against the baseline, {found.new.detector}. {alt}.", alt)

"""The report's chapter on a baseline: this run held against an older one of the same scenes, with its differences and their intervals."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from bench.comparing.page import comparison_parts
from bench.comparing.runs import Comparison, compare_folders
from reports.figures import change_scatter
from reports.page import Figure, Part, Section


def baseline_section(baseline: Path, folder: Path) -> Section:
    """The run in ``folder`` (new) against that in ``baseline`` (old). Raises ConfigError where they have nothing in common."""
    found = compare_folders([baseline, folder])
    parts = tuple(part for number, one in enumerate(found, 1) for part in (*_figure(one, number), *comparison_parts(one)))
    return Section("baseline", "Against the baseline", parts)


def _figure(found: Comparison, number: int) -> Iterator[Part]:
    both = [(max(p.old.radial_mm), max(p.new.radial_mm), p.new.limit_mm) for p in found.pairs if p.old.radial_mm and p.new.radial_mm]
    if not both:
        return
    old, new, limits = zip(*both, strict=True)
    svg = change_scatter(old, new, max(limits), name=f"change-{number}")
    worse = sum(b > a for a, b in zip(old, new, strict=True))
    alt = f"{len(both)} scenes that both found teats in: the largest error grew in {worse}, shrank in {sum(b < a for a, b, _ in both)}"
    yield Figure(svg, f"Largest error of each scene, now against the baseline, {found.new.detector}. {alt}.", alt)

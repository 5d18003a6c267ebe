"""Pages of chapters, one builder for those of runs, calibrations, comparisons and campaigns: what
came out stands open on the first screen, all else folds, and terms are explained.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from bench.report.glossary import terms
from reports.page import Banner, Page, Part, Section

Chapters = Mapping[str, tuple[str, Iterable[Part]]]  # title and parts by anchor


def sections(
    chapters: Chapters, about: Mapping[str, str] | None = None, *, folded: bool = False
) -> tuple[Section, ...]:
    """Those with a part; ``about``: by anchor what a folded chapter holds."""
    held = {anchor: (head, tuple(parts)) for anchor, (head, parts) in chapters.items()}
    return tuple(
        Section(anchor, head, parts, folded=folded, about=(about or {}).get(anchor, ""))
        for anchor, (head, parts) in held.items()
        if parts
    )


def page_of(
    title: str,
    subtitle: str,
    banner: Banner,
    shown: Chapters,
    folded: Chapters,
    about: Mapping[str, str] | None = None,
    **more: Any,
) -> Page:
    """The chapters ``shown``, then ``folded``, as `sections`; ``more``: fields of a `Page`."""
    both = (*sections(shown), *sections(folded, about, folded=True))
    return Page(title, subtitle, banner, both, **{"glossary": terms(), **more})

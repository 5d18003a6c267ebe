"""Pages of chapters, one builder for those of calibrations, comparisons and campaigns: what came
out stands open on the first screen, all else folds, and terms are explained.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from bench.report.glossary import terms
from reports.page import Banner, Page, Part, Section

Chapters = Mapping[str, tuple[str, Iterable[Part]]]  # title and parts by anchor


def page_of(
    title: str,
    subtitle: str,
    banner: Banner,
    shown: Chapters,
    folded: Chapters,
    about: Mapping[str, str] | None = None,
    **more: Any,
) -> Page:
    """``about``: by anchor what a folded chapter holds; chapters without a part are left out."""
    sections = []
    for chapters, folds in ((shown, False), (folded, True)):
        for anchor, (head, parts) in chapters.items():
            if held := tuple(parts):
                text = (about or {}).get(anchor, "")
                sections.append(Section(anchor, head, held, folded=folds, about=text))
    return Page(title, subtitle, banner, tuple(sections), **{"glossary": terms(), **more})

"""A report's page read as a person reads it, from its HTML: sentences, and cells with the heads that
they stand under. It knows nothing of the program's own parts of a page.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser

# what looks like a judgement: by its tone, or by its words
TONES = ("tone-good", "tone-bad", "tone-warn", "box-bad", "box-warn", "box-good")
VERDICTS = ("verdict-met", "verdict-not-met", "verdict-worse", "verdict-not-worse")
WORDS = re.compile(
    r"\bp = |chi-square|confidence|\bshow(s|n)?\b|\baccept|\brefus|\bworse\b|\bbetter\b|\bchance\b"
    r"|\bbias\b|\btrend\b|\bat (most|least)\b|\bknown to\b|\b95 %|\btoo (small|large|narrow)\b"
    r"|\bmet\b|\bfault\b|\bsure\b|\bmay be\b|\bexplain|\bsucceed|\bbeyond\b|\blost\b|\bheld\b"
    r"|\binconclusive\b|\bwithin\b|\bcasts? doubt\b|\boff by\b|\bsignificant\b|\bdisagree"
)
BLOCKS = {"p", "li", "dd", "dt", "td", "th", "caption", "figcaption", "summary", "pre"}
BLOCKS |= {f"h{level}" for level in range(1, 7)}
SILENT = {"script", "style", "svg", "nav"}


@dataclass(frozen=True, slots=True)
class Said:
    """One sentence or cell, how it is marked, and where it stands: the caption of its table, the
    head of its column and of its row.
    """

    text: str
    marks: frozenset[str] = frozenset()
    table: str = ""
    column: str = ""
    row: str = ""

    @property
    def judges(self) -> bool:
        """Whether it may accuse or accept."""
        return bool(self.marks) or (not self.column and WORDS.search(self.text) is not None)


@dataclass
class _Block:
    tag: str
    marks: set[str]
    text: list[str] = field(default_factory=list)


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.said: list[Said] = []
        self._open: list[_Block] = []
        self._silent = 0
        self._glossary = 0
        self._caption, self._heads, self._row, self._column = "", [], "", 0  # type: ignore[var-annotated]
        self._in_head = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if given.get("id") == "glossary" or (self._glossary and tag == "section"):
            self._glossary += tag == "section"
        if tag in SILENT:
            self._silent += 1
        marks = {one for one in (given.get("class") or "").split() if one in (*TONES, *VERDICTS)}
        if tag == "table":
            self._caption, self._heads = "", []
        elif tag == "thead":
            self._in_head = True
        elif tag == "tr":
            self._row, self._column = "", 0
        if tag in BLOCKS:
            self._open.append(_Block(tag, marks))
        elif marks and self._open:
            self._open[-1].marks |= marks

    def handle_endtag(self, tag: str) -> None:
        if tag in SILENT:
            self._silent -= 1
        if tag == "section" and self._glossary:
            self._glossary -= 1
        if tag == "thead":
            self._in_head = False
        elif tag == "table":
            self._caption, self._heads = "", []
        if tag in BLOCKS and self._open and self._open[-1].tag == tag:
            self._end(self._open.pop())

    def handle_data(self, data: str) -> None:
        if self._open and not self._silent:
            self._open[-1].text.append(data)

    def _end(self, block: _Block) -> None:
        text, marks = " ".join("".join(block.text).split()), frozenset(block.marks)
        if self._glossary:
            return
        if block.tag == "caption":
            self._caption = text
        if block.tag in ("td", "th"):
            self._cell(block.tag, text, marks)
        elif text:
            self.said += (Said(one, marks) for one in sentences(text))

    def _cell(self, tag: str, text: str, marks: frozenset[str]) -> None:
        if self._in_head:
            self._heads.append(text)
            return
        self._row = text if tag == "th" else self._row
        column = self._heads[self._column] if self._column < len(self._heads) else ""
        self._column += 1
        if text:
            self.said.append(Said(text, marks, self._caption, column, self._row))


def sentences(text: str) -> Iterator[str]:
    """Each ends with a full stop and a blank, and the next begins with a capital, or a name."""
    yield from re.split(r"(?<=[.:]) (?=[A-Z“\d])(?<!e\. )", text)


def read(page: str) -> list[Said]:
    """All that stands on it, but for the glossary."""
    reader = _Page()
    reader.feed(page)
    return reader.said

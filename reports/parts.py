"""The parts that a page is made of: requirement rows, tables, figures, lists, text.

Frozen values that check themselves when made. All text is plain text; numbers arrive as text,
rounded by whoever knows their meaning.
"""

from dataclasses import dataclass, field
from typing import ClassVar, Literal, get_args

from reports.trust import PageError, SvgFacts, address, one_of, svg_facts

Verdict = Literal[
    "met", "not met", "inconclusive", "not measured", "aborted", "no verdict", "not worse", "worse"
]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
Tone = Literal["plain", "good", "bad", "warn", "info", "muted"]
TONES: tuple[Tone, ...] = ("plain", "good", "bad", "warn", "info", "muted")
Align = Literal["left", "right", "center"]
NARROW_BELOW = 500.0  # units of a drawing's viewBox: points


@dataclass(frozen=True, slots=True)
class Requirement:
    """A row of the verdict: how it is decided, on `n` values or poses, `margin` to the limit."""

    name: str
    rule: str
    n: int
    measured: str
    limit: str
    margin: str
    verdict: Verdict
    source: str = ""

    def __post_init__(self) -> None:
        one_of(self.verdict, VERDICTS, f"requirement {self.name!r}, verdict")
        if self.n <= 0 and self.verdict in {"met", "not met"}:
            raise PageError(
                f"requirement {self.name!r}: {self.verdict!r} on {self.n} values; a verdict on"
                " nothing is 'not measured'"
            )


@dataclass(frozen=True, slots=True)
class Requirements:
    """The table of requirements; on a narrow screen each row becomes a card."""

    kind: ClassVar[str] = "requirements"
    caption: str
    rows: tuple[Requirement, ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Cell:
    """A text with a tone, a link (`#id` or relative path), a value to sort by, or monospace."""

    text: str
    tone: Tone = "plain"
    href: str = ""
    sort: float | None = None
    mono: bool = False

    def __post_init__(self) -> None:
        one_of(self.tone, TONES, f"cell {self.text!r}, tone")
        if self.href:
            address(self.href, f"cell {self.text!r}, link")


Entry = tuple[str, str | Cell]


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table: the unit stands under the title, `hint` is shown on hovering."""

    title: str
    align: Align = "left"
    unit: str = ""
    hint: str = ""


def columns(*heads: str | Column) -> tuple[Column, ...]:
    """Columns out of texts ``title | >title [unit] # hint``: ``>`` sets figures to the right.

    A title that anybody gave, as a detector's name, comes as a `Column`: it may hold such signs.
    """
    found: list[Column] = []
    for head in heads:
        found += [head] if isinstance(head, Column) else map(_column, head.split(" | "))
    return tuple(found)


def _column(text: str) -> Column:
    rest, _, hint = text.partition(" # ")
    title, _, unit = rest.partition(" [")
    align: Align = "right" if title.startswith(">") else "left"
    return Column(title.removeprefix(">"), align, unit.removesuffix("]"), hint)


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells. `searchable` adds a filter box and sorting; rows whose first link is a trial's
    then hide that trial with them.
    """

    kind: ClassVar[str] = "table"
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str | Cell, ...], ...]
    note: str = ""
    searchable: bool = False

    def __post_init__(self) -> None:
        for number, row in enumerate(self.rows, start=1):
            if len(row) != len(self.columns):
                raise PageError(
                    f"table {self.caption!r}, row {number}: {len(row)} cells for"
                    f" {len(self.columns)} columns"
                )


@dataclass(frozen=True, slots=True)
class Figure:
    """A drawing of `reports.figures`, with a caption and the words that stand for it where it can't
    be seen. `wide` fills the page.
    """

    kind: ClassVar[str] = "figure"
    svg: str
    caption: str
    alt: str
    wide: bool = False
    facts: SvgFacts = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "facts", svg_facts(self.svg, f"figure {self.caption!r}"))

    @property
    def narrow(self) -> bool:
        """Drawn for half a page: over the whole of it its letters would be too large."""
        return self.facts.width < NARROW_BELOW


@dataclass(frozen=True, slots=True)
class KeyValues:
    """A list of names and values, as for provenance."""

    kind: ClassVar[str] = "key-values"
    title: str
    entries: tuple[Entry, ...]


@dataclass(frozen=True, slots=True)
class Paragraph:
    """Running text; a tone other than plain puts it in a box. Line ends are kept."""

    kind: ClassVar[str] = "paragraph"
    text: str
    tone: Tone = "plain"

    def __post_init__(self) -> None:
        one_of(self.tone, TONES, f"paragraph {self.text[:40]!r}, tone")


@dataclass(frozen=True, slots=True)
class Notes:
    """Short points under a title: deviations, exclusions, warnings."""

    kind: ClassVar[str] = "notes"
    title: str
    items: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Code:
    """A command or a file's text, letter for letter."""

    kind: ClassVar[str] = "code"
    title: str
    text: str


Part = Requirements | Table | Figure | KeyValues | Paragraph | Notes | Code

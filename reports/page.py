"""A page described as data: what it says, as frozen values that check themselves when made.

All text is plain text; numbers arrive as text, rounded where their meaning is known. How it looks
is in `templates/`; `render.py` joins the two.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from typing import Literal, TypeVar, get_args

from reports.frames import LAYER_TONES, MOST_DETECTORS, ImageView
from reports.glossary import Term
from reports.trust import PageError, SvgFacts, address, checked_slug, one_of, svg_facts

Verdict = Literal[
    "met",
    "not met",
    "inconclusive",
    "not measured",
    "no verdict",
    "not worse",
    "worse",
    "running",
    "faulted",
    "aborted",
    "tripped",
    "interrupted",
]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)
UNFINISHED = frozenset(VERDICTS[VERDICTS.index("running") :])
Tone = Literal["plain", "good", "bad", "warn", "info", "muted"]
Align = Literal["left", "right", "center"]
Kind = Literal["computed", "emulated", "mixed", "real", "recorded"]
KINDS: dict[Kind, str] = {
    "computed": "COMPUTED, NO INSTRUMENT",
    "emulated": "EMULATED INSTRUMENTS",
    "mixed": "SOME INSTRUMENTS EMULATED",
    "real": "REAL INSTRUMENTS",
    "recorded": "RECORDED FRAMES",
}
SIGNS: dict[Verdict, str] = dict(zip(VERDICTS, "✓✕?–○✓✕…!!!!", strict=True))
WORDS = {"kinds": KINDS, "signs": SIGNS}  # of templates
NARROW_BELOW = 500.0  # units of a drawing's viewBox: points
RESERVED_IDS = (  # what the template itself uses
    *("top", "main", "verdict", "top-verdict", "contents", "trials", "layers", "keys"),
    *("appendix", "glossary"),
    *("keys-title", *(f"layer-{tone}" for tone in LAYER_TONES)),
    *(f"who-{who}" for who in range(1, MOST_DETECTORS + 1)),
)


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

    caption: str
    rows: tuple[Requirement, ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Score:
    """A requirement's result of one detector: value, and in a few words what it shows."""

    verdict: Verdict
    value: str
    shows: str


@dataclass(frozen=True, slots=True)
class Scoreboard:
    """Requirement by detector: name, limit, scores; `hints` explain a row by its name. A row in
    `shared` has one score, which is no detector's.
    """

    caption: str
    detectors: tuple[str, ...]
    rows: tuple[tuple[str, str, tuple[Score | None, ...]], ...]
    heads: tuple[str, str] = ("Requirement", "Limit")
    hints: Mapping[str, str] = field(default_factory=dict)
    shared: Collection[str] = ()

    def __post_init__(self) -> None:
        for name, _, scores in self.rows:
            if len(scores) != (1 if name in self.shared else len(self.detectors)):
                raise PageError(
                    f"scoreboard {self.caption!r}, requirement {name!r}: {len(scores)} scores for"
                    f" {len(self.detectors)} detectors"
                )


@dataclass(frozen=True, slots=True)
class Cell:
    """A text with a tone, a link (`#id` or relative path), a value to sort by, or monospace."""

    text: str
    tone: Tone = "plain"
    href: str = ""
    sort: float | None = None
    mono: bool = False

    def __post_init__(self) -> None:
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


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of cells; `searchable` adds a filter, which also hides the trials of hidden rows."""

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
    """A drawing of `reports.figures`, its caption and text alternative; `wide` fills the page."""

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

    title: str
    entries: tuple[Entry, ...]


@dataclass(frozen=True, slots=True)
class Paragraph:
    """Running text; a tone other than plain puts it in a box. Line ends are kept."""

    text: str
    tone: Tone = "plain"


@dataclass(frozen=True, slots=True)
class Notes:
    """Short points under a title: deviations, exclusions, warnings."""

    title: str
    items: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Code:
    """A command or a file's text, letter for letter."""

    title: str
    text: str


@dataclass(frozen=True, slots=True)
class Result:
    """What came out for one detector; `who` as in an `Overlay`."""

    text: str
    tone: Tone = "plain"
    who: int = 0


@dataclass(frozen=True, slots=True)
class Highlight:
    """A trial to look at: why it was chosen, what came out, its views cut to what matters."""

    trial: str
    heading: str
    why: str
    results: tuple[Result, ...]
    images: tuple[ImageView, ...]


@dataclass(frozen=True, slots=True)
class Highlights:
    """A strip of pictures; a click on one opens its trial."""

    looks: tuple[Highlight, ...]


@dataclass(frozen=True, slots=True)
class Fold:
    """Parts behind their title, which opens them; on paper only those that are open."""

    title: str
    parts: tuple["Part", ...]


@dataclass(frozen=True, slots=True)
class Section:
    """A chapter, at its anchor `id`; a `folded` one is closed, with `about` beside its title."""

    id: str
    title: str
    parts: tuple["Part", ...]
    folded: bool = False
    about: str = ""

    def __post_init__(self) -> None:
        checked_slug(self.id, f"section {self.title!r}")


P = TypeVar("P")
Part = (
    Requirements
    | Scoreboard
    | Highlights
    | Fold
    | Section
    | Table
    | Figure
    | KeyValues
    | Paragraph
    | Notes
    | Code
)


@dataclass(frozen=True, slots=True)
class Banner:
    """The first screen; `each`: the verdicts of several detectors; `urgent`: what to do before
    anything else.
    """

    kind: Kind
    verdict: Verdict
    tested: str
    sentence: str
    confidence: str
    next_action: str
    each: tuple[tuple[str, Verdict], ...] = ()
    urgent: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        one_of(self.kind, KINDS, "banner, kind")
        for verdict in (self.verdict, *(one for _, one in self.each)):
            one_of(verdict, VERDICTS, "banner, verdict")

    @property
    def verdicts(self) -> tuple[tuple[str, Verdict], ...]:
        """Detector and verdict; without a name where there is one verdict."""
        return self.each or (("", self.verdict),)

    @property
    def verdict_text(self) -> str:
        """The verdicts in a line: ``fused met, thesis not met``."""
        return ", ".join(f"{name} {verdict}".strip() for name, verdict in self.verdicts)

    @property
    def tone(self) -> Verdict:
        """The verdict whose colour the banner has; none where the detectors' verdicts differ."""
        found = {verdict for _, verdict in self.verdicts}
        return found.pop() if len(found) == 1 else "no verdict"


@dataclass(frozen=True, slots=True)
class Drawn:
    """What a trial's own file shows of the trial alone, as HTML: switches of its layers, its
    opening, its body, the style rules of its views; and the image files that it names.
    """

    switches: str
    opening: str
    body: str
    rules: str
    files: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class TrialPart:
    """One trial's part of the page, at the anchor `id` (`trial-007`): data, not a verdict. One that
    is ``drawn`` has a file of its own, and neither images, summary, tables nor notes.
    """

    id: str
    heading: str
    situation: str
    results: tuple[Result, ...] = ()
    summary: tuple[Entry, ...] = ()
    images: tuple[ImageView, ...] = ()
    tables: tuple[Table, ...] = ()
    notes: tuple[str, ...] = ()
    drawn: Drawn | None = None

    def __post_init__(self) -> None:
        checked_slug(self.id, f"trial {self.heading!r}")


@dataclass(frozen=True, slots=True)
class Page:
    """A whole report. `worst`: ids of the trials to look at first; `trials_in`: the section that
    ends with the trials. Raises PageError for an id twice, a dead link, a banner above its rows.
    """

    title: str
    subtitle: str
    banner: Banner
    sections: tuple[Section, ...]
    trials: tuple[TrialPart, ...] = ()
    trials_title: str = "Trial by trial"
    trials_note: str = ""
    trials_in: str = ""
    detectors: tuple[str, ...] = ()
    footer: tuple[str, ...] = ()
    alarm: str = ""
    worst: tuple[str, ...] = ()
    glossary: tuple[Term, ...] = ()

    def __post_init__(self) -> None:
        what = f"page {self.title!r}"
        figures = [*self.parts_of(Figure)]
        ids = [*RESERVED_IDS, *(term.id for term in self.glossary)]
        ids += [section.id for section in (*self.sections, *self.parts_of(Section))]
        ids += [name for trial in self.trials for name in (trial.id, f"{trial.id}-heading")]
        ids += [name for figure in figures for name in figure.facts.ids]
        twice = sorted(name for name, times in Counter(ids).items() if times > 1)
        if twice:
            raise PageError(
                f"{what}: the ids {twice} stand for two things; give each part, and each figure's"
                " name, its own"
            )
        looked = {look.trial for look in self.looks()}
        unknown = sorted((looked | set(self.worst)) - {trial.id for trial in self.trials})
        if unknown:
            raise PageError(f"{what}: {unknown} in 'worst' are no trials of it")
        links = [link for figure in figures for link in figure.facts.links]
        for link in (*(cell.href for cell in self._cells()), *links):
            if link.startswith("#") and link[1:] not in ids:
                raise PageError(
                    f"{what}: the link {link!r} leads nowhere; no section or trial has that id"
                )
        rows = (row for part in self.parts_of(Requirements) for row in part.rows)
        failed = [row.name for row in rows if row.verdict in {"not met"} | UNFINISHED]
        failed += [
            name
            for board in self.parts_of(Scoreboard)
            for name, _, scores in board.rows
            if any(score and score.verdict == "not met" for score in scores)
        ]
        if self.banner.verdict == "met" and failed:
            raise PageError(
                f"{what}: the banner says 'met', but {failed} is not; it must not claim more than"
                " the rows"
            )

    def first_looks(self) -> tuple[TrialPart, ...]:
        """The worst three trials for the first screen, unless the run has to be resumed first."""
        if self.banner.verdict in UNFINISHED:
            return ()
        by_id = {trial.id: trial for trial in self.trials}
        return tuple(by_id[name] for name in self.worst[:3])

    def next_worst(self, trial: TrialPart) -> str:
        """The id of the trial to look at after this one: the next worst, or the worst; or none."""
        at = self.worst.index(trial.id) + 1 if trial.id in self.worst else 0
        return self.worst[at] if at < len(self.worst) else ""

    def parts(self) -> Iterator[Part]:
        """Every part of every section, in order; a fold or a section, then what it holds."""
        return (part for section in self.sections for part in unfolded(section.parts))

    def parts_of(self, kind: type[P]) -> Iterator[P]:
        """Every part of that class, in order."""
        return (part for part in self.parts() if isinstance(part, kind))

    def looks(self) -> Iterator[Highlight]:
        """Every trial of the strips of pictures."""
        return (look for strip in self.parts_of(Highlights) for look in strip.looks)

    def files(self) -> Iterator[str]:
        """Every image file, in order."""
        shown: Iterator[Highlight | TrialPart] = chain(self.looks(), self.trials)
        yield from (path for one in shown for image in one.images for path in image.files)
        yield from (path for one in self.trials if one.drawn for path in one.drawn.files)

    def _cells(self) -> Iterator[Cell]:
        tables = chain(self.parts_of(Table), *(trial.tables for trial in self.trials))
        lists = (part.entries for part in self.parts_of(KeyValues))
        rows = chain((row for table in tables for row in table.rows), *lists)
        rows = chain(rows, *(trial.summary for trial in self.trials))
        return (cell for row in rows for cell in row if isinstance(cell, Cell))


def unfolded(parts: Iterable[Part]) -> Iterator[Part]:
    """Each part; a fold or a section, then what it holds."""
    for part in parts:
        yield part
        if isinstance(part, Fold | Section):
            yield from unfolded(part.parts)

"""A page described as data: what it says, as frozen values that check themselves when made. How it
looks is in `templates/`; `render.py` joins the two.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from reports.frames import (
    LAYER_TONES,
    Circle,
    Cross,
    Ellipse,
    ImageView,
    Label,
    LayerTone,
    Overlay,
    Polyline,
    Rect,
    Shape,
    layers,
)
from reports.parts import (
    TONES,
    VERDICTS,
    Cell,
    Code,
    Column,
    Entry,
    Figure,
    KeyValues,
    Notes,
    Paragraph,
    Part,
    Requirement,
    Requirements,
    Table,
    Tone,
    Verdict,
)
from reports.trust import PageError, checked_slug, one_of

__all__ = [
    "VERDICTS",
    "Banner",
    "Cell",
    "Circle",
    "Code",
    "Column",
    "Cross",
    "Ellipse",
    "Entry",
    "Figure",
    "ImageView",
    "KeyValues",
    "Kind",
    "Label",
    "LayerTone",
    "Notes",
    "Overlay",
    "Page",
    "PageError",
    "Paragraph",
    "Part",
    "Polyline",
    "Rect",
    "Requirement",
    "Requirements",
    "Section",
    "Shape",
    "Table",
    "Tone",
    "TrialPart",
    "Verdict",
]  # fmt: skip

Kind = Literal["computed", "emulated", "mixed", "real", "recorded"]
KINDS: dict[Kind, str] = {
    "computed": "COMPUTED, NO INSTRUMENT",
    "emulated": "EMULATED INSTRUMENTS",
    "mixed": "SOME INSTRUMENTS EMULATED",
    "real": "REAL INSTRUMENTS",
    "recorded": "RECORDED FRAMES",
}
RESERVED_IDS = (  # what the template itself uses
    *(
        "top",
        "main",
        "verdict",
        "top-verdict",
        "contents",
        "trials",
        "layers",
        "keys",
        "keys-title",
    ),
    *(f"layer-{tone}" for tone in LAYER_TONES),
)


@dataclass(frozen=True, slots=True)
class Banner:
    """The first screen: what was tested, the verdict, why, how sure it is, what to do next."""

    kind: Kind
    verdict: Verdict
    tested: str
    sentence: str
    confidence: str
    next_action: str

    def __post_init__(self) -> None:
        one_of(self.kind, KINDS, "banner, kind")
        one_of(self.verdict, VERDICTS, "banner, verdict")

    @property
    def kind_text(self) -> str:
        """What the badge says."""
        return KINDS[self.kind]


@dataclass(frozen=True, slots=True)
class Section:
    """A chapter of the page; `id` is its anchor."""

    id: str
    title: str
    parts: tuple[Part, ...]

    def __post_init__(self) -> None:
        checked_slug(self.id, f"section {self.title!r}")


@dataclass(frozen=True, slots=True)
class TrialPart:
    """One trial's part of the page, at the anchor `id` (`trial-007`): data, not a verdict."""

    id: str
    heading: str
    situation: str
    status: str
    tone: Tone = "plain"
    summary: tuple[Entry, ...] = ()
    images: tuple[ImageView, ...] = ()
    tables: tuple[Table, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        checked_slug(self.id, f"trial {self.heading!r}")
        one_of(self.tone, TONES, f"trial {self.heading!r}, tone")


@dataclass(frozen=True, slots=True)
class Page:
    """A whole report; `worst` names the trials to look at first, by their ids: they come first
    where not all find room.

    `alarm` stays at the top of each file, however far one scrolls. Raises PageError where two parts
    share an id, a link leads nowhere, or the banner claims more than its rows.
    """

    title: str
    subtitle: str
    banner: Banner
    sections: tuple[Section, ...]
    trials: tuple[TrialPart, ...] = ()
    trials_title: str = "Trial by trial"
    trials_note: str = ""
    footer: tuple[str, ...] = ()
    alarm: str = ""
    worst: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        drawn = [name for figure in self._figures() for name in figure.facts.ids]
        trials = [name for trial in self.trials for name in (trial.id, f"{trial.id}-heading")]
        ids = [*RESERVED_IDS, *(section.id for section in self.sections), *trials, *drawn]
        twice = sorted(name for name, times in Counter(ids).items() if times > 1)
        if twice:
            raise PageError(
                f"page {self.title!r}: the ids {twice} stand for two things; give each part, and"
                " each figure's name, its own"
            )
        strangers = sorted(set(self.worst) - {trial.id for trial in self.trials})
        if strangers:
            raise PageError(f"page {self.title!r}: {strangers} in 'worst' are no trials of it")
        for link in self._links():
            if link.startswith("#") and link[1:] not in ids:
                raise PageError(
                    f"page {self.title!r}: the link {link!r} leads nowhere; no section or trial has"
                    " that id"
                )
        failed = [row.name for row in self._requirements() if row.verdict in {"not met", "aborted"}]
        if self.banner.verdict == "met" and failed:
            raise PageError(
                f"page {self.title!r}: the banner says 'met', but {failed} is not; it must not"
                " claim more than the rows"
            )

    def first_looks(self) -> tuple[TrialPart, ...]:
        """The worst three trials for the first screen, unless the run has to be resumed first."""
        if self.banner.verdict == "aborted":
            return ()
        by_id = {trial.id: trial for trial in self.trials}
        return tuple(by_id[name] for name in self.worst[:3])

    def images(self) -> Iterator[ImageView]:
        """Every image, in order."""
        return (image for trial in self.trials for image in trial.images)

    def layers(self) -> dict[LayerTone, str]:
        """Tone and name of the layers that can be switched."""
        return layers(self.images())

    def _parts(self) -> Iterator[Part]:
        return (part for section in self.sections for part in section.parts)

    def _figures(self) -> Iterator[Figure]:
        return (part for part in self._parts() if isinstance(part, Figure))

    def _requirements(self) -> Iterator[Requirement]:
        return (
            row for part in self._parts() if isinstance(part, Requirements) for row in part.rows
        )

    def _links(self) -> Iterator[str]:
        tables = [part for part in self._parts() if isinstance(part, Table)] + [
            table for trial in self.trials for table in trial.tables
        ]
        lists = [part.entries for part in self._parts() if isinstance(part, KeyValues)] + [
            trial.summary for trial in self.trials
        ]
        cells = [cell for table in tables for row in table.rows for cell in row] + [
            value for entries in lists for _, value in entries
        ]
        yield from (cell.href for cell in cells if isinstance(cell, Cell) and cell.href)
        yield from (link for figure in self._figures() for link in figure.facts.links)

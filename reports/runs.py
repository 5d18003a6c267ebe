"""One page over many runs, as data and as a file: a card a run, newest first, and each detector's
verdicts in the order of time. Its pictures are in it; links to reports need the folders beside it.
"""

from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from reports.page import KINDS, Kind, Verdict
from reports.render import SIGNS, assets, environment, policy_hash, write_whole
from reports.trust import address, one_of


@dataclass(frozen=True, slots=True)
class Result:
    """What a run found of one detector; ``text`` has the figures in words."""

    detector: str
    verdict: Verdict
    text: str


@dataclass(frozen=True, slots=True)
class RunCard:
    """A run. ``href``: its report beside the page, empty where it has none; ``thumbnails``: JPEG
    data with what each shows.
    """

    name: str
    href: str
    date: str
    title: str
    script: str
    kind: Kind
    note: str
    results: tuple[Result, ...]
    thumbnails: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        one_of(self.kind, KINDS, f"run {self.name!r}, kind")
        if self.href:
            address(self.href, f"run {self.name!r}, report")

    @property
    def kind_text(self) -> str:
        """What the badge says."""
        return KINDS[self.kind]


@dataclass(frozen=True, slots=True)
class Step:
    """One run in a detector's history; ``hint`` is shown on hovering."""

    verdict: Verdict
    text: str
    href: str
    hint: str


@dataclass(frozen=True, slots=True)
class History:
    """A detector's runs of one script, oldest first."""

    detector: str
    script: str
    steps: tuple[Step, ...]


@dataclass(frozen=True, slots=True)
class RunsPage:
    """``others``: folders that are no readable run, each with the reason."""

    title: str
    summary: str
    runs: tuple[RunCard, ...]
    histories: tuple[History, ...]
    others: tuple[tuple[str, str], ...]

    @property
    def verdicts(self) -> frozenset[Verdict]:
        """Those that stand in it."""
        return frozenset(step.verdict for one in self.histories for step in one.steps)


def render_runs(page: RunsPage) -> str:
    """The HTML text."""
    style = assets("style.css", "runs.css")
    policy = (
        f"default-src 'none'; img-src data:; style-src '{policy_hash(style)}'; base-uri 'none';"
        " form-action 'none'"
    )
    return (
        environment()
        .get_template("runs.html.j2")
        .render(
            page=page,
            signs=SIGNS,
            style=Markup(style),  # noqa: S704 our own file
            policy=policy,
            link=lambda href: address(href, "link"),
        )
    )


def write_runs(page: RunsPage, target: Path) -> Path:
    """Writes the page to ``target``, whole or not at all."""
    return write_whole(target, render_runs(page))

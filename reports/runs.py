"""One page over many runs: a card a run, newest first, and each detector's verdicts in the order of
time. Its pictures are in it; links to reports need the folders beside it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any

from markupsafe import Markup

from reports.page import KINDS, Figure, Kind, Verdict
from reports.render import assets, environment, policy_hash, write_whole
from reports.trust import address, one_of

PAGE = "index.html"
JUDGED = ("met", "not met", "inconclusive")


@dataclass(frozen=True, slots=True)
class DetectorResult:
    """One detector in one run. ``verdict`` is the run's state where it is unfinished, "no verdict"
    where nothing was scored or the record is damaged; errors are None where nothing was found,
    ``false`` where no answer came.
    """

    detector: str
    version: str
    verdict: Verdict
    visible: int
    found: int
    false: int | None
    median_error_mm: float | None
    max_error_mm: float | None

    @property
    def share(self) -> str:
        """``97 %`` of the visible teats found; empty where none was visible, or no answer came."""
        return f"{100 * self.found // self.visible} %" if self.visible else ""

    @property
    def step(self) -> str:
        """In a row of runs: its share, or the verdict where that is no judgement: four states have
        one sign.
        """
        return self.share if self.share and self.verdict in JUDGED else self.verdict

    @property
    def brief(self) -> str:
        """``met (97 % found)``; the verdict alone where nothing was measured."""
        return f"{self.verdict} ({self.share} found)" if self.share else self.verdict

    @property
    def text(self) -> str:
        """Its figures in a sentence."""
        if self.false is None:
            return "It gave no answer that was scored."
        if not self.visible:
            return "No visible teat was scored."
        text = f"{self.found} of {self.visible} visible teats found, {self.false} false"
        if self.median_error_mm is None or self.max_error_mm is None:
            return f"{text}."
        errors = f"{self.median_error_mm:.2f} mm in the median, {self.max_error_mm:.2f} mm at most"
        return f"{text}; error {errors}."


@dataclass(frozen=True, slots=True)
class Run:
    """A run that could be read: ``status`` as JSON (docs/json.md), ``damage`` to its record, a
    ``note`` on what is missing, its ``report``'s path, ``thumbnails`` as text and JPEG.
    """

    folder: Path
    started: str
    title: str
    script: str
    kind: Kind
    ending: str
    status: Mapping[str, Any]
    results: tuple[DetectorResult, ...]
    damage: tuple[str, ...]
    report: str
    note: str
    thumbnails: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        one_of(self.kind, KINDS, f"run {self.folder.name!r}, kind")

    @property
    def date(self) -> str:
        """``2026-11-22 14:05``."""
        return datetime.fromisoformat(self.started).strftime("%Y-%m-%d %H:%M")

    def hint(self, result: DetectorResult) -> str:
        """What is shown on hovering over a step of a detector's history."""
        version = f" {result.version}" if result.version else ""
        return f"{self.date}, {result.detector}{version}: {result.verdict}. {result.text}"

    def as_dict(self) -> dict[str, Any]:
        """As JSON takes it."""
        shown = asdict(replace(self, thumbnails=()))
        del shown["thumbnails"], shown["note"]
        said = {"state": "state", "trials": "done", "planned": "planned"}
        of_status = {key: self.status[name] for key, name in said.items()}
        return shown | {"folder": str(self.folder), **of_status}


@dataclass(frozen=True, slots=True)
class Runs:
    """The runs in ``folder``, newest first; why other folders are none; charts of health."""

    folder: Path
    runs: tuple[Run, ...]
    others: tuple[tuple[str, str], ...]
    health: Mapping[str, Sequence[Figure]] = field(default_factory=dict)  # by rig
    warnings: Sequence[str] = ()

    def histories(self) -> Mapping[tuple[str, str], Sequence[tuple[Run, DetectorResult]]]:
        """Detector and script with their runs, oldest first."""
        found: dict[tuple[str, str], list[tuple[Run, DetectorResult]]] = {}
        for run in reversed(self.runs):
            for result in run.results:
                found.setdefault((result.detector, run.script), []).append((run, result))
        return dict(sorted(found.items()))

    @property
    def verdicts(self) -> set[Verdict]:
        """Those that stand in it."""
        return {result.verdict for run in self.runs for result in run.results}


def write_runs(
    runs: Runs, summary: str, *, name: str = PAGE, title: str = "Runs", rest: str = "Other folders"
) -> Path:
    """Writes the page beside the runs; returns its path. ``rest``: the other folders' heading."""
    style = assets("style.css", "runs.css")
    policy = f"default-src 'none'; img-src data:; style-src '{policy_hash(style)}'"
    template = environment().get_template("runs.html.j2")
    html = template.render(
        {"page": runs, "title": title, "rest": rest, "summary": summary},
        style=Markup(style),  # noqa: S704 our own file
        policy=f"{policy}; base-uri 'none'; form-action 'none'",
        link=lambda href: address(href, "link"),
        drawing=lambda figure: Markup(figure.svg),  # noqa: S704 page.Figure has checked it
    )
    return write_whole(runs.folder / name, html)

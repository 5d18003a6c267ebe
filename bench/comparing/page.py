"""A comparison as a page of its own: the gate's verdict, the differences by situation, and each scene that changed."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.comparing.runs import Comparison
from bench.comparing.words import DISTANCE, LEGEND, SUCCESS, WORDS, as_json, distance_rows, heading, notes, success_rows, verdict_told
from bench.config import ConfigError
from bench.scoring.comparison import ScenePair, why_failed
from bench.scoring.decisions import Verdict, overall
from bench.scoring.scene import SceneScore
from bench.store import write_synced
from bench.store.check import NOT_AS_WRITTEN
from bench.summary.tables import key_values
from reports.page import Banner, Cell, Column, Kind, Notes, Page, Paragraph, Part, Section, Table, Tone
from reports.render import write_report

NEXT = {
    Verdict.MET: "The new one may replace the old one as far as these scenes go.",
    Verdict.NOT_MET: "Look at the scenes below that changed, in the report of the new run, before the new one is used.",
    Verdict.INCONCLUSIVE: "Compare on more poses, as many as the reasons name.",
}
TONES: dict[Verdict, Tone] = {Verdict.MET: "good", Verdict.NOT_MET: "bad", Verdict.INCONCLUSIVE: "warn"}


def write_comparison(found: Sequence[Comparison], folder: Path) -> Path:
    """Write ``index.html`` and ``comparison.json`` into ``folder``; gives back the page's path. Raises ConfigError where it can't."""
    try:
        path = write_report(comparison_page(found), folder)
        write_synced(folder / "comparison.json", (json.dumps(as_json(found), indent=1, ensure_ascii=False) + "\n").encode())
    except OSError as error:
        raise ConfigError.plain(f"{folder}: the comparison can't be written: {error}") from error
    return path


def comparison_page(found: Sequence[Comparison]) -> Page:
    """The page: a section a comparison."""
    verdict = overall(comparison.compared.gate.verdict for comparison in found)
    worst = [one for one in found if one.compared.gate.verdict is verdict] or list(found)
    first = found[0]
    banner = Banner(
        kind=_kind(found),
        verdict=WORDS[verdict],
        tested=f"{'; '.join(heading(one) for one in found)}.",
        sentence=f"{verdict_told(worst[0])} {_listed(worst[0].compared.gate.reasons)}",
        confidence=" ".join(notes(first)),
        next_action=NEXT[verdict],
    )
    sections = tuple(
        Section(f"comparison-{number}", heading(one) if len(found) > 1 else "Differences", tuple(comparison_parts(one)))
        for number, one in enumerate(found, 1)
    )
    alarm = f"{NOT_AS_WRITTEN}: no figure below holds." if any(one.old.run.damage or one.new.run.damage for one in found) else ""
    return Page("Comparison of detectors", "Paired differences on the same scenes", banner, sections, alarm=alarm)


def comparison_parts(comparison: Comparison) -> Iterator[Part]:
    """What a page says of one comparison; a run's report can take the same."""
    gate = comparison.compared.gate
    yield Paragraph(f"{verdict_told(comparison)} {_listed(gate.reasons)}", tone=TONES[gate.verdict])
    yield Table("Success of poses, and what was counted", _columns(SUCCESS), tuple(success_rows(comparison)), LEGEND)
    yield Table("Distance to the teat end", _columns(DISTANCE), tuple(distance_rows(comparison, wide=True)))
    yield Notes("Of this comparison", tuple(notes(comparison)))
    yield _changed(comparison)
    yield key_values("Compared", [("old run", comparison.old.run.folder.name), ("new run", comparison.new.run.folder.name)])


def _columns(titles: Sequence[tuple[str, str]]) -> tuple[Column, ...]:
    return tuple(Column(title, "right" if number else "left", unit) for number, (title, unit) in enumerate(titles))


def _changed(comparison: Comparison) -> Table:
    """Scenes whose outcome changed, and those whose error changed most."""
    columns = (Column("scene"), Column("situation"), Column("old"), Column("new"), Column("change of the largest error", "right", "mm"))
    by_change = sorted(comparison.pairs, key=lambda pair: (pair.old.success == pair.new.success, -abs(_growth(pair) or 0.0)))
    shown = [pair for pair in by_change if pair.old.success != pair.new.success or _growth(pair)][:50]
    cells = tuple(
        (pair.scene, pair.situation, _outcome(pair.old), _outcome(pair.new), _growth_told(pair)) for pair in shown
    )  # fmt: skip
    note = "" if cells else "No scene's outcome changed, and no error."
    return Table("Scenes that changed (at most 50, changed outcomes first)", columns, cells, note, searchable=len(cells) > 10)


def _growth(pair: ScenePair) -> float | None:
    if not pair.old.radial_mm or not pair.new.radial_mm:
        return None
    return max(pair.new.radial_mm) - max(pair.old.radial_mm)


def _growth_told(pair: ScenePair) -> Cell:
    growth = _growth(pair)
    return Cell("not measured" if growth is None else f"{growth:+.3f}", sort=growth)


def _outcome(score: SceneScore) -> Cell:
    return Cell("success", "good") if score.success else Cell(why_failed(score), "bad")


def _kind(found: Sequence[Comparison]) -> Kind:
    kinds: set[Kind] = {side.run.facts["kind"] for one in found for side in (one.old, one.new)}
    if len(kinds) == 1:
        return kinds.pop()
    return "mixed" if kinds & {"emulated", "mixed"} else "recorded"


def _listed(reasons: Sequence[str], most: int = 5) -> str:
    more = f"; and {len(reasons) - most} more" if len(reasons) > most else ""
    return f"{'; '.join(reasons[:most])}{more}."

"""The six situations of section 5.2: what the thesis's detector found of four teats, beside what each detector found here."""

from __future__ import annotations

from collections.abc import Sequence

from bench.record import RunRecord
from bench.summary.tables import situations
from bench.summary.thesis.figures import Situation, Thesis
from bench.verdicts import scored
from reports.page import Column, Table

NOTE = (
    "The thesis judged one picture a situation by eye. Here a teat is found when an answer lies within the gate of its end, and every "
    "frame set counts; “as many” are the frame sets in which at least the thesis's share of the visible teats was found."
)


def known_situations(run: RunRecord, figures: Thesis) -> list[Situation]:
    """Those of the run that the thesis has figures of, in the thesis's order."""
    here = set(situations(run))
    return [one for one in figures.situations if one.name in here]


def situation_table(run: RunRecord, figures: Thesis) -> Table:
    """A row a situation, and one for all of them."""
    known = known_situations(run, figures)
    columns = (
        Column("situation"), Column("section"), Column("thesis found", "right"),
        *(Column(f"this run, {detector}", "right") for detector in run.detectors),
        Column("what the thesis saw"),
    )  # fmt: skip
    rows = [
        (one.name, one.section, f"{one.found} of {one.present}", *(_ours(run, detector, [one]) for detector in run.detectors), one.seen)
        for one in known
    ]
    found, present = sum(one.found for one in known), sum(one.present for one in known)
    all_of = (f"all {len(known)}", "5.2", f"{found} of {present}", *(_ours(run, detector, known) for detector in run.detectors), "")
    return Table("Teats found in the situations of section 5.2", columns, (*rows, all_of), NOTE)


def _ours(run: RunRecord, detector: str, of: Sequence[Situation]) -> str:
    """``9 of 12, with 2 false; as many in 1 of 3``."""
    matched = visible = false = as_many = sets = 0
    for one in of:
        found = scored(run, detector, one.name)
        counts = found.counts
        matched, visible, false = matched + counts.matched, visible + counts.visible, false + counts.false
        sets += len(found.scores)
        as_many += sum(s.counts.matched * one.present >= one.found * s.counts.visible for s in found.scores)
    return f"{matched} of {visible}, {false} false; as many in {as_many} of {sets}" if sets else "not measured"

"""The chapter "Beside the thesis": which of the thesis's tests a run is, and the published figures beside its own.

A run is one of them by its situations, or by the ends of its layout; any other has no such chapter. What is printed but has its
counterpart elsewhere, or nowhere, is listed.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from bench.record import RunRecord
from bench.script import Rules, Script
from bench.summary.tables import situations
from bench.summary.thesis.figures import Kind, Thesis, thesis
from bench.summary.thesis.picking import LAYOUT, first_test_table
from bench.summary.thesis.plane import PLANE, plane_table
from bench.summary.thesis.rig import rig_table
from bench.summary.thesis.situations import known_situations, situation_table
from bench.verdicts import scored
from detector.calibration import Calibration
from reports.page import Column, Part, Section, Table


def thesis_chapter(run: RunRecord, rules: Rules, calibration: Calibration) -> tuple[Section, ...]:
    """The chapter of a run that is one of the thesis's tests; none of any other, or where nothing was scored."""
    figures = thesis()
    kinds: list[Kind] = ["situations"] if known_situations(run, figures) else []
    kinds += ["plane"] if PLANE in situations(run) else []
    if not kinds or not any(trial.scores for trial in run.counted):
        return ()
    return (Section("published", "Beside the thesis", tuple(_parts(run, rules, calibration, figures, kinds))),)


def elsewhere_table(figures: Thesis, *shown: Kind) -> Table:
    """Printed figures that the page with tests of these kinds doesn't have, and where their counterpart is."""
    columns = (Column("section"), Column("figure"), Column("printed"), Column("counterpart"))
    rest = [one for one in figures.elsewhere if not set(one.shown) & set(shown)]
    rows = tuple((one.section, one.what, one.printed, one.where) for one in rest)
    return Table("Printed figures without a counterpart on this page", columns, rows)


def _parts(run: RunRecord, rules: Rules, calibration: Calibration, figures: Thesis, kinds: list[Kind]) -> Iterator[Part]:
    if "situations" in kinds:
        yield situation_table(run, figures)
        same_ends = _with_ends_of_table_5_1(rules)
        if same_ends:
            errors = {d: np.concatenate([scored(run, d, name).errors_mm for name in same_ends]) for d in run.detectors}
            yield first_test_table(figures, errors)
    if "plane" in kinds:
        yield plane_table(run, figures)
    yield rig_table(run, figures, calibration)
    yield elsewhere_table(figures, *kinds)


def _with_ends_of_table_5_1(rules: Rules) -> list[str]:
    """Situations whose every trial shows the ends of table 5.1 where they were measured, upright."""
    if not isinstance(rules, Script):
        return []
    layouts = {trial.situation: {t.layout for t in rules.trials if t.situation == trial.situation} for trial in rules.trials}
    return [situation for situation, of in layouts.items() if of == {LAYOUT}]


def published_counts(rules: Rules) -> dict[str, tuple[int, int]]:
    """Teats that the thesis found, of those present, by situation: what the script names, and else what is known of the situation."""
    known = {one.name: (one.found, one.present) for one in thesis().situations}
    return known | {name: (one.found, one.present) for name, one in rules.published.items()}

"""`compare`: detectors or versions compared on the same scenes, and a gate for CI."""

from __future__ import annotations

import argparse
import json
from typing import TYPE_CHECKING

from rich.table import Table

from bench.cli.arguments import CODES
from bench.cli.store import undamaged
from bench.cli.terminal import Terminal
from bench.results.comparison import Comparison, compare_folders, judge_folders, judgement_lines
from bench.results.verdicts import run_verdict
from bench.scoring.decisions import Verdict, overall

if TYPE_CHECKING:
    from reports.page import Table as PageTable

EXIT = {Verdict.MET: CODES.met, Verdict.NOT_MET: CODES.not_met}


def compare(given: argparse.Namespace) -> int:
    with undamaged(given.run, given) as damage:
        verdict = (_together if given.together else _paired)(given, damage)
    return EXIT.get(verdict, CODES.inconclusive) if given.gate else CODES.met


def _paired(given: argparse.Namespace, damage: tuple[str, ...]) -> Verdict:
    from bench.report.comparison import as_json, write_comparison

    found = compare_folders(
        given.run,
        given.detector,
        margin_mm=given.margin_mm,
        confidence=given.confidence,
        damage=damage,
    )
    if given.json:
        print(json.dumps(as_json(found), indent=1, ensure_ascii=False))
    else:
        _show(found)
    if given.out:
        path = write_comparison(found, given.out)
        if not given.json:
            print(f"Report: {path}")
    return overall(comparison.compared.gate.verdict for comparison in found)


def _together(given: argparse.Namespace, damage: tuple[str, ...]) -> Verdict:
    judgements = judge_folders(given.run, given.detector, damage)
    if given.json:
        lines = [
            {
                "detector": one.detector,
                "verdict": one.verdict,
                "decisions": [decision.as_dict() for decision in one.decisions],
            }
            for one in judgements
        ]
        print(json.dumps(lines, indent=1, ensure_ascii=False))
    else:
        print("\n".join(line for one in judgements for line in judgement_lines(one)))
    return run_verdict(judgements)


def _show(found: tuple[Comparison, ...]) -> None:
    from bench.report.comparison import distance_table, heading, notes, success_table, verdict_told

    console = Terminal()
    for comparison in found:
        console.print(heading(comparison), soft_wrap=True)
        console.print(_table("success", success_table(comparison)))
        console.print(_table("distance to the teat end", distance_table(comparison)))
        for line in (*notes(comparison), verdict_told(comparison)):
            console.print(line)
        for reason in comparison.compared.gate.reasons:
            console.print(f"  {reason}")


def _table(title: str, shown: PageTable) -> Table:
    """A page's table of plain texts, for the terminal."""
    table = Table(title=title)
    for at, column in enumerate(shown.columns):
        table.add_column(
            f"{column.title}, {column.unit}" if column.unit else column.title,
            justify="right" if at else "left",
            no_wrap=not at,
        )
    for row in shown.rows:
        table.add_row(*(cell if isinstance(cell, str) else cell.text for cell in row))
    return table

"""What a run found, at the terminal: that the bench works, the scoreboard of the detectors, a
sentence for each, and the report as a link.
"""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from rich.table import Table
from rich.text import Text

from bench import Decision, Judgement, Reported, RunRecord, Verdict
from bench.cli.arguments import CODES, code_of
from bench.cli.terminal import FAILURES, Terminal, print_table, print_wrapped
from bench.report.wording import limit, measured
from reports.page import SIGNS, UNFINISHED
from textfiles.text import plural

COLOURS: dict[str, str] = {  # the others are yellow
    **dict.fromkeys(UNFINISHED, "red"),
    "met": "green",
    "not met": "red",
}


def show_verdict(console: Terminal, found: Reported) -> int:
    """Show what a run found; gives back its exit code, whether or not it can be shown."""
    report, record, judgements, status = found.page, found.record, found.judgements, found.status
    with suppress(*FAILURES):
        if status.mark:
            console.print(Text(status.mark, "bold yellow"))
        decided = status.decided and bool(judgements)
        if decided:
            console.print(_bench(record, judgements[0]))
        if judgements and (table := _scoreboard(console, record, judgements)).rows:
            print_table(console, table)
        if decided and len(judgements) > 1:
            for judgement in judgements:
                own = [one for one in judgement.decisions if one.name not in judgement.of_bench]
                sign, colour = _sign(console, judgement.verdict)
                who = f"{sign} {judgement.detector}", f"bold {colour}"
                console.print(Text.assemble(who, f" {'; '.join(_reasons(own))}."))
        else:
            word = (status.word, f"bold {COLOURS.get(status.word, 'yellow')}")
            if status.under_way and not status.damage:
                console.print(Text.assemble(word, f": {status.trials}"))
                print_wrapped(console, status.line)
            else:
                console.print(Text.assemble("Verdict: ", word))
                print_wrapped(console, status.why)
            for line in status.unsafe:
                console.print(f"NOT SAFE: {line}", style="bold red", markup=False)
        for line in "\n".join(status.then).splitlines():
            print_wrapped(console, f"Next: {line}")
        console.print(f"Report: {report.resolve().as_uri()}", markup=False, soft_wrap=True)
    finished = status.state == "finished"
    return code_of(found.verdict) if finished else CODES.fault


def _bench(record: RunRecord, judgement: Judgement) -> Text:
    """Whether the bench did its own part: all trials, and the requirements that it has to meet."""
    own = [one for one in judgement.decisions if one.name in judgement.of_bench]
    done, planned = len(record.trials), record.facts["planned"]
    failed = [one.name for one in own if one.verdict is Verdict.NOT_MET]
    open_ = [one.name for one in own if one.verdict in (Verdict.INCONCLUSIVE, Verdict.NOT_MEASURED)]
    if failed:
        text = f"The bench has to be put right first: {', '.join(failed)}."
        return Text.assemble((text, "bold red"))
    count = f"{done} of {plural(planned, 'trial')} done"
    count += f", {len(record.skipped)} skipped" if record.skipped else ""
    met = [one.name for one in own if one.verdict is Verdict.MET]
    left_open = f"; not decided: {', '.join(open_)}" if open_ else ""
    text = f"{', '.join([count, *met])}{left_open}."
    return Text.assemble(("The bench works: ", "bold green"), text)


def _scoreboard(console: Terminal, record: RunRecord, judgements: Sequence[Judgement]) -> Table:
    """Requirements by detector; of those of the bench only what is not met."""
    several, title = len(judgements) > 1, record.facts["title"]
    table = Table(title=title if several else f"{title}: detector {judgements[0].detector}")
    table.add_column("requirement")
    table.add_column("limit", justify="right")
    for judgement in judgements:
        table.add_column(judgement.detector if several else "measured")
    for row in zip(*(judgement.decisions for judgement in judgements), strict=True):
        of_bench = row[0].name in judgements[0].of_bench
        if of_bench and row[0].verdict is Verdict.MET:
            continue  # said before the table
        each = row[:1] if of_bench else row  # once, not a detector each
        values = (measured(replace(one, uncertainty=None)) for one in each)  # bounds: the report
        cells = (
            Text.assemble(_sign(console, one.verdict), " ", value)
            for one, value in zip(each, values, strict=True)
        )
        table.add_row(row[0].name, limit(row[0]), *cells)
    return table


def _sign(console: Terminal, verdict: Verdict) -> tuple[str, str]:
    """The symbol of a verdict with its colour; the word where the terminal has no such symbol."""
    has = console.encoding.lower().startswith("utf")
    return SIGNS[verdict.value] if has else f"{verdict}:", COLOURS.get(verdict, "yellow")


def _reasons(decisions: Sequence[Decision]) -> Iterator[str]:
    """What of its own requirements a detector meets, and what not, with the figures."""
    met = [one for one in decisions if one.verdict is Verdict.MET]
    if len(met) == len(decisions):
        yield f"meets all {len(decisions)} requirements" if met[1:] else "meets its requirement"
        return
    yield f"meets {len(met)} of {len(decisions)} requirements"
    for words, verdicts in (
        ("does not meet", (Verdict.NOT_MET,)),
        ("too few poses to decide", (Verdict.INCONCLUSIVE,)),
        ("not measured", (Verdict.NOT_MEASURED,)),
    ):
        if which := [one for one in decisions if one.verdict in verdicts]:
            yield f"{words}: " + ", ".join(f"{one.name} {measured(one)}" for one in which)


def open_report(report: Path) -> bool:
    """Open a report in the desktop's browser; False, and nothing happens, where there is none."""
    with suppress(webbrowser.Error, OSError):
        return on_a_desktop() and webbrowser.open(report.resolve().as_uri())
    return False


def on_a_desktop() -> bool:
    """Whether a person sits before this screen: no CI, pipe, SSH, missing display."""
    there = os.environ.get
    if there("CI") or not (sys.stdout and sys.stdout.isatty()):
        return False
    if sys.platform in ("win32", "darwin"):
        return not there("SSH_CONNECTION")
    return bool(there("DISPLAY") or there("WAYLAND_DISPLAY"))

"""`run`, `resume`, `score` and `report`: what ends in a run folder with a verdict. What runs and
what reports is imported where it is needed: wrong use is to be answered at once.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import bench
from bench.cli.arguments import CODES, print_json, say
from bench.cli.store import undamaged
from bench.cli.terminal import Terminal, TerminalProgress, working
from bench.config import ConfigError, all_of
from instruments.operators.console import keyboard_of
from textfiles.whole import refusal

# once a run has begun, Ctrl-C ends it by way of safe; later only a report can be missing
REPORTING = "the run is kept, and its report may be missing: 'teatbench report latest' writes it"
WORST = (CODES.met, CODES.inconclusive, CODES.not_met, CODES.fault)  # of several runs


def run(given: argparse.Namespace) -> int:
    if given.json and not given.dry_run:
        raise ConfigError.plain("--json is for --dry-run. A run's JSON is its report/run.json.")
    rig, *scripts = all_of(
        lambda _: bench.load_rig(given.rig),
        *(lambda to, one=one: bench.load_script(one, to[0]) for one in given.script or [None]),
    )
    _summarize(given)  # its file's fault now, not when all is over
    if given.dry_run:
        from bench.cli.dry_run import look_ahead

        how = {"out": given.out, "detectors": given.detector, "seed": given.seed}
        done = [look_ahead(rig, one, given.json, len(scripts) > 1, **how) for one in scripts]
        if given.json:
            found = [seen for _, seen in done]
            print_json({"scripts": found} if found[1:] else found[0], indent=1)
        return max(code for code, _ in done)
    from bench.cli.console import beside

    with beside(given.out) if given.console else nullcontext():
        return _run(given, rig, scripts)


def _run(
    given: argparse.Namespace, rig: bench.LoadedRig, scripts: Sequence[bench.LoadedScript]
) -> int:
    console = Terminal()
    with TerminalProgress(console) as shown:
        reports = bench.run_queue(
            scripts,
            rig,
            out=given.out,
            seed=given.seed,
            detectors=given.detector or (),
            record=given.record,
            realtime=given.realtime or (given.console and rig.rig.simulated),
            speed=given.speed,
            **_shared(given, rig, shown),
        )
    queued = ""
    if len(scripts) > 1:
        from bench.report.runs import queue_headline

        queued = f"Queue: {queue_headline(given.out, [one.folder.name for one in reports])}"
    from bench.cli.verdict import open_report, show_verdict

    codes = []
    for found in reports:
        codes.append(show_verdict(console, found))
        _summarize(given, found)
        if found.took:
            say(found.took)
    page = reports[-1].page if reports else None
    if queued:
        say(queued)
        _summarize(given, queued)
        try:
            _, page = bench.write_queue_page(given.out)
            print(f"Page: {page}")
        except OSError as error:
            print(f"Page: not written: {refusal(error)}")
        codes += [CODES.fault] * (len(scripts) - len(reports))
    if given.open and page:
        open_report(page)
    return max(codes, key=WORST.index)


def _summarize(given: argparse.Namespace, found: bench.Reported | str = "") -> None:
    if given.summary:
        from bench.report import summary

        summary.append(given.summary, found if isinstance(found, str) else summary.of_run(found))


def _shared(
    given: argparse.Namespace, rig: bench.LoadedRig, shown: TerminalProgress
) -> dict[str, Any]:
    """What `run` and `resume` say alike."""

    def begun(text: str) -> None:
        given.left = given.kept = REPORTING
        shown.say(text)

    return {
        "progress": shown,
        "typed": typed_lines(by_person=rig.rig.by_person),
        "begun": begun,
        **{key: getattr(given, key) for key in ("capture", "events", "notify")},
    }


def resume(given: argparse.Namespace) -> int:
    from bench.cli.verdict import show_verdict

    console = Terminal()
    with undamaged([given.run], given) as damage:
        if bench.read_run(given.run).ending == "finished" and not _is_reported(given.run):
            print(f"{given.run}: every trial is done; the report was not written yet")
            return show_verdict(console, bench.write_report(given.run, damage=damage))
        rig = bench.rig_of_run(given.run)
        with TerminalProgress(console) as shown:
            how = _shared(given, rig, shown)
            found = bench.resume_run(given.run, damage=damage, **how)
        _summarize(given, found)
        return show_verdict(console, found)


def _is_reported(folder: Path) -> bool:
    """Whether the report is that of the finished run, and not of a session before its end."""
    with suppress(OSError, ValueError, AttributeError):
        text = (folder / "report" / "run.json").read_text(encoding="utf-8")
        return bool(json.loads(text).get("ending") == "finished")
    return False


def typed_lines(*, by_person: bool) -> Callable[[], str | None]:
    """Lines typed at this terminal, where it is one and no operator is asked there."""
    if by_person or sys.stdin is None or not sys.stdin.isatty():
        return lambda: None
    keyboard, terminal = keyboard_of(sys.stdin, lambda _: None), sys.stdin.fileno()

    def line() -> str | None:
        # the system stops a background process (`teatbench run &`) that reads its terminal
        if sys.platform != "win32":
            with suppress(OSError):  # no controlling terminal: nothing stops us
                if os.tcgetpgrp(terminal) != os.getpgrp():
                    return None
        return keyboard.line()

    return line


def score(given: argparse.Namespace) -> int:
    from bench.cli.verdict import show_verdict
    from bench.report.tables import score_table

    console = Terminal()
    with TerminalProgress(console) as shown:
        found = bench.score_recording(
            given.recording, given.detector or ["thesis"], out=given.out, progress=shown
        )
    code = show_verdict(console, found)
    _summarize(given, found)
    if found.unchecked:
        say(f"Cameras {found.unchecked}.")
    print(f"\n{score_table(found.record)}")
    return code


@contextmanager
def _withdrawn(given: argparse.Namespace) -> Iterator[None]:
    """Where the record is refused, the report of before is withdrawn, and the summary says so."""
    try:
        yield
    except bench.DamagedError as refused:
        if given.run in refused.folders:
            if given.summary:
                from bench.report import summary

                text = summary.of_refused(given.run, bench.damage_text(refused.damage))
                summary.append(given.summary, text)
            bench.write_report(given.run)  # refuses it too
        raise


def report(given: argparse.Namespace) -> int:
    from bench.cli.verdict import open_report, show_verdict
    from bench.report.growing import REPORT
    from bench.report.page import PDF
    from reports.pdf import find_browser, print_pdf
    from reports.render import WHOLE
    from reports.trust import PageError

    if given.appendix and given.no_pdf:
        raise ConfigError.plain("--appendix is about the PDF, and --no-pdf prints none. Give one.")
    wanted = given.pdf or given.appendix
    browser = None if given.no_pdf else find_browser()
    if wanted and browser is None:
        raise ConfigError.plain(
            "no Chromium, Chrome or Edge was found to print a PDF with. Install one, or print"
            " index.html by hand."
        )
    with (
        _withdrawn(given),
        undamaged([given.run, *filter(None, [given.baseline])], given) as damage,
    ):
        with working("writing the report"):
            found = bench.write_report(given.run, baseline=given.baseline, damage=damage)
        code = show_verdict(Terminal(), found)
        _summarize(given, found)
    if given.open:
        open_report(given.run / REPORT / "index.html")
    if browser:
        folder = given.run / REPORT
        try:
            page = folder / WHOLE if (folder / WHOLE).is_file() else folder / "index.html"
            with working("printing the PDF"):
                printed = print_pdf(page, folder / PDF, browser, appendix=given.appendix)
            print(f"PDF: {printed}")
        except (PageError, OSError) as error:
            if wanted:
                raise ConfigError.plain(str(error)) from error
            print(f"no PDF: {error}", file=sys.stderr)
    return code

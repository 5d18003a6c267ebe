"""`run`, `score` and `report`: what ends in a run folder with a verdict."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from bench.commands import CODES, Commands, add_detectors, add_out

if TYPE_CHECKING:
    from bench.rig import LoadedRig


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    run = commands.add("run", "run a trial script on a rig and write the scored report", _run)
    run.add_argument("script", nargs="?", help="a shipped script by name, or a .toml file (default: six-situations)")
    run.add_argument("--rig", help="a shipped rig by name, or a .toml file (default: emulated)")
    run.add_argument("--seed", type=_seed, help="seed of all chance (default: the rig file's)")
    run.add_argument("--record", type=Path, metavar="DIR", help="also write a recording that 'teatbench score' reads")
    run.add_argument("--realtime", action="store_true", help="emulated rig only: let time pass as it does")
    run.add_argument("--dry-run", action="store_true", help="move nothing: check reach, limits, fields of view and collisions")
    add_out(run)
    add_detectors(run)
    report = commands.add("report", "(re)write the report of a run", _report, opens_links=False)
    report.add_argument("run", type=Path, help="the run's folder")
    score = commands.add("score", "score detectors on recorded frames: a table, and a run folder with a report", _score, opens_links=False)
    score.add_argument("recording", type=Path, help="a recording's folder")
    add_out(score)
    add_detectors(score)


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 up")
    return int(text)


def _run(given: argparse.Namespace) -> int:
    from rich.console import Console

    from bench.commands.looking_ahead import look_ahead
    from bench.offsets import is_offset_script
    from bench.progress import TerminalProgress
    from bench.rig import find_rig, load_rig
    from bench.script import find_script, load_script

    rig = load_rig(find_rig(given.rig))
    path = find_script(given.script)
    if is_offset_script(path):
        return _run_offsets(rig, path, given.out, dry=given.dry_run)
    script = load_script(path, rig.rig.limits.set_point_c)
    if given.dry_run:
        return look_ahead(rig, script)
    from bench.jobs import run_script

    console = Console()
    with TerminalProgress(console) as progress:
        folder, _ = run_script(
            rig,
            script,
            given.out,
            progress,
            seed=given.seed,
            detectors=given.detector,
            record=given.record,
            realtime=given.realtime,
            capture=given.capture,
        )
        progress.state("writing the report")
        code, show = _reported(folder)
    show(console)
    return code


def _score(given: argparse.Namespace) -> int:
    from rich.console import Console

    from bench.jobs import score_recording
    from bench.progress import TerminalProgress
    from bench.record import read_run
    from bench.score_table import score_table

    console = Console()
    with TerminalProgress(console) as progress:
        folder = score_recording(given.recording, given.out, progress, given.detector or ["thesis"])
        progress.state("writing the report")
        code, show = _reported(folder)
    show(console)
    print(f"\n{score_table(read_run(folder))}")
    return code


def _run_offsets(rig: LoadedRig, path: Path, out: Path, *, dry: bool) -> int:
    """A sensitivity script: no instrument takes part."""
    from bench.offset_run import run_offsets
    from bench.offsets import load_offsets, outcomes

    if dry:
        outcomes(load_offsets(path), rig.calibration)
        print("nothing wrong. This script opens no instrument.")
        return CODES.met
    return _offsets_reported(run_offsets(rig, path, out))


def _offsets_reported(folder: Path) -> int:
    from bench.offset_run import report_offsets
    from bench.summary.offsets import offset_told

    page, loaded, found, verdict = report_offsets(folder)
    for one in found:
        figures = f"up to {one.worst_mm:.2f} mm in the worst of {len(one.errors_mm)} directions, median {one.median_mm:.2f} mm"
        print(f"teat {one.offset.teat}, {offset_told(one.offset)}: {figures}")
    print(f"Verdict: {verdict} (limit {loaded.script.limit_mm:g} mm)\nReport: {page}")
    return CODES.met if verdict == "met" else CODES.not_met


def _report(given: argparse.Namespace) -> int:
    from rich.console import Console

    from bench.offset_run import is_offset_run

    if is_offset_run(given.run):
        return _offsets_reported(given.run)
    code, show = _reported(given.run)
    show(Console())
    return code


def _reported(folder: Path) -> tuple[int, Callable[..., None]]:
    """Write the report of a run; gives back the exit code that it deserves, and what shows it on a console."""
    from bench.progress import show_result
    from bench.summary import write_run_report
    from bench.verdicts import run_verdict

    path, run, judgements = write_run_report(folder)
    codes = {"met": CODES.met, "not met": CODES.not_met}
    code = CODES.fault if run.ending != "finished" else codes.get(run_verdict(judgements).value, CODES.inconclusive)
    return code, lambda console: show_result(console, run, judgements, path)

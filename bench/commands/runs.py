"""`run`, `score` and `report`: what ends in a run folder with a verdict."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from bench.commands import CODES, Commands, add_detectors, add_out


def add_to(commands: Commands) -> None:
    """The family's commands with their arguments."""
    run = commands.add("run", "run a trial script on a rig and write the scored report", _run)
    run.add_argument("script", nargs="?", help="a shipped script by name, or a .toml file (default: six-situations)")
    run.add_argument("--rig", help="a shipped rig by name, or a .toml file (default: emulated)")
    run.add_argument("--seed", type=_seed, help="seed of all chance (default: the rig file's)")
    run.add_argument("--record", type=Path, metavar="DIR", help="also write a recording that 'teatbench score' reads")
    run.add_argument("--realtime", action="store_true", help="emulated rig only: let time pass as it does")
    add_out(run)
    add_detectors(run)
    report = commands.add("report", "(re)write the report of a run", _report, opens_links=False)
    report.add_argument("run", type=Path, help="the run's folder")
    score = commands.add("score", "score detectors on recorded frames", _score, opens_links=False)
    score.add_argument("recording", type=Path, help="a recording's folder")
    add_out(score)
    add_detectors(score)


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 up")
    return int(text)


def _run(given: argparse.Namespace) -> int:
    from rich.console import Console

    from bench.jobs import run_script
    from bench.progress import TerminalProgress
    from bench.rig import find_rig, load_rig
    from bench.script import find_script, load_script

    rig = load_rig(find_rig(given.rig))
    script = load_script(find_script(given.script), rig.rig.limits.set_point_c)
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

    console = Console()
    with TerminalProgress(console) as progress:
        folder = score_recording(given.recording, given.out, progress, given.detector or ["thesis"])
        progress.state("writing the report")
        code, show = _reported(folder)
    show(console)
    return code


def _report(given: argparse.Namespace) -> int:
    from rich.console import Console

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

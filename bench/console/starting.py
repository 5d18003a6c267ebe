"""Starts runs for the page, each a process of its own that outlives the console. The page names a
rig, a script and detectors from the lists made here; it never gives a path or a command.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.config import ConfigError, toml_of
from bench.rig.loading import NO_RIGS, RIGS, find_rig, load_rig, shipped
from bench.script.detectors import declared
from bench.script.model import TRIALS
from detector.registry import available
from instruments.clock import Clock, wall_time

LOGS = ".console"  # in the folder of runs
BEGIN_S, POLL_S = 60.0, 0.2
BEGUN = re.compile(r"Run folder: (.+)$", re.MULTILINE)
# on Windows, where a console's window ends all that share it; nor has it a window of its own then
APART = ("CREATE_NEW_PROCESS_GROUP", "CREATE_NO_WINDOW")
TAIL = 4000  # characters of the output of a run that didn't begin


class NotStartedError(Exception):
    """The run didn't begin; the text says why."""


@dataclass(frozen=True, slots=True)
class Choices:
    """What the page may choose from: names, each with the path or name that a command takes.
    ``paced``: rigs without a real instrument, whose speed is a choice too.
    """

    rigs: Mapping[str, str]
    scripts: Mapping[str, str]
    detectors: Sequence[str]
    paced: Sequence[str]

    def command(self, rig: str, scripts: Sequence[str], detectors: Sequence[str]) -> list[str]:
        """The arguments of `teatbench` that run them one after the other. Raises NotStartedError
        for other names.
        """
        for what, name, known in (
            ("rig", rig, self.rigs),
            *(("script", script, self.scripts) for script in scripts or [""]),
            *(("detector", name, self.detectors) for name in detectors),
        ):
            if name not in known:
                raise NotStartedError(
                    f"there is no {what} {name!r} (there are: {', '.join(known)})"
                )
        under_test = [word for name in detectors for word in ("--detector", name)]
        names = [self.scripts[script] for script in scripts]
        return ["run", *names, "--rig", self.rigs[rig], *under_test]


def choices(folder: Path) -> Choices:
    """What ships, and the rig files and scripts in ``folder``."""
    rigs = {name: name for name in shipped(RIGS) if name not in NO_RIGS}
    scripts = {name: name for name in shipped(TRIALS)}
    for path in sorted(folder.glob("*.toml")):
        if _has(path, "arm") and _has(path, "bath"):
            rigs[path.name] = str(path.resolve())
        elif _has(path, "trials"):
            scripts[path.name] = str(path.resolve())
    paced = [name for name, path in rigs.items() if _simulated(path)]
    return Choices(rigs, scripts, sorted({*available(), *declared()}), paced)


def _simulated(rig: str) -> bool:
    try:
        return load_rig(find_rig(rig)).rig.simulated
    except ConfigError:
        return False  # what is wrong is said once it is chosen


def _has(path: Path, table: str) -> bool:
    try:
        return table in toml_of(path)
    except ConfigError:
        return False


def dry_run(arguments: Sequence[str], runs: Path) -> dict[str, Any]:
    """``exit_code`` of the dry run of these arguments; what it ``found``, as `--json` prints it;
    None with a ``text`` that says why it was refused.
    """
    done = subprocess.run(
        [*_bench(), *arguments, "--out", str(runs), "--dry-run", "--json"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        check=False,
    )
    try:
        found = json.loads(done.stdout)
    except ValueError:
        found = None
    text = (done.stderr.strip() or done.stdout)[-TAIL:]
    return {"exit_code": done.returncode, "found": found, "text": "" if found else text}


def start(arguments: Sequence[str], runs: Path, clock: Clock, known: str = "") -> str:
    """Start a run; gives back its folder's name (``known`` to resume). Raises NotStartedError."""
    logs = runs / LOGS
    logs.mkdir(parents=True, exist_ok=True)
    log = logs / f"{wall_time().strftime('%Y%m%d-%H%M%S')}-{os.urandom(3).hex()}.log"
    with log.open("wb") as out:
        process = subprocess.Popen(
            [*_bench(), *arguments],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            creationflags=sum(getattr(subprocess, flag, 0) for flag in APART),
        )
    end_s = clock.now() + BEGIN_S
    while True:
        text = log.read_text(encoding="utf-8", errors="replace")
        if begun := BEGUN.search(text):
            return known or Path(begun[1].strip()).name
        if process.poll() is not None or clock.now() >= end_s:
            raise NotStartedError(text[-TAIL:].strip() or "the run ended without output")
        clock.sleep(POLL_S)


def _bench() -> list[str]:
    return [sys.executable, "-m", "bench.cli"]

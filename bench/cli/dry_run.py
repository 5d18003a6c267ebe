"""`run --dry-run`: what would go wrong, found before anything moves: by a look at each pose, then
by a rehearsal on emulators.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import bench
from bench.cli.arguments import CODES, say
from bench.cli.terminal import working
from textfiles.text import plural

SHOWN = 40  # findings; a plane map on a wrong stage has hundreds


def look_ahead(
    rig: bench.LoadedRig, script: bench.LoadedScript, as_json: bool, named: bool, **how: Any
) -> tuple[int, dict[str, Any]]:
    """The exit code, and what is found and needed, else printed. Raises ConfigError."""
    with working("going through the script on emulators") as shown:
        done = bench.check_script(script, rig, shown=shown, **how)
    findings, wanted = done.findings, list(_needs(rig, done))
    if as_json:
        found = {
            "script": script.path.stem,
            "trials": done.trials,
            "poses": done.poses,
            "gone_through": done.gone_through or 0,
            "frame_sets_rendered": done.rendered,
            "findings": [asdict(finding) for finding in findings],
            "recovered": dict(done.recovered),
            "not_checked": done.unchecked,
            "needs": wanted,
        }
        return CODES.wrong_use if findings or done.room else CODES.met, found
    if named:
        say(f"{script.path.stem}: {script.script.title}")
    for finding in findings[:SHOWN]:
        say(f"{finding.trial}: {finding.kind}: {finding.text}")
    if (more := len(findings) - SHOWN) > 0:
        say(f"and {more} more")
    for what in done.unchecked:
        say(f"not checked: {what}")
    if done.gone_through is not None:
        say(*_gone_through(done, done.gone_through))
    many = f"{plural(done.trials, 'trial')} at {plural(done.poses, 'pose')}"
    if findings:
        say(f"{many}: {plural(len(findings), 'problem')}. Nothing was moved.")
        return CODES.wrong_use, {}
    wrong = "a run is refused: the disk is too full" if done.room else "nothing wrong"
    say(f"{many}: {wrong}. Nothing was moved.")
    say(*wanted)
    return CODES.wrong_use if done.room else CODES.met, {}


def _gone_through(done: bench.ScriptCheck, trials: int) -> Iterator[str]:
    """How far the rehearsal came, and what it recovered from."""
    asked = f"; frames of {done.rendered} were rendered and checked, and each detector"
    rendered = f"{asked} was asked about one set" if done.rendered else ""
    gone = f"{trials} of {plural(done.trials, 'trial')}{rendered}"
    yield f"gone through on emulators, in virtual time: {gone}"
    for what, times in done.recovered.items():
        yield f"met and got over: {what} ({times} times)"
    if left := done.trials - trials:
        yield f"not gone through: {plural(left, 'trial')}, for what is said above"


def _needs(rig: bench.LoadedRig, done: bench.ScriptCheck) -> Iterator[str]:
    """Time, room and prompts, a line each; a warning where the room is not there."""
    if (wanted := done.needs) is None:
        return
    assumed = "by assumed times, see 'teatbench trials show'"
    by = "by what earlier runs took" if done.measured else assumed
    parts = ", ".join(
        f"{kind.removesuffix('_s').replace('_', '-')} {_time(seconds)}"
        for kind, seconds in asdict(wanted.time).items()
        if seconds >= 1
    )
    how = f"; the operator's {by}" if rig.rig.by_person else ""
    yield f"about {_time(wanted.time.total_s)} of the bench's time: {parts}{how}"
    asked = ", ".join(f"{count} {what}" for what, count in wanted.asked.items() if count)
    yield f"at most {wanted.disk_mb:.0f} MB and the report, {wanted.prompts} prompts: {asked}"
    if done.room:
        yield done.room


def _time(seconds: float) -> str:
    """``45 s``, ``20 min``, ``2.5 h``."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400.0 else f"{seconds / 3600:.1f} h"

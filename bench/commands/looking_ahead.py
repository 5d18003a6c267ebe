"""`run --dry-run`: what would go wrong, found before anything moves."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from shutil import disk_usage
from typing import TYPE_CHECKING

from bench.commands import CODES

if TYPE_CHECKING:
    from bench.rig import LoadedRig
    from bench.script import LoadedScript
    from instruments.stage.driver import Stage
    from instruments.stage.settings import AxisLimits

SHOWN = 40  # findings; a plane map on a wrong stage has hundreds


def look_ahead(rig: LoadedRig, script: LoadedScript, out: Path) -> int:
    """Print what a dry run finds, and what the run will need, kept in ``out``; gives back the exit code: 2 where something is wrong."""
    from bench.planning.dry_run import dry_run

    result = dry_run(rig, script, _travel(rig))
    for finding in result.findings[:SHOWN]:
        print(f"{finding.trial}: {finding.kind}: {finding.text}")
    if (more := len(result.findings) - SHOWN) > 0:
        print(f"and {more} more")
    for what in result.unchecked:
        print(f"not checked: {what}")
    many = f"{len(script.planned)} trials at {result.poses} poses"
    if result.findings:
        print(f"{many}: {len(result.findings)} problems. Nothing was moved.")
        return CODES.wrong_use
    print(f"{many}: nothing wrong. Nothing was moved.")
    _tell_needs(rig, script, out)
    return CODES.met


def _tell_needs(rig: LoadedRig, script: LoadedScript, out: Path) -> None:
    """Time, room and prompts; room that isn't there is said."""
    from bench.running.learnt import needs, read_learnt

    learnt = read_learnt(out, rig)
    wanted = needs(rig, script, learnt)
    by = "by what earlier runs took" if learnt else "by assumed times, see 'teatbench trials show'"
    print(f"about {wanted.time.total_s / 60:.0f} min of the bench's time ({by}), at most {wanted.disk_mb:.0f} MB, {wanted.prompts} prompts")
    there = next(folder for folder in (out.resolve(), *out.resolve().parents) if folder.exists())
    if (free_mb := disk_usage(there).free / 1e6) < wanted.disk_mb:
        print(f"NOT ENOUGH ROOM: {free_mb:.0f} MB are free in {there}")


def _travel(rig: LoadedRig) -> Mapping[str, AxisLimits] | None:
    """The travel that the stage's controller tells; None without a stage, or where it doesn't answer. It only asks."""
    from bench.emulated.emulation import EmulatedRig
    from bench.hookup import driver_openers
    from instruments.clock import RealClock, VirtualClock
    from instruments.errors import InstrumentError

    if rig.rig.stage is None:
        return None
    try:
        if rig.rig.emulated:
            with EmulatedRig(rig, still := VirtualClock(), rig.rig.seed) as twin:
                return _asked(driver_openers(rig, still, twin.urls)["stage"]())
        with closing(RealClock()) as clock:
            return _asked(driver_openers(rig, clock, rig.rig.urls)["stage"]())
    except InstrumentError:
        return None


def _asked(stage: Stage) -> Mapping[str, AxisLimits]:
    with closing(stage):
        stage.connect()
        return stage.limits

"""`run --dry-run`: what would go wrong, found before anything moves: by a look at each pose, then
by a rehearsal on emulators.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import bench
from bench.cli.arguments import CODES, json_of
from bench.cli.terminal import working
from bench.dry_run.pose_checks import Finding, dry_run
from bench.dry_run.rehearsal import NoTwinError, Rehearsal, rehearse
from bench.rig.loading import LoadedRig
from bench.rig.urls import PEOPLE
from bench.run.estimate import needs, no_room, read_durations
from bench.run.lock import RigInUseError, lock_path, locked
from bench.safety.latch import latch_path, read_latch, unconfirmed
from bench.scoring.rates import plural
from bench.script.calibration_age import refuse_old_calibration
from bench.script.detectors import introduced, make_detectors
from bench.script.model import LoadedScript, refuse_carry
from instruments.clock import wall_time
from instruments.errors import InstrumentError
from instruments.stage.settings import StageSettings

SHOWN = 40  # findings; a plane map on a wrong stage has hundreds
REHEARSING = "going through the script on emulators"


def look_ahead(
    rig: LoadedRig,
    script: LoadedScript,
    out: Path,
    detectors: Sequence[str] = (),
    seed: int | None = None,
    *,
    as_json: bool = False,
) -> int:
    """Print what a dry run finds and what the run needs; gives back the exit code. Raises
    ConfigError, KeyboardInterrupt.
    """
    rig.refuse_unfilled()
    refuse_carry(rig, script)
    refuse_old_calibration(rig, script, wall_time().date())
    settings, why_not_asked = _stage_settings(rig)
    axes = rig.rig.stage.axes if rig.rig.stage else ""
    limits = settings.limits if settings else {}
    travel = {name: way for name, way in limits.items() if name in axes} if settings else None
    of_poses, unchecked = dry_run(rig, script, travel, why_not_asked)
    # a trial beyond the stage's travel would end the run at once: the others are gone through
    beyond = {one.trial for one in of_poses if one.kind == "limits"}
    within = replace(script, planned=tuple(one for one in script.planned if one.name not in beyond))
    rehearsal, why_not = _rehearsed(rig, within, detectors, settings, seed)
    latch = read_latch(latch_path(rig))
    # each of a trial once: the check of its pose says where, the rehearsal only finds it again
    known = {(one.trial, one.kind) for one in of_poses}
    again = rehearsal.findings if rehearsal else ()
    findings = [
        *([Finding("the rig", "latched", str(latch))] if latch else []),
        *(Finding("the rig", "refused", why) for why in unconfirmed(rig, wall_time().date())),
        *of_poses,
        *(one for one in again if (one.trial, one.kind) not in known),
    ]
    trials, poses = len(script.planned), len({one.name for one in script.planned})
    wanted = [] if findings else list(_needs(rig, script, out))
    if as_json:
        found = {
            "trials": trials,
            "poses": poses,
            "gone_through": rehearsal.trials if rehearsal else 0,
            "frame_sets_rendered": rehearsal.rendered if rehearsal else 0,
            "findings": [asdict(finding) for finding in findings],
            "recovered": dict(rehearsal.recovered) if rehearsal else {},
            "not_checked": [*unchecked, *why_not],
            "needs": wanted,
        }
        print(json_of(found, indent=1))
        return CODES.wrong_use if findings else CODES.met
    for finding in findings[:SHOWN]:
        print(f"{finding.trial}: {finding.kind}: {finding.text}")
    if (more := len(findings) - SHOWN) > 0:
        print(f"and {more} more")
    for what in (*unchecked, *why_not):
        print(f"not checked: {what}")
    if rehearsal:
        print(*_gone_through(rehearsal, trials), sep="\n")
    many = f"{plural(trials, 'trial')} at {plural(poses, 'pose')}"
    if findings:
        problems = "problem" if len(findings) == 1 else "problems"
        print(f"{many}: {len(findings)} {problems}. Nothing was moved.")
        return CODES.wrong_use
    print(f"{many}: nothing wrong. Nothing was moved.")
    print(*wanted, sep="\n")
    return CODES.met


def _gone_through(rehearsal: Rehearsal, trials: int) -> Iterator[str]:
    """How far the rehearsal came, and what it recovered from."""
    rendered = ""
    if rehearsal.rendered:
        rendered = f"; frames of {rehearsal.rendered} were rendered and checked, and each detector"
        rendered += " was asked about one set"
    done = f"{rehearsal.trials} of {plural(trials, 'trial')}{rendered}"
    yield f"gone through on emulators, in virtual time: {done}"
    for what, times in rehearsal.recovered.items():
        yield f"met and got over: {what} ({times} times)"
    if left := trials - rehearsal.trials:
        yield f"not gone through: {plural(left, 'trial')}, for what is said above"


def _rehearsed(
    rig: LoadedRig,
    script: LoadedScript,
    detectors: Sequence[str],
    stage: StageSettings | None,
    seed: int | None,
) -> tuple[Rehearsal | None, tuple[str, ...]]:
    """What going through ``script`` found; None where it is impossible, and why."""
    if not script.planned:
        return None, ("the script as a whole: no trial is within the stage's travel",)
    named = (detectors,) if detectors else (script.script.detectors, script.path.parent)
    under_test = make_detectors(*named)
    try:
        with (
            introduced(under_test, script.scenes, rig.calibration),
            working(REHEARSING) as shown,
        ):
            return rehearse(rig, script, under_test, stage=stage, seed=seed, shown=shown), ()
    except NoTwinError as error:
        return None, (f"the script as a whole: there can be no emulated twin of this rig: {error}",)


def _needs(rig: LoadedRig, script: LoadedScript, out: Path) -> Iterator[str]:
    """Time, room and prompts, a line each; a warning where the room is not there."""
    measured = read_durations(out, rig)
    by = (
        "by what earlier runs took" if measured else "by assumed times, see 'teatbench trials show'"
    )
    wanted = needs(rig, script, measured)
    parts = ", ".join(
        f"{kind.removesuffix('_s').replace('_', '-')} {_time(seconds)}"
        for kind, seconds in asdict(wanted.time).items()
        if seconds >= 1
    )
    how = f"; the operator's {by}" if rig.rig.operator.url in PEOPLE else ""
    yield f"about {_time(wanted.time.total_s)} of the bench's time: {parts}{how}"
    asked = ", ".join(f"{count} {what}" for what, count in wanted.asked.items() if count)
    yield f"at most {wanted.disk_mb:.0f} MB and the report, {wanted.prompts} prompts: {asked}"
    if room := no_room(wanted.disk_mb, out):
        yield room


def _time(seconds: float) -> str:
    """``45 s``, ``20 min``, ``2.5 h``."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400.0 else f"{seconds / 3600:.1f} h"


def _stage_settings(rig: LoadedRig) -> tuple[StageSettings | None, str]:
    """What the stage's controller says of itself; or None, and why it could not be asked."""
    if rig.rig.stage is None:
        return None, ""

    # opening its port resets most boards, which no running bench must see; a rig that never ran
    # gets no lock
    lock = lock_path(rig)
    try:
        with (
            locked(lock if lock and lock.exists() else None, "a dry run", lambda _: None),
            bench.open_rig(rig, ("stage",)) as opened,
        ):
            opened.stage.connect()
            return opened.stage.settings, ""
    except RigInUseError:
        return None, "another bench has the rig"
    except InstrumentError:
        return None, "its controller doesn't answer"

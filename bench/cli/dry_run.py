"""`run --dry-run`: what would go wrong, found before anything moves: by a look at each pose, then
by a rehearsal on emulators.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from shutil import disk_usage
from typing import TYPE_CHECKING

from bench.cli.arguments import CODES
from bench.rig.urls import CONSOLE

if TYPE_CHECKING:
    from bench.dry_run.pose_checks import Finding
    from bench.dry_run.rehearsal import Rehearsal
    from bench.rig.loading import LoadedRig
    from bench.script.model import LoadedScript
    from instruments.stage.driver import Stage
    from instruments.stage.settings import StageSettings

SHOWN = 40  # findings; a plane map on a wrong stage has hundreds
RIG = "the rig"


def look_ahead(
    rig: LoadedRig,
    script: LoadedScript,
    out: Path,
    detectors: Sequence[str] = (),
    seed: int | None = None,
) -> int:
    """Print what a dry run finds, and what the run will need, kept in ``out``; gives back the exit
    code: 2 where something is wrong.

    Raises ConfigError for what a run would be refused for, and KeyboardInterrupt.
    """
    from bench.dry_run.pose_checks import dry_run
    from bench.run.estimate import read_learnt
    from bench.run.truth_source import refuse_carry
    from bench.script.calibration_age import refuse_old_calibration
    from instruments.clock import wall_time

    refuse_carry(rig, script)
    refuse_old_calibration(rig, script, wall_time().date())
    settings, why_not_asked = _stage_settings(rig)
    axes = rig.rig.stage.axes if rig.rig.stage else ""
    travel = (
        None
        if settings is None
        else {name: way for name, way in settings.limits.items() if name in axes}
    )
    look = dry_run(rig, script, travel, why_not_asked)
    learnt = read_learnt(out, rig)
    within = _within_travel(script, look.findings)
    rehearsal, why_not = _rehearsed(rig, within, detectors, settings, learnt, seed)
    findings = _all_findings(rig, look.findings, rehearsal)
    _tell_findings(findings)
    for what in (*look.unchecked, *why_not):
        print(f"not checked: {what}")
    if rehearsal:
        _tell_rehearsal(rehearsal, len(script.planned) - len(within.planned))
    many = f"{len(script.planned)} trials at {look.poses} poses"
    if findings:
        print(
            f"{many}: {len(findings)} {'problem' if len(findings) == 1 else 'problems'}. Nothing"
            " was moved."
        )
        return CODES.wrong_use
    print(f"{many}: nothing wrong. Nothing was moved.")
    _tell_needs(rig, script, out, rehearsal, learnt)
    return CODES.met


def _within_travel(script: LoadedScript, findings: Sequence[Finding]) -> LoadedScript:
    """The script without the trials that would end the run at once, for the stage can't get there:
    the others are gone through.
    """
    beyond = {one.trial for one in findings if one.kind == "limits"}
    return replace(script, planned=tuple(one for one in script.planned if one.name not in beyond))


def _rehearsed(
    rig: LoadedRig,
    script: LoadedScript,
    detectors: Sequence[str],
    stage: StageSettings | None,
    learnt: Mapping[str, float],
    seed: int | None,
) -> tuple[Rehearsal | None, tuple[str, ...]]:
    """What going through ``script`` came to; None where it can't be, and why."""
    from bench.dry_run.rehearsal import NoTwinError, rehearse
    from bench.results.answers import close_detectors
    from bench.script.detectors import make_detectors

    if not script.planned:
        return None, ("the script as a whole: no trial is within the stage's travel",)
    under_test = (
        make_detectors(detectors)
        if detectors
        else make_detectors(script.script.detectors, script.path.parent)
    )
    try:
        with _status() as shown:
            return (
                rehearse(
                    rig, script, under_test, stage=stage, learnt=learnt, seed=seed, shown=shown
                ),
                (),
            )
    except NoTwinError as error:
        return None, (f"the script as a whole: there can be no emulated twin of this rig: {error}",)
    finally:
        close_detectors(under_test)


@contextmanager
def _status() -> Iterator[Callable[[int, int], None]]:
    """A line in a terminal that tells how far the rehearsal is, and is gone at its end; nothing
    elsewhere.
    """
    from bench.cli.terminal import Terminal

    told = "going through the script on emulators"
    with Terminal().status(told) as status:
        yield lambda done, of: status.update(f"{told}: trial {min(done + 1, of)} of {of}")


def _all_findings(
    rig: LoadedRig, looked: Sequence[Finding], rehearsal: Rehearsal | None
) -> list[Finding]:
    """Each trouble of a trial once: the look at its pose says where, the rehearsal would only meet
    it again.
    """
    from bench.dry_run.pose_checks import Finding
    from bench.safety.latch import latch_path, read_latch

    latch = read_latch(latch_path(rig))
    known = {(one.trial, one.kind) for one in looked}
    met = (
        [one for one in rehearsal.findings if (one.trial, one.kind) not in known]
        if rehearsal
        else []
    )
    return [*([Finding(RIG, "latched", str(latch))] if latch else []), *looked, *met]


def _tell_findings(findings: Sequence[Finding]) -> None:
    for finding in findings[:SHOWN]:
        print(f"{finding.trial}: {finding.kind}: {finding.text}")
    if (more := len(findings) - SHOWN) > 0:
        print(f"and {more} more")


def _tell_rehearsal(rehearsal: Rehearsal, beyond: int) -> None:
    """What was gone through, and what was not."""
    planned = rehearsal.planned + beyond
    told = f"gone through on emulators, in virtual time: {rehearsal.trials} of {planned} trials"
    if rehearsal.rendered:
        told += (
            f"; frames of {rehearsal.rendered} were rendered and checked, and each detector was"
            " asked about one set"
        )
    print(told)
    for what, times in rehearsal.recovered.items():
        print(f"met and got over: {what} ({times} times)")
    if left := planned - rehearsal.trials:
        print(f"not gone through: {left} trials, for what is said above")


def _tell_needs(
    rig: LoadedRig,
    script: LoadedScript,
    out: Path,
    rehearsal: Rehearsal | None,
    learnt: Mapping[str, float],
) -> None:
    """Time, room and prompts; room that isn't there is said."""
    from bench.run.estimate import needs

    by = "by what earlier runs took" if learnt else "by assumed times, see 'teatbench trials show'"
    if rehearsal:
        parts = ", ".join(
            f"{kind} {_told(seconds)}"
            for kind, seconds in rehearsal.spent.items()
            if seconds >= 1.0
        )
        how = "" if rig.rig.operator.url != CONSOLE else f"; the operator's {by}"
        print(f"about {_told(rehearsal.total_s)} of the bench's time: {parts}{how}")
        disk_mb = rehearsal.disk_mb
        print(f"about {disk_mb:.0f} MB and the report, {rehearsal.prompts} prompts")
    else:
        wanted = needs(rig, script, learnt)
        disk_mb = wanted.disk_mb
        print(
            f"about {_told(wanted.time.total_s)} of the bench's time ({by}), at most {disk_mb:.0f}"
            f" MB, {wanted.prompts} prompts"
        )
    there = next(folder for folder in (out.resolve(), *out.resolve().parents) if folder.exists())
    if (free_mb := disk_usage(there).free / 1e6) < disk_mb:
        print(f"NOT ENOUGH ROOM: {free_mb:.0f} MB are free in {there}")


def _told(seconds: float) -> str:
    """``45 s``, ``20 min``, ``2.5 h``."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400.0 else f"{seconds / 3600:.1f} h"


def _stage_settings(rig: LoadedRig) -> tuple[StageSettings | None, str]:
    """What the stage's controller tells of itself; None without a stage, or where nobody could ask,
    and why. It only asks.
    """
    from bench.rig.emulated_rig import EmulatedRig
    from bench.rig.opening import driver_openers
    from bench.run.lock import RigInUseError, lock_path, locked
    from instruments.clock import RealClock, VirtualClock
    from instruments.errors import InstrumentError

    if rig.rig.stage is None:
        return None, ""
    # opening its port resets most boards, which no running bench must see; a rig that never ran
    # gets no lock
    lock = lock_path(rig)
    try:
        if rig.rig.emulated:
            with EmulatedRig(rig, still := VirtualClock(), rig.rig.seed) as twin:
                return _asked(driver_openers(rig, still, twin.urls)["stage"]()), ""
        with (
            locked(lock if lock and lock.exists() else None, "a dry run", lambda _: None),
            closing(RealClock()) as clock,
        ):
            return _asked(driver_openers(rig, clock, rig.rig.urls)["stage"]()), ""
    except RigInUseError:
        return None, "another bench has the rig"
    except InstrumentError:
        return None, "its controller doesn't answer"


def _asked(stage: Stage) -> StageSettings:
    with closing(stage):
        stage.connect()
        return stage.settings

"""Before a run: how many poses a claim needs, what a script comes to, and what would go wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.api.rigs import open_rig
from bench.api.runs import OUT, load_script
from bench.api.shots import AnyRig, load_rig
from bench.config import ConfigError
from bench.rig.loading import LoadedRig
from bench.run.estimate import (
    ASSUMED,
    UNITS,
    Forecast,
    TimeEstimate,
    estimate,
    needs,
    no_room,
    read_durations,
)
from bench.run.lock import RigInUseError, lock_path, locked
from bench.run.trial import refuse_carry
from bench.safety.latch import latch_path, read_latch, unconfirmed
from bench.scoring.looks import Looks
from bench.script.calibration_age import refuse_old_calibration
from bench.script.detectors import introduced, make_detectors
from bench.script.model import LoadedScript
from bench.script.planned_trials import POSE_KEYS, pose_set
from instruments.clock import wall_time
from instruments.errors import InstrumentError
from instruments.stage.settings import StageSettings

if TYPE_CHECKING:
    from bench.dry_run.pose_checks import Finding
    from bench.scoring.sample_size import SampleSizePlan

AnyScript = str | Path | LoadedScript | None
RATES = (0.95, 0.99, 0.999)


def plan_poses(
    rates: Sequence[float] = RATES,
    confidence: float = 0.95,
    *,
    poses: int | None = None,
    script: AnyScript = None,
    failures: int = 3,
    true_rate: float | None = None,
    sd_mm: float | None = None,
    shift_mm: float | None = None,
    power: float = 0.8,
    limit_mm: float | None = None,
    u_mm: float | None = None,
) -> SampleSizePlan:
    """How many poses show success ``rates`` (0 to 1), with up to so many ``failures``, and what
    ``poses`` poses, or those of ``script``, can show: `teatbench plan`. ``sd_mm``, ``shift_mm``:
    standard deviation over poses, and size, of two detectors' difference, shown with the chance
    ``power``; ``limit_mm``, ``u_mm``: of the error, and the truth's standard uncertainty along an
    axis. Raises ConfigError.
    """
    from bench.scoring.sample_size import make_plan  # scipy takes seconds to import

    if script is not None and poses is not None:
        raise ConfigError.plain(
            "--script and --trials both say how many poses there are; give one of them"
        )
    if shift_mm is not None and sd_mm is None:
        raise ConfigError.plain(
            "--shift-mm needs --sd-mm: how much the difference varies from pose to pose ('teatbench"
            " compare' shows it)"
        )
    if (limit_mm is None) != (u_mm is None):
        raise ConfigError.plain(
            "--limit-mm and --u-mm belong together: the limit of the error, and the uncertainty of"
            " the truth"
        )
    if script is not None:  # repeats of one pose count once
        loaded = _script(script)
        poses = len({trial.name for trial in loaded.planned})
        confidence = Looks(loaded.script.looks).first_confidence(confidence)
    return make_plan(
        rates,
        confidence,
        failures=failures,
        poses=poses,
        true_rate=true_rate,
        sd_mm=sd_mm,
        shift_mm=shift_mm,
        power=power,
        limit_mm=limit_mm,
        u_mm=u_mm,
    )


def _script(script: AnyScript, rig: LoadedRig | None = None) -> LoadedScript:
    return script if isinstance(script, LoadedScript) else load_script(script, rig)


@dataclass(frozen=True, slots=True)
class ScriptPlan:
    """A script on a rig: ``trials`` in their order, each with ``id``, ``pose``, ``repeat``,
    ``x_mm``, ``y_mm``, ``z_mm``, ``yaw_deg`` and ``from``; ``chosen``: how poses were chosen, a
    sentence each; ``time`` with a person at the arm, by what is ``assumed`` (a value, its unit).
    """

    script: LoadedScript
    trials: tuple[Mapping[str, Any], ...]
    chosen: tuple[str, ...]
    order: str
    seed: int
    time: TimeEstimate
    assumed: Mapping[str, tuple[float, str]]


def plan_script(script: AnyScript = None, rig: AnyRig = "emulated") -> ScriptPlan:
    """The poses of a script, and how long it takes on a rig: `teatbench trials show`. Raises
    ConfigError.
    """
    on = load_rig(rig)
    loaded = _script(script, on)
    s = loaded.script
    found = pose_set(s.trials, loaded.planned, seed=s.seed, order=s.order)
    rows = tuple(dict(zip(POSE_KEYS, row, strict=True)) for row in found["poses"])
    assumed = {name: (value, UNITS.get(name, "s")) for name, value in ASSUMED.items()}
    time = estimate(on, loaded)
    return ScriptPlan(loaded, rows, tuple(found["chosen"]), s.order, s.seed, time, assumed)


@dataclass(frozen=True, slots=True)
class ScriptCheck:
    """What would go wrong in a run: ``findings`` by trial; ``gone_through``: trials that were done
    on emulators, with ``rendered`` frame sets and what the run ``recovered`` from, counted;
    ``unchecked``: what could not be looked at. ``needs``: time, disk and prompts, by what was
    ``measured`` of the rig (nothing: by what is assumed); ``room``: says that the disk is too full.
    """

    trials: int
    poses: int
    findings: tuple[Finding, ...]
    gone_through: int | None
    rendered: int
    recovered: Mapping[str, int]
    unchecked: tuple[str, ...]
    needs: Forecast | None
    measured: Mapping[str, float]
    room: str


def check_script(
    script: AnyScript = None,
    rig: AnyRig = "emulated",
    *,
    out: Path | str = OUT,
    detectors: Sequence[str] = (),
    seed: int | None = None,
    shown: Callable[[int, int], None] = lambda _done, _of: None,
) -> ScriptCheck:
    """Look at each pose of a script, and go through it on emulators of the rig: `teatbench run
    --dry-run`. Moves nothing. ``out``: where runs are kept; ``shown`` gets how many trials have
    begun, of how many. Raises ConfigError.
    """
    from bench.dry_run.pose_checks import Finding, dry_run
    from bench.dry_run.rehearsal import NoTwinError, rehearse

    on, today = load_rig(rig), wall_time().date()
    loaded = _script(script, on)
    on.refuse_unfilled()
    refuse_carry(on, loaded)
    refuse_old_calibration(on, loaded, today)
    settings, why_not_asked = _stage_settings(on)
    axes = on.rig.stage.axes if on.rig.stage else ""
    limits = settings.limits if settings else {}
    travel = {name: way for name, way in limits.items() if name in axes} if settings else None
    of_poses, unchecked = dry_run(on, loaded, travel, why_not_asked)
    # a trial beyond the stage's travel would end the run at once: the others are gone through
    beyond = {one.trial for one in of_poses if one.kind == "limits"}
    planned = tuple(one for one in loaded.planned if one.name not in beyond)
    within, rehearsal, why_not = replace(loaded, planned=planned), None, ""
    if planned:
        named = (detectors,) if detectors else (loaded.script.detectors, loaded.path.parent)
        tested = make_detectors(*named)
        try:
            with introduced(tested, within.scenes, on.calibration):
                rehearsal = rehearse(on, within, tested, stage=settings, seed=seed, shown=shown)
        except NoTwinError as error:
            why_not = f"there can be no emulated twin of this rig: {error}"
    else:
        why_not = "no trial is within the stage's travel"
    latch = read_latch(latch_path(on))
    # each of a trial once: the check of its pose says where, the rehearsal only finds it again
    known = {(one.trial, one.kind) for one in of_poses}
    again = rehearsal.findings if rehearsal else ()
    findings = (
        *([Finding("the rig", "latched", str(latch))] if latch else []),
        *(Finding("the rig", "refused", why) for why in unconfirmed(on, today)),
        *of_poses,
        *(one for one in again if (one.trial, one.kind) not in known),
    )
    measured = read_durations(Path(out), on)
    wanted = None if findings else needs(on, loaded, measured)
    return ScriptCheck(
        trials=len(loaded.planned),
        poses=len({one.name for one in loaded.planned}),
        findings=findings,
        gone_through=rehearsal.trials if rehearsal else None,
        rendered=rehearsal.rendered if rehearsal else 0,
        recovered=rehearsal.recovered if rehearsal else {},
        unchecked=(*unchecked, *([f"the script as a whole: {why_not}"] if why_not else [])),
        needs=wanted,
        measured=measured,
        room=no_room(wanted.disk_mb, Path(out)) if wanted else "",
    )


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
            open_rig(rig, ("stage",)) as opened,
        ):
            opened.stage.connect()
            return opened.stage.settings, ""
    except RigInUseError:
        return None, "another bench has the rig"
    except InstrumentError:
        return None, "its controller doesn't answer"

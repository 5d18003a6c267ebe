"""Before a run: what would go wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from bench.api.loading import OUT, AnyRig, AnyScript, load_rig, load_script
from bench.config import all_of, check_within
from bench.dry_run.pose_checks import PoseFault, ScriptCheck, dry_run, stage_settings
from bench.dry_run.rehearsal import NoTwinError, rehearse
from bench.run.estimate import needs, no_room, read_durations
from bench.safety.latch import latch_path, read_latch, unconfirmed
from bench.script.calibration_age import not_fresh, refuse_old_calibration
from bench.script.detectors import introduced, make_detectors
from bench.script.model import refuse_carry
from instruments.clock import wall_time
from textfiles.bounds import FROM_0


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
    check_within(FROM_0, seed=seed)
    on, loaded = all_of(lambda _: load_rig(rig), lambda to: load_script(script, to[0]))
    today = wall_time().date()
    on.refuse_unfilled()
    refuse_carry(on, loaded)
    refuse_old_calibration(on, loaded, today)
    settings, why_not_asked = stage_settings(on)
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
        *([PoseFault("the rig", "latched", str(latch))] if latch else []),
        *(PoseFault("the rig", "refused", why) for why in unconfirmed(on, today)),
        *(PoseFault("the rig", "calibration", why) for why in not_fresh(on, loaded, today)),
        *of_poses,
        *(one for one in again if (one.trial, one.kind) not in known),
    )
    measured = read_durations(Path(out), on)
    wanted = None if findings else needs(on, loaded, measured)
    return ScriptCheck(
        trials=len(loaded.planned),
        poses=loaded.poses,
        findings=findings,
        gone_through=rehearsal.trials if rehearsal else None,
        rendered=rehearsal.rendered if rehearsal else 0,
        recovered=rehearsal.recovered if rehearsal else {},
        unchecked=(*unchecked, *([f"the script as a whole: {why_not}"] if why_not else [])),
        needs=wanted,
        measured=measured,
        room=no_room(wanted.disk_mb, Path(out)) if wanted else "",
    )

"""Builds the truth source that a script asks for, from the rig's settings and the open instruments;
what a source does then is in `bench.truth`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import hypot

from bench.config import ConfigError
from bench.record.reader import RunRecord
from bench.rig.loading import LoadedRig
from bench.rig.model import Stage as StageSettings
from bench.run.context import RunContext
from bench.script.model import LoadedScript
from bench.script.planned_trials import PlannedTrial, shared
from bench.truth.carrying import CarriedTruth, fixed_key, resumed
from bench.truth.registration import (
    Registration,
    RegistrationError,
    as_facts,
    registration_from_facts,
    write_registration,
)
from bench.truth.stage_registration import around, ends_of, register, stands_at
from bench.truth.touching import ExpectedScene, TouchedTruth, Toucher
from bench.truth.uncertainty import end_u_mm
from instruments.clock import wall_time
from instruments.errors import DeviceError, LimitError
from instruments.stage.driver import Stage
from instruments.world.phantom import PlatePose

REGISTRATION_FILE = "stage-registration.toml"  # in the run's folder, where it was made at its start
URGENT = ("invalid", "registration")  # what the operator has to see, not only the record
Settled = Callable[[Sequence[str], bool], None]


def refuse_carry(rig: LoadedRig, script: LoadedScript) -> None:
    """Raises ConfigError for a script that carries on a rig that has no stage to carry with."""
    if script.script.truth.mode == "carry" and rig.rig.stage is None:
        why = f'{script.path}: [truth] mode = "carry" needs a stage, and {rig.path} has none.'
        raise ConfigError.plain(f'{why} Use mode = "touch", or a rig with a [stage].')


def shown(trial: PlannedTrial, axes: str) -> ExpectedScene:
    """What stands there in ``trial`` when the stage's ``axes`` (of "XYZA", none without a stage)
    have moved it.
    """
    _, by_hand = shared(trial.pose, axes)
    return ExpectedScene(
        trial.id,
        ends_of(trial.phantom.moved(trial.pose)),
        fixed_key(trial.phantom, by_hand, trial.pose.yaw_rad),
    )


def choose_truth(
    ctx: RunContext, settled: Settled, *, before: RunRecord | None = None
) -> TouchedTruth:
    """The source for a run. ``settled`` is told which carried trials a check has confirmed (True)
    or invalidated.

    ``before`` is what a stopped run left, where it is to go on: its registration and its reference
    are used further.
    """
    table, stage, settings = ctx.script.script.truth, ctx.devices.stage, ctx.rig.rig.stage
    toucher = Toucher(ctx.ask, ctx.tip, ctx.rig.rig.arm, ctx.clock, ctx.check, table.readings)
    if table.mode == "touch":
        return TouchedTruth(toucher, lambda: None if stage is None else stands_at(stage))
    if stage is None or settings is None:
        raise ValueError("a truth can't be carried without a stage; refuse_carry says so before")
    known = registration_from_facts(before.facts) if before else None

    def tell(kind: str, text: str) -> None:
        ctx.event(kind, text)
        (ctx.events.warn if kind in URGENT else ctx.events.state)(text)

    return CarriedTruth(
        toucher,
        lambda: known or _registration(ctx, stage, settings, toucher),
        lambda: stands_at(stage),
        ctx.store,
        settled,
        tell,
        ctx.clock.now,
        every=table.check_every,
        limit_mm=table.check_limit_mm,
        state=resumed(before) if before else None,
    )


def _registration(
    ctx: RunContext, stage: Stage, settings: StageSettings, toucher: Toucher
) -> Registration:
    """The one that the script asks for: its file's, or one made now; either is a fact of the run.

    Raises LimitError where the file's doesn't hold any more, DeviceError where the touches give
    none, and as the instruments do.
    """
    found = ctx.script.registration
    if found is None:
        found = _made(ctx, stage, settings, toucher)
    else:
        # the world that it was made in has to be the one that the arm gives now
        made = ctx.rig.frame.made if ctx.rig.frame else None
        if why := found.outdated(ctx.devices.arm.identity.serial_number, made):
            what = f"its registration {ctx.script.script.truth.file} {why}"
            raise LimitError("stage", what, hint="Make it anew: 'teatbench calibrate stage'")
    for key, value in as_facts(found).items():
        ctx.store.fact(key, value)
    return found


def _made(ctx: RunContext, stage: Stage, settings: StageSettings, toucher: Toucher) -> Registration:
    planned, table = ctx.script.planned, ctx.script.script.truth
    phantom, teat = planned[0].phantom, table.registration_teat
    if teat > (there := len(phantom.teats)):
        what = f"registration_teat = {teat}, but the first trial's phantom has {there} teats"
        raise DeviceError("truth", what, hint="Name one of them in the script's [truth].")
    ctx.ask(planned[0].arrangement(settings.axes))
    poses = tuple(PlatePose(x, y) for x, y in table.registration_at_mm or ())
    poses = poses or around(shared(trial.pose, settings.axes)[0] for trial in planned)

    def tell(text: str) -> None:
        ctx.note(text)
        ctx.long("moving the stage", 600.0)

    try:
        made = register(
            stage,
            settings,
            toucher,
            phantom,
            poses,
            teat=teat,
            u_mm=hypot(end_u_mm(ctx.rig.rig.arm, toucher.readings), settings.repeatability_mm),
            made=wall_time().replace(microsecond=0),
            serial_number=ctx.devices.arm.identity.serial_number,
            tell=tell,
        )
    except RegistrationError as error:
        hint = "Name other places in the script's registration_at_mm."
        raise DeviceError("stage", str(error), hint=hint) from error
    write_registration(ctx.store.folder / REGISTRATION_FILE, made)
    return made

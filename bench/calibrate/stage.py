"""`calibrate stage`: one teat end touched at several stage positions. Nothing heats, no picture is
taken, but every instrument of the rig has to answer.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from bench.config import ConfigError, check_within
from bench.rig.loading import AnyRig, any_rig
from bench.rig.lock import lock_path, locked
from bench.rig.opening import open_instruments
from bench.rig.reconnecting import Reconnecting
from bench.script.phantom import find_layout, load_layout
from bench.truth.registration import Registration, RegistrationError
from bench.truth.stage_registration import PartialRegistration, around, register
from bench.truth.touching import TipReader, Toucher
from instruments.captures.capture import CaptureFile
from instruments.operators.operator import Arrangement, Homing
from instruments.world.phantom import PlatePose
from textfiles.bounds import COUNT, FROM_0
from textfiles.text import plural

SPAN_MM = 200.0  # of the positions where none are named


def calibrate_stage(
    rig: AnyRig,
    *,
    layout: str = "table-5-1",
    teat: int = 1,
    at_mm: Sequence[tuple[float, float]] = (),
    readings: int | None = None,
    seed: int | None = None,
    capture: CaptureFile | None = None,
    say: Callable[[str], None] = lambda _: None,
) -> Registration:
    """The stage's registration, for `write_registration`: the end of ``teat`` of a ``layout``
    touched ``readings`` times at each place ``at_mm`` from the reference place (none: corners and
    middle of 200 x 200 mm). Raises ConfigError before anything moves.
    """
    check_within(FROM_0, seed=seed)
    check_within(COUNT, teat=teat, readings=readings)
    rig = any_rig(rig)
    seed = rig.rig.seed if seed is None else seed
    settings = rig.rig.stage
    if settings is None:
        raise ConfigError.plain(f"{rig.path} has no [stage]: there is nothing to register.")
    try:
        path = find_layout(layout)
    except ValueError as error:
        raise ConfigError.plain(f"`layout` {layout}: {error}") from error
    phantom = load_layout(path).phantom(seed)
    if teat > (many := len(phantom.teats)):
        raise ConfigError.plain(f"`teat` {teat}: the layout {layout} has {plural(many, 'teat')}")
    poses = [PlatePose(x, y) for x, y in at_mm] or around([PlatePose()], SPAN_MM)
    if len(poses) < 3:
        raise ConfigError.plain(
            f"`at_mm`: {plural(len(poses), 'position')}; three or more are needed, not on a line"
        )
    with (
        locked(lock_path(rig), "calibrate stage", say),
        open_instruments(rig, seed=seed, capture=capture, warn=say) as devices,
    ):
        stage = devices.stage
        if stage is None:
            raise ValueError("the stage is in the rig file, and is not open")
        arm, operator = devices.arm, devices.operator
        tip = TipReader(arm, rig.rig.arm, rig.frame)
        try:
            arm.sign_on()
            tip.refuse_other_arm()
            operator.ask(Homing(arm.homing))
            arm.confirm_homed()
            stage.connect()
            stage.home()
            text = (
                f"Put the phantom on the stage, its teats as in layout {layout}, and fix it:"
                " it must not shift on its plate."
            )
            operator.ask(Arrangement("stage_registration", phantom, (), text))
            toucher = Toucher(operator.ask, tip, rig.rig.arm, devices.clock, lambda: None, readings)
            who = arm, operator.ask, devices.clock, say, rig.rig.limits.away_s
            given = stage, settings, toucher, PartialRegistration(), phantom, poses
            registering = partial(register, *given, teat=teat, report=say)
            return Reconnecting.of_arm(*who, stage=stage).keep(registering)
        except RegistrationError as error:
            raise ConfigError.plain(f"no registration: {error}") from error
        finally:  # the arm signed off, whatever came before
            devices.make_safe(lambda _: None, only=("arm",))

"""Builds the truth source that a script asks for, from the rig's settings and the open instruments.

The one module of this package that knows the bench's other parts; what a source does then is its
own business.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import hypot

from bench.config import ConfigError
from bench.record.reader import RunRecord
from bench.record.writer import Row, Store
from bench.rig.devices import Devices
from bench.rig.loading import LoadedRig
from bench.rig.model import Stage as StageSettings
from bench.run.context import Attention
from bench.script.model import LoadedScript
from bench.script.planned_trials import PlannedTrial, shared
from bench.truth.arm_tip import TipReader
from bench.truth.carrying import CarriedTruth, CheckRule, fixed_key, resumed
from bench.truth.registration import Registration, RegistrationError
from bench.truth.registration_file import as_facts, registration_from_facts, write_registration
from bench.truth.stage_registration import around, ends_of, register, stands_at
from bench.truth.touching import ExpectedScene, TouchedTruth, Toucher, TruthSource
from bench.truth.uncertainty import end_u_mm
from instruments.clock import wall_time
from instruments.errors import DeviceError, LimitError
from instruments.stage.driver import Stage
from instruments.world.phantom import PlatePose

REGISTRATION_FILE = "stage-registration.toml"  # in the run's folder, where it was made at its start
URGENT = ("invalid", "registration")  # what the operator has to see, not only the record


def refuse_carry(rig: LoadedRig, script: LoadedScript) -> None:
    """Raises ConfigError for a script that carries on a rig that has no stage to carry with."""
    if script.script.truth.mode == "carry" and rig.rig.stage is None:
        raise ConfigError.plain(
            f'{script.path}: [truth] mode = "carry" needs a stage, and {rig.path} has none. Use'
            ' mode = "touch", or a rig with a [stage].'
        )


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
    rig: LoadedRig,
    script: LoadedScript,
    devices: Devices,
    tip: TipReader,
    store: Store,
    attention: Attention,
    settled: Callable[[Sequence[str], bool], None],
    *,
    before: RunRecord | None = None,
) -> TruthSource:
    """The source for a run. ``settled`` is told which carried trials a check has confirmed (True)
    or invalidated.

    ``before`` is what a stopped run left, where it is to go on: its registration and its reference
    are used further.
    """
    table, stage, arm = script.script.truth, devices.stage, rig.rig.arm
    toucher = Toucher(
        lambda request: devices.operator.ask(request, attention.look),
        tip,
        arm,
        devices.clock,
        attention.check,
        table.readings,
    )
    if table.mode == "touch":
        return TouchedTruth(toucher, lambda: None if stage is None else stands_at(stage))
    if stage is None or rig.rig.stage is None:
        raise ValueError("a truth can't be carried without a stage; refuse_carry says so before")
    maker = _Maker(rig, script, devices, stage, rig.rig.stage, toucher, store, attention)
    rule = CheckRule(table.check_every, table.check_limit_mm)
    known = registration_from_facts(before.facts) if before else None
    registration = maker.registration if known is None else lambda: known
    return CarriedTruth(
        toucher,
        registration,
        lambda: stands_at(stage),
        rule,
        _Kept(store, settled),
        _telling(attention),
        devices.clock.now,
        resumed(before) if before else None,
    )


def _telling(attention: Attention) -> Callable[[str, str], None]:
    def tell(kind: str, text: str) -> None:
        attention.event(kind, text)
        (attention.progress.warn if kind in URGENT else attention.progress.state)(text)

    return tell


class _Kept:
    """The store, and whoever else wants to know what became of carried trials."""

    def __init__(self, store: Store, settled: Callable[[Sequence[str], bool], None]) -> None:
        self._store = store
        self._settled = settled

    def fact(self, key: str, value: object) -> None:
        self._store.fact(key, value)

    def checked(
        self, touches: Sequence[Row], confirmed: Sequence[str], invalid: Sequence[str], reason: str
    ) -> None:
        self._store.checked(touches, invalid, reason)
        if confirmed:
            self._settled(confirmed, True)
        if invalid:
            self._settled(invalid, False)


class _Maker:
    """Gives the registration that the script asks for: its file's, or one made now; either is a
    fact of the run.
    """

    def __init__(
        self,
        rig: LoadedRig,
        script: LoadedScript,
        devices: Devices,
        stage: Stage,
        settings: StageSettings,
        toucher: Toucher,
        store: Store,
        attention: Attention,
    ) -> None:
        self._rig = rig
        self._script = script
        self._devices = devices
        self._stage = stage
        self._settings = settings
        self._toucher = toucher
        self._store = store
        self._attention = attention

    def registration(self) -> Registration:
        """Raises LimitError where the file's doesn't hold any more, DeviceError where the touches
        give none, and as the instruments do.
        """
        found = self._script.registration
        if found is None:
            found = self._made()
        else:
            self._refuse_outdated(found)
        for key, value in as_facts(found).items():
            self._store.fact(key, value)
        return found

    def _refuse_outdated(self, found: Registration) -> None:
        """The world that it was made in has to be the one that the arm gives now."""
        frame = self._rig.frame
        why = found.outdated(
            self._devices.arm.identity.serial_number, frame.made if frame else None
        )
        if why:
            name = self._script.script.truth.file
            raise LimitError(
                "stage",
                f"its registration {name} {why}",
                hint="Make it anew: 'teatbench calibrate stage'",
            )

    def _made(self) -> Registration:
        first, arm, table = self._script.planned[0], self._rig.rig.arm, self._script.script.truth
        if table.registration_teat > len(first.phantom.teats):
            what = (
                f"registration_teat = {table.registration_teat}, but the first trial's phantom has"
                f" {len(first.phantom.teats)} teats"
            )
            raise DeviceError("truth", what, hint="Name one of them in the script's [truth].")
        self._devices.operator.ask(first.arrangement(self._settings.axes), self._attention.look)
        try:
            made = register(
                self._stage,
                self._settings,
                self._toucher,
                first.phantom,
                self._poses(),
                teat=table.registration_teat,
                u_mm=hypot(end_u_mm(arm, self._toucher.readings), self._settings.repeatability_mm),
                made=wall_time().replace(microsecond=0),
                serial_number=self._devices.arm.identity.serial_number,
                tell=self._tell,
            )
        except RegistrationError as error:
            raise DeviceError(
                "stage", str(error), hint="Name other places in the script's registration_at_mm."
            ) from error
        write_registration(self._store.folder / REGISTRATION_FILE, made)
        return made

    def _poses(self) -> tuple[PlatePose, ...]:
        named = self._script.script.truth.registration_at_mm
        if named:
            return tuple(PlatePose(x, y) for x, y in named)
        return around(shared(trial.pose, self._settings.axes)[0] for trial in self._script.planned)

    def _tell(self, text: str) -> None:
        self._attention.note(text)
        self._attention.long("moving the stage", 600.0)

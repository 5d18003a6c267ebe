"""Before the first trial: arm signed on and homed, arm check, stage homed, bath started; each step
again where an instrument drops out.

In a session that goes on all of it is done again; what it finds of the arm is kept apart from what
the run began with. May not know trials.
"""

from __future__ import annotations

from bench.record.writer import Store
from bench.rig.devices import Devices
from bench.rig.loading import LoadedRig
from bench.run.context import Attention
from bench.run.metadata import write_arm_facts
from bench.run.recovery import Recovery
from bench.script.model import Script
from bench.truth.arm_check import BEFORE, CHECK_FACT, check_arm, told
from bench.truth.arm_tip import TipReader
from instruments.bath.sequence import start_bath
from instruments.operators.operator import Homing

HOMING = "Put the arm's stylus on its peg, switch the arm on, and leave the stylus there."


class Preparation:
    """Prepares the rig for ``script``; ``session`` is 1 for a run that begins."""

    def __init__(
        self,
        rig: LoadedRig,
        script: Script,
        devices: Devices,
        store: Store,
        tip: TipReader,
        attention: Attention,
        recovery: Recovery,
        session: int,
    ) -> None:
        self._loaded = rig
        self._script = script
        self._devices = devices
        self._store = store
        self._tip = tip
        self._attention = attention
        self._recovery = recovery
        self._session = session

    def run(self) -> None:
        """All steps in their order. Raises what no further try can cure."""
        d = self._devices
        self._attention.note("preparing")
        self._attention.watch.start()
        self._recovery.run("signing on to the arm", self._sign_on)
        self._recovery.run("the arm check", lambda: self.check_arm(BEFORE))
        self._attention.check()
        if d.stage:
            self._recovery.run("homing the stage", self._home_stage)
        self._fact("identities", d.identities())
        self._fact("arm record", d.arm.record())
        self._attention.note(f"heating the bath to {self._script.bath.set_point_c:g} degC")
        self._recovery.run("starting the bath", self._start_bath)
        self._attention.watch.heating()

    def check_arm(self, when: str) -> None:
        """Touch the rig's check point, where it names one; what was found is a fact for the
        script's requirement.
        """
        arm, d = self._loaded.rig.arm, self._devices
        if arm.check_point_mm is None:
            return
        self._attention.progress.state(f"checking the arm {when} the trials")
        fact = check_arm(
            lambda request: d.operator.ask(request, self._attention.look),
            self._tip,
            arm,
            d.clock,
            self._attention.check,
        )
        name = CHECK_FACT.format(when)
        if when == BEFORE:
            self._fact(name, fact)
        else:
            self._store.fact(name, fact)
        self._attention.event("arm", told(fact, when))

    def _fact(self, key: str, value: object) -> None:
        """Under its own name in the first session, apart from it in each later one."""
        self._store.fact(key if self._session == 1 else f"{key}, session {self._session}", value)

    def _sign_on(self) -> None:
        arm = self._devices.arm
        self._attention.long("signing on to the arm", 120.0)
        arm.sign_on()
        write_arm_facts(self._store, self._loaded)
        self._tip.refuse_other_arm()
        self._devices.operator.ask(Homing(HOMING), self._attention.look)
        arm.confirm_homed()

    def _home_stage(self) -> None:
        stage = self._devices.stage
        if stage is None:
            return
        self._attention.long("homing the stage", 600.0)
        stage.connect()
        self._attention.look()  # not check: what was announced goes on
        stage.home()
        self._attention.check()

    def _start_bath(self) -> None:
        self._attention.long("starting the bath", 60.0)
        start_bath(self._devices.bath, self._script.bath.set_point_c, self._attention.wait)

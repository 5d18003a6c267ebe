"""An instrument that drops out pauses the run; the operator hears what to check; it goes on when the instrument is back.

What was under way is done again whole by whoever asked: nothing half done is kept. How often, and for what, is `retries`' table;
how long is waited is the rig's. Interlocks go on being looked at meanwhile, and may end the wait; so may somebody who gives up what waits:
then what comes next waits on. May not know trials.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from bench.devices import Devices
from bench.running.attention import Attention
from bench.running.retries import Policy, instrument_of, kind_of, policy_for
from bench.running.run_state import RunState, RunStates
from instruments.camera.cameras import CameraSet
from instruments.errors import DeviceError, InstrumentError

EVERY_S = 2.0  # between attempts to reach it
HOMING = "The arm was lost: put its stylus on its peg, see that it is switched on, and leave the stylus there."
SETTLED_S = 1.0


class Recovery:
    """Runs work that instruments may interrupt. ``patience_s`` is how long one that has dropped out is waited for.

    ``look`` raises while the cameras give nothing usable.
    """

    def __init__(self, devices: Devices, attention: Attention, states: RunStates, patience_s: float, look: Callable[[], None]) -> None:
        self._look = look
        self._devices = devices
        self._attention = attention
        self._states = states
        self._patience_s = patience_s
        self._missing: tuple[InstrumentError, Policy] | None = None
        self.counts: Counter[str] = Counter()

    def run(self, what: str, work: Callable[[], None]) -> None:
        """Do ``work`` until it is done. Raises a fault that has no policy, or came too often, or whose instrument does not come back."""
        tried: Counter[str] = Counter()
        if self._missing:  # whoever waited for it was told to do something else, and it may be back, but not where it was
            self._pause(what, *self._missing, "still away")
        while True:
            self._attention.check()
            try:
                return work()
            except InstrumentError as fault:
                self._attention.watch.check()  # a stage that a trip has braked is not to be homed again
                policy = policy_for(fault)
                kind = f"{instrument_of(fault)} {kind_of(fault)}"
                tried[kind] += 1
                if policy is None or tried[kind] > policy.times:
                    raise
                self.counts[kind] += 1
                self._pause(what, fault, policy, f"try {tried[kind]} of {policy.times}")

    def _pause(self, what: str, fault: InstrumentError, policy: Policy, count: str) -> None:
        """Until the instrument is back; then as before. Raises ``fault`` where it stays away."""
        name = str(instrument_of(fault))
        are = "are" if name == "cameras" else "is"
        self._missing = (fault, policy)
        started_s = self._attention.now_s()
        if name == "arm":
            self._devices.operator.release()
        with self._states.during(RunState.PAUSED):
            self._attention.event("dropped out", f"{what}: {fault} ({count})")
            self._attention.progress.warn(f"{fault}\nThe run is paused. {policy.check} It goes on by itself when the {name} {are} back.")
            while not self._back(name):
                if self._attention.now_s() - started_s >= self._patience_s:
                    self._attention.event("given up", f"the {name} did not come back within {self._patience_s:g} s")
                    raise fault
                self._attention.wait(EVERY_S)
            self._attention.check()
            away_s = self._attention.now_s() - started_s
            self._attention.event("back", f"the {name} {are} back after {away_s:.1f} s; done again from its start: {what}")
        self._missing = None

    def _back(self, name: str) -> bool:
        self._attention.progress.state(f"waiting for the {name}")
        try:
            {"arm": self._arm, "stage": self._stage, "bath": self._bath, "cameras": self._cameras}[name]()
        except InstrumentError:
            return False
        return True

    def _arm(self) -> None:
        """Signed on again, and its home counts loaded on its peg: nobody can tell whether it kept its power, and where it stood then."""
        arm = self._devices.arm
        self._attention.long("looking for the arm", 120.0)
        arm.recover(EVERY_S)
        self._devices.operator.confirm_homing(HOMING)
        arm.home()

    def _stage(self) -> None:
        """Restarted and homed: where it stands nobody knows."""
        stage = self._devices.stage
        if stage is None:
            raise DeviceError("stage", "this rig has none")
        self._attention.long("homing the stage again", 600.0)
        stage.reconnect()
        self._attention.look()  # that took its time, and a stage that a trip has braked meanwhile is not to move
        stage.home()

    def _bath(self) -> None:
        """The driver connects again by itself."""
        self._devices.bath.read()

    def _cameras(self) -> None:
        """Opened again where that is how they are; back is what gives a usable frame set."""
        self._attention.wait(SETTLED_S)
        self._attention.long("opening the cameras again", 60.0, silent=True)
        cameras = self._devices.cameras
        if isinstance(cameras, CameraSet):
            cameras.reopen()
        self._look()

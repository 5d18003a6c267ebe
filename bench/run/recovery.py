"""What the bench does about each kind of fault of an instrument: how often it tries again, what a
person has to check, and how the instrument is brought back.

What is not in the table ends the run at once: limits that were refused before anything was sent, a
bath that says no, whatever is no instrument's. An instrument that drops out pauses the run; what
was under way is done again whole when it is back: nothing half done is kept. Interlocks go on being
looked at meanwhile, and may end the wait; so may somebody who gives up what waits: then what comes
next waits on.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from bench.run.context import RunContext
from bench.run.states import RunState
from instruments.camera.cameras import CameraSet
from instruments.errors import DeviceError, InstrumentError, LinkError, ProtocolError
from instruments.microscribe.errors import AnotherArmError, UnusableArmError
from instruments.operators.operator import Homing, Release

INSTRUMENTS = ("arm", "stage", "bath", "cameras")
GONE, GARBLED, REFUSES = "gone", "garbled", "refuses"


@dataclass(frozen=True, slots=True)
class Policy:
    """``times`` it is tried again in one trial, or one step of preparing, at most; ``check`` is for
    the person.
    """

    times: int
    check: str


HOMES = "keep your hands off it, it will home."
POLICIES: Mapping[tuple[str, str], Policy] = {
    ("arm", GONE): Policy(3, "Check the arm's power and its cable."),
    ("arm", GARBLED): Policy(3, "Check the arm's cable and plugs, and what disturbs it."),
    ("stage", GONE): Policy(3, f"Check the stage's power and its cable; {HOMES}"),
    ("stage", GARBLED): Policy(3, f"Check the stage's cable and what disturbs it; {HOMES}"),
    ("stage", REFUSES): Policy(1, f"Look whether something is in the stage's way; {HOMES}"),
    ("bath", GONE): Policy(3, "Check the bath's power and its cable."),
    ("bath", GARBLED): Policy(3, "Check the bath's cable, its address and what disturbs it."),
    ("cameras", GONE): Policy(3, "Check the cameras' power and cables."),
    ("cameras", GARBLED): Policy(3, "Check the cameras' cables and settings."),
    ("cameras", REFUSES): Policy(2, "Look at the cameras: lens caps, light, focus, trigger."),
}


def instrument_of(fault: InstrumentError) -> str | None:
    """Whose fault it is, by who the error names; None where it is no instrument's."""
    who = fault.who.lower()
    if "camera" in who:
        return "cameras"
    first = who.replace(":", " ").split()[0] if who.split() else ""
    return {"pump": "bath"}.get(first, first if first in INSTRUMENTS else None)


def kind_of(fault: InstrumentError) -> str | None:
    """Gone, garbled or refuses; None for what no second try can cure."""
    if isinstance(fault, AnotherArmError | UnusableArmError):
        return None
    kinds = ((LinkError, GONE), (ProtocolError, GARBLED), (DeviceError, REFUSES))
    return next((kind for error, kind in kinds if isinstance(fault, error)), None)


def policy_for(fault: InstrumentError) -> Policy | None:
    """What to do about ``fault``; None to end the run."""
    instrument, kind = instrument_of(fault), kind_of(fault)
    return POLICIES.get((instrument, kind)) if instrument and kind else None


EVERY_S = 2.0  # between attempts to reach it
HOMING = (
    "The arm was lost: put its stylus on its peg, see that it is switched on, and leave the stylus"
    " there."
)
SETTLED_S = 1.0


class Recovery:
    """Runs work that instruments may interrupt; one that has dropped out is waited for as long as
    the rig says. ``look`` raises while the cameras give nothing usable.
    """

    def __init__(self, ctx: RunContext, look: Callable[[], None]) -> None:
        self._ctx = ctx
        self._look = look
        self._patience_s = ctx.rig.rig.limits.away_s
        self._missing: tuple[InstrumentError, Policy] | None = None
        self.counts: Counter[str] = Counter()

    def run(self, what: str, work: Callable[[], None]) -> None:
        """Do ``work`` until it is done. Raises a fault that has no policy, or came too often, or
        whose instrument does not come back.
        """
        tried: Counter[str] = Counter()
        # whoever waited for it was told to do something else, and it may be back, but not where it
        # was
        if self._missing:
            self._pause(what, *self._missing, "still away")
        while True:
            self._ctx.check()
            try:
                return work()
            except InstrumentError as fault:
                # a stage that a trip has braked is not to be homed again
                self._ctx.watch.check()
                policy = policy_for(fault)
                kind = f"{instrument_of(fault)} {kind_of(fault)}"
                tried[kind] += 1
                if policy is None or tried[kind] > policy.times:
                    raise
                self.counts[kind] += 1
                self._pause(what, fault, policy, f"try {tried[kind]} of {policy.times}")

    def _pause(self, what: str, fault: InstrumentError, policy: Policy, count: str) -> None:
        """Until the instrument is back; then as before. Raises ``fault`` where it stays away."""
        ctx, name = self._ctx, str(instrument_of(fault))
        are = "are" if name == "cameras" else "is"
        self._missing = (fault, policy)
        started_s = ctx.clock.now()
        if name == "arm":
            ctx.ask(Release())
        with ctx.states.during(RunState.PAUSED):
            ctx.event("dropped out", f"{what}: {fault} ({count})")
            then = f"{policy.check} It goes on by itself when the {name} {are} back."
            ctx.events.warn(f"{fault}\nThe run is paused. {then}")
            while not self._back(name):
                if ctx.clock.now() - started_s >= self._patience_s:
                    why = f"the {name} did not come back within {self._patience_s:g} s"
                    ctx.event("given up", why)
                    raise fault
                ctx.wait(EVERY_S)
            ctx.check()
            told = f"the {name} {are} back after {ctx.clock.now() - started_s:.1f} s"
            ctx.event("back", f"{told}; done again from its start: {what}")
        self._missing = None

    def _back(self, name: str) -> bool:
        self._ctx.events.state(f"waiting for the {name}")
        bath = self._ctx.devices.bath  # its driver connects again by itself
        back: dict[str, Callable[[], object]] = {
            "arm": self._arm,
            "stage": self._stage,
            "bath": bath.read,
            "cameras": self._cameras,
        }
        try:
            back[name]()
        except InstrumentError:
            return False
        return True

    def _arm(self) -> None:
        """Signed on again, and its home counts loaded on its peg: nobody can tell whether it kept
        its power, and where it stood then.
        """
        arm = self._ctx.devices.arm
        self._ctx.long("looking for the arm", 120.0)
        arm.recover(EVERY_S)
        self._ctx.ask(Homing(HOMING))
        arm.home()

    def _stage(self) -> None:
        """Restarted and homed: where it stands nobody knows."""
        stage = self._ctx.devices.stage
        if stage is None:
            raise DeviceError("stage", "this rig has none")
        self._ctx.long("homing the stage again", 600.0)
        stage.reconnect()
        # that took its time, and a stage that a trip has braked meanwhile is not to move
        self._ctx.look()
        stage.home()

    def _cameras(self) -> None:
        """Opened again where that is how they are; back is what gives a usable frame set."""
        self._ctx.wait(SETTLED_S)
        self._ctx.long("opening the cameras again", 60.0, silent=True)
        cameras = self._ctx.devices.cameras
        if isinstance(cameras, CameraSet):
            cameras.reopen()
        self._look()

"""An instrument that drops out and comes back: which one a fault is of and of what kind, what a
person checks then, how it is reached and homed again, and the wait for it. A run waits as
`bench.run.interruptions` says; outside of a run `Reconnecting` waits.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from instruments.clock import Clock
from instruments.drivers.protocols import Arm, Stage
from instruments.errors import DeviceError, DriverError, InstrumentError, LinkError, ProtocolError
from instruments.microscribe.errors import AnotherArmError, UnusableArmError
from instruments.operators.operator import Homing, Request, Task

Done = TypeVar("Done")

INSTRUMENTS = ("arm", "stage", "bath", "cameras")
GONE, GARBLED, REFUSES = "gone", "garbled", "refuses"
EVERY_S = 2.0  # between attempts to reach it


@dataclass(frozen=True, slots=True)
class Policy:
    """At most ``times`` tries in a trial or a step of preparing; ``check`` is for the person."""

    times: int
    check: str


PICTURES = ("cameras", REFUSES)  # they answer, and none of their pictures is of use
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
    PICTURES: Policy(2, "Look at the cameras: cables, lens caps, light, focus, trigger."),
}


def diagnosis(fault: InstrumentError) -> tuple[str, str]:
    """Which instrument, and if it is gone, garbled or refuses; "" for what can't be retried."""
    who = fault.who.lower()
    first = (who.replace(":", " ").split() or [""])[0]
    instrument = "cameras" if "camera" in who else "bath" if first == "pump" else first
    kinds: dict[type[InstrumentError], str] = {AnotherArmError: "", UnusableArmError: ""}
    kinds |= {LinkError: GONE, ProtocolError: GARBLED, DriverError: GARBLED, DeviceError: REFUSES}
    kind = next((kind for error, kind in kinds.items() if isinstance(fault, error)), "")
    return instrument if instrument in INSTRUMENTS else "", kind


def to_check(fault: InstrumentError, policy: Policy) -> str:
    """What a person checks. Pictures of no use have their own cure: cold water is no cable's."""
    return (diagnosis(fault) == PICTURES and fault.hint) or policy.check


def goes_on(fault: InstrumentError) -> str:
    """When it goes on without a key."""
    if diagnosis(fault) == PICTURES:
        return "It goes on by itself when the cameras' pictures are usable."
    name = diagnosis(fault)[0]
    return f"It goes on by itself when the {name} {'are' if name == 'cameras' else 'is'} back."


def no_step() -> None:
    """Nothing more is done."""


def reach_arm(
    arm: Arm, ask: Callable[[Request], object], answers: Callable[[], None] = no_step
) -> None:
    """Connect once more, and home. ``answers`` is called between, and may raise. Raises
    InstrumentError while it is away.
    """
    arm.recover(EVERY_S)
    answers()
    ask(Homing(arm.homing_again))
    arm.home()


def reach_stage(stage: Stage, answers: Callable[[], None] = no_step) -> None:
    """The same for a stage."""
    stage.reconnect()
    answers()
    stage.home()


def wait_for(
    attempt: Callable[[], object],
    fault: InstrumentError,
    patience_s: float,
    now: Callable[[], float],
    wait: Callable[[float], None],
    say: Callable[[str], None],
) -> None:
    """Wait until ``attempt`` passes. Raises ``fault`` after ``patience_s``, and what ``wait``
    raises. ``say`` gets each new reason but a link without an answer; one with other figures is
    not new.
    """
    started_s, said = now(), _reason(fault)
    while True:
        try:
            attempt()
            return
        except InstrumentError as why:
            if not isinstance(why, LinkError) and _reason(why) != said:
                said = _reason(why)
                say(str(why))
        if now() - started_s >= patience_s:
            raise fault
        wait(EVERY_S)


def _reason(fault: InstrumentError) -> str:
    return re.sub(r"[\d.]+( tr(y|ies)\b)?", "", str(fault))


TRIES = 10  # of one piece of work outside of a run: a person is there each time, who can end it
BLOCKED = "Look whether something is in the stage's way. Then keep your hands off it: it will home."


def is_loss(fault: InstrumentError) -> bool:
    """Whether an instrument is gone, or nothing that comes from it is of use."""
    return diagnosis(fault)[1] in (GONE, GARBLED)


@dataclass(frozen=True, slots=True, eq=False)
class Reconnecting:
    """Waits outside of a run for an instrument that drops out, ``away_s`` each time. ``ready``, by
    the instrument's name, makes it ready again, and raises while it is away. ``ask`` and ``say``
    reach the person; ``kept`` is the sentence that nothing is lost.
    """

    ready: Mapping[str, Callable[[], object]]
    ask: Callable[[Request], object]
    clock: Clock
    say: Callable[[str], None]
    away_s: float
    kept: str = "What was touched so far is kept."

    @classmethod
    def of_arm(
        cls,
        arm: Arm,
        ask: Callable[[Request], object],
        clock: Clock,
        say: Callable[[str], None],
        away_s: float,
        *,
        stage: Stage | None = None,
        look: Callable[[], object] | None = None,
        homed: Callable[[], None] = no_step,
    ) -> Reconnecting:
        """For an arm, also a stage and cameras where given. ``look`` raises while the cameras are
        away; ``homed`` is called each time the arm was homed again.
        """

        def ready_arm() -> None:
            reach_arm(arm, ask)
            homed()

        ready: dict[str, Callable[[], object]] = {"arm": ready_arm}
        ready |= {"stage": partial(reach_stage, stage)} if stage else {}
        ready |= {"cameras": look} if look else {}
        return cls(ready, ask, clock, say, away_s)

    def keep(self, work: Callable[[], Done]) -> Done:
        """What ``work`` gives, done again after a loss. Raises as it, and as `wait`."""
        for _ in range(TRIES):
            try:
                return work()
            except InstrumentError as fault:
                self.wait(fault)
        return work()

    def wait(self, fault: InstrumentError) -> None:
        """Wait until the instrument of ``fault`` is ready again; a person looks at a stage that
        refuses first. Raises ``fault`` where it stays away, and one that is no loss of an
        instrument in ``ready``; OperatorAbort.
        """
        name, how = diagnosis(fault)
        jammed = (name, how) == ("stage", REFUSES)
        ready, policy = self.ready.get(name), POLICIES.get((name, how))
        if ready is None or policy is None or not (is_loss(fault) or jammed):
            raise fault
        are = "are" if name == "cameras" else "is"
        if jammed:
            self.say(f"{fault}\n{self.kept}")
            self.ask(Task(BLOCKED))
        else:
            self.say(f"{fault}\n{policy.check} {self.kept} {goes_on(fault)}")
        wait_for(ready, fault, self.away_s, self.clock.now, self.clock.sleep, self.say)
        homed = "" if name == "cameras" else ", and homed again"
        self.say(f"The {name} {are} back{homed}.")

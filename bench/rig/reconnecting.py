"""An arm or a stage that drops out while a person works with it, outside of a run: it is waited
for, homed again, and what was under way is asked for once more. What was touched before is kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from instruments.clock import Clock
from instruments.drivers.protocols import Arm, Stage
from instruments.errors import DeviceError, DriverError, InstrumentError, LinkError, ProtocolError
from instruments.microscribe.errors import UnusableArmError
from instruments.operators.operator import Homing, Request, Task

Done = TypeVar("Done")

TRIES = 10  # of one piece of work: a person is there each time, who can end it
EVERY_S = 2.0  # between attempts to reach it
CHECK = {
    "arm": "Check the arm's power and its cable.",
    "stage": "Check the stage's power and its cable; keep your hands off it, it will home.",
}
BLOCKED = "Look whether something is in the stage's way. Then keep your hands off it: it will home."


@dataclass(slots=True, eq=False)
class Reconnecting:
    """Waits for ``arm`` and ``stage`` (None: there is none), for ``away_s`` each time; ``ask`` and
    ``say`` speak to the person.
    """

    arm: Arm
    ask: Callable[[Request], object]
    clock: Clock
    say: Callable[[str], None]
    away_s: float
    stage: Stage | None = None

    def keep(self, work: Callable[[], Done]) -> Done:
        """What ``work`` gives, done again after a loss. Raises as it, and as `wait`."""
        for _ in range(TRIES):
            try:
                return work()
            except InstrumentError as fault:
                self.wait(fault)
        return work()

    def wait(self, fault: InstrumentError) -> None:
        """Until what ``fault`` speaks of is back, and homed; a stage that refuses is looked at by
        the person first. Raises ``fault`` where it stays away, and one that is no loss of the arm
        or the stage; OperatorAbort.
        """
        name = (fault.who.lower().replace(":", " ").split() or [""])[0]
        gone = isinstance(fault, (LinkError, ProtocolError, DriverError))
        refuses = isinstance(fault, DeviceError) and not gone and name == "stage"
        there = name == "arm" or (name == "stage" and self.stage is not None)
        if not (there and (gone or refuses)) or isinstance(fault, UnusableArmError):
            raise fault
        kept = "What was touched so far is kept."
        if refuses:
            self.say(f"{fault}\n{kept}")
            self.ask(Task(BLOCKED))
        else:
            back = f"It goes on by itself when the {name} is back."
            self.say(f"{fault}\n{CHECK[name]} {kept} {back}")
        end_s, said = self.clock.now() + self.away_s, str(fault)
        while why := self._missing(name):
            if self.clock.now() >= end_s:
                raise fault
            if not isinstance(why, LinkError) and str(why) != said:
                said = str(why)
                self.say(said)
            self.clock.sleep(EVERY_S)
        self.say(f"The {name} is back, and homed again.")

    def _missing(self, name: str) -> InstrumentError | None:
        """Look for it once: what keeps it away; None where it is back."""
        try:
            if name == "arm":
                self.arm.recover(EVERY_S)
                self.ask(Homing(self.arm.homing_again))
                self.arm.home()
            elif self.stage:
                self.stage.reconnect()
                self.stage.home()
        except InstrumentError as why:
            return why
        return None

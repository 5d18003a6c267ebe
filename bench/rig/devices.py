"""The instruments of an open rig: who they are, and how they are made safe."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.rig.by_hand import BY_HAND, silent
from instruments.bath.sequence import cause_of, heater_off, pump_off, run_pump_on
from instruments.clock import Clock
from instruments.drivers.protocols import Arm, Bath, Cameras, Stage
from instruments.errors import InstrumentError
from instruments.operators.operator import Operator


class Evidence(StrEnum):
    """What a step of going to safe stands on."""

    READ_BACK = "read back"
    SENT = "sent, not acknowledged"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Safing:
    """A step of going to safe. ``done``: what the instrument said of itself; ``detail``: why the
    step failed, or what else there is to say; ``brief``: why it failed, for one who has to act.
    """

    name: str
    evidence: Evidence
    done: str = "is safe"
    detail: str = ""
    brief: str = ""

    @property
    def is_safe(self) -> bool:
        """Whether the instrument itself says so."""
        return self.evidence is Evidence.READ_BACK

    @property
    def texts(self) -> list[str]:
        """For terminal, console, record and report: all have these."""
        if self.evidence is Evidence.FAILED:
            if self.name == "arm":  # nothing in it heats or moves
                return [f"arm: its session was not ended; it has no motor: {self.detail}"]
            return [f"{self.name} could not be made safe: {self.detail}"]
        if self.evidence is Evidence.SENT:
            return [f"{self.name}: {self.detail or 'the order to stop was'} {self.evidence}"]
        return [f"{self.name} {self.done}", *([self.detail] if self.detail else [])]


def attempt(name: str, step: Callable[[], object], done: str = "is safe") -> Safing:
    """``step``, whatever it raises: it reads back what it does, and may return a further text."""
    try:
        return Safing(name, Evidence.READ_BACK, done, str(step() or ""))
    except BaseException as error:  # whatever it is, the next step is tried too
        brief = error.what if isinstance(error, InstrumentError) else cause_of(error)
        return Safing(name, Evidence.FAILED, done, cause_of(error), brief)


@dataclass(frozen=True, slots=True)
class Devices:
    """All that is open. ``exact_ends``, world mm (n, 3), is there on an emulated rig only.
    ``answered_s``: when each instrument last answered; ``safed``: how making it safe went;
    ``practice``: while it lasts, what is left in a run's folder happens to emulators in real time.
    """

    clock: Clock
    arm: Arm
    bath: Bath
    stage: Stage | None
    cameras: Cameras
    operator: Operator
    exact_ends: Callable[[], NDArray[np.float64]] | None = None
    answered_s: dict[str, float] = field(default_factory=dict)
    safed: dict[str, Safing] = field(default_factory=dict)
    practice: Callable[[Path], AbstractContextManager[None]] = lambda _: nullcontext()

    def identities(self) -> dict[str, dict[str, str]]:
        """What each instrument says of itself; where it was reached stands in the rig file."""
        stage = {"stage": asdict(self.stage.identity)} if self.stage else {}
        bath = {key: value for key, value in self.bath.identity.items() if key != "url"}
        cameras = dict(self.cameras.identity)
        return {"arm": asdict(self.arm.identity), "bath": bath, **stage, "cameras": cameras}

    def safe_states(self) -> dict[str, str]:
        drivers = {"bath": self.bath, "stage": self.stage, "arm": self.arm}
        states = {name: driver.safe_state for name, driver in drivers.items() if driver}
        return {**states, "cameras": "nothing to make safe"}

    @property
    def active(self) -> tuple[str, ...]:
        """What was made to heat, move or turn by these drivers, and not read back at rest since."""
        bath: Bath | None = self.bath  # of a rig opened in part
        found: list[str] = []
        if bath and bath.heats:
            found += ["bath", "pump"]
        elif bath and bath.pump_on:
            found.append("pump alone")
        if self.stage and self.stage.moves:
            found.append("stage")
        if self.arm and self.arm.moves:
            found.append("arm")
        return tuple(found)

    def make_safe(
        self,
        report: Callable[[str], None],
        cut_short: Callable[[], bool] = lambda: False,
        *,
        only: Collection[str] = ("bath", "stage", "arm", "pump"),
    ) -> Mapping[str, str]:
        """Bath to standby, stage still, arm's session ended, whatever a step raises. Gives back
        what failed of that which heats, moves or turns, heat first: by name what to do by hand, and
        why. ``cut_short`` ends the pump's run-on; ``only``: these of them.
        """
        steps: dict[str, Callable[[], object]] = {
            "bath": lambda: heater_off(self.bath),
            "stage": self.stage.safe if self.stage else lambda: None,
            "arm": lambda: self.arm.safe(),
            "pump": lambda: run_pump_on(self.bath, self.clock.sleep, cut_short),
            "pump alone": lambda: pump_off(self.bath),
        }
        unsafe: dict[str, str] = {}
        for name, step in steps.items():
            if name not in only or (name == "stage" and self.stage is None):
                continue
            robot = name == "arm" and self.arm.touches  # which has a motor
            found = attempt("robot" if robot else name.split()[0], step)
            self.safed[found.name] = found
            if not found.is_safe and found.name in BY_HAND:
                answered_s = self.answered_s.get(found.name)
                age_s = None if answered_s is None else self.clock.now() - answered_s
                unsafe[found.name] = f"{BY_HAND[found.name]}: {silent(found.brief, age_s)}"
            for text in found.texts[name.startswith("pump") and found.is_safe :]:
                report(text)
        return unsafe

"""The instruments of an open rig: who they are, and how they are made safe."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from instruments.bath.driver import Bath
from instruments.bath.sequence import cause_of, heater_off, run_pump_on
from instruments.camera.frame import FrameSet
from instruments.clock import Clock
from instruments.microscribe.driver import MicroScribe
from instruments.operators.operator import Operator
from instruments.points import PointArm
from instruments.stage.driver import Stage

AnyArm = MicroScribe | PointArm


class Cameras(Protocol):
    """Whatever gives frame sets: real cameras, a recording, the scene."""

    @property
    def identity(self) -> Mapping[str, str]: ...
    def capture(self) -> FrameSet: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Devices:
    """All that is open. ``exact_ends``, world mm (n, 3), is there on an emulated rig only."""

    clock: Clock
    arm: AnyArm
    bath: Bath
    stage: Stage | None
    cameras: Cameras
    operator: Operator
    exact_ends: Callable[[], NDArray[np.float64]] | None = None

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

    def make_safe(
        self, report: Callable[[str], None], cut_short: Callable[[], bool] = lambda: False
    ) -> tuple[str, ...]:
        """Bath to standby, stage still, arm's session ended, whatever a step raises; the names that
        failed. ``cut_short`` ends the pump's run-on.
        """
        steps: dict[str, Callable[[], object]] = {"bath": lambda: heater_off(self.bath)}
        if self.stage:
            steps["stage"] = self.stage.safe
        steps |= {
            "arm": self.arm.safe,
            "pump": lambda: run_pump_on(self.bath, self.clock.sleep, cut_short),
        }
        unsafe: list[str] = []
        for name, step in steps.items():
            try:
                said = step()
                if name != "pump":
                    report(f"{name} is safe")
                if said:
                    report(str(said))
            except BaseException as error:
                unsafe.append(name)
                report(f"{name} could not be made safe: {cause_of(error)}")
        return tuple(unsafe)

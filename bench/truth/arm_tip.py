"""The arm's tip in the world: the one place where a reading, which is in the arm's own frame,
becomes a point of the table.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bench.rig.arm_files import TableFrame
from bench.rig.model import Arm
from instruments.errors import LimitError
from instruments.microscribe.configuration import Identity
from instruments.microscribe.stream import Reading


class ReadableArm(Protocol):
    """What is asked of the driver."""

    @property
    def identity(self) -> Identity: ...
    def read(self, n: int = 8, max_spread_mm: float = 1.0) -> Reading: ...


class TipReader:
    """Reads ``arm`` as the rig says. Without a ``frame`` the arm's own frame is the world, as in
    the thesis.
    """

    def __init__(self, arm: ReadableArm, settings: Arm, frame: TableFrame | None) -> None:
        self._arm = arm
        self._settings = settings
        self._frame = frame

    def refuse_other_arm(self) -> None:
        """Raises LimitError where the frame is that of another arm; to be called once the arm has
        said who it is.
        """
        serial_number = self._arm.identity.serial_number
        if self._frame is not None and self._frame.serial_number != serial_number:
            what = (
                f"the rig's table frame is of the arm {self._frame.serial_number}, but the arm that"
                f" answers is {serial_number}"
            )
            raise LimitError(
                "arm", what, hint="Make the frame anew with this arm: 'teatbench arm frame'"
            )

    def read(self) -> Reading:
        """One reading of a still arm, in the world. Raises as the driver does."""
        seen = self._arm.read(self._settings.packets, max_spread_mm=self._settings.max_spread_mm)
        if self._frame is None:
            return seen
        motion = self._frame.world_from_arm
        return replace(seen, tip_mm=motion.apply(seen.tip_mm), axis=motion.R @ seen.axis)

    def u_registration_mm(self, point_mm: NDArray[np.float64]) -> float | None:
        """What the frame adds to the uncertainty of ``point_mm``, along an axis; None where the
        world is the arm's frame.
        """
        return (
            None
            if self._frame is None
            else self._frame.u_registration_mm(point_mm, self._settings.accuracy_mm)
        )

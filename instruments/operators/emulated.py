"""The emulated operator: arranges the emulated phantom as asked and touches its teat ends with a hand's error.

It sees the world as a person does (where the ends are, which of them the cameras see), and nothing of the bench.
"""

from __future__ import annotations

import numpy as np

from instruments.operators.operator import Arrangement, Placed
from instruments.world.world import World

STYLUS_AXIS = np.array([0.0, 0.0, 1.0])  # held upright over the end


class EmulatedOperator:
    """``hand_error_mm`` is the standard deviation, along each axis, of where the hand puts the tip."""

    def __init__(self, world: World, *, hand_error_mm: float) -> None:
        self._world = world
        self._hand_error_mm = hand_error_mm
        self._rng = np.random.default_rng([world.seed, *b"hand"])

    def confirm_homing(self, instruction: str) -> None:  # noqa: ARG002 - it needs no telling
        self._world.hold(None)

    def set_up(self, arrangement: Arrangement) -> Placed:
        self._world.arrange(arrangement.layout, arrangement.objects)
        seen = self._world.renderer.visible_ends(self._world.scene())
        return Placed(tuple(bool(row.all()) for row in np.asarray(seen)))

    def touch(self, teat: int, of: int) -> None:  # noqa: ARG002 - nor how many there are
        end = self._world.ends_mm()[teat - 1]
        self._world.hold(end + self._rng.normal(0.0, self._hand_error_mm, 3), STYLUS_AXIS)

    def release(self) -> None:
        self._world.hold(None)

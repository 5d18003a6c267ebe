"""The emulated operator: arranges the emulated phantom as asked and touches its teat ends with a hand's error.

It sees the world as a person does (where the ends are, which of them the cameras see), and nothing of the bench.
"""

from __future__ import annotations

import numpy as np

from instruments.operators.operator import Arrangement, Placed
from instruments.world.world import World

SWING_RAD = np.radians(35.0)  # how far the stylus leans in the divot, each time another way
STYLUS_AXIS = np.array([0.0, 0.0, 1.0])  # held upright over the end


class EmulatedOperator:
    """``hand_error_mm`` is the standard deviation, along each axis, of where the hand puts the tip.

    The divot at ``check_point_mm`` leads the tip, so that the hand has no error there.
    """

    def __init__(self, world: World, *, hand_error_mm: float, check_point_mm: tuple[float, float, float] | None = None) -> None:
        self._world = world
        self._hand_error_mm = hand_error_mm
        self._check_point_mm = check_point_mm
        self._rng = np.random.default_rng([world.seed, *b"hand"])

    def confirm_homing(self, instruction: str) -> None:  # noqa: ARG002 - it needs no telling
        self._world.hold(None)

    def touch_check_point(self, touch: int, of: int) -> None:
        if self._check_point_mm is None:
            raise ValueError("the emulated operator knows of no check point; give it check_point_mm")
        turn = 2.0 * np.pi * (touch - 1) / of
        lean = np.array([np.sin(SWING_RAD) * np.cos(turn), np.sin(SWING_RAD) * np.sin(turn), np.cos(SWING_RAD)])
        self._world.hold(np.array(self._check_point_mm), lean)

    def set_up(self, arrangement: Arrangement) -> Placed:
        self._world.arrange(arrangement.layout, arrangement.objects)
        seen = self._world.renderer.visible_ends(self._world.scene())
        return Placed(tuple(bool(row.all()) for row in np.asarray(seen)))

    def touch(self, teat: int, of: int) -> None:  # noqa: ARG002 - nor how many there are
        end = self._world.ends_mm()[teat - 1]
        self._world.hold(end + self._rng.normal(0.0, self._hand_error_mm, 3), STYLUS_AXIS)

    def release(self) -> None:
        self._world.hold(None)

"""The emulated operator: places the emulated phantom and touches its teat ends with a hand's error.

It sees where the ends are and which of them the cameras see. It can make each mistake once, on
request.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from instruments.operators.board_hands import BoardHands
from instruments.operators.operator import Arrangement, BoardAsked, Placed
from instruments.teat_end import ball_centre_mm
from instruments.world.phantom import PlatePose
from instruments.world.world import World

SWING_RAD = np.radians(35.0)  # how far the stylus leans in the divot, each time another way
STYLUS_AXIS = np.array([0.0, 0.0, 1.0])  # held upright over the end
LOOK_S = 1.0  # between two looks at the interlocks while a prompt takes its time

Mistake = Literal["wrong teat", "forgotten teat", "forgotten move"]


class EmulatedOperator:
    """A pair of hands in ``world``.

    ``hand_error_mm``: standard deviation along each axis of where the tip is put;
    ``placement_error_mm`` (x, y) and ``placement_error_rad`` (turn): of the plate. The divot at
    ``check_point_mm`` takes the tip without error. ``tip_radius_mm``: of a ball tip. Each prompt
    takes ``prompt_s``. ``mistakes``, at the first occasion: "wrong teat" touches the next teat,
    "forgotten teat" stays on the one before, "forgotten move" leaves the plate.
    """

    def __init__(
        self,
        world: World,
        *,
        hand_error_mm: float,
        placement_error_mm: float = 0.0,
        placement_error_rad: float = 0.0,
        prompt_s: float = 0.0,
        tip_radius_mm: float = 0.0,
        check_point_mm: tuple[float, float, float] | None = None,
        mistakes: Sequence[Mistake] = (),
    ) -> None:
        self._world = world
        self._hand_error_mm = hand_error_mm
        self._placement = np.array([placement_error_mm, placement_error_mm, placement_error_rad])
        self._prompt_s = prompt_s
        self._tip_radius_mm = tip_radius_mm
        self._check_point_mm = check_point_mm
        self._to_make = list(mistakes)
        self._rng = np.random.default_rng([world.seed, *b"hand"])
        self._placing = np.random.default_rng([world.seed, *b"placing"])
        self._check: Callable[[], None] = lambda: None
        self._stands: tuple[Arrangement, PlatePose] | None = None
        self._boards = BoardHands(world)

    def check_interrupts(self, check: Callable[[], None]) -> None:
        self._check = check

    def next_trial(self, number: int, of: int, left_s: float | None) -> None:
        """It needs no encouragement."""

    def confirm_homing(self, instruction: str) -> None:  # noqa: ARG002 - it needs no telling
        self._take_time()
        self._world.hold(None)

    def touch_check_point(self, touch: int, of: int) -> None:
        if self._check_point_mm is None:
            raise ValueError(
                "the emulated operator knows of no check point; give it check_point_mm"
            )
        self._take_time()
        turn = 2.0 * np.pi * (touch - 1) / of
        lean = np.array(
            [np.sin(SWING_RAD) * np.cos(turn), np.sin(SWING_RAD) * np.sin(turn), np.cos(SWING_RAD)]
        )
        self._world.hold(np.array(self._check_point_mm), lean)

    def set_up(self, arrangement: Arrangement) -> Placed:
        self._take_time()
        self._world.show(None)
        self._stands = self._placed(arrangement)
        self._world.arrange(
            arrangement.phantom.moved(self._stands[1]), arrangement.objects, arrangement.scene
        )
        seen = self._world.renderer.visible_ends(self._world.scene())
        return Placed(tuple(bool(row.all()) for row in np.asarray(seen)))

    def touch(
        self,
        teat: int,
        of: int,
        *,
        number: int = 1,  # noqa: ARG002
        numbers: int = 1,  # noqa: ARG002
        again: str = "",  # noqa: ARG002
    ) -> None:
        self._take_time()
        if teat > 1 and self._makes("forgotten teat"):
            return
        at = teat % of if teat > 1 and self._makes("wrong teat") else teat - 1
        phantom = self._world.phantom()
        # what the arm reads is the ball's centre
        tip = ball_centre_mm(phantom.ends_mm[at], phantom.axes[at], self._tip_radius_mm)
        self._world.hold(tip + self._rng.normal(0.0, self._hand_error_mm, 3), STYLUS_AXIS)

    def hold_board(self, asked: BoardAsked) -> None:
        self._take_time()
        self._world.hold(None)
        self._world.show(self._boards.held(asked))

    def touch_board(self, corner: int, instruction: str, *, again: str = "") -> None:  # noqa: ARG002 - it needs no telling
        self._take_time()
        point, axis = self._boards.tip(corner, self._tip_radius_mm)
        self._world.hold(point + self._rng.normal(0.0, self._hand_error_mm, 3), axis)

    def release(self) -> None:
        self._world.hold(None)

    def finish(self) -> None:
        """It has said nothing that could be left over."""

    def _placed(self, wanted: Arrangement) -> tuple[Arrangement, PlatePose]:
        """What was done, and the plate's pose: kept where it stands as asked, else nearly it."""
        if self._stands is not None:
            before, stands = self._stands
            if _same(before, wanted):
                return wanted, stands
            if before.pose != wanted.pose and self._makes("forgotten move"):
                return replace(wanted, pose=before.pose), stands
        x_mm, y_mm, yaw_rad = self._placing.normal(0.0, 1.0, 3) * self._placement
        pose = wanted.pose
        return wanted, PlatePose(
            pose.x_mm + float(x_mm),
            pose.y_mm + float(y_mm),
            pose.z_mm,
            pose.yaw_rad + float(yaw_rad),
        )

    def _makes(self, mistake: Mistake) -> bool:
        if mistake not in self._to_make:
            return False
        self._to_make.remove(mistake)
        return True

    def _take_time(self) -> None:
        """The time a prompt takes, with an eye on the interlocks."""
        clock = self._world.clock
        end_s = clock.now() + self._prompt_s
        self._check()
        while (left_s := end_s - clock.now()) > 0.0:
            clock.sleep(min(LOOK_S, left_s))
            self._check()


def _same(one: Arrangement, other: Arrangement) -> bool:
    """Whether the phantom stays untouched from one to the other; other things don't matter."""
    return (one.phantom, one.pose) == (other.phantom, other.pose)

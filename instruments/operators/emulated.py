"""The emulated operator: places the emulated phantom, touches its teat ends with a hand's error,
and holds calibration boards.

It sees where the ends are and which of them the cameras see. It can make each mistake once, on
request.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from instruments.operators.operator import (
    DONE,
    Answer,
    Arrangement,
    BoardAsked,
    BoardTouch,
    CheckPoint,
    Homing,
    OperatorEnough,
    Release,
    Request,
    Touch,
    no_check,
)
from instruments.teat_end import ball_centre_mm
from instruments.world.boards import Board, poses
from instruments.world.optics import CameraModel, Floats
from instruments.world.phantom import PlatePose
from instruments.world.solids import Point
from instruments.world.world import World

SWING_RAD = np.radians(35.0)  # how far the stylus leans in the divot, each time another way
STYLUS_AXIS = np.array([0.0, 0.0, 1.0])  # held upright over the end
SHOWN = 24  # views after which the arms are tired
DEPTHS_MM = (450.0, 1200.0)
FIXED_TURNS_RAD = ((-0.35, -0.25), (0.30, 0.30))  # about the board's own axes, position by position
FIXED_SHIFTS_MM = ((-40.0, -50.0, 30.0), (-40.0, 70.0, -10.0))
HEATED_C = 40.0
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
        self._stands: tuple[Arrangement, PlatePose] | None = None
        self._boards = BoardHands(world)

    def ask(self, request: Request, check: Callable[[], None] = no_check) -> Answer:
        """Raises ValueError for a check point or a board that isn't there, OperatorEnough."""
        match request:
            case Arrangement():
                self._take_time(check)
                return self._set_up(request)
            case Touch(teat, of):
                self._take_time(check)
                self._touch(teat, of)
            case Homing():
                self._take_time(check)
                self._world.hold(None)
            case CheckPoint(touch, of):
                self._touch_check_point(touch, of, check)
            case BoardAsked():
                self._take_time(check)
                self._world.hold(None)
                self._world.show(self._boards.held(request))
            case BoardTouch(corner):
                self._take_time(check)
                point, axis = self._boards.tip(corner, self._tip_radius_mm)
                self._world.hold(point + self._rng.normal(0.0, self._hand_error_mm, 3), axis)
            case Release():
                self._world.hold(None)
            case _:
                pass  # it needs no encouragement
        return DONE

    def _touch_check_point(self, touch: int, of: int, check: Callable[[], None]) -> None:
        if self._check_point_mm is None:
            what = "the emulated operator knows of no check point; give it check_point_mm"
            raise ValueError(what)
        self._take_time(check)
        turn, out, up = 2.0 * np.pi * (touch - 1) / of, np.sin(SWING_RAD), np.cos(SWING_RAD)
        lean = np.array([out * np.cos(turn), out * np.sin(turn), up])
        self._world.hold(np.array(self._check_point_mm), lean)

    def _set_up(self, arrangement: Arrangement) -> Answer:
        self._world.show(None)
        self._stands = self._placed(arrangement)
        self._world.arrange(
            arrangement.phantom.moved(self._stands[1]), arrangement.objects, arrangement.scene
        )
        seen = self._world.renderer.visible_ends(self._world.scene())
        return Answer(tuple(bool(row.all()) for row in np.asarray(seen)))

    def _touch(self, teat: int, of: int) -> None:
        if teat > 1 and self._makes("forgotten teat"):
            return
        at = teat % of if teat > 1 and self._makes("wrong teat") else teat - 1
        phantom = self._world.phantom()
        # what the arm reads is the ball's centre
        tip = ball_centre_mm(phantom.ends_mm[at], phantom.axes[at], self._tip_radius_mm)
        self._world.hold(tip + self._rng.normal(0.0, self._hand_error_mm, 3), STYLUS_AXIS)

    def _placed(self, wanted: Arrangement) -> tuple[Arrangement, PlatePose]:
        """What was done, and the plate's pose: kept where it stands as asked, else nearly it."""
        if self._stands is not None:
            before, stands = self._stands
            if (before.phantom, before.pose) == (wanted.phantom, wanted.pose):
                return wanted, stands
            if before.pose != wanted.pose and self._makes("forgotten move"):
                return replace(wanted, pose=before.pose), stands
        x_mm, y_mm, yaw_rad = (self._placing.normal(0.0, 1.0, 3) * self._placement).tolist()
        pose = wanted.pose
        return wanted, PlatePose(
            pose.x_mm + x_mm, pose.y_mm + y_mm, pose.z_mm, pose.yaw_rad + yaw_rad
        )

    def _makes(self, mistake: Mistake) -> bool:
        if mistake not in self._to_make:
            return False
        self._to_make.remove(mistake)
        return True

    def _take_time(self, check: Callable[[], None]) -> None:
        clock = self._world.clock
        end_s = clock.now() + self._prompt_s
        check()
        while (left_s := end_s - clock.now()) > 0.0:
            clock.sleep(min(LOOK_S, left_s))
            check()


class BoardHands:
    """Holds boards before the cameras of ``world``, each time differently; keeps the last one."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._drawn: dict[object, tuple[Board, ...]] = {}
        self._board: Board | None = None

    def held(self, asked: BoardAsked) -> Board:
        """The board as it is held for ``asked``. Raises OperatorEnough after `SHOWN` views."""
        board = self._fixed(asked) if asked.fixed else self._before_cameras(asked)
        self._board = replace(board, dark=HEATED_C) if asked.heated else board
        return self._board

    def tip(self, corner: int, tip_radius_mm: float) -> tuple[Floats, Floats]:
        """Centre (3,) of the ball tip on a point of the board, and the stylus's axis. Raises
        ValueError without a board.
        """
        if self._board is None:
            raise ValueError("the emulated operator holds no board that could be touched")
        normal = self._board.normal
        # nearly upright, which the arm reaches farthest with
        axis = 0.5 * normal + np.array([0.0, 0.0, 1.0])
        return self._board.corners_mm[corner] + tip_radius_mm * normal, axis / np.linalg.norm(axis)

    def _before_cameras(self, asked: BoardAsked) -> Board:
        if asked.number > SHOWN:
            raise OperatorEnough(f"the emulated operator has shown the board {SHOWN} times")
        key, cameras = (asked.pattern, asked.cameras), self._cameras(asked)
        if key not in self._drawn:
            self._drawn[key] = poses(asked.pattern, cameras, DEPTHS_MM, self._world.seed, SHOWN)
        return self._drawn[key][asked.number - 1]

    def _fixed(self, asked: BoardAsked) -> Board:
        """Near the teat ends, within the arm's reach, tilted towards the middle of the cameras."""
        cameras, turn = self._cameras(asked), (asked.number - 1) % len(FIXED_TURNS_RAD)
        middle = self._world.ends_mm().mean(axis=0) + np.array(FIXED_SHIFTS_MM[turn])
        away = middle - np.mean([camera.centre_mm for camera in cameras], axis=0)
        away = away / np.linalg.norm(away)
        across = np.cross(away, [0.0, 0.0, 1.0])
        across = across / np.linalg.norm(across)
        along = np.cross(away, across)
        up, side = FIXED_TURNS_RAD[turn]
        along, away = np.cos(up) * along + np.sin(up) * away, np.cos(up) * away - np.sin(up) * along
        across = np.cos(side) * across + np.sin(side) * away
        width, height = asked.pattern.size_mm
        corner = middle - 0.5 * (width * across + height * along)
        return Board(_point(corner), _point(across), _point(along), asked.pattern)

    def _cameras(self, asked: BoardAsked) -> list[CameraModel]:
        return [camera for camera in self._world.renderer.cameras if camera.name in asked.cameras]


def _point(vector: Floats) -> Point:
    return float(vector[0]), float(vector[1]), float(vector[2])

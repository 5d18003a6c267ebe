"""The emulated operator: places the emulated phantom, touches its teat ends with a hand's error,
and holds calibration boards. It makes each mistake once, on request.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Literal

import numpy as np

from instruments.clock import sleep_looking
from instruments.operators import operator as op
from instruments.world.boards import Board, poses
from instruments.world.optics import Floats
from instruments.world.phantom import PlatePose, spoken_name
from instruments.world.setups import Situation
from instruments.world.solids import as_point
from instruments.world.world import World

SWING_RAD = np.radians(35.0)  # how far the stylus leans in the divot, each time another way
STYLUS_AXIS = np.array([0.0, 0.0, 1.0])  # held upright over the end
SHOWN = 24  # views after which the arms are tired
DEPTHS_MM = (450.0, 1200.0)
FIXED_TURNS_RAD = ((-0.35, -0.25), (0.30, 0.30))  # about the board's own axes, position by position
FIXED_SHIFTS_MM = ((-40.0, -50.0, 30.0), (-40.0, 70.0, -10.0))
HEATED_C = 40.0
LOOK_S = 1.0  # between two looks at the interlocks while a prompt takes its time
MOST_WHITE, DIMMER = 0.2, 0.95  # share of a picture with a drawn scene; a turn of the lamps' knob
LEAST = 0.1  # brightness, of that which was drawn
NEARER = "Have it nearer to the arm, or the arm elsewhere (arm_placed in [emulation])"

Mistake = Literal["wrong teat", "forgotten teat", "forgotten move"]


# of a tip (3,) mm and the stylus's axis (3,): the axis by which the arm gets there, None if by none
Way = Callable[[Floats, Floats], Floats | None]


class EmulatedOperator:
    """A pair of hands in ``world``. Standard deviations: ``hand_error_mm`` of the tip along each
    axis, ``placement_error_mm`` and ``placement_error_rad`` of the plate. ``mistakes`` happen at
    the first occasion. ``way``: what the arm reaches; everything unless given.
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
        way: Way = lambda _, axis: axis,
    ) -> None:
        self.way = way
        self._world = world
        self._hand_error_mm = hand_error_mm
        self._placement = np.array([placement_error_mm, placement_error_mm, placement_error_rad])
        self._prompt_s = prompt_s
        self._tip_radius_mm = tip_radius_mm
        self._check_point_mm = check_point_mm
        self._to_make = list(mistakes)
        self._rng = np.random.default_rng([world.seed, *b"hand"])
        self._placing = np.random.default_rng([world.seed, *b"placing"])
        self._stands: tuple[op.Arrangement, PlatePose] | None = None
        self._boards = BoardHands(world)

    def ask(self, request: op.Request, check: Callable[[], None] = op.no_check) -> op.Answer:
        """Raises ValueError for a check point or a board that isn't there, OperatorEnough; where
        the arm doesn't get there OperatorSkip for a teat's end, OperatorAbort for other points.
        """
        if isinstance(request, op.Task | op.NextTrial | op.Finish):
            return op.DONE
        if not isinstance(request, op.Release):
            sleep_looking(self._world.clock, self._prompt_s, check, LOOK_S)
        match request:
            case op.Arrangement():
                return self._set_up(request)
            case op.Touch(teat, of):
                self._touch(teat, of)
            case op.CheckPoint(touch, of):
                if self._check_point_mm is None:
                    what = "the emulated operator has no check point"
                    raise ValueError(f"{what}; give it check_point_mm")
                turn, out, up = 2.0 * np.pi * (touch - 1) / of, np.sin(SWING_RAD), np.cos(SWING_RAD)
                lean = np.array([out * np.cos(turn), out * np.sin(turn), up])
                self._hold(
                    np.array(self._check_point_mm), lean, op.OperatorAbort, "the check point"
                )
            case op.BoardTouch(corner):
                tip, axis = self._boards.tip(corner, self._tip_radius_mm)
                self._hold(self._by_hand(tip), axis, op.OperatorAbort, "the board")
            case _:
                self._world.hold(None)
                if isinstance(request, op.BoardPose):
                    self._world.show(self._boards.held(request))
        return op.DONE

    def _by_hand(self, tip_mm: Floats) -> Floats:
        return tip_mm + self._rng.normal(0.0, self._hand_error_mm, 3)

    def _hold(self, tip_mm: Floats, axis: Floats, stop: type[Exception], what: str) -> None:
        """Hold the tip there; where the arm doesn't get there, let go of it and raise ``stop``."""
        way = self.way(tip_mm, axis)
        self._world.hold(tip_mm, way)
        if way is None:
            where = np.round(tip_mm).astype(int).tolist()
            raise stop(f"the arm doesn't reach {what} at {where} mm. {NEARER}")

    def _set_up(self, wanted: op.Arrangement) -> op.Answer:
        self._world.show(None)
        self._stands = wanted, pose = self._placed(wanted)
        scene = wanted.scene and self._lit(wanted.scene)
        self._world.arrange(wanted.phantom.moved(pose), wanted.objects, scene)
        seen = self._world.renderer.visible_ends(self._world.scene())
        return op.Answer(tuple(bool(row.all()) for row in np.asarray(seen)))

    def _lit(self, scene: Situation) -> Situation:
        """As who looks at the optical pictures lights it: less where too much would be white."""
        shown, light = self._world.renderer, scene.lighting
        for camera in (shown.left, shown.right):
            while (
                light.brightness > LEAST * scene.lighting.brightness
                and camera.white_share(light, scene.backdrop, scene.exposure) > MOST_WHITE
            ):
                light = replace(light, brightness=DIMMER * light.brightness)
        return scene if light is scene.lighting else replace(scene, lighting=light)

    def _touch(self, teat: int, of: int) -> None:
        if teat > 1 and self._makes("forgotten teat"):
            return
        at = teat % of if teat > 1 and self._makes("wrong teat") else teat - 1
        phantom = self._world.phantom()
        # what the arm reads is the ball's centre
        tip = phantom.ends_mm[at] + self._tip_radius_mm * phantom.axes[at]
        what = f"the end of {spoken_name(at + 1, phantom.teats[at].name)}"
        self._hold(self._by_hand(tip), STYLUS_AXIS, op.OperatorSkip, what)

    def _placed(self, wanted: op.Arrangement) -> tuple[op.Arrangement, PlatePose]:
        """What was done, and the plate's pose: kept where it stands as asked, else nearly it."""
        if self._stands is not None:
            before, stands = self._stands
            if (before.phantom, before.pose) == (wanted.phantom, wanted.pose):
                return wanted, stands
            if before.pose != wanted.pose and self._makes("forgotten move"):
                return replace(wanted, pose=before.pose), stands
        x_mm, y_mm, yaw_rad = (self._placing.normal(0.0, 1.0, 3) * self._placement).tolist()
        pose = wanted.pose
        x_mm, y_mm, yaw_rad = pose.x_mm + x_mm, pose.y_mm + y_mm, pose.yaw_rad + yaw_rad
        return wanted, PlatePose(x_mm, y_mm, pose.z_mm, yaw_rad)

    def _makes(self, mistake: Mistake) -> bool:
        if mistake not in self._to_make:
            return False
        self._to_make.remove(mistake)
        return True


_views = lru_cache(maxsize=4)(poses)


class BoardHands:
    """Holds boards before the cameras of ``world``, each time differently; keeps the last one."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._board: Board | None = None

    def held(self, asked: op.BoardPose) -> Board:
        """The board as it is held for ``asked``. Raises OperatorEnough after `SHOWN` views."""
        if not asked.fixed and asked.number > SHOWN:
            raise op.OperatorEnough(f"the emulated operator has shown the board {SHOWN} times")
        cameras = tuple(c for c in self._world.renderer.cameras if c.name in asked.cameras)
        if asked.fixed:  # near the teat ends, in reach, tilted towards the middle of the cameras
            turn = (asked.number - 1) % len(FIXED_TURNS_RAD)
            middle = self._world.ends_mm().mean(axis=0) + np.array(FIXED_SHIFTS_MM[turn])
            away = middle - np.mean([camera.centre_mm for camera in cameras], axis=0)
            away = away / np.linalg.norm(away)
            across = np.cross(away, [0.0, 0.0, 1.0])
            across = across / np.linalg.norm(across)
            along = np.cross(away, across)
            up, side = FIXED_TURNS_RAD[turn]
            away, along = (
                np.cos(up) * away - np.sin(up) * along,
                np.cos(up) * along + np.sin(up) * away,
            )
            across = np.cos(side) * across + np.sin(side) * away
            width, height = asked.pattern.size_mm
            corner = middle - 0.5 * (width * across + height * along)
            board = Board(as_point(corner), as_point(across), as_point(along), asked.pattern)
        else:
            views = _views(asked.pattern, cameras, DEPTHS_MM, self._world.seed, SHOWN)
            board = views[asked.number - 1]
        self._board = replace(board, dark=HEATED_C) if asked.heated else board
        return self._board

    def tip(self, corner: int, tip_radius_mm: float) -> tuple[Floats, Floats]:
        """Centre (3,) of the ball tip on a point of the board, and the stylus's axis (3,)."""
        if self._board is None:
            raise ValueError("the emulated operator holds no board that could be touched")
        normal = self._board.normal
        # nearly upright, which the arm reaches farthest with
        axis = 0.5 * normal + np.array([0.0, 0.0, 1.0])
        return self._board.corners_mm[corner] + tip_radius_mm * normal, axis / np.linalg.norm(axis)

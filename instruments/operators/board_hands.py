"""Where emulated hands hold a calibration board, and where the tip goes to touch it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from instruments.operators.operator import BoardAsked, OperatorEnough
from instruments.world.boards import Board, poses
from instruments.world.optics import CameraModel, Floats
from instruments.world.solids import Point
from instruments.world.world import World

SHOWN = 24  # views after which the arms are tired
DEPTHS_MM = (450.0, 1200.0)
FIXED_TURNS_RAD = ((-0.35, -0.25), (0.30, 0.30))  # about the board's own axes, position by position
FIXED_SHIFTS_MM = ((-40.0, -50.0, 30.0), (-40.0, 70.0, -10.0))
HEATED_C = 40.0


class BoardHands:
    """Holds boards before the cameras of ``world``, each time differently; keeps the last one."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._drawn: dict[object, tuple[Board, ...]] = {}
        self._board: Board | None = None

    def held(self, asked: BoardAsked) -> Board:
        """The board as it is held for ``asked``. Raises OperatorEnough after `SHOWN` views."""
        board = self._fixed(asked) if asked.fixed else self._before_cameras(asked)
        self._board = board if not asked.heated else _heated(board)
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
        key = (asked.pattern, asked.cameras)
        if key not in self._drawn:
            self._drawn[key] = poses(
                asked.pattern, self._cameras(asked), DEPTHS_MM, self._world.seed, SHOWN
            )
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


def _heated(board: Board) -> Board:
    return replace(board, dark=HEATED_C)


def _point(vector: Floats) -> Point:
    return float(vector[0]), float(vector[1]), float(vector[2])

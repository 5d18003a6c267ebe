"""Pictures of a board from a rig's cameras, somebody holding it: asked for, looked at, kept; until
nothing is missing or the operator has had enough. A picture shows what is still missing.

What is kept is a set of pictures as any other: the calibration is made from the folder, and can be
made from it again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.config import ConfigError
from bench.files import png_bytes, write_synced
from detector.calibration.boards import DICTIONARIES, Board
from detector.calibration.corners import Found, ViewRefusedError, find_board
from detector.calibration.coverage import (
    COLUMNS,
    LEAST_CORNERS,
    ROWS,
    Coverage,
    coverage,
    rough_poses,
)
from instruments.camera.frame import Grey
from instruments.operators.operator import BoardAsked, Operator, OperatorEnough
from instruments.world.boards import Pattern

MOST_VIEWS = 60
TOLD = 3  # of what is missing, in one instruction
GUIDE = "guide.png"
HEIGHT_PX = 480  # of each camera's part of the guide's picture
COVERED, MISSING, CORNER = (90, 170, 60), (60, 60, 200), (0, 200, 255)  # blue, green, red
TINT = 0.25


@dataclass(frozen=True, slots=True)
class ViewsRequest:
    """Which cameras shall see the board, which of them have to be covered by it, whether it is
    heated, and which come mirrored.

    Where none is ``guided``, ``most`` views are taken.
    """

    cameras: tuple[str, ...] = ("left", "right")
    guided: tuple[str, ...] = ("left", "right")
    heated: bool = False
    most: int = MOST_VIEWS
    mirrored: frozenset[str] = frozenset()


def gather(
    look: Callable[[], Mapping[str, Grey]],
    operator: Operator,
    board: Board,
    wanted: ViewsRequest,
    folder: Path,
    tell: Callable[[str], None],
) -> int:
    """Keep views in ``folder`` as CAMERA/NN.png; gives back how many. Raises OperatorAbort,
    ConfigError, and as ``look`` does.
    """
    guide = Guide(board, wanted.guided)
    pattern = pattern_of(board)
    for number in range(1, wanted.most + 1):
        missing = guide.missing
        if wanted.guided and not missing:
            tell("Nothing is missing any more.")
            return number - 1
        text = _instruction(wanted, missing)
        asked = BoardAsked(pattern, text, number, wanted.cameras, wanted.heated)
        try:
            operator.ask(asked)
        except OperatorEnough as enough:
            tell(f"Enough: {enough}. Still missing: {'; '.join(missing) or 'nothing'}.")
            return number - 1
        seen = look()
        for camera in wanted.cameras:
            if camera not in seen:
                raise ConfigError.plain(
                    f"the rig has no {camera} camera: {', '.join(seen)} delivered pictures"
                )
        pictures = {camera: seen[camera] for camera in wanted.cameras}
        for camera, picture in pictures.items():
            write_picture(folder / camera / f"{number:02d}.png", picture)
        said = guide.add(
            {c: p[:, ::-1].copy() if c in wanted.mirrored else p for c, p in pictures.items()}
        )
        tell(f"view {number}: " + "; ".join(f"{camera} {text}" for camera, text in said.items()))
        write_picture(folder / GUIDE, guide.picture())
    tell(f"{wanted.most} views are enough. Still missing: {'; '.join(guide.missing) or 'nothing'}.")
    return wanted.most


def free_folder(out: Path) -> Path:
    """A folder beside ``out`` for its pictures, that isn't there yet: pictures are never written
    over.
    """
    first = out.with_suffix(".pictures")
    return next(
        place
        for n in range(1, 10_000)
        if not (place := first if n == 1 else first.with_name(f"{first.name}-{n}")).exists()
    )


def pattern_of(board: Board) -> Pattern:
    """The same board as the operator's side describes it: squares
    where the finder counts points.
    """
    more = 0 if board.kind == "circles" else 1
    return Pattern(
        board.kind,
        board.columns + more,
        board.rows + more,
        board.pitch_mm,
        0.5 * board.pitch_mm,
        DICTIONARIES[board.dictionary] if board.dictionary else Pattern().dictionary,
        board.marker_mm or board.circle_mm or 0.0,
    )


def write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    """A PNG, whole or not at all."""
    write_synced(path, png_bytes(image))


def _instruction(wanted: ViewsRequest, missing: tuple[str, ...]) -> str:
    who = f"{' and '.join(wanted.cameras)} see{'s' if len(wanted.cameras) == 1 else ''}"
    board = "heated board" if wanted.heated else "board"
    if not missing:
        return (
            f"Hold the {board} still where {who} all of it, another way each time: {wanted.most}"
            " views."
        )
    more = f"; and {len(missing) - TOLD} more" if len(missing) > TOLD else ""
    return (
        f"Hold the {board} still where {who} all of it. Missing: {'; '.join(missing[:TOLD])}{more}."
    )


class Guide:
    """What was seen of ``board``; ``guided`` are the cameras whose pictures have to be covered.
    Pictures come un-mirrored.
    """

    def __init__(self, board: Board, guided: tuple[str, ...]) -> None:
        self._board = board
        self._guided = guided
        self._found: dict[str, list[Found]] = {}
        self._latest: dict[str, tuple[Grey, Found | None]] = {}

    def add(self, pictures: Mapping[str, Grey]) -> dict[str, str]:
        """One view of each camera; gives back what became of it, camera by camera: found, or
        refused with the reason.
        """
        said = {}
        for camera, picture in pictures.items():
            try:
                found = find_board(picture, self._board)
            except ViewRefusedError as why:
                self._latest[camera], said[camera] = (picture, None), f"refused: {why}"
                continue
            self._found.setdefault(camera, []).append(found)
            self._latest[camera], said[camera] = (picture, found), f"found, {len(found.ids)} points"
        return said

    @property
    def missing(self) -> tuple[str, ...]:
        """What is still to be shown, as instructions; the same one of both cameras is told once.
        Empty when nothing is.
        """
        told: dict[str, list[str]] = {}
        for camera in self._guided:
            for text in self._coverage(camera).missing:
                told.setdefault(text, []).append(camera)
        return tuple(f"{' and '.join(cameras)}: {text}" for text, cameras in told.items())

    def picture(self) -> NDArray[np.uint8]:
        """The last view of each camera beside each other, BGR: points found, cells of the picture
        green where covered, red where not.
        """
        parts = [self._drawn(camera, *self._latest[camera]) for camera in self._latest]
        return np.asarray(np.hstack(parts), dtype=np.uint8)

    def _coverage(self, camera: str) -> Coverage:
        found = self._found.get(camera, [])
        shape = self._latest[camera][0].shape if camera in self._latest else (1, 1)
        size = (shape[1], shape[0])
        pixels = [view.pixels_px for view in found]
        points = [self._board.points_mm[view.ids] for view in found]
        return coverage(pixels, size, rough_poses(points, pixels, size))

    def _drawn(self, camera: str, picture: Grey, found: Found | None) -> NDArray[np.uint8]:
        scale = HEIGHT_PX / picture.shape[0]
        size = (round(picture.shape[1] * scale), HEIGHT_PX)
        small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        image = np.asarray(cv2.cvtColor(small, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
        if camera in self._guided:
            _mark_cells(image, self._coverage(camera).corners)
        if found is not None:
            for x, y in found.pixels_px * scale:
                cv2.circle(image, (round(x), round(y)), 3, CORNER, 1, cv2.LINE_AA)
        views = len(self._found.get(camera, []))
        text = f"{camera}: {'found' if found else 'refused'}, {views} views"
        for colour, width in (((0, 0, 0), 4), ((255, 255, 255), 1)):
            cv2.putText(
                image, text, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, width, cv2.LINE_AA
            )
        return image


def _mark_cells(image: NDArray[np.uint8], corners: NDArray[np.float64]) -> None:
    """Tint each cell of a BGR picture by whether it is covered; ``corners`` (ROWS, COLUMNS) counts
    what was seen in each.
    """
    high, wide = image.shape[:2]
    for row, column in np.ndindex(ROWS, COLUMNS):
        top, left = row * high // ROWS, column * wide // COLUMNS
        cell = image[top : (row + 1) * high // ROWS, left : (column + 1) * wide // COLUMNS]
        colour = COVERED if corners[row, column] >= LEAST_CORNERS else MISSING
        cell[:] = np.rint((1.0 - TINT) * cell + TINT * np.array(colour)).astype(np.uint8)
        right, bottom = left + cell.shape[1] - 1, top + cell.shape[0] - 1
        cv2.rectangle(image, (left, top), (right, bottom), colour, 1)

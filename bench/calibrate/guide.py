"""Leads somebody who holds a board before live cameras: what each view was, what is still missing,
and a picture that shows both.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.calibration.boards import Board
from detector.calibration.corners import Found, ViewRefusedError, find_board
from detector.calibration.coverage import (
    COLUMNS,
    LEAST_CORNERS,
    ROWS,
    Coverage,
    coverage,
    rough_poses,
)

Grey = NDArray[np.uint8]
HEIGHT_PX = 480  # of each camera's part of the guide's picture
COVERED, MISSING, CORNER = (90, 170, 60), (60, 60, 200), (0, 200, 255)  # blue, green, red
TINT = 0.25


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
        size = self._size(camera)
        pixels, points = (
            [view.pixels_px for view in found],
            [self._board.points_mm[view.ids] for view in found],
        )
        return coverage(pixels, size, rough_poses(points, pixels, size))

    def _size(self, camera: str) -> tuple[int, int]:
        if camera not in self._latest:
            return (1, 1)  # nothing was seen yet, so that nothing is covered
        rows, columns = self._latest[camera][0].shape
        return columns, rows

    def _drawn(self, camera: str, picture: Grey, found: Found | None) -> NDArray[np.uint8]:
        scale = HEIGHT_PX / picture.shape[0]
        size = (round(picture.shape[1] * scale), HEIGHT_PX)
        image = cv2.cvtColor(
            cv2.resize(picture, size, interpolation=cv2.INTER_AREA), cv2.COLOR_GRAY2BGR
        )
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
        return np.asarray(image, dtype=np.uint8)


def _mark_cells(image: NDArray[Any], corners: NDArray[np.float64]) -> None:
    """Tint each cell of a BGR picture by whether it is covered; ``corners`` (ROWS, COLUMNS) counts
    what was seen in each.
    """
    high, wide = image.shape[:2]
    for row in range(ROWS):
        for column in range(COLUMNS):
            top, left = row * high // ROWS, column * wide // COLUMNS
            cell = image[top : (row + 1) * high // ROWS, left : (column + 1) * wide // COLUMNS]
            colour = COVERED if corners[row, column] >= LEAST_CORNERS else MISSING
            cell[:] = np.rint((1.0 - TINT) * cell + TINT * np.array(colour)).astype(np.uint8)
            cv2.rectangle(
                image, (left, top), (left + cell.shape[1] - 1, top + cell.shape[0] - 1), colour, 1
            )

"""Calibration boards as values: numbered points on a plane, mm.

The frame: x along the columns, y along the rows, z = 0, the first point at (0, 0).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import cv2
import numpy as np

from detector.geometry import Array

BoardKind = Literal["chessboard", "charuco", "circles"]
KINDS: tuple[str, ...] = get_args(BoardKind)
DICTIONARIES: dict[str, int] = {
    name.removeprefix("DICT_").lower(): getattr(cv2.aruco, name)
    for name in ("DICT_4X4_50", "DICT_4X4_250", "DICT_5X5_100", "DICT_5X5_250")
}


@dataclass(frozen=True, slots=True)
class Board:
    """``columns`` x ``rows`` points: inner corners, or centres of circles. ``marker_mm`` and
    ``dictionary`` (of `DICTIONARIES`) for ChArUco, ``circle_mm`` (diameter) for circles.
    """

    kind: BoardKind
    columns: int
    rows: int
    pitch_mm: float
    marker_mm: float | None = None
    dictionary: str | None = None
    circle_mm: float | None = None

    def __post_init__(self) -> None:
        if fault := next(self._faults(), None):
            raise ValueError(fault)

    def _faults(self) -> Iterator[str]:
        if self.kind not in KINDS:
            yield f"no board {self.kind!r}; there are {', '.join(KINDS)}"
        if not (3 <= self.columns <= 100 and 3 <= self.rows <= 100):
            yield f"a board has from 3 x 3 to 100 x 100 points, not {self.columns} x {self.rows}"
        if not 0.1 <= self.pitch_mm <= 1000.0:
            yield f"the points' distance must be from 0.1 to 1000 mm, is {self.pitch_mm}"
        charuco = self.kind == "charuco"
        part = self.marker_mm if charuco else self.circle_mm
        if {charuco} != {self.marker_mm is not None, self.dictionary is not None}:
            yield "marker_mm and dictionary belong to a charuco board, which needs both"
        if (self.kind == "circles") != (self.circle_mm is not None):
            yield "circle_mm belongs to a board of circles, which needs it"
        if part is not None and not 0.0 < part < self.pitch_mm:
            fits = f"does not fit between points {self.pitch_mm:g} mm apart"
            yield f"a marker or circle of {part:g} mm {fits}"
        if self.dictionary is None:
            return
        if self.dictionary not in DICTIONARIES:
            yield f"no marker dictionary {self.dictionary!r}; there are {', '.join(DICTIONARIES)}"
        needed = (self.columns + 1) * (self.rows + 1) // 2
        if needed > len(self._markers.bytesList):
            larger = "take a larger dictionary"
            yield f"the board needs {needed} markers, more than {self.dictionary} has; {larger}"

    @property
    def _markers(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(DICTIONARIES[self.dictionary or ""])

    @property
    def points_mm(self) -> Array:
        """All points (columns * rows, 3), row by row."""
        rows, columns = np.mgrid[0 : self.rows, 0 : self.columns]
        grid = np.column_stack([columns.reshape(-1), rows.reshape(-1), np.zeros(columns.size)])
        return np.asarray(grid * self.pitch_mm)

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of what is printed, without a margin."""
        more, extra = -1 if self.kind == "circles" else 1, self.circle_mm or 0.0
        wide, high = ((count + more) * self.pitch_mm + extra for count in (self.columns, self.rows))
        return wide, high

    @property
    def reads_the_same_turned(self) -> bool:
        """Whether half a turn changes nothing, so a picture can't tell its first point."""
        even = (self.columns + self.rows) % 2 == 0
        return self.kind == "circles" or (self.kind == "chessboard" and even)

    @property
    def aruco(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's own description of a ChArUco board. Raises ValueError for another kind."""
        if self.marker_mm is None:
            raise ValueError(f"a board of the kind {self.kind} has no markers")
        squares = self.columns + 1, self.rows + 1
        return cv2.aruco.CharucoBoard(squares, self.pitch_mm, self.marker_mm, self._markers)

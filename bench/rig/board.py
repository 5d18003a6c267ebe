"""The description of a calibration board, as a person writes it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from bench.config import Section, read_config
from bench.rig.loading import find_shipped
from detector.calibration.boards import Board

BOARDS = Path(__file__).parents[1] / "boards"


class BoardFile(Section):
    """``columns`` and ``rows`` count points: inner corners of squares, or circles. ``pitch_mm`` is
    what the print measures.

    ``pitch_u_mm`` is its standard uncertainty.
    """

    kind: Literal["chessboard", "charuco", "circles"]
    columns: Annotated[int, Field(ge=3, le=100)]
    rows: Annotated[int, Field(ge=3, le=100)]
    pitch_mm: Annotated[float, Field(ge=0.1, le=1000)]
    marker_mm: Annotated[float, Field(gt=0)] | None = None
    dictionary: str | None = None
    circle_mm: Annotated[float, Field(gt=0)] | None = None
    pitch_u_mm: Annotated[float, Field(ge=0, le=1)] = 0.0

    @model_validator(mode="after")
    def _whole(self) -> BoardFile:
        self.board  # noqa: B018 - raises what is wrong with the parts together
        return self

    @property
    def board(self) -> Board:
        """The board itself."""
        return Board(
            self.kind,
            self.columns,
            self.rows,
            self.pitch_mm,
            self.marker_mm,
            self.dictionary,
            self.circle_mm,
        )


def find_board_file(name: str) -> Path:
    """The file of a shipped board by name, or of any board by path. Raises ConfigError."""
    return find_shipped(name, BOARDS, "board")


def load_board(path: Path) -> BoardFile:
    """The board described at ``path``. Raises ConfigError with all its faults."""
    return read_config(path, BoardFile)

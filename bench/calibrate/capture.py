"""Pictures of a board from a rig's cameras, somebody holding it: asked for, looked at, kept; until
nothing is missing or he has had enough.

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

from bench.calibrate.guide import Grey, Guide
from bench.config import ConfigError
from bench.files import write_synced
from detector.calibration.boards import DICTIONARIES, Board
from instruments.operators.operator import BoardAsked, Operator, OperatorEnough
from instruments.world.boards import Pattern

MOST_VIEWS = 60
TOLD = 3  # of what is missing, in one instruction
GUIDE = "guide.png"


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
        try:
            operator.ask(
                BoardAsked(
                    pattern, _instruction(wanted, missing), number, wanted.cameras, wanted.heated
                )
            )
        except OperatorEnough as enough:
            tell(f"Enough: {enough}. Still missing: {'; '.join(missing) or 'nothing'}.")
            return number - 1
        pictures = _seen(look, wanted.cameras)
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
    dictionary = DICTIONARIES[board.dictionary] if board.dictionary else Pattern().dictionary
    feature_mm = board.marker_mm or board.circle_mm or 0.0
    margin_mm = 0.5 * board.pitch_mm
    return Pattern(
        board.kind,
        board.columns + more,
        board.rows + more,
        board.pitch_mm,
        margin_mm,
        dictionary,
        feature_mm,
    )


def write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    """A PNG, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    good, data = cv2.imencode(".png", image)
    if not good:
        raise ConfigError.plain(f"{path}: the picture could not be written as PNG")
    write_synced(path, data.tobytes())


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


def _seen(look: Callable[[], Mapping[str, Grey]], cameras: tuple[str, ...]) -> dict[str, Grey]:
    pictures = look()
    for camera in cameras:
        if camera not in pictures:
            raise ConfigError.plain(
                f"the rig has no {camera} camera: {', '.join(pictures)} delivered pictures"
            )
    return {camera: pictures[camera] for camera in cameras}

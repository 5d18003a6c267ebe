"""A board drawn by a rig's emulated cameras, into a recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.config import ConfigError, check_within, read_text
from bench.record.recording import added_to
from bench.rig.loading import AnyRig, any_rig, drawn
from bench.rig.scenes import BOARD_DEPTHS_MM, named_cameras, rig_renderer, taken
from detector.calibration.boards import Board
from instruments.world import boards
from instruments.world.phantom import Phantom
from instruments.world.state import SceneState
from textfiles.bounds import COUNT, FROM_0


def record_boards(
    rig: AnyRig,
    board: Board,
    cameras: Sequence[str],
    poses: int,
    folder: Path | str,
    seed: int,
    *,
    warmer_k: float = 0.0,
) -> Iterator[str]:
    """A recording of a board in ``poses`` poses that ``cameras`` see whole, its dark parts
    ``warmer_k`` warmer; yields the frames' names. Raises ConfigError.
    """
    check_within(FROM_0, seed=seed)
    check_within(COUNT, poses=poses)
    rig, pattern = any_rig(rig), drawn(board, 0.3)
    renderer = rig_renderer(rig, seed)
    watching, ambient_c = named_cameras(renderer, cameras), rig.rig.emulation.ambient_c
    try:
        held = [*boards.poses(pattern, watching, BOARD_DEPTHS_MM, seed, poses)]
    except ValueError as error:
        raise ConfigError.plain(f"the board: {error}") from error
    with added_to(folder, read_text(rig.calibration_path)) as writer:
        for number, one in enumerate(held):
            heated = replace(one, light=ambient_c, dark=ambient_c + warmer_k)
            state = SceneState(Phantom(()), (), ambient_c, ambient_c, boards=(heated,))
            rng = np.random.default_rng([seed, number, *b"boards"])
            writer.add(f"pose-{number:02d}", taken(renderer, state, rng))
            yield f"pose-{number:02d}"

"""Weaves: grey textures of boards and tables, each from a seed. May not know where they are used."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np

from instruments.world.noise import Image

Weave = Literal["cloud", "grain", "waves", "planks"]
CELLS_CLOUD = ((120, 0.5), (40, 0.3), (12, 0.2), (3, 0.15), (1, 0.12))
CELLS_GRAIN = ((12, 0.2), (3, 0.45), (1, 0.6))


@lru_cache(maxsize=8)
def woven(weave: Weave, seed: int, width: int, height: int) -> Image:
    """A texture of about -1 to 1, (height, width)."""
    rng = np.random.Generator(np.random.PCG64(seed))
    return np.asarray(np.clip(WEAVES[weave](rng, width, height), -1.5, 1.5), dtype=np.float32)


def _lattices(rng: np.random.Generator, width: int, height: int, cells: tuple[tuple[int, float], ...]) -> Image:
    """Random lattices of several sizes, blown up smoothly and added."""
    cloth = np.zeros((height, width), dtype=np.float32)
    for cell, weight in cells:
        lattice = rng.standard_normal((height // cell + 2, width // cell + 2), dtype=np.float32)
        cloth += np.float32(weight) * cv2.resize(lattice, (width, height), interpolation=cv2.INTER_CUBIC)
    return cloth


def _cloud(rng: np.random.Generator, width: int, height: int) -> Image:
    return _lattices(rng, width, height, CELLS_CLOUD)


def _grain(rng: np.random.Generator, width: int, height: int) -> Image:
    return _lattices(rng, width, height, CELLS_GRAIN)


def _waves(rng: np.random.Generator, width: int, height: int) -> Image:
    """Veins, as in stone: a wave whose phase is cloudy."""
    rows = np.arange(height, dtype=np.float32)[:, None]
    phase = rows * np.float32(2.0 * np.pi / rng.uniform(22.0, 45.0)) + np.float32(2.5) * _lattices(
        rng, width, height, ((160, 1.0), (50, 0.5))
    )
    return np.asarray(0.8 * np.sin(phase) + 0.5 * _grain(rng, width, height), dtype=np.float32)


def _planks(rng: np.random.Generator, width: int, height: int) -> Image:
    """Long grain across, as in wood."""
    across = rng.standard_normal((height // 2 + 2, max(width // 80, 2)), dtype=np.float32)
    return np.asarray(
        0.6 * cv2.resize(across, (width, height), interpolation=cv2.INTER_CUBIC) + 0.4 * _cloud(rng, width, height), dtype=np.float32
    )


WEAVES: dict[Weave, Callable[[np.random.Generator, int, int], Image]] = {
    "cloud": _cloud,
    "grain": _grain,
    "waves": _waves,
    "planks": _planks,
}

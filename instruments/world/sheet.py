"""A contact sheet: several states of the scene side by side, for a person to look at.

Each row is one state: the left image, its middle at full size, the right one's middle, the thermal picture as delivered.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.scene import RenderedSet, Renderer, SceneState

ROW_PX = 340
LABEL_PX = 22
CLOSE_UP_PX = (440, 340)


def contact_sheet(states: Mapping[str, SceneState], renderer: Renderer, seed: int = 0) -> NDArray[np.uint8]:
    """One row for each named state, grey, uint8. Raises ValueError for no states."""
    if not states:
        raise ValueError("a contact sheet needs at least one state")
    rows = []
    for number, (name, state) in enumerate(states.items()):
        frames = renderer.render(state, np.random.Generator(np.random.SFC64([seed, number])))
        rows += [_label(name, _row(frames, state, renderer))]
    return np.concatenate(rows)


def _row(frames: RenderedSet, state: SceneState, renderer: Renderer) -> NDArray[np.uint8]:
    middles = [camera.project(state.phantom.ends_mm).mean(axis=0) for camera in renderer.cameras[:2]]
    parts = [_whole(frames.left), *(_close_up(f, m) for f, m in zip((frames.left, frames.right), middles, strict=True))]
    return np.concatenate([*parts, _whole(frames.thermal_8bit)], axis=1)


def _whole(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    width = round(image.shape[1] * ROW_PX / image.shape[0])
    return np.asarray(cv2.resize(image, (width, ROW_PX), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _close_up(image: NDArray[np.uint8], middle_px: NDArray[np.float64]) -> NDArray[np.uint8]:
    width, height = CLOSE_UP_PX
    left = int(np.clip(round(middle_px[0] - width / 2), 0, max(image.shape[1] - width, 0)))
    top = int(np.clip(round(middle_px[1] - height / 3), 0, max(image.shape[0] - height, 0)))
    cut = image[top : top + height, left : left + width]
    padded = np.zeros((height, width), dtype=np.uint8)
    padded[: cut.shape[0], : cut.shape[1]] = cut
    return padded


def _label(name: str, row: NDArray[np.uint8]) -> NDArray[np.uint8]:
    strip = np.full((LABEL_PX, row.shape[1]), 255, dtype=np.uint8)
    cv2.putText(strip, name, (6, LABEL_PX - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.55, 0, 1, cv2.LINE_AA)
    return np.concatenate([strip, row])

"""A contact sheet: several states of the scene side by side, for a person to look at.

Each row is one state: left and right image whole, the left one's middle at full size, the thermal picture as delivered. A small cross
in the close-up stands on each teat end, a ring where that camera can't see it.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.scene import Renderer, SceneState

ROW_PX = 340
LABEL_PX = 22
CLOSE_UP_PX = (440, 340)
Grey8 = NDArray[np.uint8]


def contact_sheet(states: Mapping[str, SceneState], renderer: Renderer, seed: int = 0) -> Grey8:
    """One row for each named state, grey, uint8. Raises ValueError for no states."""
    if not states:
        raise ValueError("a contact sheet needs at least one state")
    rows = []
    for number, (name, state) in enumerate(states.items()):
        frames = renderer.render(state, np.random.Generator(np.random.SFC64([seed, number])))
        close_up = _close_up(_marked(frames.left, state, renderer), renderer.cameras[0].project(state.phantom.ends_mm))
        row = np.concatenate([_whole(frames.left), _whole(frames.right), close_up, _whole(frames.thermal_8bit)], axis=1)
        rows.append(_label(name, row))
    return np.concatenate(rows)


def _marked(image: Grey8, state: SceneState, renderer: Renderer) -> Grey8:
    marked = image.copy()
    visible = renderer.visible_ends(state)
    for (u, v), seen in zip(renderer.cameras[0].project(state.phantom.ends_mm).round().astype(int), visible[:, 0], strict=True):
        grey = 0 if np.mean(image[max(v - 9, 0) : v + 1, max(u - 4, 0) : u + 5]) > 110 else 255
        at = (int(u), int(v))
        if seen:
            cv2.drawMarker(marked, at, grey, cv2.MARKER_CROSS, 7, 1)
        else:
            cv2.circle(marked, at, 5, grey, 1, cv2.LINE_AA)
    return marked


def _whole(image: Grey8) -> Grey8:
    width = round(image.shape[1] * ROW_PX / image.shape[0])
    return np.asarray(cv2.resize(image, (width, ROW_PX), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _close_up(image: Grey8, ends_px: NDArray[np.float64]) -> Grey8:
    width, height = CLOSE_UP_PX
    middle = ends_px.mean(axis=0) if len(ends_px) else np.array([image.shape[1] / 2.0, image.shape[0] / 2.0])
    left = int(np.clip(round(middle[0] - width / 2), 0, max(image.shape[1] - width, 0)))
    top = int(np.clip(round(middle[1] - height / 3), 0, max(image.shape[0] - height, 0)))
    cut = image[top : top + height, left : left + width]
    padded = np.zeros((height, width), dtype=np.uint8)
    padded[: cut.shape[0], : cut.shape[1]] = cut
    return padded


def _label(name: str, row: Grey8) -> Grey8:
    strip = np.full((LABEL_PX, row.shape[1]), 255, dtype=np.uint8)
    cv2.putText(strip, name, (6, LABEL_PX - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.55, 0, 1, cv2.LINE_AA)
    return np.concatenate([strip, row])

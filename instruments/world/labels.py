"""Which pixels of a delivered picture show which teat, and where its end and base are: labels for
training, from the geometry that the pictures are drawn of.

Labels are of the picture as its file has it: the thermal one at its delivered size, mirrored where
the camera mirrors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instruments.world.optical_camera import PixelRays
from instruments.world.optics import Floats
from instruments.world.scene import Renderer
from instruments.world.solids import Bools, Ints
from instruments.world.state import SceneState, Stage

MOST_OF_A_PIXEL = 0.5  # a thing that covers less of it is not what the pixel shows


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """Of n teats in one picture. ``shown`` (h, w): the number of the teat that a pixel shows, -1
    for none. ``ends_px``, ``bases_px`` (n, 2): column, row; the base is where the axis meets the
    plate. ``ends_seen`` (n,): as `Renderer.visible_ends`; ``bases_seen`` (n,): the pixel shows it.
    """

    camera: str
    shown: Ints
    ends_px: Floats
    bases_px: Floats
    ends_seen: Bools
    bases_seen: Bools


class Labeller:
    """Labels scenes for the cameras of one renderer."""

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        thermal = PixelRays(renderer.cameras[2])  # the camera's own view has its sensor's fine grid
        self._views = (renderer.left.view, renderer.right.view, thermal)

    def of(self, state: SceneState) -> tuple[Labels, Labels, Labels]:
        """The labels of left, right and thermal picture. Raises ValueError as drawing does."""
        ends_seen = self._renderer.visible_ends(state)
        mirrored = (False, False, self._renderer.thermal.readout.sensor.mirrored)
        left, right, thermal = (
            _labels(view, state, ends_seen[:, i], mirrored=mirrored[i])
            for i, view in enumerate(self._views)
        )
        return left, right, thermal


def _labels(view: PixelRays, state: SceneState, ends_seen: Bools, *, mirrored: bool) -> Labels:
    camera, teats = view.camera, len(state.phantom.teats)
    shown = _nearest(view, state)
    shown[shown >= teats] = -1
    ends, bases = (camera.project(mm) for mm in (state.phantom.ends_mm, state.phantom.bases_mm))
    column, row = np.rint(np.nan_to_num(bases, nan=-1.0)).astype(np.intp).T
    inside = (column >= 0) & (row >= 0) & (column < camera.width_px) & (row < camera.height_px)
    bases_seen = np.zeros(teats, dtype=np.bool_)
    bases_seen[inside] = shown[row[inside], column[inside]] == np.flatnonzero(inside)
    if mirrored:
        shown = shown[:, ::-1]
        ends, bases = (
            np.column_stack([camera.width_px - 1.0 - px[:, 0], px[:, 1]]) for px in (ends, bases)
        )
    return Labels(camera.name, shown, ends, bases, ends_seen, bases_seen)


def _nearest(view: PixelRays, state: SceneState) -> NDArray[np.intp]:
    """The number of the nearest thing that covers most of a pixel, boards last; -1 for none."""
    stage = Stage.of(state.everything())
    seen = view.surfaces(stage)
    layers = seen.by_thing(len(stage.things), np.zeros(len(seen.owner)))
    boards = [view.board(board) for board in state.boards]
    layers += [board.layer(np.zeros(len(board.depth_mm))) for board in boards]
    owner = np.repeat(np.arange(len(layers)), [len(layer) for layer in layers])
    row, column, share, depth = (
        np.concatenate([getattr(layer, name) for layer in layers])
        for name in ("row", "column", "share", "depth_mm")
    )
    # from far to near: of several things in a pixel the last one written stays
    order = np.argsort(-depth, kind="stable")
    order = order[share[order] >= MOST_OF_A_PIXEL]
    picture = np.full((view.camera.height_px, view.camera.width_px), -1, dtype=np.intp)
    picture[row[order], column[order]] = owner[order]
    return picture

"""What a camera sees of each thing, kept from one picture to the next: most of a scene stands still.

A `View` is a camera with the ray of each of its pixels. What it works out about a thing depends on that thing alone, not on
what stands before it, so it can be kept and put together with others anew. May not know of light, heat or noise.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from instruments.world.boards import Board, dark_parts_mm
from instruments.world.composite import Layer, merged
from instruments.world.coverage import Cover, cover, cover_outlines
from instruments.world.optics import CameraModel, Floats
from instruments.world.raycast import dot, meet
from instruments.world.solids import Ints
from instruments.world.state import Stage

KEPT_PIXELS = 400_000


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """What each solid shows in each pixel that it covers, n pairs sorted by thing, hidden or not; camera's frame."""

    cover: Cover
    owner: Ints  # which thing of the stage
    rays: Floats  # (3, n)
    depth_mm: Floats
    normals: Floats  # (3, n), unit

    def by_thing(self, count: int, value: NDArray[np.float32] | Floats, along: Floats | None = None) -> list[Layer]:
        """A layer for each of ``count`` things, from a value for each pair."""
        ends = np.searchsorted(self.owner, np.arange(count + 1))
        seen = self.cover
        return [
            merged(
                seen.row[part],
                seen.column[part],
                seen.share[part],
                self.depth_mm[part],
                value[part],
                None if along is None else along[part],
            )
            for part in (slice(start, end) for start, end in pairwise(ends))
        ]


@dataclass(frozen=True, slots=True, eq=False)
class BoardSurface:
    """A board in a camera: the pixels (n,) that it covers, what share of its part of each is dark, and the points seen (3, n), world."""

    cover: Cover
    dark: Floats
    depth_mm: Floats
    points_mm: Floats
    facing: bool


class View:
    """A camera with the ray of each of its pixels: what of the stage it sees, and where."""

    def __init__(self, camera: CameraModel) -> None:
        self.camera = camera
        self.rays = camera.rays()

    def surfaces(self, stage: Stage) -> Surfaces:
        """Every surface of every thing in every pixel that it covers."""
        solids = stage.solids.in_camera(self.camera)
        covered = cover(solids, self.camera)
        x, y = self._rays(covered)
        depth, normals, _ = meet(solids, covered.solid, x, y)
        return Surfaces(covered, stage.owner[covered.solid], np.stack([x, y, np.ones_like(x)]), depth, normals)

    def heights(self, stage: Stage, seen: Surfaces) -> Floats:
        """How far along its solid each surface lies, from 0 at the first end to 1 at the far side of the second, (n,)."""
        solids = stage.solids.in_camera(self.camera)
        reach = np.linalg.norm(solids.b - solids.a, axis=1) + np.where(solids.flat_b, 0.0, solids.radius_b)
        which = seen.cover.solid
        off = seen.depth_mm * seen.rays - solids.a[which].T
        return np.asarray(np.clip(dot(off, solids.axis[which].T) / reach[which], 0.0, 1.0))

    def board(self, board: Board) -> BoardSurface:
        """A board; from behind it is plain."""
        camera = self.camera
        whole = cover_outlines([camera.camera_from_world(board.outline_mm)], camera)
        facing = bool(board.normal @ (camera.centre_mm - np.asarray(board.corner_mm)) > 0.0)
        dark = self._dark(board, whole) if facing else np.zeros(len(whole.share))
        normal = camera.R @ board.normal
        x, y = self._rays(whole)
        towards = normal @ np.stack([x, y, np.ones_like(x)])
        # A pixel at the board's edge may look past it: its depth stays within the board's.
        corners = camera.camera_from_world(board.outline_mm)[:, 2]
        plane = float(normal @ camera.camera_from_world(np.asarray(board.corner_mm)[None, :])[0])
        depth = np.clip(plane / np.where(np.abs(towards) > 1e-9, towards, 1e-9), corners.min(), corners.max())
        points = camera.R.T @ (depth * np.stack([x, y, np.ones_like(x)])) + camera.centre_mm[:, None]
        return BoardSurface(whole, dark, depth, points, facing)

    def _dark(self, board: Board, whole: Cover) -> Floats:
        parts = dark_parts_mm(board.pattern)
        if not parts:
            return np.zeros(len(whole.share))
        seen = cover_outlines([self.camera.camera_from_world(board.placed(part)) for part in parts], self.camera)
        area = np.zeros((self.camera.height_px, self.camera.width_px))
        np.add.at(area, (seen.row, seen.column), seen.share)
        return np.asarray(np.clip(area[whole.row, whole.column] / whole.share, 0.0, 1.0))

    def _rays(self, covered: Cover) -> tuple[Floats, Floats]:
        pixel = covered.row * self.camera.width_px + covered.column
        return self.rays[0].reshape(-1)[pixel], self.rays[1].reshape(-1)[pixel]


class KeptLayers:
    """Layers by what they show; beyond `KEPT_PIXELS` in all, those not asked for the longest go."""

    def __init__(self) -> None:
        self._layers: dict[Hashable, Layer] = {}
        self._pixels = 0

    def of(self, keys: Sequence[Hashable], make: Callable[[list[int]], Sequence[Layer]]) -> list[Layer]:
        """The layer of each key; those that aren't there are made, all at once, by ``make`` from their places in ``keys``."""
        missing = [i for i, key in enumerate(keys) if key not in self._layers]
        fresh = dict(zip(missing, make(missing), strict=True)) if missing else {}
        for i, key in enumerate(keys):
            self._put(key, fresh[i] if i in fresh else self._layers[key])
        found = [self._layers[key] for key in keys]
        while self._pixels > KEPT_PIXELS and len(self._layers) > 1:
            self._pixels -= len(self._layers.pop(next(iter(self._layers))))
        return found

    def _put(self, key: Hashable, layer: Layer) -> None:
        before = self._layers.pop(key, None)
        self._pixels += len(layer) - (len(before) if before is not None else 0)
        self._layers[key] = layer

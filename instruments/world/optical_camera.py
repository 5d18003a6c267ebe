"""The optical cameras: the still background drawn once, things laid over it, lens and sensor.

A `View` is a camera with the ray of each pixel; what it computes for a thing depends on that thing
alone and is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instruments.world import backdrop as backdrops
from instruments.world.backdrop import Backdrop, Shade, ShadowMap, shade
from instruments.world.boards import Board, dark_parts_mm
from instruments.world.compositing import Cover, Layer, cover, cover_outlines, lay_over, merged
from instruments.world.objects import SceneObject
from instruments.world.optics import CameraModel, Floats
from instruments.world.sensor import (
    Expected,
    Grey,
    Image,
    OpticalReadout,
    OpticalSensor,
    blurred,
    blurred_by_depth,
    reach_px,
)
from instruments.world.shading import GLOSS_EXPONENT, Lighting, irradiance, seen_light
from instruments.world.solids import BLOCK, Ints, dot, meet
from instruments.world.state import SceneState, Stage

KEPT_PIXELS = 400_000


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """What solids show in the pixels they cover, n pairs sorted by thing; camera's frame."""

    cover: Cover
    owner: Ints  # which thing of the stage
    rays: Floats  # (3, n)
    depth_mm: Floats
    normals: Floats  # (3, n), unit

    def by_thing(self, count: int, value: NDArray[Any], along: Floats | None = None) -> list[Layer]:
        """A layer for each of ``count`` things, from a value for each pair."""
        ends = np.searchsorted(self.owner, np.arange(count + 1))
        return [self._layer(slice(*part), value, along) for part in pairwise(ends)]

    def _layer(self, part: slice, value: NDArray[Any], along: Floats | None) -> Layer:
        at = self.cover
        solid, row, column, share = at.solid[part], at.row[part], at.column[part], at.share[part]
        several = len(solid) > 0 and solid[0] != solid[-1]  # else no two meet in a pixel
        return (merged if several else Layer)(
            row,
            column,
            share,
            self.depth_mm[part],
            value[part],
            None if along is None else along[part],
        )


@dataclass(frozen=True, slots=True, eq=False)
class BoardSurface:
    """A board in a camera: covered pixels (n,), their dark share, and points (3, n), world."""

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
        rays = self._rays(covered)
        depth, normals, _ = meet(solids, covered.solid, rays[0], rays[1])
        return Surfaces(covered, stage.owner[covered.solid], rays, depth, normals)

    def heights(self, stage: Stage, seen: Surfaces) -> Floats:
        """Place of each surface along its thing, 0 to 1 from the first solid's a to the last one's
        b, (n,).
        """
        solids, numbers = stage.solids.in_camera(self.camera), np.arange(len(stage.things))
        first, last = (np.searchsorted(stage.owner, numbers + i) - i for i in (0, 1))
        foot, span = solids.a[first], solids.b[last] - solids.a[first]
        length = np.linalg.norm(span, axis=1)
        reach = np.maximum(length + np.where(solids.flat_b, 0.0, solids.radius_b)[last], 1e-9)
        whole = span / np.maximum(length, 1e-9)[:, None]
        axis = np.where((first == last)[:, None], solids.axis[first], whole)
        off = seen.depth_mm * seen.rays - foot[seen.owner].T
        return np.asarray(np.clip(dot(off, axis[seen.owner].T) / reach[seen.owner], 0.0, 1.0))

    def board(self, board: Board) -> BoardSurface:
        """A board; from behind it is plain."""
        camera = self.camera
        outline = camera.camera_from_world(board.outline_mm)
        whole = cover_outlines([outline], camera)
        facing = bool(board.normal @ (camera.centre_mm - np.asarray(board.corner_mm)) > 0.0)
        dark, parts = np.zeros(len(whole.share)), dark_parts_mm(board.pattern)
        if facing and parts:
            placed = [camera.camera_from_world(board.placed(part)) for part in parts]
            seen = cover_outlines(placed, camera)
            area = np.zeros((camera.height_px, camera.width_px))
            np.add.at(area, (seen.row, seen.column), seen.share)
            dark = np.clip(area[whole.row, whole.column] / whole.share, 0.0, 1.0)
        normal = camera.R @ board.normal
        rays = self._rays(whole)
        towards = normal @ rays
        # A pixel at the board's edge may look past it: its depth stays within the board's.
        plane = float(normal @ camera.camera_from_world(np.asarray(board.corner_mm)[None, :])[0])
        ahead = np.where(np.abs(towards) > 1e-9, towards, 1e-9)
        depth = np.clip(plane / ahead, outline[:, 2].min(), outline[:, 2].max())
        points = camera.R.T @ (depth * rays) + camera.centre_mm[:, None]
        return BoardSurface(whole, dark, depth, points, facing)

    def _rays(self, covered: Cover) -> Floats:
        pixel = covered.row * self.camera.width_px + covered.column
        x, y = (ray.reshape(-1)[pixel] for ray in self.rays)
        return np.stack([x, y, np.ones_like(x)])


class KeptLayers:
    """Layers by what they show; beyond `KEPT_PIXELS` in all, those not asked for the longest go."""

    def __init__(self) -> None:
        self._layers: dict[Hashable, Layer] = {}
        self._pixels = 0

    def of(
        self, keys: Sequence[Hashable], make: Callable[[list[int]], Sequence[Layer]]
    ) -> list[Layer]:
        """The layer of each key; ``make`` makes all missing ones from their places in ``keys``."""
        kept = [self._layers.pop(key, None) for key in keys]
        self._pixels -= sum(len(layer) for layer in kept if layer is not None)
        missing = [i for i, layer in enumerate(kept) if layer is None]
        fresh = iter(make(missing) if missing else ())
        found = [next(fresh) if layer is None else layer for layer in kept]
        latest = dict(zip(keys, found, strict=True))
        self._layers.update(latest)
        self._pixels += sum(map(len, latest.values()))
        while self._pixels > KEPT_PIXELS and len(self._layers) > 1:
            self._pixels -= len(self._layers.pop(next(iter(self._layers))))
        return found


BACKDROPS_KEPT = 2
SHARP_PX = 0.15  # less blur than this on top of the lens's own is left out
MOST_STEPS = 64  # pictures that make one smeared by motion


class OpticalCamera:
    """One optical camera: geometry, kept backdrops and layers, sensor."""

    def __init__(
        self, camera: CameraModel, sensor: OpticalSensor, seed: np.random.SeedSequence
    ) -> None:
        self.view = View(camera)
        self.readout = OpticalReadout(sensor, self.view.rays, seed)
        self._focal_px = float(camera.fc.mean())
        self._backdrops: dict[tuple[Backdrop, Lighting], tuple[Image, Image | None]] = {}
        self._layers = KeptLayers()
        self._latest: tuple[object, Expected | None] = (None, None)

    def expose(
        self, state: SceneState, shadows: ShadowMap | None, rng: np.random.Generator
    ) -> Grey:
        """One exposure, (height, width) uint8."""
        return self.readout.expose(self._expected(state, shadows), rng)

    def expected(self, state: SceneState, shadows: ShadowMap | None = None) -> Image:
        """Mean grey level of each pixel before noise and rounding, (height, width)."""
        return self._expected(state, shadows).mean.copy()

    def _expected(self, state: SceneState, shadows: ShadowMap | None) -> Expected:
        """The frame before noise; kept while nothing changes."""
        looks = tuple((thing.hulls, thing.paint) for thing in state.everything())
        fixed = state.boards, state.lighting, state.backdrop, state.exposure, state.velocity_mm_s
        key = (looks, fixed, shadows is None)
        kept, expected = self._latest
        if expected is None or kept != key:
            self._latest = None, None  # let go before the next is drawn
            expected = self.readout.expected(self._drawn(state, shadows), state.exposure)
            self._latest = key, expected
        return expected

    def _drawn(self, state: SceneState, shadows: ShadowMap | None) -> Image:
        """Light on the sensor: the backdrop, its shadows, and over it what stands there."""
        backdrop, view = self._backdrop(state), self.view
        dark = shade(shadows, state.backdrop, view.camera, view.rays) if shadows else None
        moments = self._moments(state)
        light, *others = (self._lens(*backdrop, dark, self._seen(moment)) for moment in moments)
        for other in others:
            light += other
        if others:
            light /= np.float32(len(moments))
        return light

    def _moments(self, state: SceneState) -> list[SceneState]:
        """Even moments of the exposure, less than half a pixel of motion apart."""
        if not state.moves:
            return [state]
        velocities = state.velocity_mm_s, *(board.velocity_mm_s for board in state.boards)
        speed = max(float(np.linalg.norm(v)) for v in velocities)
        ends = [state.phantom.ends_mm, *(board.outline_mm for board in state.boards)]
        nearest = float(self.view.camera.camera_from_world(np.concatenate(ends))[:, 2].min())
        smear_px = speed * state.exposure.time_s * self._focal_px / max(nearest, 1.0)
        steps = min(int(np.ceil(2.0 * smear_px)) + 1, MOST_STEPS)
        return [
            state.later(state.exposure.time_s * ((i + 0.5) / steps - 0.5)) for i in range(steps)
        ]

    def _lens(
        self, empty: Image, soft: Image | None, dark: Shade | None, layers: Sequence[Layer]
    ) -> Image:
        """Light on the sensor; out-of-focus things in layers, far to near."""
        sharp = self.readout.sensor.blur_px
        extra = [self._defocus(layer) for layer in layers]
        if soft is None and max(extra, default=0.0) > 0.0:
            soft = blurred(empty, sharp)
        light = (empty if soft is None else soft).copy()
        if dark is not None:
            light[dark.rows, dark.columns] *= dark.share
        if soft is None:
            lay_over(light, layers, [layer.value for layer in layers])
            return blurred(light, sharp)
        for i in sorted(range(len(layers)), key=lambda i: -_depth(layers[i])):
            layer, sigma = layers[i], float(np.hypot(extra[i], sharp))
            if len(layer) == 0:
                continue
            rows, columns = _around(layer, reach_px(sigma), light.shape)
            corner, behind = (rows.start, columns.start), light[rows, columns]
            cover, own = np.zeros_like(behind), np.zeros_like(behind)
            lay_over(own, [layer], [layer.value], corner)
            lay_over(cover, [layer], [np.ones_like(layer.value)], corner)
            behind *= 1.0 - blurred(cover, sigma)
            behind += blurred(own, sigma)
        return light

    def _defocus(self, layer: Layer) -> float:
        """Blur of a layer by its distance, on top of the lens's own; 0 where that doesn't show."""
        if len(layer) == 0:
            return 0.0
        sigma = float(self.readout.sensor.focus.sigma_px(_depth(layer), self._focal_px))
        sharp = self.readout.sensor.blur_px
        return sigma if np.hypot(sigma, sharp) - sharp > SHARP_PX else 0.0

    def _backdrop(self, state: SceneState) -> tuple[Image, Image | None]:
        """The empty scene's light before the lens, and on the sensor where it is out of focus."""
        key = (state.backdrop, state.lighting)
        if key not in self._backdrops:
            while len(self._backdrops) >= BACKDROPS_KEPT:
                self._backdrops.pop(next(iter(self._backdrops)))
            empty, depth, span = backdrops.draw(state.backdrop, state.lighting, self.view.camera)
            soft = None
            # blur grows both ways from what is in focus
            ends = self._sigma(np.array(span, dtype=np.float32))
            if float(ends.max()) - self.readout.sensor.blur_px > SHARP_PX:
                soft = blurred_by_depth(empty, self._sigma(depth).astype(np.float32))
            self._backdrops[key] = empty, soft
        return self._backdrops[key]

    def _sigma(self, depth_mm: NDArray[np.floating]) -> Floats:
        sensor = self.readout.sensor
        return np.hypot(sensor.focus.sigma_px(depth_mm, self._focal_px), sensor.blur_px)

    def _seen(self, state: SceneState) -> list[Layer]:
        """The layer of each thing and each board."""
        things, lighting = state.everything(), state.lighting
        keys = [(thing.hulls, thing.paint, lighting) for thing in things]
        layers = self._layers.of(
            keys, lambda which: self._things([things[i] for i in which], lighting)
        )
        boards = [(board, lighting) for board in state.boards]
        return layers + self._layers.of(
            boards, lambda which: [self._board(state.boards[i], lighting) for i in which]
        )

    def _things(self, things: Sequence[SceneObject], lighting: Lighting) -> list[Layer]:
        stage = Stage.of(things)
        seen = self.view.surfaces(stage)
        turn = self.view.camera.R.T.astype(np.float32)
        eye = self.view.camera.centre_mm.astype(np.float32)[:, None]
        looks = [(thing.paint.albedo, thing.paint.gloss) for thing in things]
        paints = np.array(looks, dtype=np.float32).reshape(-1, 2).T
        exponents = np.array([thing.paint.gloss_exponent for thing in things], dtype=np.float32)
        usual = bool(np.all(exponents == GLOSS_EXPONENT))
        light = np.empty(len(seen.owner), dtype=np.float32)
        for start in range(0, len(light), BLOCK):
            part = slice(start, start + BLOCK)
            points = turn @ (seen.depth_mm[part] * seen.rays[:, part]).astype(np.float32) + eye
            normals = turn @ seen.normals[:, part].astype(np.float32)
            albedo, gloss = paints[:, seen.owner[part]]
            exponent = GLOSS_EXPONENT if usual else exponents[seen.owner[part]]
            light[part] = seen_light(lighting, points, normals, eye, albedo, gloss, exponent)
        return seen.by_thing(len(things), light)

    def _board(self, board: Board, lighting: Lighting) -> Layer:
        seen = self.view.board(board)
        normal = (board.normal if seen.facing else -board.normal)[:, None]
        albedo = board.light_albedo + seen.dark * (board.dark_albedo - board.light_albedo)
        light = (albedo * irradiance(lighting, seen.points_mm, normal)).astype(np.float32)
        return Layer(seen.cover.row, seen.cover.column, seen.cover.share, seen.depth_mm, light)


def _depth(layer: Layer) -> float:
    return float(np.add.reduce(layer.depth_mm)) / len(layer) if len(layer) else 0.0


def _around(layer: Layer, reach: int, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """The part of an image that a layer changes, with the lens's blur around it."""
    spans = zip((layer.row, layer.column), shape, strict=True)
    rows, columns = (
        slice(max(int(at.min()) - reach, 0), min(int(at.max()) + 1 + reach, size))
        for at, size in spans
    )
    return rows, columns

"""The optical cameras: the still background drawn once, things laid over it, lens and sensor.

A `PixelRays` is a camera with the ray of each pixel; what it computes for a thing depends on that
thing alone and is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from instruments.world import backdrop as backdrops
from instruments.world.backdrop import Backdrop, ShadowMap, shade
from instruments.world.boards import Board, dark_parts_mm
from instruments.world.compositing import Cover, Layer, cover, cover_outlines, lay_over, merged
from instruments.world.objects import SceneObject
from instruments.world.optics import CameraModel, Floats
from instruments.world.sensor import (
    Exposure,
    Grey,
    Image,
    OpticalReadout,
    OpticalSensor,
    Part,
    Words,
    blurred,
    blurred_by_depth,
    reach_px,
)
from instruments.world.shading import GLOSS_EXPONENT, Lighting, irradiance, seen_light
from instruments.world.solids import Ints, dot, intersect
from instruments.world.state import SceneState, Stage

BLOCK = 8192  # pairs at a time: what is worked out on the way stays in the processor's cache
KEPT_PIXELS = 100_000  # 5 MB a camera: a scene or two
T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """What solids show in the pixels they cover, n pairs sorted by thing; camera's frame."""

    cover: Cover
    owner: Ints  # which thing of the stage
    rays: Floats  # (3, n)
    depth_mm: Floats
    normals: Floats  # (3, n), unit

    @property
    def facing(self) -> Floats:
        """Cosine of the angle between each ray and its normal, (n,)."""
        rays = self.rays
        return np.asarray(np.abs(dot(rays, self.normals)) / np.sqrt(dot(rays, rays)))

    def by_thing(self, count: int, value: NDArray[Any], along: Floats | None = None) -> list[Layer]:
        """A layer for each of ``count`` things, from a value for each pair."""
        at, layers = self.cover, []
        for start, end in pairwise(np.searchsorted(self.owner, np.arange(count + 1))):
            part = slice(start, end)
            own = None if along is None else along[part]
            row, column, share = at.row[part], at.column[part], at.share[part]
            layer = Layer(row, column, share, self.depth_mm[part], value[part], own)
            solid = at.solid[part]
            several = len(solid) > 0 and solid[0] != solid[-1]  # else no two meet in a pixel
            layers.append(merged(layer) if several else layer)
        return layers


@dataclass(frozen=True, slots=True, eq=False)
class BoardSurface:
    """A board in a camera: pixels (n,), dark shares, points (3, n), ``normal`` (3,), world."""

    cover: Cover
    dark: Floats
    depth_mm: Floats
    points_mm: Floats
    normal: Floats

    def layer(self, value: NDArray[Any], along: Floats | None = None) -> Layer:
        """Its layer, from a value for each pixel."""
        at = self.cover
        return Layer(at.row, at.column, at.share, self.depth_mm, value, along)


class PixelRays:
    """A camera with the ray of each of its pixels: what of the stage it sees, and where."""

    def __init__(self, camera: CameraModel) -> None:
        self.camera = camera
        self.rays = camera.rays()

    def surfaces(self, stage: Stage) -> Surfaces:
        """Every surface of every thing in every pixel that it covers."""
        solids = stage.solids.in_camera(self.camera)
        covered = cover(solids, self.camera)
        rays = self._rays(covered)
        depth, normals, _ = intersect(solids, covered.solid, rays[0], rays[1])
        return Surfaces(covered, stage.owner[covered.solid], rays, depth, normals)

    def heights(self, stage: Stage, seen: Surfaces) -> Floats:
        """Place of each surface along its thing, 0 to 1, (n,)."""
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
        return BoardSurface(whole, dark, depth, points, board.normal if facing else -board.normal)

    def _rays(self, covered: Cover) -> Floats:
        pixel = covered.row * self.camera.width_px + covered.column
        x, y = (ray.reshape(-1)[pixel] for ray in self.rays)
        return np.stack([x, y, np.ones_like(x)])


class KeptLayers:
    """Layers by what they show: the last asked for, and others while all are `KEPT_PIXELS` at most;
    those not asked for the longest go.
    """

    def __init__(self) -> None:
        self._layers: dict[Hashable, Layer] = {}
        self._pixels = 0

    def of(
        self,
        items: Sequence[T],
        look: Callable[[T], Hashable],
        make: Callable[[list[T]], Sequence[Layer]],
    ) -> list[Layer]:
        """The layer of each item, kept by its ``look``; ``make`` makes all missing ones."""
        keys = [look(item) for item in items]
        kept = [self._layers.pop(key, None) for key in keys]
        self._pixels -= sum(len(layer) for layer in kept if layer is not None)
        missing = [item for item, layer in zip(items, kept, strict=True) if layer is None]
        fresh = iter(make(missing) if missing else ())
        found = [next(fresh) if layer is None else layer for layer in kept]
        latest = dict(zip(keys, found, strict=True))
        self._layers.update(latest)
        self._pixels += sum(map(len, latest.values()))
        while self._pixels > KEPT_PIXELS and len(self._layers) > len(latest):
            self._pixels -= len(self._layers.pop(next(iter(self._layers))))
        return found


BACKDROPS_KEPT = 4  # two of each camera of a rig, which commands and tests open again
SHARP_PX = 0.15  # less blur than this on top of the lens's own is left out
SPARSE = 16  # pixels in either direction, of which one tells how bright a backdrop is
MOST_STEPS = 64  # pictures that make one smeared by motion
# Columns that a processor's vectors hold, and some more: of whole ones, the lens makes the same
# of a part as of the whole picture, bit by bit.
LANES = 16


class OpticalCamera:
    """One optical camera: geometry, kept backdrops and layers, sensor."""

    def __init__(
        self, camera: CameraModel, sensor: OpticalSensor, seed: np.random.SeedSequence
    ) -> None:
        self.view = PixelRays(camera)
        self.readout = OpticalReadout(sensor, self.view.rays, seed)
        self._focal_px = float(camera.fc.mean())
        self._sparse = camera.sparse(SPARSE)
        self._layers = KeptLayers()
        self._latest: object = None  # what the kept light is of
        self._still: tuple[object, Image, Image] | None = None  # of what, empty, and with things
        self._changed = list[Part]()  # where these two differ

    def expose(
        self, state: SceneState, shadows: ShadowMap | None, rng: np.random.Generator
    ) -> Grey:
        """One exposure, (height, width) uint8."""
        return self.exposed(state, shadows, self.noise(rng))

    def noise(self, rng: np.random.Generator) -> Words:
        """Fresh noise of one exposure: all that it needs of chance."""
        return self.readout.noise(rng)

    def exposed(self, state: SceneState, shadows: ShadowMap | None, noise: Words) -> Grey:
        """One exposure with `noise`, (height, width) uint8."""
        return self.readout.exposed(self._light(state, shadows), noise, state.exposure)

    def expected(self, state: SceneState, shadows: ShadowMap | None = None) -> Image:
        """Mean grey level of each pixel before noise and rounding, (height, width)."""
        return self.readout.mean(self._light(state, shadows), state.exposure)

    def white_share(self, lighting: Lighting, backdrop: Backdrop, exposure: Exposure) -> float:
        """Which share of the picture would be white with nothing before the backdrop, without its
        textures and from few of its pixels: no more than 0.05 off.
        """
        plain = replace(backdrop, board_texture=0.0, table_texture=0.0)
        light, *_ = backdrops.draw(plain, lighting, self._sparse)
        level = self.readout.mean(light, exposure, SPARSE)
        return float(np.mean(level >= 2**self.readout.sensor.bits - 2))

    def _light(self, state: SceneState, shadows: ShadowMap | None) -> Image:
        """Light on the sensor, (height, width); kept while nothing changes."""
        looks = tuple((thing.hulls, thing.paint) for thing in state.everything())
        fixed = state.boards, state.lighting, state.backdrop, state.exposure, state.velocity_mm_s
        key, lit = (looks, fixed, shadows is None), (state.backdrop, state.lighting)
        if self._still is None or self._still[0] != lit:
            self._latest = self._still = None  # let go before the next is drawn
            sensor = self.readout.sensor
            empty, soft = _empty(*lit, self.view.camera, sensor)
            still = blurred(empty, sensor.blur_px) if soft is None else soft
            self._still, self._changed = (lit, still, still.copy()), []
        _, still, light = self._still
        if self._latest != key:
            self._latest, drawn = None, self._drawn(state, shadows)
            for part in self._changed:
                light[part] = still[part]
            for part, seen in drawn:
                light[part] = seen
            self._latest, self._changed = key, [part for part, _ in drawn]
        return light

    def _drawn(self, state: SceneState, shadows: ShadowMap | None) -> list[tuple[Part, Image]]:
        """The part of the picture that isn't empty, and light on the sensor there: the backdrop,
        its shadows, and over it what stands there. Nothing where nothing does.
        """
        camera, moments = self.view.camera, [self._seen(one) for one in self._moments(state)]
        empty, soft = _empty(state.backdrop, state.lighting, camera, self.readout.sensor)
        dark = shade(shadows, state.backdrop, camera) if shadows else None
        layers = [layer for seen in moments for layer in seen if len(layer)]
        parts = [layer.around for layer in layers] + ([dark[0]] if dark else [])
        if not parts:
            return []
        reach = reach_px(max(self._blurs(layers), default=self.readout.sensor.blur_px))
        part = _wider(_joined(parts), reach, empty.shape)
        wide = _wider(part, reach, empty.shape)  # the lens brings light from there
        dark = dark and (_within(dark[0], wide), dark[1])
        behind = empty[wide], None if soft is None else soft[wide], dark
        pictures = (
            self._lens(*behind, wide, [one for one in seen if len(one)]) for seen in moments
        )
        light = next(pictures)
        for other in pictures:
            light += other
        if len(moments) > 1:
            light /= np.float32(len(moments))
        return [(part, light[_within(part, wide)])]

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
        self,
        empty: Image,
        soft: Image | None,
        dark: tuple[Part, Image] | None,
        wide: Part,
        layers: Sequence[Layer],
    ) -> Image:
        """Light on a part of the sensor; out-of-focus things in layers, far to near."""
        sharp, blurs = self.readout.sensor.blur_px, self._blurs(layers)
        if soft is None and max(blurs, default=sharp) > sharp:
            soft = blurred(empty, sharp)
        light = (empty if soft is None else soft).copy()
        if dark is not None:
            light[dark[0]] *= dark[1]
        if soft is None:
            lay_over(light, layers, (wide[0].start, wide[1].start))
            return blurred(light, sharp)
        shape = self.view.rays[0].shape
        for i in sorted(range(len(layers)), key=lambda i: -layers[i].mean_depth_mm):
            layer, sigma = layers[i], blurs[i]
            part = _wider(layer.around, reach_px(sigma), shape, lanes=1)
            corner, behind = (part[0].start, part[1].start), light[_within(part, wide)]
            cover, own = np.zeros_like(behind), np.zeros_like(behind)
            lay_over(own, [layer], corner)
            lay_over(cover, [replace(layer, value=np.ones_like(layer.value))], corner)
            behind *= 1.0 - blurred(cover, sigma)
            behind += blurred(own, sigma)
        return light

    def _blurs(self, layers: Sequence[Layer]) -> list[float]:
        """Blur of each layer's picture, sigma in px."""
        sensor, sharp = self.readout.sensor, self.readout.sensor.blur_px
        depths = (layer.mean_depth_mm for layer in layers)
        blurs = (float(_sigma_px(sensor, depth, self._focal_px)) for depth in depths)
        return [sigma if sigma - sharp > SHARP_PX else sharp for sigma in blurs]

    def _seen(self, state: SceneState) -> list[Layer]:
        """The layer of each thing and each board."""
        lighting = state.lighting
        things = self._layers.of(
            state.everything(),
            lambda thing: (thing.hulls, thing.paint, lighting),
            lambda new: self._things(new, lighting),
        )
        boards = self._layers.of(
            state.boards,
            lambda board: (board, lighting),
            lambda new: [self._board(board, lighting) for board in new],
        )
        return things + boards

    def _things(self, things: Sequence[SceneObject], lighting: Lighting) -> list[Layer]:
        stage = Stage.of(things)
        seen = self.view.surfaces(stage)
        turn = self.view.camera.R.T.astype(np.float32)
        eye = self.view.camera.centre_mm.astype(np.float32)
        looks = [(thing.paint.albedo, thing.paint.gloss) for thing in things]
        paints = np.array(looks, dtype=np.float32).reshape(-1, 2).T
        exponents = np.array([thing.paint.gloss_exponent for thing in things], dtype=np.float32)
        usual = bool(np.all(exponents == GLOSS_EXPONENT))
        light = np.empty(len(seen.owner), dtype=np.float32)
        for start in range(0, len(light), BLOCK):
            part = slice(start, start + BLOCK)
            points = turn @ (seen.depth_mm[part] * seen.rays[:, part]).astype(np.float32)
            points += eye[:, None]
            normals = turn @ seen.normals[:, part].astype(np.float32)
            owner = seen.owner[part]
            albedo, gloss = np.repeat(paints, np.bincount(owner, minlength=len(things)), axis=1)
            exponent = GLOSS_EXPONENT if usual else exponents[owner]
            light[part] = seen_light(lighting, points, normals, eye, albedo, gloss, exponent)
        return seen.by_thing(len(things), light)

    def _board(self, board: Board, lighting: Lighting) -> Layer:
        seen = self.view.board(board)
        albedo = board.light_albedo + seen.dark * (board.dark_albedo - board.light_albedo)
        light = albedo * irradiance(lighting, seen.points_mm, seen.normal[:, None])
        return seen.layer(light.astype(np.float32))


@lru_cache(BACKDROPS_KEPT)
def _empty(
    backdrop: Backdrop, lighting: Lighting, camera: CameraModel, sensor: OpticalSensor
) -> tuple[Image, Image | None]:
    """The empty scene's light before the lens, and on the sensor where it is out of focus."""
    empty, depth, span = backdrops.draw(backdrop, lighting, camera)
    empty.flags.writeable = False  # it is kept
    focal_px = float(camera.fc.mean())
    # blur grows both ways from what is in focus
    if max(_sigma_px(sensor, end, focal_px) for end in span) - sensor.blur_px <= SHARP_PX:
        return empty, None
    sigma = _sigma_px(sensor, depth, focal_px)
    return empty, blurred_by_depth(empty, sigma.astype(np.float32))


def _sigma_px(
    sensor: OpticalSensor, depth_mm: NDArray[np.floating] | float, focal_px: float
) -> Floats:
    """Blur at a depth, of the lens and out of focus."""
    return np.asarray(np.hypot(sensor.focus.sigma_px(depth_mm, focal_px), sensor.blur_px))


def _joined(parts: Sequence[Part]) -> Part:
    """The least part that holds them all."""
    rows, columns = (
        slice(min(one.start for one in spans), max(one.stop for one in spans))
        for spans in zip(*parts, strict=True)
    )
    return rows, columns


def _wider(part: Part, reach: int, shape: tuple[int, ...], lanes: int = LANES) -> Part:
    """A part with ``reach`` pixels around it, its columns in whole ``lanes``."""
    (rows, columns), (tall, wide) = part, shape
    left, right = (columns.start - reach) // lanes, -(-(columns.stop + reach) // lanes)
    return (
        slice(max(rows.start - reach, 0), min(rows.stop + reach, tall)),
        slice(max(left * lanes, 0), min(right * lanes, wide)),
    )


def _within(part: Part, outer: Part) -> Part:
    """A part's place in an outer one."""
    rows, columns = (
        slice(one.start - out.start, one.stop - out.start)
        for one, out in zip(part, outer, strict=True)
    )
    return rows, columns

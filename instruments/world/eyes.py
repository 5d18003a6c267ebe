"""The cameras at work: geometry, what never moves drawn once and kept, what stands before it drawn anew, and the sensor.

May not know where a state comes from, nor what is made of a frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instruments.world import backdrop as backdrops
from instruments.world.backdrop import Backdrop
from instruments.world.composite import lay_over
from instruments.world.coverage import Cover, cover
from instruments.world.optics import CameraModel, Floats
from instruments.world.raycast import BLOCK, meet
from instruments.world.sensor import Expected, Image, OpticalReadout, OpticalSensor, ThermalReadout, ThermalSensor
from instruments.world.shading import Lighting, heat, kelvin_from_radiance, radiance_from_c, seen_light
from instruments.world.shadow import Shade, ShadowMap, shade, shadow_map
from instruments.world.solids import Ints
from instruments.world.state import SceneState, Stage

BACKDROPS_KEPT = 3
BLUR_REACH_PX = 4


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """What each solid shows in each pixel that it covers, n pairs, hidden or not; camera's frame."""

    cover: Cover
    owner: Ints  # which thing of the stage
    rays: Floats  # (3, n)
    depth_mm: Floats
    normals: Floats  # (3, n), unit


class View:
    """A camera with the ray of each of its pixels: what of the stage it sees, and where."""

    def __init__(self, camera: CameraModel) -> None:
        self.camera = camera
        self.rays = camera.rays()

    def surfaces(self, stage: Stage) -> Surfaces:
        """Every surface of every thing in every pixel that it covers."""
        solids = stage.solids.in_camera(self.camera)
        covered = cover(solids, self.camera)
        pixel = covered.row * self.camera.width_px + covered.column
        x, y = (ray.reshape(-1)[pixel] for ray in self.rays)
        depth, normals, _ = meet(solids, covered.solid, x, y)
        return Surfaces(covered, stage.owner[covered.solid], np.stack([x, y, np.ones_like(x)]), depth, normals)


class OpticalCamera:
    """One optical camera: geometry, kept backdrops, sensor."""

    def __init__(self, camera: CameraModel, sensor: OpticalSensor, seed: np.random.SeedSequence) -> None:
        self.view = View(camera)
        self.readout = OpticalReadout(sensor, self.view.rays, seed)
        self._kept: dict[tuple[Backdrop, Lighting], tuple[Image, Expected]] = {}

    def expose(self, state: SceneState, stage: Stage, shadows: ShadowMap | None, rng: np.random.Generator) -> NDArray[np.uint8]:
        """One exposure, (height, width) uint8."""
        return self.readout.expose(self._parts(state, stage, shadows), rng)

    def expected(self, state: SceneState) -> Image:
        """Mean grey level of each pixel before noise and rounding, (height, width)."""
        stage = Stage.of(state)
        whole, *parts = self._parts(state, stage, shadow_map(state.lighting, stage.solids))
        mean = whole.mean.copy()
        for part in parts:
            mean[part.rows, part.columns] = part.mean
        return mean

    def _parts(self, state: SceneState, stage: Stage, shadows: ShadowMap | None) -> list[Expected]:
        """The empty scene, and over it the part of the image where anything stands or throws its shadow."""
        empty, whole = self._backdrop(state.backdrop, state.lighting)
        seen = self.view.surfaces(stage)
        dark = None if shadows is None else shade(shadows, state.backdrop, self.view.camera, self.view.rays)
        around = _bounds(seen.cover, dark, empty.shape)
        if around is None:
            return [whole]
        rows, columns = around
        light = empty[rows, columns].copy()
        if dark is not None:
            light[_within(dark.rows, rows), _within(dark.columns, columns)] *= dark.share
        pixel = (seen.cover.row - rows.start) * light.shape[1] + seen.cover.column - columns.start
        value = self._light(state.lighting, stage, seen)
        lay_over(light.reshape(-1), pixel, seen.cover.share, seen.depth_mm, seen.owner, value)
        return [whole, self.readout.expected(self.readout.blurred(light), rows, columns)]

    def _backdrop(self, backdrop: Backdrop, lighting: Lighting) -> tuple[Image, Expected]:
        """Light from the empty scene before the lens, and what the sensor makes of it."""
        key = (backdrop, lighting)
        if key not in self._kept:
            while len(self._kept) >= BACKDROPS_KEPT:
                self._kept.pop(next(iter(self._kept)))
            empty = backdrops.draw(backdrop, lighting, self.view.camera, self.view.rays)
            self._kept[key] = empty, self.readout.expected(self.readout.blurred(empty), slice(None), slice(None))
        return self._kept[key]

    def _light(self, lighting: Lighting, stage: Stage, seen: Surfaces) -> Image:
        """Light from each surface towards this camera, (n,)."""
        turn = self.view.camera.R.T.astype(np.float32)
        eye = self.view.camera.centre_mm.astype(np.float32)[:, None]
        paints = np.array([(thing.paint.albedo, thing.paint.gloss) for thing in stage.things], dtype=np.float32).reshape(-1, 2).T
        light = np.empty(len(seen.owner), dtype=np.float32)
        for start in range(0, len(light), BLOCK):
            part = slice(start, start + BLOCK)
            points = turn @ (seen.depth_mm[part] * seen.rays[:, part]).astype(np.float32) + eye
            normals = turn @ seen.normals[:, part].astype(np.float32)
            albedo, gloss = paints[:, seen.owner[part]]
            light[part] = seen_light(lighting, points, normals, eye, albedo, gloss)
        return light


def _bounds(covered: Cover, dark: Shade | None, shape: tuple[int, ...]) -> tuple[slice, slice] | None:
    """The part of an image that surfaces and shadows change, with the reach of the lens's blur around it."""
    rows: list[tuple[int, int]] = []
    columns: list[tuple[int, int]] = []
    if len(covered.share):
        rows.append((int(covered.row.min()), int(covered.row.max()) + 1))
        columns.append((int(covered.column.min()), int(covered.column.max()) + 1))
    if dark is not None:
        rows.append((dark.rows.start, dark.rows.stop))
        columns.append((dark.columns.start, dark.columns.stop))
    return (_around(rows, shape[0]), _around(columns, shape[1])) if rows else None


def _around(spans: list[tuple[int, int]], size: int) -> slice:
    return slice(max(min(low for low, _ in spans) - BLUR_REACH_PX, 0), min(max(high for _, high in spans) + BLUR_REACH_PX, size))


def _within(part: slice, whole: slice) -> slice:
    return slice(part.start - whole.start, part.stop - whole.start)


class ThermalCamera:
    """The thermal camera: geometry on a grid finer than its sensor, and the sensor."""

    def __init__(self, camera: CameraModel, sensor: ThermalSensor, seed: np.random.SeedSequence) -> None:
        self.camera = camera
        self.view = View(camera.resized(sensor.width_px * sensor.oversample, sensor.height_px * sensor.oversample))
        self.readout = ThermalReadout(sensor, seed)

    def expected_k(self, state: SceneState, stage: Stage) -> Floats:
        """Apparent temperature of each sensor pixel before noise, kelvin, un-mirrored, (height, width)."""
        seen = self.view.surfaces(stage)
        warmth = stage.temperatures_c(state)
        emissivity = np.array([thing.paint.emissivity for thing in stage.things], dtype=np.float64)
        value = heat(warmth, emissivity, state.ambient_c)[seen.owner]
        radiance = np.full((self.view.camera.height_px, self.view.camera.width_px), float(radiance_from_c(state.ambient_c)))
        pixel = seen.cover.row * radiance.shape[1] + seen.cover.column
        lay_over(radiance.reshape(-1), pixel, seen.cover.share, seen.depth_mm, seen.owner, value)
        return kelvin_from_radiance(self.readout.gathered(radiance))

    def expose(self, state: SceneState, stage: Stage, rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """One frame: 8-bit as delivered, and centi-kelvin."""
        centikelvin = self.readout.expose(self.expected_k(state, stage), rng)
        return self.readout.delivered(centikelvin, self.camera.width_px, self.camera.height_px), centikelvin

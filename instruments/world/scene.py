"""The simulated scene and its renderer: one `SceneState` in, one frame set of the three cameras out.

Analytic: every solid's share of every pixel is an area computed exactly (coverage), its depth and normal a root of a quadratic
(raycast), so nothing is sampled and no edge depends on its sub-pixel phase. What never moves is drawn once a
camera and kept. Visibility of the teat ends comes from the same solids by rays of its own.
Same state, same generator: same bytes. May not know of any detector, of instruments or of the bench.

Not modelled: shadows on solids, light that bounces between surfaces, defocus with depth, motion during exposure,
reflections of heat between objects, drift of the thermal camera between its flat-field events.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instruments.world import backdrop as backdrops
from instruments.world.backdrop import Backdrop
from instruments.world.composite import lay_over
from instruments.world.coverage import Cover, cover
from instruments.world.objects import TEAT_PAINT, SceneObject, phantom_objects
from instruments.world.optics import CameraModel, Floats, cameras_from_calibration
from instruments.world.phantom import Phantom
from instruments.world.raycast import BLOCK, meet
from instruments.world.sensor import Expected, Image, OpticalReadout, OpticalSensor, ThermalReadout, ThermalSensor
from instruments.world.shading import Lighting, Paint, heat, kelvin_from_radiance, radiance_from_c, seen_light
from instruments.world.shadow import Shade, ShadowMap, shade, shadow_map
from instruments.world.solids import Bools, Ints, Solids
from instruments.world.visibility import seen_share

BACKDROPS_KEPT = 3
BLUR_REACH_PX = 4
LOWEST_MM = 1.0  # below the table: paint and play
LEAST_SEEN = 0.5  # of a rounded end's near side


@dataclass(frozen=True, slots=True)
class SceneState:
    """Everything that the cameras can see at one moment. Temperatures in degC, one for each teat, in the phantom's order.

    ``teat_paint`` is the phantom's paint; the room (board, table, what is mirrored in paint) is at ``ambient_c``. Raises ValueError
    where the number of temperatures is wrong, or an object reaches below the table or behind the board.
    """

    phantom: Phantom
    teat_temps_c: tuple[float, ...]
    hose_temp_c: float
    ambient_c: float
    objects: tuple[SceneObject, ...] = ()
    lighting: Lighting = field(default_factory=Lighting)
    backdrop: Backdrop = field(default_factory=Backdrop)
    teat_paint: Paint = TEAT_PAINT

    def __post_init__(self) -> None:
        if len(self.teat_temps_c) != len(self.phantom.teats):
            raise ValueError(f"the phantom has {len(self.phantom.teats)} teats, but there are {len(self.teat_temps_c)} teat temperatures")
        temps = {"a teat": self.teat_temps_c, "the hoses": (self.hose_temp_c,), "the room": (self.ambient_c,)}
        for what, values in temps.items():
            if not all(-60.0 <= value <= 200.0 for value in values):
                raise ValueError(f"the temperature of {what} must be from -60 to 200 degC, is {values}")
        _refuse_outside(Stage.of(self), self.backdrop)

    def everything(self) -> tuple[SceneObject, ...]:
        """All that stands on the table: the teats first, in their order."""
        return (*phantom_objects(self.phantom, self.teat_paint, self.teat_temps_c, self.hose_temp_c), *self.objects)


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """All solids of a state as columns in the world frame, and which thing of ``things`` each belongs to, (k,)."""

    things: tuple[SceneObject, ...]
    solids: Solids
    owner: Ints

    @classmethod
    def of(cls, state: SceneState) -> Stage:
        """What stands on the table in a state."""
        things = state.everything()
        solids = Solids.from_hulls([hull for thing in things for hull in thing.hulls])
        return cls(things, solids, np.repeat(np.arange(len(things)), [len(thing.hulls) for thing in things]))


def _refuse_outside(stage: Stage, backdrop: Backdrop) -> None:
    low = np.flatnonzero(stage.solids.nearest_depth() < -LOWEST_MM)
    if len(low):
        raise ValueError(f"{stage.things[stage.owner[low[0]]].name} reaches below the table (z = 0): raise it")
    far = np.flatnonzero(np.maximum(stage.solids.a[:, 1], stage.solids.b[:, 1]) > backdrop.board_y_mm)
    if len(far):
        name = stage.things[stage.owner[far[0]]].name
        raise ValueError(f"{name} stands behind the board (y = {backdrop.board_y_mm:g} mm), where no camera sees it")


@dataclass(frozen=True, slots=True, eq=False)
class RenderedSet:
    """``left``, ``right`` uint8; ``thermal_8bit`` uint8 as delivered; ``thermal_ck`` uint16 centi-kelvin on the sensor's grid, un-mirrored."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    thermal_8bit: NDArray[np.uint8]
    thermal_ck: NDArray[np.uint16]


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
        teat_c = float(np.mean(state.teat_temps_c)) if state.teat_temps_c else state.ambient_c
        warmth = np.array([thing.temperature_c(state.ambient_c, teat_c) for thing in stage.things], dtype=np.float64)
        emissivity = np.array([thing.paint.emissivity for thing in stage.things], dtype=np.float64)
        value = heat(warmth, emissivity, state.ambient_c)[seen.owner]
        radiance = np.full(self.view.rays[0].shape, float(radiance_from_c(state.ambient_c)))
        pixel = seen.cover.row * radiance.shape[1] + seen.cover.column
        lay_over(radiance.reshape(-1), pixel, seen.cover.share, seen.depth_mm, seen.owner, value)
        return kelvin_from_radiance(self.readout.gathered(radiance))

    def expose(self, state: SceneState, stage: Stage, rng: np.random.Generator) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """One frame: 8-bit as delivered, and centi-kelvin."""
        centikelvin = self.readout.expose(self.expected_k(state, stage), rng)
        return self.readout.delivered(centikelvin, self.camera.width_px, self.camera.height_px), centikelvin


class Renderer:
    """Three cameras before one scene.

    ``cameras`` left, right, thermal; ``camera_seed`` fixes what is peculiar to these very cameras (their fixed patterns).
    """

    def __init__(
        self,
        cameras: tuple[CameraModel, CameraModel, CameraModel],
        camera_seed: int,
        optical: OpticalSensor | None = None,
        thermal: ThermalSensor | None = None,
    ) -> None:
        seeds = np.random.SeedSequence(camera_seed).spawn(3)
        sensor = optical or OpticalSensor()
        self.cameras = cameras
        self.left = OpticalCamera(cameras[0], sensor, seeds[0])
        self.right = OpticalCamera(cameras[1], sensor, seeds[1])
        self.thermal = ThermalCamera(cameras[2], thermal or ThermalSensor(), seeds[2])

    @classmethod
    def from_calibration(cls, table: Mapping[str, Any], camera_seed: int) -> Renderer:
        """From a parsed calibration file; the thermal camera's sensor_size, mirrored and polarity are taken from it where they stand."""
        entry = table.get("cameras", {}).get("thermal", {})
        default = ThermalSensor()
        width, height = entry.get("sensor_size", (default.width_px, default.height_px))
        polarity = entry.get("polarity", "hot_is_black")
        if polarity not in ("hot_is_black", "hot_is_white"):
            raise ValueError(f'calibration: cameras.thermal.polarity must be "hot_is_black" or "hot_is_white", is {polarity!r}')
        mirrored = bool(entry.get("mirrored", default.mirrored))
        sensor = replace(default, width_px=int(width), height_px=int(height), mirrored=mirrored, hot_is_black=polarity == "hot_is_black")
        return cls(cameras_from_calibration(table), camera_seed, thermal=sensor)

    def render(self, view: SceneState, rng: np.random.Generator) -> RenderedSet:
        """A frame set with fresh noise from ``rng``. Raises ValueError where something stands too near a camera."""
        stage = Stage.of(view)
        shadows = shadow_map(view.lighting, stage.solids)
        left = self.left.expose(view, stage, shadows, rng)
        right = self.right.expose(view, stage, shadows, rng)
        return RenderedSet(left, right, *self.thermal.expose(view, stage, rng))

    def visible_ends(self, state: SceneState) -> Bools:
        """Whether each teat end shows in left, right, thermal: (n_teats, 3).

        It does where the apex is in the image, no other solid stands before it, and at least half of the rounded end's near side is
        free. The teat's own surface doesn't count: cameras a little below the ends never see an apex that points up.
        """
        stage = Stage.of(state)
        columns = [seen_share(state.phantom, stage.solids, camera) >= LEAST_SEEN for camera in self.cameras]
        return np.column_stack(columns)

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
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instruments.world.eyes import OpticalCamera, ThermalCamera
from instruments.world.optics import CameraModel, cameras_from_calibration
from instruments.world.sensor import OpticalSensor, ThermalSensor
from instruments.world.shadow import shadow_map
from instruments.world.solids import Bools
from instruments.world.state import SceneState, Stage
from instruments.world.visibility import seen_share

__all__ = ["RenderedSet", "Renderer", "SceneState"]

LEAST_SEEN = 0.5  # of a rounded end's near side


@dataclass(frozen=True, slots=True, eq=False)
class RenderedSet:
    """``left``, ``right`` uint8; ``thermal_8bit`` uint8 as delivered; ``thermal_ck`` uint16 centi-kelvin, sensor's grid, un-mirrored."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    thermal_8bit: NDArray[np.uint8]
    thermal_ck: NDArray[np.uint16]


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

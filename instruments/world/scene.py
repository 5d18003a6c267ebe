"""The simulated scene and its renderer: one `SceneState` in, one frame set of the three cameras out.

Analytic: every solid's share of every pixel is an area computed exactly (coverage), its depth and normal a root of a quadratic
(raycast), so nothing is sampled and no edge depends on its sub-pixel phase. What never moves is drawn once a
camera and kept. Visibility of the teat ends comes from the same solids by rays of its own.
Same state, same generator: same bytes. May not know of any detector, of instruments or of the bench.

What is modelled and what isn't stands in docs/scene.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instruments.world.eyes import OpticalCamera
from instruments.world.microbolometer import ThermalSensor
from instruments.world.optics import CameraModel, cameras_from_calibration
from instruments.world.sensor import OpticalSensor
from instruments.world.shadow import ShadowMap, shadow_map
from instruments.world.solids import Bools
from instruments.world.state import SceneState, Stage
from instruments.world.thermal_eye import ThermalCamera
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
        self._shadows: tuple[object, ShadowMap | None] = (None, None)

    @classmethod
    def from_calibration(
        cls, table: Mapping[str, Any], camera_seed: int, *, optical: OpticalSensor | None = None, thermal: ThermalSensor | None = None
    ) -> Renderer:
        """From a parsed calibration file; without a ``thermal`` sensor its size and form are taken from there. Raises ValueError."""
        return cls(cameras_from_calibration(table), camera_seed, optical, thermal or ThermalSensor.from_calibration(table))

    def render(self, view: SceneState, rng: np.random.Generator) -> RenderedSet:
        """A frame set with fresh noise from ``rng``. Raises ValueError where something stands too near a camera."""
        shadows = self.shadows(view)
        left = self.left.expose(view, shadows, rng).astype(np.uint8, copy=False)
        right = self.right.expose(view, shadows, rng).astype(np.uint8, copy=False)
        return RenderedSet(left, right, *self.thermal.expose(view, rng))

    def shadows(self, state: SceneState) -> ShadowMap | None:
        """The shadows on the table; kept while nothing moves."""
        hulls = tuple(thing.hulls for thing in state.everything())
        if self._shadows[0] != (state.lighting, hulls):
            self._shadows = (state.lighting, hulls), shadow_map(state.lighting, Stage.of(state).solids)
        return self._shadows[1]

    def visible_ends(self, state: SceneState) -> Bools:
        """Whether each teat end shows in left, right, thermal: (n_teats, 3).

        It does where the apex is in the image, no other solid and no board stands before it, and at least half of the rounded end's
        near side is free. The teat's own surface doesn't count: cameras a little below the ends never see an apex that points up.
        """
        stage = Stage.of(state)
        columns = [seen_share(state.phantom, stage.solids, camera, state.boards) >= LEAST_SEEN for camera in self.cameras]
        return np.column_stack(columns)

"""The renderer: one `SceneState` in, one frame set of three cameras out; and contact sheets
(docs/scene.md).

Analytic: coverage is an exact area, depth and normal roots of a quadratic, so nothing is sampled.
Same state and generator, same bytes. A contact sheet has a row a state: left, right, close-up,
thermal; a cross on each teat end, a ring where that camera can't see it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.backdrop import ShadowMap, shadow_map
from instruments.world.microbolometer import ThermalSensor
from instruments.world.optical_camera import OpticalCamera
from instruments.world.optics import CameraModel, cameras_from_calibration
from instruments.world.sensor import OpticalSensor
from instruments.world.solids import Bools
from instruments.world.state import SceneState, Stage
from instruments.world.thermal_camera import ThermalCamera
from instruments.world.visibility import seen_share

LEAST_SEEN = 0.5  # of a rounded end's near side


@dataclass(frozen=True, slots=True, eq=False)
class RenderedSet:
    """``left``, ``right``, ``thermal_8bit`` (as delivered) uint8; ``thermal_ck`` uint16, sensor's
    grid, un-mirrored.
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    thermal_8bit: NDArray[np.uint8]
    thermal_ck: NDArray[np.uint16]


class Renderer:
    """Three cameras before one scene. ``cameras``: left, right, thermal; ``camera_seed``: their
    fixed patterns.
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
        cls,
        table: Mapping[str, Any],
        camera_seed: int,
        *,
        optical: OpticalSensor | None = None,
        thermal: ThermalSensor | None = None,
    ) -> Renderer:
        """From a parsed calibration; so is a missing ``thermal`` sensor. Raises ValueError."""
        return cls(
            cameras_from_calibration(table),
            camera_seed,
            optical,
            thermal or ThermalSensor.from_calibration(table),
        )

    def render(self, view: SceneState, rng: np.random.Generator) -> RenderedSet:
        """A frame set with noise from ``rng``. Raises ValueError for a thing too near a camera."""
        shadows = self.shadows(view)
        left = self.left.expose(view, shadows, rng).astype(np.uint8, copy=False)
        right = self.right.expose(view, shadows, rng).astype(np.uint8, copy=False)
        return RenderedSet(left, right, *self.thermal.expose(view, rng))

    def shadows(self, state: SceneState) -> ShadowMap | None:
        """The shadows on the table; kept while nothing moves."""
        hulls = tuple(thing.hulls for thing in state.everything())
        if self._shadows[0] != (state.lighting, hulls):
            self._shadows = (
                (state.lighting, hulls),
                shadow_map(state.lighting, Stage.of(state).solids),
            )
        return self._shadows[1]

    def visible_ends(self, state: SceneState) -> Bools:
        """Whether each teat end shows in left, right, thermal: (n_teats, 3).

        The apex is in the image with no other solid or board before it, and half of the rounded
        end's near side is free. The teat's own surface doesn't count: a camera below never sees an
        apex that points up.
        """
        stage = Stage.of(state)
        columns = [
            seen_share(state.phantom, stage.solids, camera, state.boards) >= LEAST_SEEN
            for camera in self.cameras
        ]
        return np.column_stack(columns)


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
        close_up = _close_up(
            _marked(frames.left, state, renderer),
            renderer.cameras[0].project(state.phantom.ends_mm),
        )
        row = np.concatenate(
            [_whole(frames.left), _whole(frames.right), close_up, _whole(frames.thermal_8bit)],
            axis=1,
        )
        rows.append(_label(name, row))
    return np.concatenate(rows)


def _marked(image: Grey8, state: SceneState, renderer: Renderer) -> Grey8:
    marked = image.copy()
    visible = renderer.visible_ends(state)
    for (u, v), seen in zip(
        renderer.cameras[0].project(state.phantom.ends_mm).round().astype(int),
        visible[:, 0],
        strict=True,
    ):
        grey = 0 if np.mean(image[max(v - 9, 0) : v + 1, max(u - 4, 0) : u + 5]) > 110 else 255
        at = (int(u), int(v))
        if seen:
            cv2.drawMarker(marked, at, grey, cv2.MARKER_CROSS, 7, 1)
        else:
            cv2.circle(marked, at, 5, grey, 1, cv2.LINE_AA)
    return marked


def _whole(image: Grey8) -> Grey8:
    width = round(image.shape[1] * ROW_PX / image.shape[0])
    return np.asarray(
        cv2.resize(image, (width, ROW_PX), interpolation=cv2.INTER_AREA), dtype=np.uint8
    )


def _close_up(image: Grey8, ends_px: NDArray[np.float64]) -> Grey8:
    width, height = CLOSE_UP_PX
    middle = (
        ends_px.mean(axis=0)
        if len(ends_px)
        else np.array([image.shape[1] / 2.0, image.shape[0] / 2.0])
    )
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

"""The thermal camera: radiance on a fine grid, lens, pixels and their time constant."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from instruments.world.backdrop import Backdrop, warmer
from instruments.world.boards import Board
from instruments.world.compositing import Layer, lay_over
from instruments.world.microbolometer import ThermalReadout, ThermalSensor
from instruments.world.objects import SceneObject
from instruments.world.optical_camera import KeptLayers, View
from instruments.world.optics import CameraModel, Floats
from instruments.world.shading import directional_emissivity, kelvin_from_radiance, radiance_from_c
from instruments.world.solids import dot
from instruments.world.state import SceneState, Stage

TRAIL = 12  # moments of a lagging pixel's past


class ThermalCamera:
    """The thermal camera: geometry on a grid finer than its sensor, and the sensor."""

    def __init__(
        self, camera: CameraModel, sensor: ThermalSensor, seed: np.random.SeedSequence
    ) -> None:
        self.camera = camera
        fine = sensor.oversample
        self.view = View(camera.resized(sensor.width_px * fine, sensor.height_px * fine))
        self.readout = ThermalReadout(sensor, seed)
        self._layers = KeptLayers()
        # no reference to self: no cycle
        self._warmer = lru_cache(maxsize=3)(partial(_drawn_warmer, self.view.camera))

    def expected_k(self, state: SceneState) -> Floats:
        """Apparent temperature before noise, kelvin, un-mirrored, (height, width)."""
        moments = self._moments(state)
        radiance = np.mean([self._radiance(moment) for moment in moments], axis=0)
        return kelvin_from_radiance(self.readout.gathered(radiance))

    def expose(
        self, state: SceneState, rng: np.random.Generator
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """One frame: 8-bit as delivered, and centi-kelvin."""
        centikelvin = self.readout.expose(self.expected_k(state), state.time_s, rng)
        size = self.camera.width_px, self.camera.height_px
        return self.readout.delivered(centikelvin, *size), centikelvin

    def _moments(self, state: SceneState) -> list[SceneState]:
        """The past of a pixel that follows exponentially, as moments of equal weight."""
        lag_s = self.readout.sensor.time_constant_s
        if not state.moves or lag_s <= 0.0:
            return [state]
        return [state.later(lag_s * float(np.log((i + 0.5) / TRAIL))) for i in range(TRAIL)]

    def _radiance(self, state: SceneState) -> Floats:
        things = state.everything()
        keys = [(thing.hulls, thing.paint.emissivity) for thing in things]
        layers = self._layers.of(keys, lambda which: self._things([things[i] for i in which]))
        boards = self._layers.of(
            [*state.boards], lambda which: [self._board(state.boards[i]) for i in which]
        )
        own = [_own(state, i, *each) for i, each in enumerate(zip(things, layers, strict=True))]
        own += [_own_of_board(state, *each) for each in zip(state.boards, boards, strict=True)]
        room, seen = float(radiance_from_c(state.ambient_c)), [*layers, *boards]
        radiance = radiance_from_c(state.ambient_c + self._warmer(state.backdrop))
        values = [
            room + layer.value * (black - room) for layer, black in zip(seen, own, strict=True)
        ]
        lay_over(radiance, seen, values)
        return radiance

    def _things(self, things: Sequence[SceneObject]) -> list[Layer]:
        stage = Stage.of_things(things)
        seen = self.view.surfaces(stage)
        facing = np.abs(dot(seen.rays, seen.normals)) / np.sqrt(dot(seen.rays, seen.rays))
        own = np.array([thing.paint.emissivity for thing in things], dtype=np.float64)
        value = directional_emissivity(own[seen.owner], facing)
        return seen.by_thing(len(things), value, self.view.heights(stage, seen))

    def _board(self, board: Board) -> Layer:
        seen = self.view.board(board)
        away = seen.points_mm - self.view.camera.centre_mm[:, None]
        facing = np.abs(board.normal @ away) / np.sqrt(dot(away, away))
        value = directional_emissivity(np.full(len(facing), board.emissivity), facing)
        at = seen.cover
        return Layer(at.row, at.column, at.share, seen.depth_mm, value, seen.dark)


def _drawn_warmer(camera: CameraModel, backdrop: Backdrop) -> Floats:
    return warmer(backdrop, camera).astype(np.float64)


def _own(state: SceneState, number: int, thing: SceneObject, layer: Layer) -> Floats:
    """Black-body radiance of each pixel of a thing, (n,) or (); teats first, warmer at the base."""
    if number < len(state.teat_temps_c) and layer.along is not None:
        mean_c = state.teat_temps_c[number]
        return radiance_from_c(
            mean_c + state.teat_fall * (mean_c - state.ambient_c) * (0.5 - layer.along)
        )
    return radiance_from_c(state.temperature_c(thing.temperature) + thing.offset_k)


def _own_of_board(state: SceneState, board: Board, layer: Layer) -> Floats:
    light, dark = (
        radiance_from_c(state.temperature_c(warmth)) for warmth in (board.light, board.dark)
    )
    return np.asarray(light + (dark - light) * (0.0 if layer.along is None else layer.along))

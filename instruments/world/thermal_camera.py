"""The thermal camera: radiance on a fine grid, lens, pixels with their time constant and noise.

An uncooled array with the seven components of the three-dimensional noise model (Driggers, Cox and
Edwards; NVESD's 3-D noise): of each pixel, row, column and the frame, fresh or fixed. Level and
pattern drift between flat-field events. Fixed noise is from the camera's seed, fresh noise from the
generator, drift from the time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.backdrop import warmer
from instruments.world.boards import Board
from instruments.world.compositing import Layer, lay_over
from instruments.world.objects import SceneObject
from instruments.world.optical_camera import KeptLayers, PixelRays
from instruments.world.optics import CameraModel, Floats
from instruments.world.sensor import normal_noise
from instruments.world.shading import (
    KELVIN_AT_0_C,
    directional_emissivity,
    kelvin_from_radiance,
    radiance_from_c,
)
from instruments.world.solids import dot
from instruments.world.state import SceneState, Stage


@dataclass(frozen=True, slots=True)
class Drift:
    """Drift between flat-field events, one sigma: ``level_k_per_min`` of all pixels,
    ``pattern_k_per_min`` of each. An event comes every ``every_s`` and shows the shutter at
    ``shutter_c`` for ``lasts_s``.
    """

    level_k_per_min: float = 0.03
    pattern_k_per_min: float = 0.006
    every_s: float = 300.0
    lasts_s: float = 0.0
    shutter_c: float = 30.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.lasts_s < self.every_s:
            raise ValueError(
                f"flat-field events must be over before the next one begins, are {self}"
            )


@dataclass(frozen=True, slots=True)
class ThermalSensor:
    """An uncooled array; temperatures and noises in kelvin, one sigma: fresh (``netd_k``,
    ``…_flicker_k``) and fixed (``fixed_k``, ``row_k``, ``column_k``). The 8-bit picture spans the
    1st to the 99.5th percentile, at least ``least_span_k``, plus ``headroom``.
    """

    width_px: int = 160
    height_px: int = 120
    netd_k: float = 0.10
    row_flicker_k: float = 0.02
    column_flicker_k: float = 0.02
    level_flicker_k: float = 0.02
    fixed_k: float = 0.06
    row_k: float = 0.03
    column_k: float = 0.04
    drift: Drift = field(default_factory=Drift)
    time_constant_s: float = 0.012
    blur_px: float = 0.45
    oversample: int = 2
    least_span_k: float = 10.0
    headroom: float = 0.06
    mirrored: bool = True
    hot_is_black: bool = True

    def __post_init__(self) -> None:
        if min(self.width_px, self.height_px, self.oversample) < 1:
            raise ValueError(
                f"a thermal sensor needs at least one pixel each way, has {self.width_px} x"
                f" {self.height_px}"
            )

    @classmethod
    def from_calibration(cls, table: Mapping[str, Any]) -> ThermalSensor:
        """A parsed calibration's thermal camera: size, mirroring, polarity. Raises ValueError."""
        entry = table.get("cameras", {}).get("thermal", {})
        width, height = entry.get("sensor_size", (cls().width_px, cls().height_px))
        polarity = entry.get("polarity", "hot_is_black")
        if polarity not in ("hot_is_black", "hot_is_white"):
            raise ValueError(
                'calibration: cameras.thermal.polarity must be "hot_is_black" or "hot_is_white",'
                f" is {polarity!r}"
            )
        return cls(
            int(width),
            int(height),
            mirrored=bool(entry.get("mirrored", cls().mirrored)),
            hot_is_black=polarity == "hot_is_black",
        )


class ThermalReadout:
    """One thermal camera's sensor: its fixed pattern, its centi-kelvin and its 8-bit picture."""

    def __init__(self, sensor: ThermalSensor, seed: np.random.SeedSequence) -> None:
        rng = np.random.Generator(np.random.SFC64(seed))
        shape = (sensor.height_px, sensor.width_px)
        self.sensor = sensor
        rows = sensor.row_k * rng.standard_normal((shape[0], 1))
        columns = sensor.column_k * rng.standard_normal((1, shape[1]))
        self._pattern_k: Floats = sensor.fixed_k * rng.standard_normal(shape) + rows + columns
        self._drift_seed = int(rng.integers(2**63))

    def gathered(self, radiance: Floats) -> Floats:
        """Radiance on the fine grid (oversample x) through lens and pixels: (height, width)."""
        sensor, fine = self.sensor, self.sensor.oversample
        sigma = sensor.blur_px * fine
        blurred = cv2.GaussianBlur(radiance, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
        pixels = blurred.reshape(sensor.height_px, fine, sensor.width_px, fine)
        return np.asarray(pixels.mean(axis=(1, 3)))

    def drift_k(self, time_s: float) -> Floats:
        """How far each pixel has gone astray since the last flat-field event, (height, width)."""
        since, event = self._since(time_s)
        return _astray(self.sensor, self._drift_seed, event) * (since / 60.0)

    def shows_shutter(self, time_s: float) -> bool:
        """Whether a flat-field event is going on."""
        since, event = self._since(time_s)
        return event > 0 and since < self.sensor.drift.lasts_s

    def expose(
        self, apparent_k: Floats, time_s: float, rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        """One frame as centi-kelvin, 16 bits, un-mirrored, from apparent temperatures in kelvin."""
        sensor = self.sensor
        shape = (sensor.height_px, sensor.width_px)
        if self.shows_shutter(time_s):
            apparent_k = np.full(shape, sensor.drift.shutter_c + KELVIN_AT_0_C)
        fresh = sensor.netd_k * normal_noise(rng, shape)
        fresh = fresh + sensor.row_flicker_k * rng.standard_normal((shape[0], 1))
        fresh += (
            sensor.column_flicker_k * rng.standard_normal((1, shape[1]))
            + sensor.level_flicker_k * rng.standard_normal()
        )
        frame = apparent_k + self._pattern_k + self.drift_k(time_s) + fresh
        return np.clip(np.rint(100.0 * frame), 0.0, 65535.0).astype(np.uint16)

    def delivered(
        self, centikelvin: NDArray[np.uint16], width_px: int, height_px: int
    ) -> NDArray[np.uint8]:
        """The 8-bit picture: automatic gain, enlarged smoothly, mirrored, hot is black."""
        low, high = np.percentile(centikelvin, [1.0, 99.5]) / 100.0
        span, room = max(float(high - low), self.sensor.least_span_k), self.sensor.headroom
        grey = (centikelvin / 100.0 - low + room * span) / (span * (1.0 + 2.0 * room))
        grey = (255.0 * (1.0 - grey if self.sensor.hot_is_black else grey)).astype(np.float32)
        picture = cv2.resize(grey, (width_px, height_px), interpolation=cv2.INTER_LINEAR)
        picture = picture[:, ::-1] if self.sensor.mirrored else picture
        return np.ascontiguousarray(np.clip(np.rint(picture), 0.0, 255.0).astype(np.uint8))

    def _since(self, time_s: float) -> tuple[float, int]:
        """Seconds since the last flat-field event, and its number."""
        event = int(max(time_s, 0.0) // self.sensor.drift.every_s)
        return max(time_s, 0.0) - event * self.sensor.drift.every_s, event


@lru_cache(maxsize=4)
def _astray(sensor: ThermalSensor, seed: int, event: int) -> Floats:
    """Drift after an event, K a minute, (height, width)."""
    rng = np.random.Generator(np.random.SFC64([seed, event]))
    pattern = sensor.drift.pattern_k_per_min * rng.standard_normal(
        (sensor.height_px, sensor.width_px)
    )
    return np.asarray(pattern + sensor.drift.level_k_per_min * rng.standard_normal())


TRAIL = 12  # moments of a lagging pixel's past


class ThermalCamera:
    """The thermal camera: geometry on a grid finer than its sensor, and the sensor."""

    def __init__(
        self, camera: CameraModel, sensor: ThermalSensor, seed: np.random.SeedSequence
    ) -> None:
        self.camera = camera
        fine = sensor.oversample
        self.view = PixelRays(camera.resized(sensor.width_px * fine, sensor.height_px * fine))
        self.readout = ThermalReadout(sensor, seed)
        self._layers = KeptLayers()

    def expected_k(self, state: SceneState) -> Floats:
        """Apparent temperature before noise, kelvin, un-mirrored, (height, width)."""
        moments = self._moments(state)
        radiance = np.mean([self._radiance(moment) for moment in moments], axis=0)
        return kelvin_from_radiance(self.readout.gathered(radiance))

    def exposed(
        self, apparent_k: Floats, time_s: float, rng: np.random.Generator
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """One frame of what `expected_k` gave: 8-bit as delivered, and centi-kelvin."""
        centikelvin = self.readout.expose(apparent_k, time_s, rng)
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
        layers = self._layers.of(
            things, lambda thing: (thing.hulls, thing.paint.emissivity), self._things
        )
        layers += self._layers.of(
            state.boards, lambda board: board, lambda new: [self._board(board) for board in new]
        )
        warm_k = warmer(state.backdrop, self.view.camera).astype(np.float64)
        room, radiance = (radiance_from_c(state.ambient_c + more) for more in (0.0, warm_k))
        seen: tuple[SceneObject | Board, ...] = (*things, *state.boards)
        values = []
        for number, (thing, layer) in enumerate(zip(seen, layers, strict=True)):
            black = _black(state, number, thing, layer)
            values.append(replace(layer, value=room + layer.value * (black - room)))
        lay_over(radiance, values)
        return radiance

    def _things(self, things: Sequence[SceneObject]) -> list[Layer]:
        stage = Stage.of(things)
        seen = self.view.surfaces(stage)
        own = np.array([thing.paint.emissivity for thing in things], dtype=np.float64)
        value = directional_emissivity(own[seen.owner], seen.facing)
        return seen.by_thing(len(things), value, self.view.heights(stage, seen))

    def _board(self, board: Board) -> Layer:
        seen = self.view.board(board)
        away = seen.points_mm - self.view.camera.centre_mm[:, None]
        facing = np.abs(seen.normal @ away) / np.sqrt(dot(away, away))
        value = directional_emissivity(np.full(len(facing), board.emissivity), facing)
        return seen.layer(value, seen.dark)


def _black(state: SceneState, number: int, thing: SceneObject | Board, layer: Layer) -> Floats:
    """Black-body radiance of each pixel of a thing, (n,) or (); teats first, warmer at the base."""
    if isinstance(thing, Board):
        light, dark = (
            radiance_from_c(state.temperature_c(warmth)) for warmth in (thing.light, thing.dark)
        )
        return np.asarray(light + (dark - light) * (0.0 if layer.along is None else layer.along))
    if number < len(state.teat_temps_c) and layer.along is not None:
        mean_c = state.teat_temps_c[number]
        return radiance_from_c(
            mean_c + state.teat_fall * (mean_c - state.ambient_c) * (0.5 - layer.along)
        )
    return radiance_from_c(state.temperature_c(thing.temperature) + thing.offset_k)

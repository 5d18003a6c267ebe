"""A time-of-flight depth camera with what decides its errors (Kolb, Barth, Koch and Larsen,
Time-of-Flight Cameras in Computer Graphics, Computer Graphics Forum 29(1), 2010).

Light is modulated at f; what comes back over the distance d with the strength A is the phasor A
exp(i 4 pi f d / c). A pixel adds up all that it gets, and reads a distance from the sum's angle:
- where it sees a near and a far surface, one between them (flying pixels);
- light that took a second path, over table or board, draws it away;
- noise of the sum gives one of the distance that goes with 1 / A (Lange and Seitz, IEEE Journal of
  Quantum Electronics 37(3), 2001, where the room's light decides);
- harmonics of the modulation make an error of four periods in the range (wiggling).

The camera is its own lamp: a surface of albedo a, turned by the angle t, has A = a cos t / d^2, d
in m. Shadows, interreflections of objects and motion during the exposure are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.backdrop import (
    BOARD_TOP_MM,
    BOARD_X_MM,
    FAR_MM,
    TABLE_FRONT_Y_MM,
    Backdrop,
    patches_seen,
)
from instruments.world.boards import Board
from instruments.world.compositing import Layer, lay_over
from instruments.world.objects import SceneObject
from instruments.world.optical_camera import KeptLayers, PixelRays
from instruments.world.optics import CameraModel, Floats
from instruments.world.sensor import normal_noise
from instruments.world.solids import dot
from instruments.world.state import SceneState, Stage

LIGHT_MM_PER_S = 299_792_458_000.0
AMPLITUDE_COUNTS = 10_000  # of a white surface that faces the camera at 1 m
CELL_MM = 100.0  # of table and board, where they send light on
AT_ONCE = 2048  # points at a time whose second path is added up
Phasors = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class DepthSensor:
    """``noise_mm``: one sigma of a white surface that faces the camera at 1 m (amplitude 1);
    ``offset_mm``: added to every distance; ``cyclic_mm``: amplitude of the wiggling;
    ``second_path``: share of the light over table and board that is there, 0 for none; ``blur_px``:
    the lens's sigma; ``least_amplitude``: below it nothing is measured. Distances beyond c / 2f are
    taken for near ones. As it is, of the class that makers state as within 5 mm.
    """

    modulation_mhz: float = 20.0
    noise_mm: float = 0.5
    offset_mm: float = 0.0
    cyclic_mm: float = 4.0
    second_path: float = 1.0
    blur_px: float = 0.4
    least_amplitude: float = 0.004

    @property
    def rad_per_mm(self) -> float:
        """Phase by distance: there and back."""
        return 4.0e6 * np.pi * self.modulation_mhz / LIGHT_MM_PER_S


class DepthCamera:
    """The depth camera: phasors of all that it sees, lens and sensor."""

    def __init__(self, camera: CameraModel, sensor: DepthSensor) -> None:
        self.view = PixelRays(camera)
        self.sensor = sensor
        x, y = self.view.rays
        self._stretch = np.sqrt(x * x + y * y + 1.0)  # distance by depth
        self._layers = KeptLayers()

    def expose(
        self, state: SceneState, rng: np.random.Generator
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Depth along the axis in tenths of a mm, 0: not measured, and amplitude in counts."""
        sensor, signal = self.sensor, self.expected(state)
        sigma, shape = sensor.noise_mm * sensor.rad_per_mm, signal.shape
        rows, columns = int(shape[0]), int(shape[1])
        signal = signal + sigma * normal_noise(rng, (rows, columns))
        signal += 1j * sigma * normal_noise(rng, (rows, columns))
        phase, amplitude = np.angle(signal) % (2.0 * np.pi), np.abs(signal)
        away_mm = phase / sensor.rad_per_mm + sensor.offset_mm
        away_mm += sensor.cyclic_mm * np.sin(4.0 * phase)
        tenths = np.rint(10.0 * away_mm / self._stretch)
        measured = (amplitude >= sensor.least_amplitude) & (tenths > 0.0) & (tenths <= 65535.0)
        counts = np.clip(np.rint(AMPLITUDE_COUNTS * amplitude), 0.0, 65535.0)
        return np.where(measured, tenths, 0.0).astype(np.uint16), counts.astype(np.uint16)

    def expected(self, state: SceneState) -> Phasors:
        """The sum of all light at each pixel before noise, (height, width)."""
        backdrop = state.backdrop
        layers = self._layers.of(
            state.everything(),
            lambda thing: (thing.hulls, thing.paint, backdrop),
            lambda new: self._things(new, backdrop),
        )
        layers += self._layers.of(
            state.boards, lambda board: board, lambda new: [self._board(board) for board in new]
        )
        signal = self._empty(backdrop)
        lay_over(signal, layers)
        if not self.sensor.blur_px:
            return signal
        two = signal.view(np.float64).reshape(*signal.shape, 2)
        blur = (0, 0), self.sensor.blur_px
        soft = cv2.GaussianBlur(two, *blur, borderType=cv2.BORDER_REPLICATE)
        return np.ascontiguousarray(soft).view(np.complex128)[..., 0]

    def _phasors(self, strength: Floats, away_mm: Floats) -> Phasors:
        """Direct light: ``strength`` at 1 m falls with the square of the way."""
        return np.asarray(
            strength * (1e3 / away_mm) ** 2 * np.exp(1j * self.sensor.rad_per_mm * away_mm)
        )

    def _empty(self, backdrop: Backdrop) -> Phasors:
        """Walls, board and table."""
        camera, (x, y) = self.view.camera, self.view.rays
        signal = self._phasors(backdrop.room_albedo / self._stretch, FAR_MM * self._stretch)
        for patch, seen in patches_seen(backdrop, camera):
            at = seen.part
            normal, stretch = camera.R @ np.asarray(patch.place.normal), self._stretch[at]
            facing = np.abs(normal[0] * x[at] + normal[1] * y[at] + normal[2]) / stretch
            albedo = np.full(facing.shape, patch.albedo)
            if patch.texture > 0.0:
                albedo *= 1.0 + patch.texture * seen.texture(patch)
            away_mm = np.maximum(seen.depth_mm * stretch, 1.0)
            light = self._phasors(albedo * facing, away_mm)
            signal[at] += seen.share * (light - signal[at])
        return signal

    def _things(self, things: Sequence[SceneObject], backdrop: Backdrop) -> list[Layer]:
        seen = self.view.surfaces(Stage.of(things))
        stretch = np.sqrt(dot(seen.rays, seen.rays))
        albedo = np.array([thing.paint.albedo for thing in things])[seen.owner]
        away_mm = seen.depth_mm * stretch
        light = self._phasors(albedo * seen.facing, away_mm)
        if self.sensor.second_path:
            camera = self.view.camera
            points = seen.depth_mm * seen.rays
            for start in range(0, len(light), AT_ONCE):
                part = slice(start, start + AT_ONCE)
                at = camera.R.T @ points[:, part] + camera.centre_mm[:, None]
                normals = camera.R.T @ seen.normals[:, part]
                light[part] += albedo[part] * self._second(at, normals, away_mm[part], backdrop)
        return seen.by_thing(len(things), light)

    def _board(self, board: Board) -> Layer:
        seen = self.view.board(board)
        off = seen.points_mm - self.view.camera.centre_mm[:, None]
        away_mm = np.sqrt(dot(off, off))
        albedo = board.light_albedo + seen.dark * (board.dark_albedo - board.light_albedo)
        return seen.layer(self._phasors(albedo * np.abs(seen.normal @ off) / away_mm, away_mm))

    def _second(
        self, points: Floats, normals: Floats, away_mm: Floats, backdrop: Backdrop
    ) -> Phasors:
        """Light of the camera that table and board send on to points (3, n), as white ones send it
        back, (n,): each cell scatters evenly and acts as a disc of its size (Wallace, Elmquist and
        Haines, A ray tracing algorithm for progressive radiosity, SIGGRAPH 1989).
        """
        eye, k = self.view.camera.centre_mm, np.float32(self.sensor.rad_per_mm)
        total = np.zeros(points.shape[1], dtype=np.complex128)
        for middles, normal, albedo in _cells(backdrop):
            there = middles - eye[:, None]
            first_mm = np.sqrt(dot(there, there))
            lit = albedo * np.maximum(-(normal @ there), 0.0) / first_mm * (1e3 / first_mm) ** 2
            # a sum over hundreds of cells that changes the distance by millimetres: six digits do
            way = (points[:, :, None] - middles[:, None, :]).astype(np.float32)
            square = np.maximum(np.einsum("inm,inm->nm", way, way), np.float32(1.0))
            leaves = np.maximum(np.einsum("i,inm->nm", normal.astype(np.float32), way), 0.0)
            meets = np.maximum(-np.einsum("in,inm->nm", normals.astype(np.float32), way), 0.0)
            area = np.float32(CELL_MM**2)
            form = leaves * meets / (square * (np.float32(np.pi) * square + area))
            form *= (lit * area).astype(np.float32)
            path = np.sqrt(square) + (first_mm + away_mm[:, None]).astype(np.float32)
            path *= np.float32(0.5) * k
            total += np.sum(form * np.cos(path), axis=1) + 1j * np.sum(form * np.sin(path), axis=1)
        return self.sensor.second_path * total


@lru_cache(maxsize=4)
def _cells(backdrop: Backdrop) -> tuple[tuple[Floats, Floats, float], ...]:
    """Table and board as cells: middles (3, n), normal (3,), albedo."""

    def grid(low: Any, high: Any) -> Iterator[Floats]:
        yield from np.meshgrid(
            *(np.arange(a + 0.5 * CELL_MM, b, CELL_MM) for a, b in zip(low, high, strict=True))
        )

    b = backdrop
    (left, right), back = BOARD_X_MM, b.board_y_mm
    x, y = (one.ravel() for one in grid((left, TABLE_FRONT_Y_MM), (right, back)))
    table = np.stack([x, y, np.zeros_like(x)]), np.array([0.0, 0.0, 1.0]), b.table_albedo
    x, z = (one.ravel() for one in grid((left, 0.0), (right, BOARD_TOP_MM)))
    board = np.stack([x, np.full_like(x, back), z]), np.array([0.0, -1.0, 0.0]), b.board_albedo
    return table, board

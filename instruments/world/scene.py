"""The renderer: one `SceneState` in, one frame set of three cameras and perhaps a depth camera out;
and contact sheets (docs/scene.md).

Analytic: coverage is an exact area, depth and normal roots of a quadratic, so nothing is sampled.
Same state and generator, same bytes. A contact sheet has a row a state: left, right, close-up,
thermal; a cross on each teat end, a ring where that camera can't see it.

Which ends a camera can see is found by rays to points of each end, against every other solid and
board: no picture is used, so the truth doesn't depend on a camera's resolution.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib import import_module
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.backdrop import ShadowMap, patches, shadow_map
from instruments.world.boards import Board
from instruments.world.depth_camera import DepthCamera, DepthSensor
from instruments.world.optical_camera import OpticalCamera
from instruments.world.optics import (
    CameraModel,
    Floats,
    cameras_from_calibration,
    depth_from_calibration,
)
from instruments.world.phantom import Phantom
from instruments.world.sensor import OpticalSensor
from instruments.world.solids import Bools, intersect, square_to
from instruments.world.state import SceneState, Stage
from instruments.world.thermal_camera import ThermalCamera, ThermalSensor

LEAST_SEEN = 0.5  # of a rounded end's near side


@dataclass(frozen=True, slots=True, eq=False)
class RenderedSet:
    """uint8 pictures; ``thermal_ck`` uint16, un-mirrored; ``depth_dmm`` tenths of a mm and
    ``amplitude`` uint16, None without a depth camera.
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    thermal_8bit: NDArray[np.uint8]
    thermal_ck: NDArray[np.uint16]
    depth_dmm: NDArray[np.uint16] | None = None
    amplitude: NDArray[np.uint16] | None = None


class Renderer:
    """Left, right and thermal camera, and perhaps ``depth``; ``camera_seed``: fixed patterns."""

    def __init__(
        self,
        cameras: tuple[CameraModel, CameraModel, CameraModel],
        camera_seed: int,
        optical: OpticalSensor | None = None,
        thermal: ThermalSensor | None = None,
        depth: DepthCamera | None = None,
    ) -> None:
        import_module("instruments.world.kernels")  # compiled now, if at all: not amid a run
        seeds = np.random.SeedSequence(camera_seed).spawn(3)
        sensor = optical or OpticalSensor()
        self.cameras = cameras
        self.left = OpticalCamera(cameras[0], sensor, seeds[0])
        self.right = OpticalCamera(cameras[1], sensor, seeds[1])
        self.thermal = ThermalCamera(cameras[2], thermal or ThermalSensor(), seeds[2])
        self.depth = depth
        self._shadows: tuple[object, ShadowMap | None] = (None, None)

    @classmethod
    def from_calibration(
        cls,
        table: Mapping[str, Any],
        camera_seed: int,
        *,
        optical: OpticalSensor | None = None,
        thermal: ThermalSensor | None = None,
        depth: DepthSensor | None = None,
    ) -> Renderer:
        """From a parsed calibration; so is a missing ``thermal`` sensor. Raises ValueError."""
        model = depth_from_calibration(table)
        return cls(
            cameras_from_calibration(table),
            camera_seed,
            optical,
            thermal or ThermalSensor.from_calibration(table),
            None if model is None else DepthCamera(model, depth or DepthSensor()),
        )

    def render(self, view: SceneState, rng: np.random.Generator) -> RenderedSet:
        """A frame set with noise from ``rng``. Raises ValueError for a thing too near a camera."""
        noise, noise_right = self.left.noise(rng), self.right.noise(rng)
        # what the optical cameras share comes first: each would weave it anew
        woven = (patch.woven for patch in patches(view.backdrop) if patch.texture > 0.0)
        *_, shadows = _at_once(*woven, partial(self.shadows, view))
        left, right, apparent_k = _at_once(
            partial(self.left.exposed, view, shadows, noise),
            partial(self.right.exposed, view, shadows, noise_right),
            partial(self.thermal.expected_k, view),
        )
        thermal = self.thermal.exposed(apparent_k, view.time_s, rng)
        # last, so that the others' noise is the same with and without it
        depth = self.depth.expose(view, rng) if self.depth else ()
        left, right = (grey.astype(np.uint8, copy=False) for grey in (left, right))
        return RenderedSet(left, right, *thermal, *depth)

    def shadows(self, state: SceneState) -> ShadowMap | None:
        """The shadows on the table; kept while nothing moves."""
        things = state.everything()
        key = state.lighting, tuple(thing.hulls for thing in things)
        if self._shadows[0] != key:
            self._shadows = key, shadow_map(state.lighting, Stage.of(things).solids)
        return self._shadows[1]

    def visible_ends(self, state: SceneState) -> Bools:
        """Whether each teat end shows in left, right, thermal: (n_teats, 3). The apex is in the
        image with no other solid or board before it, and half of the rounded end's near side is
        free; the teat's own surface doesn't count.
        """
        stage = Stage.of(state.everything())
        shares = [seen_share(state.phantom, stage, one, state.boards) for one in self.cameras]
        return np.column_stack(shares) >= LEAST_SEEN


def _at_once(*works: Callable[[], Any]) -> list[Any]:
    """What each gives, in their order: the first in this thread, the others beside it where OpenCV
    may use several processors. All are over when this returns, or raises the first one's error.
    They share what is kept in caches, where two may make the same at once, and change nothing that
    another reads.
    """
    beside = min(cv2.getNumThreads(), len(works)) - 1
    if beside < 1:
        return [work() for work in works]
    with ThreadPoolExecutor(beside) as pool:
        others = [pool.submit(work) for work in works[1:]]
        return [works[0](), *(each.result() for each in others)]


RINGS = np.meshgrid(np.radians((30.0, 60.0, 85.0)), np.arange(16) * 2.0 * np.pi / 16)


def seen_share(
    phantom: Phantom, stage: Stage, camera: CameraModel, boards: Sequence[Board] = ()
) -> Floats:
    """Visible share of each rounded end's near side, (n,); 0 where the apex is hidden or outside.
    The ``stage`` begins with the teats; a teat doesn't hide its own end.
    """
    rings, outward, middles = _rounded_ends(phantom)
    points, of = rings.reshape(-1, 3), np.repeat(np.arange(len(rings)), rings.shape[1])
    seen, sights = stage.solids.in_camera(camera), camera.camera_from_world(points)
    # no solid but the teat itself stands between; most are far from every line of sight
    which, at = np.nonzero(seen.near_lines(sights) & (stage.owner[:, None] != of))
    x, y, z = sights[at].T
    depth, _, hit = intersect(seen, which, x / z, y / z)
    free = np.ones(len(points), dtype=np.bool_)
    free[at[hit & (depth > 0.0) & (depth < z)]] = False
    away = points - camera.centre_mm
    for board in boards:
        towards, corner = away @ board.normal, np.asarray(board.corner_mm)
        ahead = np.where(np.abs(towards) > 1e-9, towards, 1e-9)
        part = ((corner - camera.centre_mm) @ board.normal) / ahead
        point = camera.centre_mm + part[:, None] * away - corner
        place = np.column_stack([point @ np.asarray(board.across), point @ np.asarray(board.along)])
        on_it = np.all((place >= 0.0) & (place <= board.pattern.size_mm), axis=1)
        free &= ~((part > 0.0) & (part < 1.0) & on_it)
    pixels, size = camera.project(rings[:, 0]), np.array([camera.width_px, camera.height_px])
    inside = np.all((pixels >= -0.5) & (pixels <= size - 0.5), axis=1)
    apex, ring = np.split(free.reshape(rings.shape[:2]), [1], axis=1)
    near_side = (outward @ (camera.centre_mm - middles)[:, :, None])[:, :, 0] > 0.0
    share = np.sum(ring & near_side, axis=1) / np.sum(near_side, axis=1)
    return np.where(inside & apex[:, 0], share, 0.0)


@lru_cache(maxsize=4)  # each camera asks for the same
def _rounded_ends(phantom: Phantom) -> tuple[Floats, Floats, Floats]:
    """Of each of n ends, first its apex, then points of its hemisphere (n, 49, 3), of another form
    on rings as far behind the end; there the ways outward (n, 48, 3), and the middles (n, 3).
    """
    polar, round_ = (grid.ravel() for grid in RINGS)
    rings, ways, ends, axes = list[Floats](), list[Floats](), phantom.ends_mm, phantom.axes
    radii_mm = [teat.shape.radius_mm for teat in phantom.teats]
    middles = ends - np.array(radii_mm).reshape(-1, 1) * axes
    for i, (end, axis, u, v) in enumerate(zip(ends, axes, *square_to(axes), strict=True)):
        way = np.cos(round_)[:, None] * u + np.sin(round_)[:, None] * v
        if form := phantom.teats[i].shape.form:
            behind = radii_mm[i] * (1.0 - np.cos(polar))
            ring = form.middles(end, axis, behind) + form.radii_mm(behind)[:, None] * way
        else:
            way = np.cos(polar)[:, None] * axis + np.sin(polar)[:, None] * way
            ring = middles[i] + radii_mm[i] * way
        rings.append(np.vstack([end, ring]))
        ways.append(way)
    return np.reshape(rings, (-1, 49, 3)), np.reshape(ways, (-1, 48, 3)), middles


ROW_PX, LABEL_PX, CLOSE_UP_PX = 340, 22, (440, 340)
Grey8 = NDArray[np.uint8]


def contact_sheet(states: Mapping[str, SceneState], renderer: Renderer, seed: int = 0) -> Grey8:
    """One row for each named state, grey, uint8. Raises ValueError for no states."""
    if not states:
        raise ValueError("a contact sheet needs at least one state")
    rows = []
    for number, (name, state) in enumerate(states.items()):
        frames = renderer.render(state, np.random.Generator(np.random.SFC64([seed, number])))
        parts = [
            cv2.resize(
                image,
                (round(image.shape[1] * ROW_PX / image.shape[0]), ROW_PX),
                interpolation=cv2.INTER_AREA,
            )
            for image in (frames.left, frames.right, frames.thermal_8bit)
        ]
        row = np.hstack([*parts[:2], _close_up(frames.left, state, renderer), parts[2]])
        strip = np.full((LABEL_PX, row.shape[1]), 255, dtype=np.uint8)
        font = cv2.FONT_HERSHEY_SIMPLEX, 0.55, 0, 1, cv2.LINE_AA
        cv2.putText(strip, name, (6, LABEL_PX - 6), *font)
        rows += [strip, row]
    return np.concatenate(rows)


def _close_up(image: Grey8, state: SceneState, renderer: Renderer) -> Grey8:
    """The part of the left picture about the teat ends, each marked."""
    marked, ends_px = image.copy(), renderer.cameras[0].project(state.phantom.ends_mm)
    seen = renderer.visible_ends(state)[:, 0]
    for (u, v), visible in zip(ends_px.round().astype(int).tolist(), seen, strict=True):
        grey = 0 if np.mean(image[max(v - 9, 0) : v + 1, max(u - 4, 0) : u + 5]) > 110 else 255
        if visible:
            cv2.drawMarker(marked, (u, v), grey, cv2.MARKER_CROSS, 7, 1)
        else:
            cv2.circle(marked, (u, v), 5, grey, 1, cv2.LINE_AA)
    (width, height), size = CLOSE_UP_PX, image.shape[::-1]
    middle = ends_px.mean(axis=0) if len(ends_px) else np.array(size) / 2.0
    left = int(np.clip(round(middle[0] - width / 2), 0, max(size[0] - width, 0)))
    top = int(np.clip(round(middle[1] - height / 2), 0, max(size[1] - height, 0)))
    cut = marked[top : top + height, left : left + width]
    bottom, right = height - cut.shape[0], width - cut.shape[1]
    return np.pad(cut, ((0, bottom), (0, right)))

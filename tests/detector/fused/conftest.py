"""Scenes of round-ended teats drawn with OpenCV: surfaces sampled densely, projected by
`cv2.projectPoints`, filled, averaged down.

Nothing here comes from the detector, nor from the renderer: outlines are hulls of projected points,
bent as the lens bends lines, and cameras are OpenCV's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.external.serve import Pictures
from detector.fused.detector import FusedDetector
from detector.geometry import Camera, Motion
from detector.protocol import Detection

Array = NDArray[np.float64]
FINE = 12  # sub-pixels a pixel and axis


@dataclass(frozen=True)
class Body:
    """A teat in the world: its end (3,) mm, lean, shape, grey and temperature."""

    end_mm: tuple[float, float, float]
    lean: tuple[float, float] = (0.0, 0.0)  # along world x and y, a unit downwards
    radius_mm: float = 11.0
    height: float = 1.0  # of the end, in radii
    grey: float = 30.0
    kelvin: float = 305.5
    seen_by: str = "LRT"

    def surface(self) -> Array:
        """Points (n, 3) of the surface."""
        axis = np.array([self.lean[0], self.lean[1], -1.0])
        axis /= np.linalg.norm(axis)
        e1 = np.cross(axis, [0.0, 1.0, 0.0])
        e1 /= np.linalg.norm(e1)
        e2 = np.cross(axis, e1)
        turn = np.linspace(0, 2 * np.pi, 360, endpoint=False)
        ring = np.cos(turn)[:, None] * e1 + np.sin(turn)[:, None] * e2
        middle = np.array(self.end_mm) + self.radius_mm * self.height * axis
        polar = np.linspace(0, np.pi / 2, 60)
        end = [
            middle + self.radius_mm * (np.sin(p) * ring - self.height * np.cos(p) * axis)
            for p in polar
        ]
        return np.concatenate([*end, middle + self.radius_mm * ring + 100.0 * axis])


def coverage(
    body: Body, camera: Camera, camera_from_world: Motion
) -> tuple[tuple[slice, slice], NDArray[np.float64]]:
    """Where a body is in a picture, and how much of each pixel there it covers."""
    lens = np.array([[camera.fc[0], 0, camera.cc[0]], [0, camera.fc[1], camera.cc[1]], [0, 0, 1]])
    flat = cv2.projectPoints(
        body.surface(), camera_from_world.om, camera_from_world.T, np.eye(3), None
    )[0]
    hull = cv2.convexHull(flat.astype(np.float32)).reshape(-1, 2).astype(np.float64)
    steps = np.linspace(0, 1, 20, endpoint=False)[None, :, None]  # lines bend in the lens
    edge = (hull[:, None] + steps * (np.roll(hull, -1, axis=0) - hull)[:, None]).reshape(-1, 2)
    rays, still = np.column_stack([edge, np.ones(len(edge))]), np.zeros(3)
    pixels = cv2.projectPoints(rays, still, still, lens, np.array(camera.kc))[0].reshape(-1, 2)
    columns, rows = camera.image_size
    low = np.clip(np.floor(pixels.min(axis=0)).astype(int) - 2, 0, None)
    high = np.minimum(np.ceil(pixels.max(axis=0)).astype(int) + 3, [columns, rows])
    fine = np.zeros(np.maximum(high - low, 1)[::-1] * FINE, dtype=np.uint8)
    # the pixel at 0 reaches from -0.5 to 0.5: its first sub-pixel's centre is at -0.5 + 0.5 / FINE
    cv2.fillPoly(
        fine, [np.rint(((pixels - low + 0.5) * FINE - 0.5) * 256).astype(np.int32)], 255, shift=8
    )
    size = tuple(int(v) for v in np.maximum(high - low, 1))
    cover = (
        np.asarray(cv2.resize(fine, size, interpolation=cv2.INTER_AREA), dtype=np.float64) / 255.0
    )
    return (slice(low[1], low[1] + size[1]), slice(low[0], low[0] + size[0])), cover


Draw = Callable[..., Pictures]
Find = Callable[..., Detection]


def drawer(rig: Calibration) -> Draw:
    """Draws bodies, the farthest first, in all three cameras, with noise from a seed."""
    assert rig.thermal.lens is not None
    assert rig.thermal_from_right is not None
    right_from_world = rig.world_from_right.inverse()
    scale = rig.thermal.image_size[0] / rig.thermal.sensor_size[0]
    lens = rig.thermal.lens
    sensor = replace(
        lens,
        image_size=rig.thermal.sensor_size,
        fc=(lens.fc[0] / scale, lens.fc[1] / scale),
        cc=((lens.cc[0] + 0.5) / scale - 0.5, (lens.cc[1] + 0.5) / scale - 0.5),
    )
    eyes = {
        "L": (rig.left, rig.right_from_left.inverse() @ right_from_world),
        "R": (rig.right, right_from_world),
        "T": (sensor, rig.thermal_from_right @ right_from_world),
    }

    def scene(bodies: list[Body], seed: int = 0, noise: float = 1.5) -> Pictures:
        rng = np.random.default_rng(seed)
        pictures = {}
        for eye, (camera, motion) in eyes.items():
            picture = np.full(camera.image_size[::-1], 292.0 if eye == "T" else 190.0)
            for body in sorted(
                bodies, key=lambda b: -float(np.linalg.norm(right_from_world.apply(b.end_mm)))
            ):
                if eye in body.seen_by:
                    at, cover = coverage(body, camera, motion)
                    picture[at] += cover * (
                        (body.kelvin if eye == "T" else body.grey) - picture[at]
                    )
            picture = cv2.GaussianBlur(picture, (0, 0), 0.6)
            grain = rng.standard_normal(picture.shape, dtype=np.float32)
            pictures[eye] = picture + (0.08 if eye == "T" else noise) * grain
        left, right = (np.clip(np.rint(pictures[eye]), 0, 255).astype(np.uint8) for eye in "LR")
        return Pictures(left, right, None, np.rint(pictures["T"] * 100) / 100)

    return scene


@pytest.fixture(scope="session")
def draw_scene(rig: Calibration) -> Draw:
    return drawer(rig)


@pytest.fixture(scope="session")
def find(draw_scene: Draw, rig: Calibration) -> Find:
    """What the detector finds in a drawn scene."""
    return lambda *scene, **drawn: FusedDetector().detect(draw_scene(*scene, **drawn), rig)


@pytest.fixture(scope="session")
def udder() -> list[Body]:
    """Four teats, each leaning and shaped its own way."""
    return [
        Body((-255.0, 275.0, 132.0), (0.10, -0.05), 10.5),
        Body((-205.0, 200.0, 137.0), (-0.05, 0.08), 12.0, 0.9),
        Body((-140.0, 205.0, 136.0), (0.0, 0.0), 9.5, 1.1),
        Body((-80.0, 270.0, 134.0), (-0.15, 0.1), 11.0),
    ]

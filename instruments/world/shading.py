"""Light and heat that leave a surface towards a camera.

Light: two lamps and the room, Lambert's law with distance, a weak gloss (Blinn and Phong). Heat:
radiance in 8 to 13 um goes with T^4.8 (Planck: d ln L / d ln T = c2 / (lambda T) at 10 um), within
0.1 K of the band integral from 10 to 45 degC; emissivity of its own, the rest reflects the room.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from instruments import world as package
from instruments.world.optics import Floats
from instruments.world.solids import Point, dot

KELVIN_AT_0_C = 273.15
BAND_EXPONENT = 4.8
REFERENCE_K = 300.0
GLOSS_EXPONENT = 32

Singles = NDArray[np.float32]
Rows = NDArray[Any]  # float32 or float64; vectors as (3, n)


@dataclass(frozen=True, slots=True)
class Paint:
    """``albedo`` (share scattered back), ``gloss`` (strength of the highlight), ``emissivity``;
    ``gloss_exponent`` makes highlights narrow: 32 of paint and skin, some hundreds of a wet film.
    """

    albedo: float
    gloss: float = 0.0
    emissivity: float = 0.95
    gloss_exponent: float = GLOSS_EXPONENT

    def __post_init__(self) -> None:
        for name in ("albedo", "gloss", "emissivity"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be from 0 to 1, is {getattr(self, name)}")
        if not 1.0 <= self.gloss_exponent <= 1e4:
            raise ValueError(f"gloss_exponent must be from 1 to 1e4, is {self.gloss_exponent}")


@dataclass(frozen=True, slots=True)
class Lamp:
    """In the world frame; ``power`` is the irradiance of a facing surface at 1 m."""

    at_mm: Point
    power: float


@dataclass(frozen=True, slots=True)
class Lighting:
    """``brightness`` scales all light; 1 exposes a light board well, 0.3 is a dim room."""

    brightness: float = 1.0
    lamps: tuple[Lamp, ...] = (
        Lamp((450.0, -350.0, 1350.0), 2.6),
        Lamp((-1300.0, -700.0, 1100.0), 1.5),
    )
    ambient: float = 0.50


def irradiance(lighting: Lighting, points_mm: Rows, normals: Rows) -> Rows:
    """Light on surface points (3, n) mm with unit normals (3, n) or (3, 1), world frame: (n,)."""
    # The sky of a room is its ceiling and walls: what faces up sees more of it.
    light = lighting.ambient * (0.65 + 0.35 * normals[2]) + np.zeros_like(points_mm[0])
    for lamp in lighting.lamps:
        direction, square = _towards(lamp, points_mm)
        light += lamp.power * 1e6 * np.maximum(dot(direction, normals), 0.0) / square
    return np.asarray(light * lighting.brightness)


def seen_light(
    lighting: Lighting,
    points_mm: Singles,
    normals: Singles,
    eye_mm: Singles,
    albedo: Singles,
    gloss: Singles,
    exponent: Singles | float = GLOSS_EXPONENT,
) -> Singles:
    """Light (n,) from points (3, n) towards ``eye_mm`` (3,): Lambert's law and highlights.
    ``albedo``, ``gloss`` and ``exponent``, each (n,), are those of `Paint`.
    """
    light, parts = albedo * lighting.ambient * (0.65 + 0.35 * normals[2]), np.empty_like(points_mm)
    for lamp in lighting.lamps:
        at, power = np.array(lamp.at_mm, dtype=np.float32), lamp.power * 1e6
        package.kernels.lamp_light(points_mm, normals, eye_mm, at, power, albedo, parts)
        strength, lambert, shine = parts
        light += strength * (lambert + gloss * shine**exponent)
    return np.asarray(light * lighting.brightness)


def _towards(lamp: Lamp, points_mm: Rows) -> tuple[Rows, Rows]:
    """Unit directions (3, n) to the lamp, and squared distances (n,)."""
    way = np.asarray(lamp.at_mm, dtype=points_mm.dtype)[:, None] - points_mm
    square = dot(way, way)
    way /= np.sqrt(square)
    return way, square


def radiance_from_c(temperature_c: ArrayLike) -> Floats:
    """In-band radiance of a black body, in units of one at 300 K."""
    return np.asarray(
        ((np.asarray(temperature_c, dtype=np.float64) + KELVIN_AT_0_C) / REFERENCE_K)
        ** BAND_EXPONENT
    )


def kelvin_from_radiance(radiance: ArrayLike) -> Floats:
    """Apparent temperature, kelvin: the inverse of `radiance_from_c`."""
    return np.asarray(REFERENCE_K * np.asarray(radiance, dtype=np.float64) ** (1.0 / BAND_EXPONENT))


def directional_emissivity(emissivity: Floats, facing: Floats) -> Floats:
    """Emissivity (n,) at an angle of cosine ``facing`` (n,): Schlick's Fresnel approximation
    (Computer Graphics Forum 13, 1994) with normal reflectance 1 - emissivity.
    """
    return np.asarray(emissivity * (1.0 - (1.0 - np.clip(facing, 0.0, 1.0)) ** 5))

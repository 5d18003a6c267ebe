"""From light to numbers: an optical sensor by the model of EMVA 1288, and an uncooled thermal one.

What is fixed about one camera (pixels that are a little brighter, columns that are a little warmer) comes from the camera's
seed; what is fresh in each frame comes from the generator passed in. May not know of scenes or lenses' geometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.optics import Floats
from instruments.world.shading import KELVIN_AT_0_C

Image = NDArray[np.float32]
NOISE_LEVELS = 65536


@cache
def _normal_levels() -> Image:
    """Quantiles of the unit normal at (k + 1/2) / 65536, scaled to unit variance."""
    half = [NormalDist().inv_cdf((k + 0.5) / NOISE_LEVELS) for k in range(NOISE_LEVELS // 2, NOISE_LEVELS)]
    levels = np.concatenate([-np.array(half)[::-1], half])
    return np.asarray(levels / levels.std(), dtype=np.float32)


def normal_noise(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """Unit normal noise, float32, by looking 16 random bits up in a table of quantiles: reaches 4.3 sigma, seven times as fast."""
    count = shape[0] * shape[1]
    bits = rng.integers(0, 2**64, size=-(-count // 4), dtype=np.uint64, endpoint=False)
    level = bits.astype("<u8", copy=False).view("<u2")[:count].reshape(shape)
    noise: Image = np.asarray(_normal_levels().take(level, mode="clip"), dtype=np.float32)
    return noise


@dataclass(frozen=True, slots=True)
class OpticalSensor:
    """A CCD of the ICX205's class: light 1.0 fills a pixel to ``full_well_e`` electrons, ``white_dn`` grey levels over the offset.

    ``read_noise_e`` electrons rms; ``prnu`` spread of the pixels' gain, ``dsnu_dn`` of their offset; ``blur_px`` sigma of lens
    and pixel together; ``vignetting`` is the share of the cos^4 law that the lens shows.
    """

    full_well_e: float = 13000.0
    read_noise_e: float = 20.0
    offset_dn: float = 4.0
    white_dn: float = 255.0
    prnu: float = 0.006
    dsnu_dn: float = 0.25
    blur_px: float = 0.5
    vignetting: float = 0.4

    @property
    def gain_dn_per_e(self) -> float:
        """The system gain K of EMVA 1288."""
        return self.white_dn / self.full_well_e


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """A frame before noise, or a part of one: mean grey level, unrounded, and its standard deviation, at those rows and columns."""

    rows: slice
    columns: slice
    mean: Image
    spread: Image


class OpticalReadout:
    """One optical camera's sensor: its fixed pattern and its grey levels."""

    def __init__(self, sensor: OpticalSensor, rays: tuple[Floats, Floats], seed: np.random.SeedSequence) -> None:
        rng = np.random.Generator(np.random.SFC64(seed))
        x, y = (ray.astype(np.float32) for ray in rays)
        shape = (x.shape[0], x.shape[1])
        cos4 = 1.0 / (1.0 + x * x + y * y) ** 2
        self.sensor = sensor
        self._dark_dn = sensor.offset_dn + sensor.dsnu_dn * normal_noise(rng, shape)
        response = (1.0 - sensor.vignetting * (1.0 - cos4)) * (1.0 + sensor.prnu * normal_noise(rng, shape))
        self._response_dn = (sensor.white_dn * response).astype(np.float32)

    def blurred(self, light: Image) -> Image:
        """Through the lens's blur."""
        sigma = self.sensor.blur_px
        if sigma <= 0.0:
            return light
        return np.asarray(cv2.GaussianBlur(light, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)

    def expected(self, light: Image, rows: slice, columns: slice) -> Expected:
        """What light (h, w) on that part of the sensor gives.

        Variance: K^2 (electrons + read noise^2), EMVA 1288. A full well holds no more.
        """
        gain = self.sensor.gain_dn_per_e
        signal = np.minimum(light * self._response_dn[rows, columns], np.float32(self.sensor.full_well_e * gain))
        spread = cv2.sqrt(gain * signal + np.float32((gain * self.sensor.read_noise_e) ** 2))
        return Expected(rows, columns, signal + self._dark_dn[rows, columns], spread)

    def expose(self, parts: Sequence[Expected], rng: np.random.Generator) -> NDArray[np.uint8]:
        """One exposure of the whole sensor: fresh noise, then 8 bits. The first part is the whole image, later ones lie over it."""
        shape = (parts[0].mean.shape[0], parts[0].mean.shape[1])
        noise = normal_noise(rng, shape)
        exposed: NDArray[np.uint8] = np.empty(shape, dtype=np.uint8)
        for part in parts:
            at = (part.rows, part.columns)
            exposed[at] = cv2.add(cv2.multiply(noise[at], part.spread), part.mean, dtype=cv2.CV_8U)
        return exposed


@dataclass(frozen=True, slots=True)
class ThermalSensor:
    """An uncooled array. ``width_px`` x ``height_px`` pixels; temperatures and noises in kelvin.

    ``netd_k`` fresh noise of a pixel; ``fixed_k`` what is left of the fixed pattern, ``line_k`` of its rows and columns; ``blur_px``
    sigma of the lens's blur in sensor pixels, before the pixel's own area. The 8-bit picture is automatic: from the 1st to the 99.5th
    percentile of the frame, opened to at least ``least_span_k`` upwards and by ``headroom`` of that at both ends, so a room without
    anything warm shows noise, not a stretched picture. ``mirrored`` and ``hot_is_black`` say how it is delivered.
    """

    width_px: int = 160
    height_px: int = 120
    netd_k: float = 0.10
    fixed_k: float = 0.06
    line_k: float = 0.04
    blur_px: float = 0.45
    oversample: int = 2
    least_span_k: float = 10.0
    headroom: float = 0.06
    mirrored: bool = True
    hot_is_black: bool = True


class ThermalReadout:
    """One thermal camera's sensor: its fixed pattern, its centi-kelvin and its 8-bit picture."""

    def __init__(self, sensor: ThermalSensor, seed: np.random.SeedSequence) -> None:
        rng = np.random.Generator(np.random.SFC64(seed))
        shape = (sensor.height_px, sensor.width_px)
        self.sensor = sensor
        lines = sensor.line_k * (rng.standard_normal((shape[0], 1)) + rng.standard_normal((1, shape[1])))
        self._pattern_k: Floats = sensor.fixed_k * rng.standard_normal(shape) + lines

    def gathered(self, radiance: Floats) -> Floats:
        """Radiance on the fine grid (oversample x) through lens and pixels: (height, width)."""
        fine = self.sensor.oversample
        blurred = cv2.GaussianBlur(radiance, (0, 0), self.sensor.blur_px * fine, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(blurred.reshape(self.sensor.height_px, fine, self.sensor.width_px, fine).mean(axis=(1, 3)))

    def expose(self, apparent_k: Floats, rng: np.random.Generator) -> NDArray[np.uint16]:
        """One frame as centi-kelvin, 16 bits, un-mirrored, from apparent temperatures in kelvin."""
        frame = apparent_k + self._pattern_k + self.sensor.netd_k * normal_noise(rng, (self.sensor.height_px, self.sensor.width_px))
        return np.clip(np.rint(100.0 * frame), 0.0, 65535.0).astype(np.uint16)

    def delivered(self, centikelvin: NDArray[np.uint16], width_px: int, height_px: int) -> NDArray[np.uint8]:
        """The 8-bit picture as the camera hands it over: automatic gain, blown up smoothly, mirrored, hot is black."""
        low, high = np.percentile(centikelvin, [1.0, 99.5]) / 100.0
        span = max(float(high - low), self.sensor.least_span_k)
        grey = (centikelvin / 100.0 - low + self.sensor.headroom * span) / (span * (1.0 + 2.0 * self.sensor.headroom))
        grey = 1.0 - grey if self.sensor.hot_is_black else grey
        picture = cv2.resize((255.0 * grey).astype(np.float32), (width_px, height_px), interpolation=cv2.INTER_LINEAR)
        picture = picture[:, ::-1] if self.sensor.mirrored else picture
        return np.ascontiguousarray(np.clip(np.rint(picture), 0.0, 255.0).astype(np.uint8))


def celsius(centikelvin: NDArray[np.uint16]) -> Floats:
    """degC of a radiometric frame."""
    return np.asarray(centikelvin / 100.0 - KELVIN_AT_0_C)

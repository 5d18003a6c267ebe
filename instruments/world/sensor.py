"""The optical sensor by EMVA 1288, fast normal noise, and the lens's blur and focus.

Pixels gather light over their area, so the lens is a kernel on their grid: the discrete Gaussian
(Lindeberg 1990), with variance sigma^2 exactly and transfer function exp(sigma^2 (cos 2 pi f - 1)).
Fixed patterns come from the camera's seed, fresh noise from the generator; shot noise is taken as
normal.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache, lru_cache
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments import world as package
from instruments.world.optics import Floats

Image = NDArray[np.float32]
Words = NDArray[np.uint16]
Part = tuple[slice, slice]  # rows and columns
NOISE_LEVELS = 65536


@cache
def _normal_levels() -> Image:
    """Quantiles of the unit normal at (k + 1/2) / 65536, scaled to unit variance."""
    places = (np.arange(NOISE_LEVELS // 2, NOISE_LEVELS) + 0.5) / NOISE_LEVELS
    half = [NormalDist().inv_cdf(place) for place in places.tolist()]
    levels = np.concatenate([-np.array(half)[::-1], half])
    return np.asarray(levels / levels.std(), dtype=np.float32)


def _words(rng: np.random.Generator, count: int) -> Words:
    """Random numbers of 16 bits, which name normal levels."""
    bits = rng.integers(0, 2**64, size=-(-count // 4), dtype=np.uint64, endpoint=False)
    return bits.astype("<u8", copy=False).view("<u2")[:count].astype(np.uint16, copy=False)


def normal_noise(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """Unit normal noise, float32, from a table of quantiles by 16 random bits: to 4.3 sigma."""
    level = _words(rng, shape[0] * shape[1]).reshape(shape)
    return np.asarray(cv2.LUT(level, _normal_levels()), dtype=np.float32)


FAINT = 1e-5  # weights below this are left out
LEVELS_PX = 0.25  # blurs between which pictures are interpolated


@lru_cache(maxsize=64)
def kernel(sigma_px: float) -> Image:
    """Weights of the discrete Gaussian, (2 n + 1,), sum 1."""
    size = max(64, 1 << int(np.ceil(np.log2(16.0 * sigma_px + 1.0))) + 1)
    spectrum = np.exp(sigma_px**2 * (np.cos(2.0 * np.pi * np.arange(size) / size) - 1.0))
    weights = np.fft.fftshift(np.fft.ifft(spectrum).real)
    reach = max(int(np.flatnonzero(weights[size // 2 :] > FAINT).max(initial=0)), 1)
    cut = weights[size // 2 - reach : size // 2 + reach + 1]
    return np.asarray(cut / cut.sum(), dtype=np.float32)


def reach_px(sigma_px: float) -> int:
    """How far the blur carries light, whole pixels."""
    return len(kernel(sigma_px)) // 2 if sigma_px > 0.0 else 0


def blurred(image: Image, sigma_px: float) -> Image:
    """An image (h, w) through a lens of that blur."""
    if sigma_px <= 0.0:
        return image
    weights = kernel(sigma_px)
    return np.asarray(
        cv2.sepFilter2D(image, cv2.CV_32F, weights, weights, borderType=cv2.BORDER_REPLICATE),
        dtype=np.float32,
    )


def blurred_by_depth(image: Image, sigma_px: Image) -> Image:
    """An image with a blur (h, w) that varies: interpolated between even blurs."""
    low, high = float(sigma_px.min()), float(sigma_px.max())
    count = max(int(np.ceil((high - low) / LEVELS_PX)) + 1, 2)
    levels = np.linspace(low, high, count)
    if high - low < 1e-3:
        return blurred(image, high)
    result = np.zeros_like(image)
    per_px = np.float32((count - 1) / (high - low))
    for level in levels:
        share = np.clip(1.0 - np.abs(sigma_px - np.float32(level)) * per_px, 0.0, 1.0)
        result += share * blurred(image, float(level))
    return result


@dataclass(frozen=True, slots=True)
class Focus:
    """A thin lens: pupil ``aperture_mm``, sharp at ``distance_mm``."""

    aperture_mm: float = 1.5
    distance_mm: float = 1080.0

    def sigma_px(self, depth_mm: NDArray[np.floating] | float, focal_px: float) -> Floats:
        """Blur at a depth: a quarter of the circle of confusion, aperture f |1/z - 1/z_focus|."""
        nearer = np.abs(1.0 / np.asarray(depth_mm, dtype=np.float64) - 1.0 / self.distance_mm)
        return np.asarray(0.25 * (self.aperture_mm * focal_px * nearer))


NORMAL_EXPOSURE_S = 0.02
Grey = NDArray[np.unsignedinteger]


@dataclass(frozen=True, slots=True)
class Exposure:
    """``time_s`` the shutter is open, ``gain`` over the sensor's own."""

    time_s: float = NORMAL_EXPOSURE_S
    gain: float = 1.0


@dataclass(frozen=True, slots=True)
class OpticalSensor:
    """A CCD of the ICX205's class: at `NORMAL_EXPOSURE_S` light 1.0 gives ``full_well_e``
    electrons. ``prnu``, ``dsnu_e``: spread of gain and offset; ``vignetting``: share of the cos^4
    law.
    """

    full_well_e: float = 13000.0
    read_noise_e: float = 20.0
    dark_e_per_s: float = 50.0
    offset_dn: float = 4.0
    white_dn: float = 255.0
    bits: int = 8
    prnu: float = 0.006
    dsnu_e: float = 12.0
    blur_px: float = 0.5
    vignetting: float = 0.4
    focus: Focus = field(default_factory=Focus)

    @property
    def gain_dn_per_e(self) -> float:
        """The system gain K of EMVA 1288 at gain 1."""
        return self.white_dn / self.full_well_e


class OpticalReadout:
    """One optical camera's sensor: its fixed pattern and its grey levels."""

    def __init__(
        self, sensor: OpticalSensor, rays: tuple[Floats, Floats], seed: np.random.SeedSequence
    ) -> None:
        rng = np.random.Generator(np.random.SFC64(seed))
        x, y = (ray.astype(np.float32) for ray in rays)
        shape = (x.shape[0], x.shape[1])
        cos4 = 1.0 / (1.0 + x * x + y * y) ** 2
        self.sensor = sensor
        self._dark_e = np.float32(sensor.dsnu_e) * normal_noise(rng, shape)
        vignette = 1.0 - np.float32(sensor.vignetting) * (1.0 - cos4)
        self._response = vignette * (1.0 + np.float32(sensor.prnu) * normal_noise(rng, shape))

    def mean(self, light: Image, exposure: Exposure | None = None, every: int = 1) -> Image:
        """Mean grey levels that light on the sensor gives, (h, w), before rounding; ``light`` is
        that of ``every`` so many pixels in either direction.
        """
        filled, dark, full, _, _, gain, offset, _ = self._constants(exposure or Exposure())
        response, dark_e = (part[::every, ::every] for part in (self._response, self._dark_e))
        electrons = np.minimum(light * response * filled + dark, full)
        return np.asarray((electrons + dark_e) * gain + offset)

    def noise(self, rng: np.random.Generator) -> Words:
        """Which of `NOISE_LEVELS` is each pixel's, (h, w): all that an exposure needs of chance."""
        return _words(rng, self._response.size).reshape(self._response.shape)

    def exposed(self, light: Image, noise: Words, exposure: Exposure | None = None) -> Grey:
        """What light on the sensor gives with `noise`, (h, w): uint8 (uint16 above 8 bits)."""
        pixels = light, self._response, self._dark_e, noise
        constants, exposed = self._constants(exposure or Exposure()), np.empty_like(noise)
        package.kernels.expose(*pixels, _normal_levels(), constants, exposed)
        return exposed if self.sensor.bits > 8 else exposed.astype(np.uint8)

    def _constants(self, shutter: Exposure) -> Image:
        """Electrons at light 1, of dark current, and of a full well, which holds no more; variance
        of reading; grey levels by electron, squared and plain, at no light, and at most.
        """
        sensor, gain = self.sensor, self.sensor.gain_dn_per_e * shutter.gain
        filled = sensor.full_well_e * shutter.time_s / NORMAL_EXPOSURE_S
        electrons = filled, sensor.dark_e_per_s * shutter.time_s, sensor.full_well_e
        grey = gain**2, gain, sensor.offset_dn, 2**sensor.bits - 1
        return np.array([*electrons, sensor.read_noise_e**2, *grey], dtype=np.float32)

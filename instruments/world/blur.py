"""The lens's blur, with a transfer function that can be written down, and the depth that a lens has sharp.

Pixels gather light over their area (coverage is exact), so what is left for the lens is a kernel on the grid of pixels. The kernel is
the discrete Gaussian (Lindeberg 1990): its variance is exactly sigma^2 however narrow it is, and its transfer function is
exp(sigma^2 (cos 2 pi f - 1)); a Gaussian cut to pixels has neither. May not know what is in an image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.noise import Image
from instruments.world.optics import Floats

FAINT = 1e-5  # weights below this are left out
LEVELS_PX = 0.25  # blurs between which pictures are interpolated


def transfer(sigma_px: float, cycles_per_px: Floats) -> Floats:
    """Modulation of lens and square pixel together along rows or columns, at spatial frequencies (n,): the declared MTF."""
    return np.asarray(np.abs(np.sinc(cycles_per_px)) * np.exp(sigma_px**2 * (np.cos(2.0 * np.pi * cycles_per_px) - 1.0)))


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
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, weights, weights, borderType=cv2.BORDER_REPLICATE), dtype=np.float32)


def blurred_by_depth(image: Image, sigma_px: Image) -> Image:
    """An image through a blur that differs from pixel to pixel, (h, w): interpolated between even blurs."""
    low, high = float(sigma_px.min()), float(sigma_px.max())
    count = max(int(np.ceil((high - low) / LEVELS_PX)) + 1, 2)
    levels = np.linspace(low, high, count)
    if high - low < 1e-3:
        return blurred(image, high)
    result = np.zeros_like(image)
    for level in levels:
        share = np.clip(1.0 - np.abs(sigma_px - np.float32(level)) * np.float32((count - 1) / (high - low)), 0.0, 1.0)
        result += share * blurred(image, float(level))
    return result


@dataclass(frozen=True, slots=True)
class Focus:
    """A thin lens: ``aperture_mm`` of its pupil, ``distance_mm`` that it has sharp. Raises ValueError for one without sense.

    A 6 mm lens at f/4, focused on the teats, is the default; what is a little off still falls on one pixel.
    """

    aperture_mm: float = 1.5
    distance_mm: float = 1080.0

    def __post_init__(self) -> None:
        if not (self.aperture_mm >= 0.0 and self.distance_mm > 0.0 and np.isfinite([self.aperture_mm, self.distance_mm]).all()):
            raise ValueError(f"a lens needs an aperture of 0 mm or more and a distance above zero, has {self}")

    def sigma_px(self, depth_mm: NDArray[np.floating] | float, focal_px: float) -> Floats:
        """Blur at a depth: the circle of confusion is aperture f |1/z - 1/z_focus| across; a disc's sigma is a quarter of that."""
        across = self.aperture_mm * focal_px * np.abs(1.0 / np.asarray(depth_mm, dtype=np.float64) - 1.0 / self.distance_mm)
        return np.asarray(0.25 * across)

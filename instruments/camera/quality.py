"""Measures of one picture, largely independent of its subject: sharpness, black, saturation,
flatness, missing rows.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

FINE_PX, COARSE_PX = 1.2, 3.0  # sigmas of the two blurs whose gradients are compared
STRONGEST = 0.002  # share of all pixels whose gradient counts as an edge's
# a difference over two pixels is a derivative seen through a box of that width: its variance
DIFFERENCE_PX2 = 1.0 / 3.0
# white noise would give (coarse / fine)^4, a perfect edge (coarse / fine)^2
NOISE_RATIO2 = 1.2 * (COARSE_PX / FINE_PX) ** 2
STRIDES, LARGE_PX = (5, 7, 11, 13), 500_000
LEAST_GRADIENT_DN = 1.0  # per px, after the fine blur; below there is no edge but noise


def edge_blur_px(picture: NDArray[np.uint8]) -> float | None:
    """Standard deviation in px of the blur of the strongest edges (median of 0.2 % of the pixels);
    None without edges. After a further blur a the gradient is proportional to 1 / sqrt(s^2 + a^2),
    so that two gradients give s (Zhuo and Sim, Pattern Recognition 44, 2011, eq. 6).
    """
    light, at = picture.astype(np.float32), _inner_places(picture.shape)
    if at.size == 0:
        return None
    inner = _gradients(light, FINE_PX, at)
    rank = inner.size - max(1, int(STRONGEST * inner.size))
    edges = inner >= max(float(np.partition(inner, rank)[rank]), LEAST_GRADIENT_DN)
    if np.count_nonzero(edges) < 16:
        return None
    wide = _gradients(light, COARSE_PX, at[edges])
    ratio2 = float(np.median(inner[edges] / np.maximum(wide, 1e-6))) ** 2
    if ratio2 > NOISE_RATIO2:
        return None
    if ratio2 <= 1.0:
        return float("inf")
    fine2, coarse2 = FINE_PX**2 + DIFFERENCE_PX2, COARSE_PX**2 + DIFFERENCE_PX2
    return float(np.sqrt(max(0.0, (coarse2 - ratio2 * fine2) / (ratio2 - 1.0))))


@lru_cache(maxsize=4)  # cameras are few
def _inner_places(shape: tuple[int, int]) -> NDArray[np.intp]:
    """Pixels without the blur's own border, by their numbers in the picture."""
    inner = np.arange(shape[0] * shape[1]).reshape(shape)[8:-8, 8:-8].reshape(-1)
    if inner.size > LARGE_PX:  # a sample of a large picture says the same, if it meets every column
        stride = next((step for step in STRIDES if (shape[1] - 16) % step), 1)
        inner = np.ascontiguousarray(inner[::stride])
    inner.flags.writeable = False
    return inner


def _gradients(
    light: NDArray[np.float32], sigma: float, at: NDArray[np.intp]
) -> NDArray[np.float32]:
    """Of the picture after a blur, at the pixels ``at``."""
    smooth, wide = cv2.GaussianBlur(light, (0, 0), sigma).reshape(-1), light.shape[1]
    x, y = (np.float32(0.5) * (smooth[at + step] - smooth[at - step]) for step in (1, wide))
    return np.asarray(cv2.magnitude(x, y), dtype=np.float32).reshape(-1)


def level_dn(picture: NDArray[np.uint8], share: float) -> int:
    """The grey level that ``share`` of the pixels don't exceed."""
    counts = np.cumsum(
        cv2.calcHist([picture], [0], None, [256], [0.0, 256.0]).reshape(-1).astype(np.float64)
    )
    return int(np.searchsorted(counts, share * picture.size))


def saturated_share(picture: NDArray[np.uint8]) -> float:
    """Share of pixels at the top of the range: 254 counts too, for lossy streams blur 255."""
    return float(np.count_nonzero(picture >= 254) / picture.size)


def spread(image: NDArray[Any]) -> float:
    """Between the 0.5th and the 99.5th percentile, in the image's own unit."""
    low, high = np.percentile(image, [0.5, 99.5])
    return float(high - low)


def missing_rows(picture: NDArray[Any], last: NDArray[Any] | None = None) -> float:
    """Share of rows at the top or bottom that hold one value, or are those of ``last``. Noise
    prevents both in a row that was read out; white rows don't count.
    """
    least = picture.min(axis=1)
    missing = picture.max(axis=1) == least
    if last is not None and last.shape == picture.shape:
        missing |= np.all(picture == last, axis=1)
    missing &= least < np.iinfo(picture.dtype).max
    if np.all(missing):
        return 1.0
    return float(max(np.argmin(missing), np.argmin(missing[::-1])) / len(missing))

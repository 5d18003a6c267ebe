"""From light to grey levels: an optical sensor by the model of EMVA 1288.

What is fixed about one camera (pixels that are a little brighter, an offset of their own) comes from the camera's seed; what
is fresh in each frame comes from the generator passed in. Shot noise is taken as normal, which it is to a few electrons.
May not know of scenes or lenses' geometry.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.world.blur import Focus
from instruments.world.noise import Image, normal_noise
from instruments.world.optics import Floats

NORMAL_EXPOSURE_S = 0.02
Grey = NDArray[np.unsignedinteger]


@dataclass(frozen=True, slots=True)
class Exposure:
    """How a camera is set: ``time_s`` its shutter is open, ``gain`` on top of the sensor's own. Raises ValueError."""

    time_s: float = NORMAL_EXPOSURE_S
    gain: float = 1.0

    def __post_init__(self) -> None:
        if not (0.0 < self.time_s <= 10.0 and 0.0 < self.gain <= 100.0):
            raise ValueError(f"an exposure takes up to 10 s, with a gain above 0 and up to 100, is {self}")


@dataclass(frozen=True, slots=True)
class OpticalSensor:
    """A CCD of the ICX205's class. At `NORMAL_EXPOSURE_S` light 1.0 fills a pixel to ``full_well_e`` electrons, which is
    ``white_dn`` grey levels over the offset at gain 1.

    ``read_noise_e`` electrons rms, ``dark_e_per_s`` dark current; ``prnu`` spread of the pixels' gain, ``dsnu_e`` of their offset;
    ``bits`` of the converter; ``blur_px`` sigma of the sharp lens (`instruments.world.blur`); ``vignetting`` is the share of the cos^4
    law that the lens shows.
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

    def __post_init__(self) -> None:
        if not 1 <= self.bits <= 16:
            raise ValueError(f"a sensor has from 1 to 16 bits, has {self.bits}")

    @property
    def gain_dn_per_e(self) -> float:
        """The system gain K of EMVA 1288 at gain 1."""
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
        self._dark_e = np.float32(sensor.dsnu_e) * normal_noise(rng, shape)
        vignette = 1.0 - np.float32(sensor.vignetting) * (1.0 - cos4)
        self._response = vignette * (1.0 + np.float32(sensor.prnu) * normal_noise(rng, shape))

    def expected(self, light: Image, rows: slice, columns: slice, exposure: Exposure | None = None) -> Expected:
        """What light (h, w) on that part of the sensor gives.

        Variance: K^2 (electrons + read noise^2), EMVA 1288. A full well holds no more.
        """
        shutter = exposure or Exposure()
        sensor, gain = self.sensor, self.sensor.gain_dn_per_e * shutter.gain
        filled = np.float32(sensor.full_well_e * shutter.time_s / NORMAL_EXPOSURE_S)
        dark = np.float32(sensor.dark_e_per_s * shutter.time_s)
        electrons = np.minimum(light * self._response[rows, columns] * filled + dark, np.float32(sensor.full_well_e))
        spread = cv2.sqrt(np.float32(gain**2) * (electrons + np.float32(sensor.read_noise_e**2)))
        mean = np.float32(gain) * (electrons + self._dark_e[rows, columns]) + np.float32(sensor.offset_dn)
        return Expected(rows, columns, mean, np.asarray(spread, dtype=np.float32))

    def expose(self, parts: Sequence[Expected], rng: np.random.Generator) -> Grey:
        """One exposure of the whole sensor: fresh noise, then grey levels, uint8 (uint16 for more than 8 bits).

        The first part is the whole image, later ones lie over it.
        """
        shape = (parts[0].mean.shape[0], parts[0].mean.shape[1])
        noise = normal_noise(rng, shape)
        deep = self.sensor.bits > 8
        exposed = np.empty(shape, dtype=np.uint16 if deep else np.uint8)
        for part in parts:
            at = (part.rows, part.columns)
            exposed[at] = cv2.add(cv2.multiply(noise[at], part.spread), part.mean, dtype=cv2.CV_16U if deep else cv2.CV_8U)
        return np.minimum(exposed, exposed.dtype.type(2**self.sensor.bits - 1)) if self.sensor.bits not in (8, 16) else exposed

"""The pictures as the detector needs them, or a sentence on why they can't be used.

Optical intensities stay linear, in a region about the nominations. The thermal picture has the
sensor's pixels, un-mirrored, warm high.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from detector import outline as package
from detector.calibration import ThermalCamera
from detector.outline.edges import Field
from detector.protocol import Frames

_GREY = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601
_GROUPED = 0.01  # of differences that are one number: intensities are whole
_SECOND = np.array([1.0, -2.0, 1.0])  # difference
_EVERY = 3  # of so many pixels in either direction one tells of noise
BARN_C = (-60.0, 150.0)  # the middle of a barn's picture; raw counts read as -191 degC


class UnusableError(ValueError):
    """A picture that can't be used; the message is one sentence."""


def optical(picture: NDArray[Any], size: tuple[int, int], camera: str) -> NDArray[Any]:
    """The grey picture (rows, columns), of the calibration's size. Raises UnusableError."""
    grey = _grey(picture, camera)
    _check_size(grey, size, camera)
    return grey


def thermal(frames: Frames, camera: ThermalCamera) -> Field:
    """Warmth (rows, columns), sensor's grid, un-mirrored; K, else grey. Raises UnusableError."""
    columns, rows = camera.sensor_size
    if frames.thermal_k is not None:
        kelvin = np.asarray(frames.thermal_k)
        _check_size(kelvin, camera.sensor_size, "radiometric thermal")
        if not np.isfinite(kelvin).all():
            raise UnusableError("the radiometric thermal picture has pixels that are no numbers")
        warm = np.ascontiguousarray(kelvin, dtype=np.float32)
        middle_c = median(warm) - 273.15
        if not BARN_C[0] <= middle_c <= BARN_C[1]:
            what = f"the radiometric thermal picture reads {middle_c:.0f} degC in the middle of all"
            raise UnusableError(f"{what}: its counts are no hundredths of a kelvin")
        return warm
    if frames.thermal is None:
        raise UnusableError("there is no thermal picture, which shows what is as warm as a teat")
    grey = _grey(frames.thermal, "thermal")
    _check_size(grey, camera.image_size, "thermal")
    upright = grey[:, ::-1] if camera.mirrored else grey
    field = np.ascontiguousarray(upright, dtype=np.float32)
    small = cv2.resize(field, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(-small if camera.polarity == "hot_is_black" else small, dtype=np.float32)


def region(
    picture: NDArray[Any], points_px: NDArray[np.float64], margin_px: int
) -> tuple[Field, NDArray[np.float64]]:
    """Linear intensities about points (n, 2), first pixel (2,). Raises UnusableError if empty."""
    rows, columns = picture.shape
    seen = points_px[np.isfinite(points_px).all(axis=1)]
    if len(seen) == 0:
        raise UnusableError("nothing warm lies in the optical pictures")
    low = np.clip(np.floor(seen.min(axis=0)).astype(int) - margin_px, 0, None)
    high = np.minimum(np.ceil(seen.max(axis=0)).astype(int) + margin_px, [columns, rows])
    if (high - low < 16).any():
        raise UnusableError("nothing warm lies in the optical pictures")
    near = picture[low[1] : high[1], low[0] : high[0]]
    return np.ascontiguousarray(near, dtype=np.float32), low.astype(np.float64)


def noise_of(field: Field) -> float:
    """Robust noise sd of intensities, from second differences (Immerkaer 1996). Of whole grey
    levels the median is that of a step's share, so that it doesn't hang on the region's rim.
    """
    bent = cv2.sepFilter2D(field, cv2.CV_32F, _SECOND, _SECOND)
    second = np.abs(bent[::_EVERY, ::_EVERY])
    middle = median(second)
    below, same = np.count_nonzero(second < middle), np.count_nonzero(second == middle)
    if same > _GROUPED * second.size:
        middle += (0.5 * second.size - below) / same - 0.5
    return max(middle / (0.6745 * 6.0), 0.05)


def steepness(field: Field) -> Field:
    """Lengths of gradients in every third row and column: enough for a median."""
    found = np.empty([-(-side // _EVERY) for side in field.shape], dtype=np.float32)
    package.kernels.steepness(field, _EVERY, found)
    return found


def median(values: NDArray[Any]) -> float:
    """As numpy's of finite single precision, in a seventh of its time."""
    half = values.size // 2
    parted = np.partition(values, half, axis=None)
    below = parted[half] if values.size % 2 else parted[:half].max()
    return float((below + parted[half]) / np.float32(2))


def _grey(picture: NDArray[Any], camera: str) -> NDArray[Any]:
    image = np.asarray(picture)
    if image.ndim == 3 and image.shape[2] in (3, 4):
        image = image[..., :3].astype(np.float64) @ _GREY[::-1]
    if image.ndim != 2 or image.size == 0:
        raise UnusableError(
            f"the {camera} picture has the shape {image.shape}; a grey or colour picture is needed"
        )
    if not (np.issubdtype(image.dtype, np.integer) or np.issubdtype(image.dtype, np.floating)):
        raise UnusableError(
            f"the {camera} picture has pixels of type {image.dtype}; numbers are needed"
        )
    if np.issubdtype(image.dtype, np.floating) and not np.isfinite(image).all():
        raise UnusableError(f"the {camera} picture has pixels that are no numbers")
    return image


def _check_size(picture: NDArray[Any], size: tuple[int, int], camera: str) -> None:
    if picture.shape != (size[1], size[0]):
        given = " x ".join(map(str, picture.shape[::-1]))
        raise UnusableError(
            f"the {camera} picture is {given}, the calibration is for {size[0]} x {size[1]}"
        )

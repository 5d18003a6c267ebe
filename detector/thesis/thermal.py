"""The thermal picture in the thesis's chain: 8-bit, un-mirrored, edges, order filters (4.1.1 to
4.1.4).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.thesis.canny import Edges, Mask, canny
from detector.thesis.parameters import Domain, Parameters

Grey = NDArray[np.uint8]


def eight_bit(image: NDArray[Any]) -> Grey:
    """Grey as uint8: the upper byte of 16 bits. Raises ValueError for other pixels."""
    if image.ndim != 2:
        raise ValueError(
            f"must be a grey picture of rows and columns, its array has the shape {image.shape}"
        )
    if image.dtype == np.uint16:
        return (image >> 8).astype(np.uint8)
    if image.dtype != np.uint8:
        raise ValueError(f"must have 8-bit or 16-bit pixels (uint8, uint16), has {image.dtype}")
    return np.asarray(image, dtype=np.uint8)


def unmirror(picture: Grey) -> Grey:
    """Reflected about the vertical centre line, against the beam splitter (4.1.1, A.2.1)."""
    return np.ascontiguousarray(picture[:, ::-1])


def picture_from_kelvin(thermal_k: NDArray[Any], image_size: tuple[int, int]) -> Grey:
    """An 8-bit picture of image_size (columns, rows): hottest 0, coldest 255, linear (4.1.1). For
    radiometric frames only. Raises ValueError unless a plane of finite numbers.
    """
    kelvin = np.asarray(thermal_k, dtype=np.float32)
    if kelvin.ndim != 2 or kelvin.size == 0 or not np.all(np.isfinite(kelvin)):
        raise ValueError(
            f"must be rows and columns of finite kelvin, its array has the shape {kelvin.shape}"
        )
    coldest, hottest = float(kelvin.min()), float(kelvin.max())
    grey = (
        (hottest - kelvin) * (255.0 / (hottest - coldest))
        if hottest > coldest
        else np.zeros_like(kelvin)
    )
    resized = cv2.resize(grey, image_size, interpolation=cv2.INTER_LINEAR)
    return np.rint(resized).astype(np.uint8)


def find_edges(picture: Grey, p: Parameters) -> Edges:
    """Canny edges without the published column (A.1: BW(:,631)=0), where there is one."""
    edges = canny(
        picture,
        p.canny_sigma_px,
        p.canny_kernel_reach_px,
        p.canny_not_edges,
        p.canny_histogram_bins,
        p.canny_threshold_ratio,
    )
    mask = edges.mask.copy()
    mask[:, p.blanked_column : p.blanked_column + 1] = False
    return Edges(mask, edges.low, edges.high)


def order_filter(mask: Mask, domain: Domain) -> Mask:
    """ordfilt2(mask, 1, domain): true where the mask is at every 1 of the domain; outside is false.
    Odd sides, the middle is the origin (4.1.3, 4.1.4).
    """
    kernel = np.array(domain, dtype=np.uint8)
    eroded = cv2.erode(
        mask.astype(np.uint8),
        kernel,
        borderType=cv2.BORDER_CONSTANT,
        borderValue=(0.0, 0.0, 0.0, 0.0),
    )
    return np.asarray(eroded.astype(np.bool_))

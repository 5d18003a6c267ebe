"""The thermal picture as the thesis's chain takes it: 8-bit, un-mirrored, its edges, and the order
filters (sections 4.1.1 to 4.1.4).

The module may not know what the segments that it finds will be taken for.
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
    """A grey picture as uint8: 16-bit ones keep their upper byte. Raises ValueError for other kinds
    of pixels and for colour.
    """
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
    """The picture reflected about its vertical centre line, to undo the beam splitter (section
    4.1.1, appendix A.2.1).
    """
    return np.ascontiguousarray(picture[:, ::-1])


def picture_from_kelvin(thermal_k: NDArray[Any], image_size: tuple[int, int]) -> Grey:
    """An 8-bit picture of image_size (columns, rows) from kelvin: hottest 0, coldest 255, linear
    between, as section 4.1.1 describes.

    For recordings that hold only radiometric frames. Raises ValueError where the frame isn't a
    plane of finite numbers.
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
    """Canny edges with the published column taken out (appendix A.1: BW(:,631)=0; a narrower
    picture has no such column).
    """
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
    """Matlab's ordfilt2(mask, 1, domain): true where the mask is true at every 1 of the domain laid
    on the pixel; outside is false.

    The domain's sides are odd, its middle is its origin (sections 4.1.3, 4.1.4).
    """
    kernel = np.array(domain, dtype=np.uint8)
    eroded = cv2.erode(
        mask.astype(np.uint8),
        kernel,
        borderType=cv2.BORDER_CONSTANT,
        borderValue=(0.0, 0.0, 0.0, 0.0),
    )
    return np.asarray(eroded.astype(np.bool_))

"""The thermal picture in the thesis's chain: 8-bit, un-mirrored, edges, order filters (4.1.1 to
4.1.4).

Edges are those of Matlab's `edge(picture, 'canny', [], sigma)` of 2009, when the thesis was
written: a Gaussian, then derivative-of-Gaussian filters of the same sigma (2011's blurs once and
keeps this as 'canny_old'), thresholds from a histogram of gradient lengths, ridges, hysteresis, one
thinning.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.thesis.parameters import Domain, ThesisParameters

Grey = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Single = NDArray[np.float32]

# kernels end where the Gaussian falls below this part of its peak, if their greatest reach lets
# them
_DIE_OFF = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Edges:
    """The edge mask (rows, columns) and thresholds as parts of the greatest gradient."""

    mask: Mask
    low: float
    high: float


def canny(
    picture: NDArray[np.uint8],
    sigma_px: float,
    reach_px: int,
    not_edges: float,
    bins: int,
    ratio: float,
) -> Edges:
    """Edges of a grey picture (rows, columns), automatic thresholds; none in a uniform one."""
    if picture.min() == picture.max():
        return Edges(np.zeros(picture.shape, dtype=np.bool_), 0.0, 0.0)
    gx, gy = gradient(picture, sigma_px, reach_px)
    length = np.asarray(cv2.magnitude(gx, gy), dtype=np.float32)
    length /= max(float(length.max()), float(np.finfo(np.float32).tiny))
    high = automatic_threshold(length, not_edges, bins)
    low = ratio * high
    weak = ridges(gx, gy, length, low)
    return Edges(thin_once(hysteresis(weak, weak & (length > high))), low, high)


def kernels(sigma_px: float, reach_px: int) -> tuple[Single, Single]:
    """A Gaussian of sum one and its slope kernel, (2 w + 1,) each, w at most reach_px. Correlation:
    brighter along the axis is positive.
    """
    t = np.arange(-reach_px, reach_px + 1, dtype=np.float64)
    t = t[(np.exp(-(t * t) / (2 * sigma_px**2)) > _DIE_OFF) | (np.abs(t) <= 1)]
    gauss = np.exp(-(t * t) / (2 * sigma_px**2))
    slope = t * gauss / (t * t * gauss).sum()
    return (gauss / gauss.sum()).astype(np.float32), slope.astype(np.float32)


def gradient(picture: NDArray[np.uint8], sigma_px: float, reach_px: int) -> tuple[Single, Single]:
    """Slopes along columns and rows, grey levels a px, smoothed twice; borders replicate."""
    gauss, slope = kernels(sigma_px, reach_px)

    def filtered(image: Single, along: Single, across: Single) -> Single:
        border = cv2.BORDER_REPLICATE
        seen = cv2.sepFilter2D(image, cv2.CV_32F, along, across, borderType=border)
        return np.asarray(seen, dtype=np.float32)

    smooth = filtered(picture.astype(np.float32), gauss, gauss)
    return filtered(smooth, slope, gauss), filtered(smooth, gauss, slope)


def automatic_threshold(length: NDArray[np.floating], not_edges: float, bins: int) -> float:
    """Of lengths in 0..1: the upper end of the first bin below which more than `not_edges` of all
    pixels lie. As imhist, bin k of n is centred on k / (n - 1): the outermost bins are half as
    wide.
    """
    counts = np.bincount((length.ravel() * (bins - 1) + 0.5).astype(np.intp), minlength=bins)
    above = np.cumsum(counts) > not_edges * length.size
    return float(np.argmax(above) + 1) / bins


def ridges(gx: Single, gy: Single, length: Single, low: float) -> Mask:
    """Pixels above `low` with no longer gradient on either side across the edge; never the
    outermost. Neighbours are interpolated between the two pixels on the gradient's way.
    """
    keep = np.zeros(length.shape, dtype=np.bool_)
    rows, columns = np.nonzero(length[1:-1, 1:-1] > low)
    rows, columns = rows + 1, columns + 1
    u, v, here = gx[rows, columns], gy[rows, columns], length[rows, columns]
    steep = np.abs(v) > np.abs(u)
    along_x, along_y = np.sign(u).astype(np.intp), np.sign(v).astype(np.intp)
    # the diagonal neighbour's share; the gradient here is longer than low >= 0, so never 0 / 0
    share = np.minimum(np.abs(u), np.abs(v)) / np.maximum(np.abs(u), np.abs(v))
    straight_row, straight_column = np.where(steep, along_y, 0), np.where(steep, 0, along_x)
    ridge = np.ones(len(rows), dtype=np.bool_)
    for side in (1, -1):
        straight = length[rows + side * straight_row, columns + side * straight_column]
        diagonal = length[rows + side * along_y, columns + side * along_x]
        ridge &= here >= straight * (1 - share) + diagonal * share
    keep[rows[ridge], columns[ridge]] = True
    return keep


def hysteresis(weak: Mask, strong: Mask) -> Mask:
    """The 8-connected groups of weak pixels that hold a strong one."""
    count, labels = cv2.connectedComponents(weak.astype(np.uint8), connectivity=8)
    held = np.zeros(count, dtype=np.bool_)
    held[labels[strong]] = True
    held[0] = False
    return np.asarray(held[labels])


def thin_once(mask: Mask) -> Mask:
    """One pass of parallel thinning, bwmorph(…, 'thin', 1) (Guo and Hall 1989; Lam et al. 1992)."""
    # counter-clockwise from the east, as the papers number them: x1 = E, x2 = NE, ... x8 = SE
    around = ((0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1))
    for first in (True, False):  # remove pixels that end and join nothing: south-east, north-west
        padded = np.pad(mask, 1)
        rows, columns = np.nonzero(mask)
        x = np.array([padded[rows + 1 + dr, columns + 1 + dc] for dr, dc in around])
        odd, even, after = x[::2], x[1::2], np.roll(x[::2], -1, axis=0)
        crossings = (~odd & (even | after)).sum(axis=0)
        fewest = np.minimum((odd | even).sum(axis=0), (even | after).sum(axis=0))
        side = (x[1] | x[2] | ~x[7]) & x[0] if first else (x[5] | x[6] | ~x[3]) & x[4]
        gone = (crossings == 1) & (fewest >= 2) & (fewest <= 3) & ~side
        mask = mask.copy()
        mask[rows[gone], columns[gone]] = False
    return mask


def eight_bit(image: NDArray[Any]) -> Grey:
    """Grey as uint8: the upper byte of 16 bits. Raises ValueError for other pixels."""
    if image.ndim != 2:
        what = "must be a grey picture of rows and columns"
        raise ValueError(f"{what}, its array has the shape {image.shape}")
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
        what = "must be rows and columns of finite kelvin"
        raise ValueError(f"{what}, its array has the shape {kelvin.shape}")
    coldest, hottest = float(kelvin.min()), float(kelvin.max())
    grey = (hottest - kelvin) * (255.0 / (hottest - coldest) if hottest > coldest else 0.0)
    resized = cv2.resize(grey, image_size, interpolation=cv2.INTER_LINEAR)
    return np.rint(resized).astype(np.uint8)


def find_edges(picture: Grey, p: ThesisParameters) -> Edges:
    """Canny edges without the published column (A.1: BW(:,631)=0), where there is one."""
    kernel, histogram = (p.canny_sigma_px, p.canny_kernel_reach_px), p.canny_histogram_bins
    edges = canny(picture, *kernel, p.canny_not_edges, histogram, p.canny_threshold_ratio)
    edges.mask[:, p.blanked_column : p.blanked_column + 1] = False
    return edges


def order_filter(mask: Mask, domain: Domain) -> Mask:
    """ordfilt2(mask, 1, domain): true where the mask is at every 1 of the domain; outside is false.
    Odd sides, the middle is the origin (4.1.3, 4.1.4).
    """
    kernel = np.array(domain, dtype=np.uint8)
    border = cv2.BORDER_CONSTANT
    eroded = cv2.erode(mask.astype(np.uint8), kernel, borderType=border, borderValue=(0.0,) * 4)
    return np.asarray(eroded.astype(np.bool_))

"""From the thermal picture to the optical ones: nominations, regions, and the teat's end in each
(sections 4.2, 4.3; A.3, A.4).

What the original did wrong, and what stands here:
- A region that left the picture stopped it with an error. Here such a teat stays where the
  homography put it.
- It mapped without dividing by the third coordinate, right for the printed homographies only. Here
  that division is made.
- In `locateteat` the end of the dark line is looked up in row i of the region, where i counts the
  rows with dark pixels; section 4.3.5 and the rest of the listing mean the line's own row, which is
  what stands here.
- `locateteat` never looks at the last dark row, and its search ends one column before the region
  does. Kept.
- The last lines of `locateteat` are lost. Section 4.3.5: the end lies above the line's middle by
  half its length. The middle is taken between the listing's two columns, the line's first and the
  first one after it; nothing is rounded. No line leaves the nomination.
- Its way back from region to picture is one pixel off for an end that was found; where none was,
  (20, 20) leads to the nomination. Kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from detector.geometry import Array, apply_homography
from detector.thesis.parameters import ThesisParameters
from detector.thesis.thermal import Grey, Mask

_REGION_SLIP_PX = 1  # see above


@dataclass(frozen=True, slots=True, eq=False)
class RefinedEnd:
    """One teat's end (2,) px in an optical picture, and whether the picture moved it. region,
    bright (41, 41): the cut-out and its bright part after both dilations; zeros beyond the picture.
    """

    end_px: Array
    moved: bool
    region: Grey
    bright: Mask


def nominate(homography: Array, teats_px: Array) -> Array:
    """Optical pixels (n, 2), rounded, of thermal pixels (n, 2); NaN where there are none."""
    return np.asarray(np.floor(apply_homography(homography, teats_px) + 0.5))


def refine(picture: Grey, nomination_px: Array, p: ThesisParameters) -> RefinedEnd:
    """Look for the end around a nomination (2,), which stays where there is none."""
    region = cut_region(picture, nomination_px, p.region_reach_px)
    if region is None:  # beyond the picture
        blank = np.zeros((2 * p.region_reach_px + 1,) * 2, dtype=np.uint8)
        return RefinedEnd(nomination_px, False, blank, blank.astype(np.bool_))
    bright = binary_dilation(grey_dilation(region, p) > p.binary_level * 255, p)
    end = locate_end(~bright, p) if np.count_nonzero(bright) >= p.least_bright_px else None
    if end is None:
        return RefinedEnd(nomination_px, False, region, bright)
    return RefinedEnd(
        nomination_px - p.region_reach_px + end + _REGION_SLIP_PX, True, region, bright
    )


def cut_region(picture: Grey, centre_px: Array, reach_px: int) -> Grey | None:
    """The square (2 reach + 1, 2 reach + 1) around a whole pixel (2,); None beyond the picture."""
    x, y = (int(v) for v in np.nan_to_num(centre_px, nan=-1.0))
    height, width = picture.shape
    if not (reach_px <= x < width - reach_px and reach_px <= y < height - reach_px):
        return None
    return picture[y - reach_px : y + reach_px + 1, x - reach_px : x + reach_px + 1]


def grey_dilation(region: Grey, p: ThesisParameters) -> Grey:
    """Grey-scale dilation with the 9 x 10 element of figure 4.12 (section 4.3.1)."""
    element = np.ones(p.grey_dilation_size, dtype=np.uint8)
    element[:2, [0, -1]] = 0
    element[0, [1, -2]] = 0
    return _dilate(region, element)


def binary_dilation(bright: Mask, p: ThesisParameters) -> Mask:
    """Binary dilation with a rectangle of 10 rows by 7 columns (section 4.3.3)."""
    element = np.ones(p.binary_dilation_size, dtype=np.uint8)
    return _dilate(bright.astype(np.uint8), element).astype(np.bool_)


def locate_end(dark: Mask, p: ThesisParameters) -> Array | None:
    """The end (column, row): half its length above the middle of the topmost dark line of 10 px."""
    width = dark.shape[1]
    for row in np.flatnonzero(dark.any(axis=1))[:-1]:
        line = dark[row]
        start = _line_start(line, p.line_least_px)
        if start is not None:
            bright_after = np.flatnonzero(~line[start:])
            stop = start + int(bright_after[0]) if len(bright_after) else width - 1
            return np.array([(start + stop) / 2, row - (stop - start) / 2])
    return None


def _line_start(line: Mask, least_px: int) -> int | None:
    """First column of the first dark run of least_px; None where the listing finds none."""
    if np.count_nonzero(line) < least_px:
        return None
    width, start = len(line), int(np.argmax(line))
    while start + least_px < width:
        if line[start : start + least_px].all():
            return start
        bright = np.flatnonzero(~line[start + 1 : width - 1])
        if len(bright) == 0:
            return None
        start += int(bright[0]) + 2
    return None


def _dilate(image: NDArray[np.uint8], element: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Matlab's imdilate: element turned by 180 degrees, an even side's origin before the middle."""
    rows, columns = element.shape
    anchor = (columns // 2, rows // 2)  # of the turned element, (column, row) as OpenCV wants it
    turned = np.ascontiguousarray(element[::-1, ::-1])
    return np.asarray(cv2.dilate(image, turned, anchor=anchor), dtype=np.uint8)

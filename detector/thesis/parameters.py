"""Every figure of the published algorithm, with its place in the thesis; none is tuned. Indices
count from 0: Matlab's column 631 is 630 here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Domain = tuple[tuple[int, ...], ...]


@dataclass(frozen=True, slots=True)
class ThesisParameters:
    """The published settings; px of their picture, windows (before, after) inclusive."""

    # Edges of the thermal picture: appendix A.1 and Matlab's own defaults of the time
    canny_sigma_px: float = 12.0
    # Matlab's kernels ended there, at 2.5 sigma, whatever the sigma
    canny_kernel_reach_px: int = 30
    canny_not_edges: float = 0.7
    canny_histogram_bins: int = 64
    canny_threshold_ratio: float = 0.4
    blanked_column: int = 630

    # Order filters: appendix A.1. The vertical domain is lost: the horizontal one is 5 rows by 3
    # columns with its middle row set, which only makes sense if it was made from one with its
    # middle column set, so that is what stands here.
    horizontal_domain: Domain = ((0, 0, 0), (0, 0, 0), (1, 1, 1), (0, 0, 0), (0, 0, 0))
    vertical_domain: Domain = ((0, 1, 0), (0, 1, 0), (0, 1, 0), (0, 1, 0), (0, 1, 0))

    # Ends of verticals: appendix A.2.2
    vertical_merge_px: int = 4
    vertical_least_points: int = 35
    vertical_most_lines: int = 8

    # Middles of horizontals: appendix A.2.3
    window_rows: tuple[int, int] = (65, 50)
    window_columns: tuple[int, int] = (250, 280)
    # the original stopped with an error there: see lines.py
    window_outside: Literal["clip", "refuse"] = "clip"
    horizontal_merge_rows: int = 2
    horizontal_merge_columns: int = 15
    horizontal_points_between: tuple[int, int] = (5, 50)  # exclusive
    segment_points: int = 6
    segment_widest_px: int = 12
    segment_skip_px: int = 10
    segment_middle_shift_px: int = 2

    # Ends of teats: appendix A.2.4
    teat_count: int = 4
    teat_row_tolerance_px: int = 30
    teat_least_spacing_px: int = 30

    # From thermal to optical: the printed homographies of section 3.2.2, or the calibration's,
    # which are to hold at the teats' plane
    homographies: Literal["calibration", "published"] = "calibration"

    # Optical refinement: section 4.2, 4.3, appendix A.4
    region_reach_px: int = 20
    grey_dilation_size: tuple[int, int] = (9, 10)  # rows, columns; figure 4.12 has the corners off
    binary_level: float = 0.3
    binary_dilation_size: tuple[int, int] = (10, 7)
    least_bright_px: int = 1100
    line_least_px: int = 10

"""Regions, dilations and the row search in optical pictures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from detector.thesis.optical import (
    binary_dilation,
    cut_region,
    grey_dilation,
    locate_end,
    nominate,
    refine,
)
from detector.thesis.parameters import ThesisParameters

P = ThesisParameters()
FIGURE_4_12 = np.array(
    [[int(c) for c in row] for row in ("0011111100", "0111111110", *["1111111111"] * 7)]
)


def matlab_dilation(image: NDArray[np.uint8], element: NDArray[np.int_]) -> NDArray[np.uint8]:
    """max over the element of image(x - b), b counted from floor((size + 1) / 2); outside is 0."""
    rows, columns = element.shape
    origin = (rows + 1) // 2 - 1, (columns + 1) // 2 - 1
    result = np.zeros_like(image)
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            for i, j in np.argwhere(element):
                v, u = y - (i - origin[0]), x - (j - origin[1])
                if 0 <= v < image.shape[0] and 0 <= u < image.shape[1]:
                    result[y, x] = max(result[y, x], image[v, u])
    return result


@pytest.mark.slow
def test_dilations_are_matlabs() -> None:
    image = np.random.default_rng(6).integers(0, 256, (24, 22)).astype(np.uint8)
    assert np.array_equal(grey_dilation(image, P), matlab_dilation(image, FIGURE_4_12))
    bright = image > 245
    expected = matlab_dilation(bright.astype(np.uint8), np.ones((10, 7), dtype=np.int_))
    assert np.array_equal(binary_dilation(bright, P), expected.astype(np.bool_))


def dark_region(*lines: tuple[int, int, int]) -> NDArray[np.bool_]:
    """A bright region (41, 41) with dark lines (row, first column, last column)."""
    dark = np.zeros((41, 41), dtype=np.bool_)
    for row, first, last in lines:
        dark[row, first : last + 1] = True
    return dark


def test_the_end_lies_half_a_line_above_its_middle() -> None:
    end = locate_end(dark_region((15, 14, 25), (16, 10, 30)), P)
    assert end is not None
    assert end.tolist() == [20.0, 9.0]  # columns 14 and 26 (the first bright one), 12 long


def literal_search(dark: NDArray[np.bool_]) -> tuple[int, int, int] | None:
    """The listing's search, counted from 1: row, first column, column after the last."""

    def at(row: int, column: int) -> bool:
        return bool(dark[row - 1, column - 1])

    s = dark.shape[1]
    counted = [(r, int(dark[r - 1].sum())) for r in range(1, s + 1) if dark[r - 1].any()]
    for row, count in counted[:-1]:
        if count <= 9:
            continue
        ind = next(c for c in range(1, s + 1) if at(row, c))
        while ind + 10 < s + 1:
            if all(at(row, c) for c in range(ind, ind + 10)):
                return row, ind, next((c for c in range(ind, s + 1) if not at(row, c)), s)
            step = next(
                (f for f, c in enumerate(range(ind + 1, 41), start=1) if not at(row, c)), None
            )
            if step is None:
                break
            ind += step + 1
    return None


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.floats(0.5, 0.97))
def test_row_search_is_the_listings(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    dark = (rng.random((41, 41)) < share) & (rng.random((41, 1)) < 0.3)
    end, expected = locate_end(dark, P), literal_search(dark)
    if expected is None:
        assert end is None
    else:
        row, first, after = expected
        assert end is not None
        assert end.tolist() == [(first + after) / 2 - 1, row - 1 - (after - first) / 2]


def test_a_dark_teat_on_a_bright_ground_is_moved() -> None:
    picture = np.full((200, 300), 200, dtype=np.uint8)
    picture[95:, 138:164] = 20  # 26 px wide, its end at row 95
    refined = refine(picture, np.array([150.0, 90.0]), P)
    assert refined.moved
    # what the dilations leave: the dark top sinks by 4 + 5 rows, the width shrinks from 26 to 26 -
    # 9 - 6 = 11 columns
    first, after, row = 138 + 5 + 3, 138 + 5 + 3 + 11, 95 + 4 + 5
    assert refined.end_px.tolist() == [(first + after) / 2 + 1, row - 5.5 + 1]


@pytest.mark.parametrize("grey", [0, 76, 77])
def test_a_plain_region_keeps_the_nomination(grey: int) -> None:
    refined = refine(np.full((200, 300), grey, dtype=np.uint8), np.array([150.0, 90.0]), P)
    assert not refined.moved
    assert refined.end_px.tolist() == [150, 90]
    # im2bw: above 0.3 * 255 = 76.5 is bright
    assert set(refined.bright.ravel().tolist()) == {grey > 76}


@pytest.mark.parametrize(
    ("x", "y"),
    [(20, 20), (279, 179), (19, 20), (20, 19), (280, 179), (279, 180), (np.nan, 50), (-1e9, 50)],
)
def test_a_region_must_lie_in_the_picture(x: float, y: float) -> None:
    picture = np.zeros((200, 300), dtype=np.uint8)
    region = cut_region(picture, np.array([x, y]), 20)
    assert (region is not None) == ((x, y) in ((20, 20), (279, 179)))
    assert refine(picture, np.array([x, y]), P).region.shape == (41, 41)


def test_nominations_are_rounded_and_divided() -> None:
    H = np.array([[0.615, 0.007, 672.822], [-0.004, 0.616, 363.601], [0.0, 0.0, 1.0]])
    assert nominate(H, np.array([[126.0, 100.0]])).tolist() == [[751, 425]]  # 751.01, 424.70
    assert nominate(2 * H, np.array([[126.0, 100.0]])).tolist() == [[751, 425]]

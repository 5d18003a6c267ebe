"""The edge detector on pictures whose edges are known, its parts against direct evaluations."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import ndimage

from detector.thesis import thermal
from detector.thesis.thermal import automatic_threshold, kernels, thin_once


def edges(picture: NDArray[np.uint8], sigma: float = 12.0) -> thermal.Edges:
    return thermal.canny(picture, sigma, 30, 0.7, 64, 0.4)


@pytest.mark.parametrize("at", [60, 101, 150])
@pytest.mark.parametrize("turned", [False, True])
def test_a_straight_step_gives_one_edge_on_the_step(at: int, turned: bool) -> None:
    picture = np.full((200, 240), 200, dtype=np.uint8)
    picture[:, :at] = 30  # the step lies between columns at - 1 and at
    mask = edges(picture.T if turned else picture).mask
    mask = mask.T if turned else mask
    rows, columns = np.nonzero(mask)
    assert np.abs(columns - (at - 0.5)).max() <= 1
    # all the way down but for the ends: the outermost pixels are never ridges, and a doubled line's
    # end loses one more to the thinning
    assert set(range(3, 197)) <= set(rows.tolist())
    assert len(rows) == len(set(rows.tolist()))


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (2, 2), (3, 3), (120, 160)])
def test_flat_and_tiny_pictures_do_no_harm(shape: tuple[int, int]) -> None:
    for grey in (0, 128, 255):
        assert not edges(np.full(shape, grey, dtype=np.uint8)).mask.any()
    picture = np.arange(np.prod(shape)).astype(np.uint8).reshape(shape)
    assert edges(picture).mask.shape == shape


def test_edges_do_not_hang_on_gain_offset_or_polarity() -> None:
    squares = np.random.default_rng(2).integers(0, 2, (6, 8)).astype(np.uint8)
    picture = np.kron(squares, np.ones((40, 40), np.uint8))
    base = edges(picture * 100 + 20).mask
    # rounding in 32 bits may move a tie by a pixel: nearly all must agree
    assert np.count_nonzero(base ^ edges(picture * 200).mask) < 0.01 * np.count_nonzero(base)
    assert np.count_nonzero(base ^ edges(220 - picture * 100).mask) < 0.01 * np.count_nonzero(base)


def test_kernels_end_at_30_px_or_where_the_gaussian_dies() -> None:
    assert len(kernels(12.0, 30)[0]) == 61
    assert len(kernels(1.0, 30)[0]) == 9  # exp(-t^2 / 2) > 1e-4 up to t = 4
    gauss, slope = kernels(12.0, 30)
    assert gauss.sum() == pytest.approx(1, abs=1e-6)
    assert (slope * np.arange(-30, 31)).sum() == pytest.approx(1, abs=1e-5)


def test_threshold_is_where_seventy_in_a_hundred_lie_below() -> None:
    length = np.zeros((10, 10), dtype=np.float32)
    length.flat[71:] = 1.0
    assert automatic_threshold(length, 0.7, 64) == 1 / 64
    length.flat[70] = 1.0  # now just 70 of 100 lie in the first bin: not more than 70 %
    assert automatic_threshold(length, 0.7, 64) == 1.0
    middle = np.full((10, 10), 10 / 63, dtype=np.float32)
    assert automatic_threshold(middle, 0.7, 64) == 11 / 64


@given(st.integers(0, 2**32 - 1))
def test_hysteresis_is_reconstruction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    weak = rng.random((20, 30)) < 0.4
    strong = weak & (rng.random((20, 30)) < 0.1)
    grown = ndimage.binary_propagation(strong, np.ones((3, 3)), weak)
    assert np.array_equal(thermal.hysteresis(weak, strong), grown)


@given(st.integers(0, 2**32 - 1))
def test_thinning_keeps_every_piece_and_every_hole(seed: int) -> None:
    mask = ndimage.binary_dilation(np.random.default_rng(seed).random((25, 30)) < 0.06)
    thin = thin_once(mask)
    assert not (thin & ~mask).any()
    assert ndimage.label(thin, np.ones((3, 3)))[1] == ndimage.label(mask, np.ones((3, 3)))[1]
    assert ndimage.label(~np.pad(thin, 1))[1] == ndimage.label(~np.pad(mask, 1))[1]

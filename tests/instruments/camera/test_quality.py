"""Figures of one picture: they find what they are for in any light, and see nothing where there is
nothing.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import ndtr

from instruments.camera.quality import edge_blur_px, level_dn, missing_rows, saturated_share, spread


def edges(
    blur_px: float, *, contrast: float = 120.0, noise_dn: float = 0.5, seed: int = 1
) -> NDArray[np.uint8]:
    """Slanted dark bars behind a lens of that blur: each edge is the integral of a normal one."""
    y, x = np.mgrid[0:160, 0:160].astype(np.float64)
    across = ((x + 0.17 * y) / np.hypot(1.0, 0.17)) % 60.0
    wall = ndtr((across - 15.0) / blur_px) - ndtr((across - 45.0) / blur_px)
    noise = noise_dn * np.random.default_rng(seed).standard_normal(wall.shape)
    picture = np.rint(30.0 + contrast * wall + noise)
    return np.asarray(np.clip(picture, 0, 255), dtype=np.uint8)


@settings(max_examples=15, deadline=None)
@given(st.floats(0.6, 4.0), st.floats(40.0, 200.0))
def test_the_blur_of_an_edge_whatever_its_contrast(blur_px: float, contrast: float) -> None:
    found = edge_blur_px(edges(blur_px, contrast=contrast))
    assert found == pytest.approx(blur_px, rel=0.1, abs=0.1)


def test_noise_is_no_edge_and_neither_is_nothing() -> None:
    noise = 100.0 + 8.0 * np.random.default_rng(1).standard_normal((200, 200))
    assert edge_blur_px(np.clip(noise, 0, 255).astype(np.uint8)) is None
    assert edge_blur_px(np.full((200, 200), 90, np.uint8)) is None
    assert edge_blur_px(np.zeros((12, 12), np.uint8)) is None


def test_levels() -> None:
    picture = np.zeros((10, 100), np.uint8)
    picture[0, :4] = 200
    assert level_dn(picture, 0.995) == 0
    assert level_dn(picture, 0.999) == 200
    picture[1] = 254
    picture[2] = 255
    assert saturated_share(picture) == pytest.approx(0.2)
    assert spread(np.array([[29000] * 50 + [30500] * 50], np.uint16)) == 1500.0


def test_missing_rows_at_either_edge_and_rows_of_the_last_frame() -> None:
    rng = np.random.default_rng(2)
    whole, last = rng.integers(10, 100, (2, 100, 40), dtype=np.uint8)
    assert missing_rows(whole) == missing_rows(whole, last) == 0.0
    for rows in (slice(70, None), slice(None, 30)):
        cut, stale = whole.copy(), whole.copy()
        cut[rows] = 128
        stale[rows] = last[rows]
        assert missing_rows(cut) == missing_rows(stale, last) == 0.3
        cut[rows] = 255
        assert missing_rows(cut, last) == 0.0, "plain white is the exposure's fault"
    amid = whole.copy()
    amid[40:60] = 0
    assert missing_rows(amid) == 0.0
    assert missing_rows(np.zeros((5, 5), np.uint8)) == 1.0

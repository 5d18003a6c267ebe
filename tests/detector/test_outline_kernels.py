"""What compiles the hot loops, where nothing can be kept on disk."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numba.core.caching import CompileResultCacheImpl

from detector.outline import kernels


def half(value: float) -> float:
    return value / 2.0


def test_without_a_folder_to_write_loops_are_compiled_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(CompileResultCacheImpl, "_locator_classes", [])
    assert kernels._compiled("f8(f8)")(half)(3.0) == 1.5


@pytest.mark.parametrize("shape", [(40, 57), (41, 16), (2, 2)])
def test_gradients_are_those_of_opencv_up_to_the_rim(shape: tuple[int, int]) -> None:
    picture = np.random.default_rng(4).uniform(0.0, 255.0, shape).astype(np.float32)
    x = cv2.Sobel(picture, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    y = cv2.Sobel(picture, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    length = np.hypot(x, y)
    assert np.allclose(kernels.steepness(picture, 3), length[::3, ::3], rtol=1e-6)
    found = kernels.squeezed(picture, np.float32(12.0), 5)
    expected = np.stack([x, y], axis=2) / (length + 12.0)[..., None]
    assert np.allclose(found[5:-5, 5:-5], expected, rtol=1e-5, atol=1e-7)
    found[5:-5, 5:-5] = 0.0
    assert not found.any()

"""What compiles the hot loops, where nothing can be kept on disk; and that Ctrl-C ends none of them
badly.
"""

from __future__ import annotations

import errno
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numba
import numpy as np
import pytest
from numba.core.caching import CompileResultCacheImpl, IndexDataCacheFile
from numba.core.dispatcher import Dispatcher

import instruments.world.kernels
from detector.outline import kernels


def half(value: float) -> float:
    return value / 2.0


@pytest.mark.parametrize("module", [kernels, instruments.world.kernels])
def test_without_a_folder_to_write_loops_are_compiled_all_the_same(
    monkeypatch: pytest.MonkeyPatch, module: Any
) -> None:
    monkeypatch.setattr(CompileResultCacheImpl, "_locator_classes", [])
    assert module._compiled("f8(f8)")(half)(3.0) == 1.5


@pytest.mark.parametrize("module", [kernels, instruments.world.kernels])
@pytest.mark.parametrize("ending", ["nbi", "nbc"])
@pytest.mark.slow
def test_what_is_kept_may_be_damaged_and_is_then_kept_anew(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, module: Any, ending: str
) -> None:
    """As a power cut leaves it: the file is there, and empty."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    module._compiled("f8(f8)")(half)
    [kept] = tmp_path.rglob(f"*.{ending}")
    kept.write_bytes(b"")
    assert module._compiled("f8(f8)")(half)(3.0) == 1.5
    again = module._compiled("f8(f8)")(half)
    assert again(3.0) == 1.5
    assert sum(again.stats.cache_hits.values()) == 1


@pytest.mark.slow
@pytest.mark.parametrize("module", [kernels, instruments.world.kernels])
def test_on_a_full_disk_loops_are_compiled_all_the_same(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, module: Any
) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(IndexDataCacheFile, "_save_data", full)
    assert module._compiled("f8(f8)")(half)(3.0) == 1.5


@pytest.mark.parametrize("shape", [(40, 57), (41, 16), (2, 2)])
def test_gradients_are_those_of_opencv_up_to_the_rim(shape: tuple[int, int]) -> None:
    picture = np.random.default_rng(4).uniform(0.0, 255.0, shape).astype(np.float32)
    x = cv2.Sobel(picture, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    y = cv2.Sobel(picture, cv2.CV_32F, 0, 1, ksize=3, scale=0.125)
    length = np.hypot(x, y)
    steep = np.empty_like(picture[::3, ::3])
    kernels.steepness(picture, 3, steep)
    assert np.allclose(steep, length[::3, ::3], rtol=1e-6)
    found = np.zeros((shape[0] + 10, shape[1] + 10, 2), dtype=np.float32)
    kernels.squeezed(picture, np.float32(12.0), 5, found)
    expected = np.stack([x, y], axis=2) / (length + 12.0)[..., None]
    assert np.allclose(found[5:-5, 5:-5], expected, rtol=1e-5, atol=1e-7)
    found[5:-5, 5:-5] = 0.0
    assert not found.any()


@pytest.mark.parametrize("module", [kernels, instruments.world.kernels])
def test_no_loop_hands_back_an_array(module: ModuleType) -> None:
    """A Ctrl-C that comes amid a loop is raised there, in code of numba that does not expect it."""
    back = [
        str(made.return_type)
        for name, loop in vars(module).items()
        if isinstance(loop, Dispatcher) and not name.startswith("_")  # which loops alone call
        for made in loop.nopython_signatures
    ]
    assert len(back) >= 8
    assert set(back) <= {"none", "bool", "int64", "float64"}

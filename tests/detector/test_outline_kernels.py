"""What compiles the hot loops, where nothing can be kept on disk."""

from __future__ import annotations

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

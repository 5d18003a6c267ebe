"""The compiled loops (extra `fast`) beside numpy's, which say what is right."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import ParamSpec, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import Calibration, load_calibration
from detector.fused import fast
from detector.fused.detector import FusedDetector
from detector.fused.edges import Profile, find_edges
from detector.fused.model import COUNT, RADIUS, outlines
from detector.fused.refine import FINE_OUTLINE, OPTICAL_FINE, OPTICAL_ROUGH, THERMAL
from detector.geometry import Motion
from detector.protocol import Detection
from tests.detector.conftest import recorded
from tests.detector.fused.conftest import Body, Draw

SAME_MM = 1e-6  # promised are 0.01
Value = TypeVar("Value")
Given = ParamSpec("Given")


class Both:
    """Calls a function with numpy's loops and with the compiled ones."""

    def __init__(self, loops: ModuleType, patch: pytest.MonkeyPatch) -> None:
        self._loops, self._patch = loops, patch

    def __call__(
        self, function: Callable[Given, Value], *args: Given.args, **kwargs: Given.kwargs
    ) -> tuple[Value, Value]:
        self._patch.setattr(fast, "compiled", lambda: None)
        slow = function(*args, **kwargs)
        self._patch.setattr(fast, "compiled", lambda: self._loops)
        return slow, function(*args, **kwargs)


@pytest.fixture(scope="module")
def loops() -> Iterator[ModuleType]:
    """The compiled loops; some ten seconds where they aren't on disk yet."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(fast.VARIABLE, raising=False)
        fast.chosen.cache_clear()
        chosen = fast.chosen()
    fast.chosen.cache_clear()
    if chosen.loops is None and "isn't installed" in chosen.why:
        if "TEATBENCH_NEED_PEERS" in os.environ:
            pytest.fail(chosen.why)
        pytest.skip(f"the kernels are not compared with numpy: {chosen.why}")
    assert chosen.loops is not None, chosen.why
    return chosen.loops


@pytest.fixture
def both(loops: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Both:
    return Both(loops, monkeypatch)


def drawn_teats(count: int) -> NDArray[np.float64]:
    rng = np.random.default_rng(count)
    low = [-150.0, -150.0, 850.0, -0.4, -0.4, 7.0, -0.2, 0.5]
    high = [150.0, 150.0, 1900.0, 0.4, 0.4, 16.0, 0.2, 1.8]
    return rng.uniform(low, high, (count, COUNT))


@pytest.mark.slow
def test_outlines_and_their_slopes_are_equal(both: Both, rig: Calibration) -> None:
    teats = drawn_teats(40)
    teats[3, 2] = -500.0  # behind the cameras
    teats[4, :3], teats[4, RADIUS] = (0.0, 0.0, 5.0), 20.0  # a camera is inside
    assert rig.thermal.lens is not None
    assert rig.thermal_from_right is not None
    cameras = [
        (rig.left, rig.right_from_left.inverse()),
        (rig.right, Motion.identity()),
        (rig.thermal.lens, rig.thermal_from_right),
    ]
    for slopes_too in (True, False):
        slow, quick = both(outlines, teats, cameras, FINE_OUTLINE, slopes_too=slopes_too)
        for one, other in zip(slow, quick, strict=True):
            np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9)
    assert np.isnan(slow[0][:, 3:5]).any()
    assert np.isfinite(slow[0][:, 5:]).all()


@pytest.mark.parametrize("profile", [OPTICAL_FINE, OPTICAL_ROUGH, THERMAL])
@pytest.mark.parametrize(("contrast", "noise"), [(60.0, 2.0), (8.0, 3.0), (3e4, 90.0), (5.0, 0.05)])
def test_edges_are_equal_to_the_last_bit(
    both: Both, profile: Profile, contrast: float, noise: float
) -> None:
    rng = np.random.default_rng(round(contrast))
    places = rng.uniform(-3.0, 3.0, (6, 50, 1))
    lines = contrast * (rng.random((6, 50, 1)) + np.tanh(profile.offsets - places))
    lines += rng.normal(0.0, noise, lines.shape)
    lines[1, 5:9], lines[2] = np.nan, 40.0  # beyond the picture; without any edge
    slow, quick = both(find_edges, lines.astype(np.float32), profile, noise)
    for name in ("offset_px", "sd_px", "clarity", "limb_px", "limb_sd_px"):
        assert np.array_equal(getattr(slow, name), getattr(quick, name), equal_nan=True), name
    assert np.isfinite(slow.offset_px).any()


def same(slow: Detection, quick: Detection) -> None:
    """The same teats, places and covariances; every number of the trace too."""
    assert (len(slow.teats), slow.hidden, slow.reason) == (
        len(quick.teats),
        quick.hidden,
        quick.reason,
    )
    for one, other in zip(slow.teats, quick.teats, strict=True):
        assert np.abs(one.world_mm - other.world_mm).max() < SAME_MM
        assert one.covariance_mm2 is not None
        assert other.covariance_mm2 is not None
        np.testing.assert_allclose(one.covariance_mm2, other.covariance_mm2, rtol=1e-6, atol=1e-9)
    for stage, again in zip(slow.trace, quick.trace, strict=True):
        for name, values in stage.data.items():
            other_values = again.data[name]
            if name == "sd_mm":  # as 1/mm: that of an end which isn't seen at all is only rounding
                values, other_values = 1 / values, 1 / other_values
            if values.dtype.kind == "f":
                np.testing.assert_allclose(other_values, values, rtol=1e-5, atol=1e-5)
            else:
                assert np.array_equal(values, other_values)


@pytest.mark.slow
def test_answers_on_drawn_teats_are_equal(
    both: Both, draw_scene: Draw, udder: list[Body], rig: Calibration
) -> None:
    overlapping = [udder[0], Body((-248.0, 320.0, 128.0)), Body((-230.0, 240.0, 140.0))]
    for bodies in (udder, overlapping, []):
        frames = draw_scene(bodies)
        slow, quick = both(FusedDetector().detect, frames, rig)
        same(slow, quick)
        assert bool(slow.teats) == bool(bodies)


@pytest.mark.slow
def test_answers_on_path_traced_frames_are_equal(both: Both, path_traced: Path) -> None:
    calibration = load_calibration(path_traced / "calibration.toml")
    frames = sorted((path_traced / "frames").iterdir())[::6]
    assert len(frames) >= 5
    for folder in frames:
        slow, quick = both(FusedDetector().detect, recorded(folder), calibration)
        same(slow, quick)


@pytest.mark.parametrize(
    ("numba", "said"),
    [
        ("raise ImportError('Numba needs NumPy 2.5 or less')", "needs NumPy 2.5 or less"),
        ("def njit(*a, **k): raise RuntimeError('no locator')\n__version__ = '9'", "no locator"),
    ],
)
def test_a_numba_that_cannot_be_used_is_told_and_does_no_harm(
    tmp_path: Path, numba: str, said: str
) -> None:
    (tmp_path / "numba.py").write_text(numba, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    environment.pop(fast.VARIABLE, None)
    done = subprocess.run(
        [sys.executable, "-c", "from bench.cli.main import main; main(['--version'])"],
        env=environment, capture_output=True, text=True, encoding="utf-8", check=True,
    )  # fmt: skip
    assert "fused is computed by numpy (numba can't be used here: " in done.stdout
    assert said in done.stdout

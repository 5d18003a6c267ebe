"""The compiled loops (extra `fast`) beside numpy's, which say what is right."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType
from typing import ParamSpec, TypeVar

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import Calibration, load_calibration
from detector.fused.detector import FusedDetector
from detector.fused.parameters import Parameters
from detector.geometry import Motion
from detector.outline import fast
from detector.outline.edges import Edges, Profile, find_edges, find_edges_into, lit_alike
from detector.outline.fine import FINE_OUTLINE, ROUGH_OUTLINE, _trusted
from detector.outline.fit import Seen, View, look, step
from detector.outline.model import COUNT, RADIUS
from detector.outline.views import OPTICAL_FINE, OPTICAL_ROUGH, THERMAL
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


@pytest.fixture(scope="module")
def views(rig: Calibration) -> tuple[View, ...]:
    """All cameras before pictures of smooth noise."""
    rng, made = np.random.default_rng(0), list[View]()
    assert rig.thermal.lens is not None
    assert rig.thermal_from_right is not None
    for camera, motion, profiles in (
        (rig.left, rig.right_from_left.inverse(), (OPTICAL_ROUGH, OPTICAL_FINE)),
        (rig.right, Motion.identity(), (OPTICAL_ROUGH, OPTICAL_FINE)),
        (rig.thermal.lens, rig.thermal_from_right, (THERMAL, THERMAL)),
    ):
        columns, rows = camera.image_size
        noise = rng.normal(0.0, 900.0, (rows, columns)).astype(np.float32)
        smooth = np.asarray(cv2.GaussianBlur(noise, (0, 0), 6), dtype=np.float32)
        made.append(View(smooth, np.array([3.0, 5.0]), 2.0, camera, motion, *profiles, 0.05))
    return tuple(made)


def nearly_the_same(slow: Seen, quick: Seen) -> None:
    for name in ("pixels_px", "normals", "jacobian", "floor_px"):
        one, other = getattr(slow, name), getattr(quick, name)
        np.testing.assert_allclose(other, one, rtol=1e-8, atol=1e-8, err_msg=name)
    for name in ("offset_px", "sd_px", "clarity", "limb_px", "unlike_px"):
        # samples are rounded to 1/32 px: a last bit may send one to the next
        one, other = getattr(slow, name), getattr(quick, name)
        alike = np.isclose(one, other, rtol=1e-6, atol=1e-6, equal_nan=True)
        assert alike.mean() > 0.995, name


@pytest.mark.slow
@pytest.mark.parametrize("fine", [True, False])
def test_looks_are_equal(both: Both, views: tuple[View, ...], fine: bool) -> None:
    outline = FINE_OUTLINE if fine else ROUGH_OUTLINE
    teats = drawn_teats(40)
    teats[3, 2] = -500.0  # behind the cameras
    teats[4, :3], teats[4, RADIUS] = (0.0, 0.0, 5.0), 20.0  # a camera is inside
    slow, quick = both(look, teats, views, outline, fine=fine)
    nearly_the_same(slow, quick)
    assert np.isnan(slow.pixels_px[3:5]).any()
    assert np.isfinite(slow.pixels_px[5:]).all()
    assert np.isfinite(slow.offset_px).mean() > 0.5
    which, k = np.array([2, 4, 7]), 2 * len(outline.part)
    moved = teats + 0.5
    slow, quick = both(look, moved, views[:2], outline, fine=fine, known=quick, which=which)
    nearly_the_same(slow, quick)
    assert not np.array_equal(
        quick.pixels_px[2, :k], look(teats, views, outline, fine=fine).pixels_px[2, :k]
    )
    assert not look(teats, views, outline, fine=fine, slopes_too=False).jacobian.any()


def test_a_look_again_changes_nothing_else(both: Both, views: tuple[View, ...]) -> None:
    teats, which = drawn_teats(6), np.array([1, 4])
    k = 2 * len(FINE_OUTLINE.part)
    first, _ = both(look, teats, views, FINE_OUTLINE, fine=True)
    before = first.copied()
    for again in both(
        look, teats + 0.5, views[:2], FINE_OUTLINE, fine=True, known=first, which=which
    ):
        for name in Seen.__slots__:
            old, new = getattr(first, name), getattr(again, name)
            assert np.array_equal(old, getattr(before, name), equal_nan=True)
            assert np.array_equal(old[[0, 2, 3, 5]], new[[0, 2, 3, 5]], equal_nan=True)
            assert np.array_equal(old[:, k:], new[:, k:], equal_nan=True)
        assert not np.array_equal(first.pixels_px[which, :k], again.pixels_px[which, :k])


@pytest.mark.parametrize("profile", [OPTICAL_FINE, OPTICAL_ROUGH, THERMAL])
@pytest.mark.parametrize(("contrast", "noise"), [(60.0, 2.0), (8.0, 3.0), (3e4, 90.0), (5.0, 0.05)])
def test_edges_and_their_correction_by_light_are_equal(
    loops: ModuleType, profile: Profile, contrast: float, noise: float
) -> None:
    rng = np.random.default_rng(round(contrast))
    places = rng.uniform(-3.0, 3.0, (2, 3, 50, 1))
    lines = contrast * (rng.random((2, 3, 50, 1)) + np.tanh(profile.offsets - places))
    lines += rng.normal(0.0, noise, lines.shape)
    lines[0, 1, 5:9], lines[1, 2] = np.nan, 40.0  # beyond the picture; without any edge
    given = lines.astype(np.float32)
    edges = find_edges(given.reshape(6, 50, -1), profile, noise)
    edges = Edges(*(getattr(edges, f.name).reshape(2, 3, 50) for f in fields(edges)))
    by_light = lit_alike(edges)
    found = [
        np.full((5, 110), 7.0) for _ in fields(by_light)
    ]  # of which rows and columns are filled
    which = np.array([0, 3, 4])
    find_edges_into(loops, given, profile, np.full(2, noise), which, 4, tuple(found))
    for f, filled in zip(fields(by_light), found, strict=True):
        one = getattr(by_light, f.name).swapaxes(0, 1).reshape(3, -1)
        if f.name == "clarity" or (f.name == "offset_px" and not profile.limb):
            assert np.array_equal(one, filled[which, 4:104], equal_nan=True), f.name
        np.testing.assert_allclose(filled[which, 4:104], one, rtol=1e-12, atol=1e-12)
        assert (filled[[1, 2]] == 7.0).all()
        assert (filled[:, :4] == 7.0).all()
    assert np.isfinite(found[0][which, 4:104]).any()


def test_steps_and_trust_are_equal(both: Both, views: tuple[View, ...]) -> None:
    teats, p = drawn_teats(20), Parameters()
    seen, _ = both(look, teats, views, FINE_OUTLINE, fine=True)
    close = 0.3 * np.nan_to_num(seen.offset_px)  # so that sides are seen, and some aren't
    seen = replace(seen, offset_px=close)
    hidden = np.zeros(close.shape, dtype=bool)
    hidden[:9, 10:60], hidden[5:, 90:110] = True, True
    slow, quick = both(_trusted, seen, hidden, 1)
    np.testing.assert_allclose(quick, slow, rtol=1e-12)
    untrusted, _ = both(_trusted, seen, hidden, 0)
    assert 0 < (slow > 0).sum() < (untrusted > 0).sum()
    for weight in (slow, untrusted):
        one, other = both(step, teats, seen, weight, p.prior)
        np.testing.assert_allclose(other, one, rtol=1e-9, atol=1e-9)
        assert np.abs(one - teats).max() > 0.1


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

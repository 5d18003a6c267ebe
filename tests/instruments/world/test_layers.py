"""Layers against a brute-force account of every pixel; what is kept is what is drawn anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.world.compositing import Layer, lay_over, merged
from instruments.world.objects import make_object
from instruments.world.optical_camera import KEPT_PIXELS, KeptLayers
from instruments.world.optics import Floats
from instruments.world.phantom import Phantom, PlatePose, Teat
from instruments.world.scene import Renderer
from instruments.world.state import SceneState
from tests.instruments.world.scenes import PLAIN, renderer

SHAPE = (6, 7)


def some_layer(rng: np.random.Generator, near: float, far: float) -> Layer:
    pixel = rng.choice(42, size=rng.integers(0, 30), replace=False)
    share = rng.random(len(pixel))
    depth = rng.uniform(near, far, len(pixel))
    value = rng.random(len(pixel))
    return Layer(pixel // 7, pixel % 7, share, depth, value)


def one_by_one(layers: list[Layer], background: Floats) -> Floats:
    """Every pixel's surfaces sorted by depth, each laid over what is behind it."""
    image = background.copy()
    for row in range(SHAPE[0]):
        for column in range(SHAPE[1]):
            met = []
            for layer in layers:
                at = np.flatnonzero((layer.row == row) & (layer.column == column))
                met += [(layer.depth_mm[i], layer.share[i], layer.value[i]) for i in at]
            for _, share, value in sorted(met, reverse=True):
                image[row, column] += share * (value - image[row, column])
    return image


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 6), mixed=st.booleans())
def test_any_layers_in_any_order_of_depth(seed: int, count: int, mixed: bool) -> None:
    rng = np.random.default_rng(seed)
    spans = (
        [(1000.0, 1100.0)] * count
        if mixed
        else [(1000.0 + 50.0 * i, 1049.0 + 50.0 * i) for i in range(count)]
    )
    layers = [some_layer(rng, *span) for span in rng.permutation(spans)] if count else []
    background = rng.random(SHAPE)
    image = background.copy()
    lay_over(image, layers, [layer.value for layer in layers])
    assert image == pytest.approx(one_by_one(layers, background), abs=1e-9)


@given(seed=st.integers(0, 2**32 - 1))
def test_pieces_of_one_object_cover_the_larger_share(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixel = rng.integers(0, 42, 60)
    share, depth, value = rng.random(60), rng.uniform(1000.0, 1010.0, 60), rng.random(60)
    layer = merged(pixel // 7, pixel % 7, share, depth, value)
    seen = layer.row * 7 + layer.column
    assert len(np.unique(seen)) == len(seen) == len(np.unique(pixel))
    for at, covered, nearest, mean in zip(
        seen, layer.share, layer.depth_mm, layer.value, strict=True
    ):
        here = pixel == at
        assert covered == pytest.approx(share[here].max())
        assert nearest == depth[here].min()
        assert value[here].min() - 1e-9 <= mean <= value[here].max() + 1e-9


def test_kept_layers_make_each_once_and_forget_the_oldest() -> None:
    kept, made = KeptLayers(), []

    def make(which: list[int]) -> list[Layer]:
        made.extend(which)
        size = KEPT_PIXELS // 3
        return [
            Layer(np.zeros(size, dtype=np.intp), np.zeros(size, dtype=np.intp), *np.ones((3, size)))
            for _ in which
        ]

    kept.of(["a", "b"], make)
    kept.of(["b", "a"], make)
    assert made == [0, 1]
    kept.of(["c", "d"], make)  # too much for all: b, asked for the longest ago, goes
    kept.of(["a", "c", "d"], make)
    assert made == [0, 1, 0, 1]
    kept.of(["b"], make)
    assert made == [0, 1, 0, 1, 0]


def scene(pose: PlatePose, **more: object) -> SceneState:
    phantom = Phantom((Teat((-110.0, 284.0)), Teat((-160.0, 192.0)), Teat((-225.0, 199.0))), pose)
    return SceneState(
        phantom,
        (32.0, 32.5, 33.0),
        33.0,
        20.0,
        (make_object("warm_arm"), make_object("hot_cup")),
        backdrop=PLAIN,
        **more,  # type: ignore[arg-type]
    )


@pytest.mark.slow
def test_a_kept_arm_looks_as_one_drawn_anew() -> None:
    kept = Renderer(renderer().cameras, camera_seed=7)
    for x in (0.0, 3.0, 7.5):
        kept.render(scene(PlatePose(x)), np.random.default_rng(1))
    last = scene(PlatePose(11.0))
    one = kept.render(last, np.random.default_rng(2))
    two = Renderer(renderer().cameras, camera_seed=7).render(last, np.random.default_rng(2))
    for name in ("left", "right", "thermal_8bit", "thermal_ck"):
        assert np.array_equal(getattr(one, name), getattr(two, name))


@pytest.mark.slow
def test_temperatures_light_and_paint_are_no_part_of_what_is_kept() -> None:
    eyes, first = Renderer(renderer().cameras, camera_seed=7), scene(PlatePose())
    before = eyes.left.expected(first), eyes.thermal.expected_k(first)
    warmer = replace(first, teat_temps_c=(34.0, 34.0, 34.0))
    assert np.array_equal(eyes.left.expected(warmer), before[0])
    assert eyes.thermal.expected_k(warmer).max() > before[1].max() + 0.5
    darker = replace(first, lighting=replace(first.lighting, brightness=0.5))
    painted = replace(first, teat_paint=replace(first.teat_paint, albedo=0.6))
    for changed in (darker, painted):
        assert not np.array_equal(eyes.left.expected(changed), before[0])
    assert np.array_equal(eyes.left.expected(first), before[0])

"""Layers against a brute-force account of every pixel; what is kept is what is drawn anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.world import optical_camera
from instruments.world.compositing import Layer, lay_over, merged
from instruments.world.objects import make_object
from instruments.world.optical_camera import KEPT_PIXELS, KeptLayers
from instruments.world.optics import Floats
from instruments.world.phantom import Phantom, PlatePose, Teat
from instruments.world.state import SceneState
from tests.instruments.world.scenes import NOBODY, PLAIN, small
from tests.situations import SITUATIONS, situation

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
    lay_over(image, layers)
    assert image == pytest.approx(one_by_one(layers, background), abs=1e-9)


@given(seed=st.integers(0, 2**32 - 1))
def test_pieces_of_one_object_cover_the_larger_share(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pixel = rng.integers(0, 42, 60)
    share, depth, value = rng.random(60), rng.uniform(1000.0, 1010.0, 60), rng.random(60)
    layer = merged(Layer(pixel // 7, pixel % 7, share, depth, value))
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
    kept, made, size = KeptLayers(), list[str](), KEPT_PIXELS // 3
    nowhere = np.zeros(size, dtype=np.intp)

    def make(which: list[str]) -> list[Layer]:
        made.extend(which)
        return [Layer(nowhere, nowhere, *np.ones((3, size))) for _ in which]

    for asked, in_all in (
        ("ab", "ab"),
        ("ba", "ab"),
        ("cd", "abcd"),  # too much for all: b, asked for the longest ago, goes
        ("acd", "abcd"),
        ("b", "abcdb"),
        ("abcd", "abcdba"),
        ("dcba", "abcdba"),  # the last asked for stay, however large
    ):
        kept.of(asked, str.upper, make)
        assert "".join(made) == in_all


PHANTOM = Phantom((Teat((-110.0, 284.0)), Teat((-160.0, 192.0)), Teat((-225.0, 199.0))))
SCENE = SceneState(
    PHANTOM, (32.0, 32.5, 33.0), 33.0, 20.0,
    (make_object("warm_arm"), make_object("hot_cup")), backdrop=PLAIN,
)  # fmt: skip


def at(x_mm: float) -> SceneState:
    return replace(SCENE, phantom=PHANTOM.moved(PlatePose(x_mm)))


@pytest.mark.slow
def test_what_was_drawn_before_leaves_no_trace() -> None:
    kept, last = small(), at(11.0)
    for before in (*map(at, (0.0, 3.0, 7.5)), *map(situation, SITUATIONS)):
        kept.render(before, np.random.default_rng(1))
    same = [eyes.render(last, np.random.default_rng(2)) for eyes in (kept, small())]
    other = [eyes.render(last, np.random.default_rng(s)) for eyes, s in ((kept, 3), (small(8), 2))]
    for name in ("left", "right", "thermal_8bit", "thermal_ck"):
        one, two, *others = (getattr(frames, name) for frames in (*same, *other))
        assert np.array_equal(one, two)
        assert not any(np.array_equal(one, another) for another in others)


@pytest.mark.slow
def test_temperatures_are_no_part_of_what_is_kept_but_light_and_paint_are() -> None:
    eyes, first = small(), SCENE
    before = eyes.left.expected(first), eyes.thermal.expected_k(first)
    warmer = replace(first, teat_temps_c=(34.0, 34.0, 34.0))
    assert np.array_equal(eyes.left.expected(warmer), before[0])
    assert eyes.thermal.expected_k(warmer).max() > before[1].max() + 0.5
    darker = replace(first, lighting=replace(first.lighting, brightness=0.5))
    painted = replace(first, teat_paint=replace(first.teat_paint, albedo=0.6))
    for changed in (darker, painted):
        assert not np.array_equal(eyes.left.expected(changed), before[0])
    assert np.array_equal(eyes.left.expected(first), before[0])


@pytest.mark.parametrize("velocity_mm_s", [(0.0, 0.0, 0.0), (40.0, 0.0, 0.0)])
def test_a_part_is_drawn_as_the_whole_picture_is(
    monkeypatch: pytest.MonkeyPatch, velocity_mm_s: tuple[float, float, float]
) -> None:
    state = replace(at(3.0), velocity_mm_s=velocity_mm_s)
    shadows = small().shadows(state)
    parts = [small().left.expected(state, shadows)]
    whole = parts[0].shape
    monkeypatch.setattr(optical_camera, "_joined", lambda _: tuple(slice(0, n) for n in whole))
    parts.append(small().left.expected(state, shadows))
    assert np.abs(parts[0] - parts[1]).max() < 1e-4  # of a grey level: equal but for rounding
    empty = small().left.expected(replace(NOBODY, lighting=state.lighting))
    assert (parts[0] == empty).mean() > 0.2  # where nothing stands, all is the empty scene's

"""Scenes of the free range of `bench.testing`, by a number instead of by hypothesis: no two alike."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from bench.testing.scene import PAINTS, PLACES_MM, Object, Pose, Scene, Teat
from bench.testing.strategies import SHARES, nearest
from instruments.world.objects import KINDS

T = TypeVar("T", Teat, Pose, Object, Scene)
DIFFERING = 0.6  # the share of numbers that differ from the plain ones
MOST_OBJECTS = 3


def free_scene(k: int) -> Scene:
    """The k-th: up to four teats, and up to three things beside them or before them."""
    rng = np.random.default_rng([77, k])
    found = Scene((Teat(),) * int(rng.integers(1, len(PLACES_MM) + 1)))
    for i in range(len(found.teats)):
        tried = (_with_teat(found, i, near) for near in _nearer(_drawn(Teat(), rng)))
        found = next((one for one in tried if not one.faults()), found)
    found = nearest(found, _drawn(Pose(), rng), lambda near, scene: replace(scene, pose=near))
    found = replace(_drawn(found, rng), paint=_one_of(PAINTS, rng))
    for _ in range(rng.integers(MOST_OBJECTS + 1)):
        thing = _drawn(Object(_one_of(KINDS, rng)), rng)
        found = nearest(found, thing, lambda near, at: replace(at, objects=(*at.objects, near)))
    return found


def _nearer(teat: Teat) -> Iterator[Teat]:
    """As it is, then first nearer to its place, since most stand before another; then plainer."""
    for share in SHARES:
        near = teat.nearer(share)
        yield replace(teat, right_mm=near.right_mm, away_mm=near.away_mm)
    yield from map(teat.nearer, SHARES)


def _with_teat(scene: Scene, i: int, teat: Teat) -> Scene:
    return replace(scene, teats=(*scene.teats[:i], teat, *scene.teats[i + 1 :]))


def _one_of(names: Iterable[str], rng: np.random.Generator) -> Any:
    among = list(names)
    return among[int(rng.integers(len(among)))]


def _drawn(plain: T, rng: np.random.Generator) -> T:
    """``plain`` with numbers of its range."""
    numbers: dict[str, Any] = {
        name: steps.value(int(rng.integers(steps.least, steps.most + 1)))
        for name, steps in plain.STEPS.items()
        if rng.random() < DIFFERING
    }
    return replace(plain, **numbers)

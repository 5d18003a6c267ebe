"""Scenes for hypothesis. Each shrinks towards the plainest one (`bench.testing.scene`).

``published`` keeps to what the thesis's own scenes have (section 5.2): four teats, a steady light,
at most one of its objects, pictures as the cameras take them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy

from bench.campaign.perturbations import Applied
from bench.testing.scene import (
    AMOUNTS,
    PAINTS,
    PLACES_MM,
    PUBLISHED_KINDS,
    Object,
    Pose,
    Scene,
    Steps,
    Teat,
)
from instruments.world.objects import KINDS

T = TypeVar("T", Teat, Pose, Object, Scene)


def layouts(
    least: int = 1, most: int = len(PLACES_MM), *, published: bool = False
) -> SearchStrategy[tuple[Teat, ...]]:
    """Teats of a `Scene`, each at a place of its own; one that can't stand so is plain."""
    least = most if published else least
    teat = _numbers(Teat(), Teat.STEPS, published=published)
    teats: SearchStrategy[list[Teat]] = st.lists(teat, min_size=least, max_size=most)
    return teats.map(_standing)


def poses() -> SearchStrategy[Pose]:
    """Places and turns of the phantom's plate."""
    return _numbers(Pose(), Pose.STEPS)


def objects(*kinds: str, published: bool = False) -> SearchStrategy[Object]:
    """A thing of one of these kinds, of any without one."""
    known = kinds or (PUBLISHED_KINDS if published else tuple(KINDS))
    return st.sampled_from(known).flatmap(
        lambda kind: _numbers(Object(kind), Object.STEPS, published=published)
    )


def perturbations(*names: str) -> SearchStrategy[Applied]:
    """What is done to pictures or calibration: one of these names, of any without one."""
    return st.sampled_from(names or tuple(AMOUNTS)).flatmap(_amounts)


@st.composite
def scenes(
    draw: DrawFn,
    *,
    published: bool = False,
    layouts: SearchStrategy[tuple[Teat, ...]] | None = None,
    poses: SearchStrategy[Pose] | None = None,
    objects: SearchStrategy[Object] | None = None,
    perturbations: SearchStrategy[Applied] | None = None,
    most_objects: int = 3,
    most_perturbations: int = 1,
) -> Scene:
    """A scene that can be set up; its parts by strategies of their own where these are given. An
    object that can't stand there, or a pose out of reach, is left out.
    """
    found = Scene(draw(_layouts(published=published) if layouts is None else layouts))
    if published:
        most_objects, most_perturbations = min(most_objects, 1), 0
    else:
        moved = replace(found, pose=draw(_poses() if poses is None else poses))
        found = found if moved.faults() else moved
    found = replace(found, paint=draw(st.sampled_from(tuple(PAINTS))))
    found = draw(_numbers(found, Scene.STEPS, published=published))
    if objects is None:
        objects = _objects(published=published)
    for one in draw(st.lists(objects, max_size=most_objects)):
        more = replace(found, objects=(*found.objects, one))
        found = found if more.faults() else more
    if perturbations is None:
        perturbations = _perturbations()
    once = st.lists(perturbations, max_size=most_perturbations, unique_by=lambda one: one.name)
    return replace(found, perturbations=tuple(draw(once)))


_layouts, _poses, _objects, _perturbations = layouts, poses, objects, perturbations


def _standing(teats: Sequence[Teat]) -> tuple[Teat, ...]:
    found: tuple[Teat, ...] = tuple(teats)
    if not Scene(found).faults():
        return found
    found = (Teat(),) * len(teats)
    for i, one in enumerate(teats):
        tried = (*found[:i], one, *found[i + 1 :])
        found = found if Scene(tried).faults() else tried
    return found


def _numbers(plain: T, steps: Mapping[str, Steps], *, published: bool = False) -> SearchStrategy[T]:
    """``plain`` with numbers that hypothesis shrinks to 0."""
    ranges = {
        name: one.published if published else (one.least, one.most) for name, one in steps.items()
    }
    numbers = {
        name: st.integers(*ends).map(steps[name].value)
        for name, ends in ranges.items()
        if ends != (0, 0)
    }
    given: SearchStrategy[dict[str, Any]] = st.fixed_dictionaries(numbers)
    return given.map(lambda found: replace(plain, **found))


def _amounts(name: str) -> SearchStrategy[Applied]:
    plain, steps = AMOUNTS[name]
    counts = st.integers(steps.least, steps.most).filter(bool)
    return counts.map(lambda count: Applied(name, round(plain + count * steps.size, 6)))

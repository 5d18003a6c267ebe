"""Scenes for hypothesis. Each shrinks towards the plainest one (`bench.testing.scene`).

``published`` keeps to what the thesis's own scenes have (section 5.2): four teats, a steady light,
at most one of its objects, pictures as the cameras take them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, lru_cache, partial
from typing import Any, TypeVar

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy

from bench.campaign.perturbations import Applied
from bench.config import ConfigError, check_within, did_you_mean
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
    stand,
)
from instruments.world.objects import KINDS
from textfiles.bounds import FROM_0

if not hasattr(settings, "get_current_profile_name"):  # what the plug-in asks for
    raise ImportError(
        "bench.testing needs hypothesis 6.139 or newer: pip install --upgrade 'teatbench[testing]'"
    )

T = TypeVar("T", Teat, Pose, Object, Scene)
P = TypeVar("P", Teat, Pose, Object)
S = TypeVar("S", Object, Applied)
SHARES = (1.0, 0.5, 0.25, 0.0)  # of what can't stand as it is drawn
# of four teats that are drawn at once, one stands before another in 19 of 20
SIDEWAYS = 4  # mm, a try
LEFT_TO_RIGHT = sorted(range(len(PLACES_MM)), key=PLACES_MM.__getitem__)


def layouts(
    least: int = 1, most: int = len(PLACES_MM), *, published: bool = False
) -> SearchStrategy[tuple[Teat, ...]]:
    """1 to 4 teats of a `Scene`, each beside its place; one that can't stand so moves sideways."""
    if not 1 <= least <= most <= len(PLACES_MM):
        raise ConfigError.plain(f"`least`, `most`: {least}, {most} is no span from 1 to 4")
    least = most if published else least
    teat = _numbers(Teat(), published=published)
    teats: SearchStrategy[list[Teat]] = st.lists(teat, min_size=least, max_size=most)
    return teats.map(partial(_standing, published=published))


def poses() -> SearchStrategy[Pose]:
    """Places and turns of the phantom's plate."""
    return _numbers(Pose())


def objects(*kinds: str, published: bool = False) -> SearchStrategy[Object]:
    """A thing of one of these kinds, of any without one."""
    _there("kinds", kinds, KINDS)
    known = kinds or (PUBLISHED_KINDS if published else tuple(KINDS))
    return st.sampled_from(known).flatmap(lambda kind: _object(kind, published))


@cache
def _object(kind: str, published: bool) -> SearchStrategy[Object]:
    return _numbers(Object(kind), published=published)


def perturbations(*names: str) -> SearchStrategy[Applied]:
    """What is done to pictures or calibration: one of these names, of any without one."""
    _there("names", names, AMOUNTS)
    return st.sampled_from(names or tuple(AMOUNTS)).flatmap(_amounts)


def _there(argument: str, given: Sequence[str], known: Mapping[str, object]) -> None:
    for one in given:
        if one not in known:
            near, there = did_you_mean(one, known), ", ".join(known)
            raise ConfigError.plain(f"`{argument}`: there is no {one!r}{near} (there are: {there})")


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
    """A scene that can be set up; its parts by strategies of their own where these are given. What
    can't stand, or is out of reach, comes nearer to its plain place, or is left out.
    """
    check_within(FROM_0, most_objects=most_objects, most_perturbations=most_perturbations)
    of_layouts, of_poses, of_objects, of_perturbations = _usual(published)
    found = Scene(draw(of_layouts if layouts is None else layouts))
    if published:
        most_objects, most_perturbations = min(most_objects, 1), 0
    else:
        pose = draw(of_poses if poses is None else poses)
        found = nearest(found, pose, lambda near, scene: replace(scene, pose=near))
    found = replace(found, paint=draw(_PAINTS), **draw(_steps(_OF_A_SCENE, published)))
    for one in draw(_several(of_objects if objects is None else objects, most_objects)):
        found = nearest(found, one, lambda near, at: replace(at, objects=(*at.objects, near)))
    done = of_perturbations if perturbations is None else perturbations
    return replace(found, perturbations=tuple(draw(_several(done, most_perturbations, "name"))))


_OF_A_SCENE = tuple(Scene.STEPS.items())
_PAINTS: SearchStrategy[Any] = st.sampled_from(tuple(PAINTS))
_layouts, _poses, _objects, _perturbations = layouts, poses, objects, perturbations


# hypothesis checks each strategy anew that it is given, which takes longer than to draw from it
@cache
def _usual(published: bool) -> tuple[SearchStrategy[Any], ...]:
    """The parts' own strategies."""
    things = _objects(published=published)
    return _layouts(published=published), _poses(), things, _perturbations()


@lru_cache(maxsize=64)
def _several(of: SearchStrategy[S], most: int, once: str = "") -> SearchStrategy[list[S]]:
    """``once``: what differs between them."""
    return st.lists(
        of, max_size=most, unique_by=(lambda one: getattr(one, once, one)) if once else None
    )


def _standing(teats: Sequence[Teat], published: bool) -> tuple[Teat, ...]:
    """From left to right, each as near to how it was drawn as it stands beside those before it.
    Where one has no room at all, each is plainer.
    """
    given = dict(enumerate(teats))
    for most in SHARES:
        found = dict[int, Teat]()
        for i in filter(given.__contains__, LEFT_TO_RIGHT):
            plainer = (given[i].nearer(most * share) for share in SHARES)
            tried = (one for near in plainer for one in _beside(near, published))
            found |= next(({i: one} for one in tried if stand({**found, i: one})), {})
        if len(found) == len(given):
            break
    return tuple(found[i] for i in given)


def _beside(teat: Teat, published: bool) -> Iterator[Teat]:
    """As it is, then further and further to either side."""
    steps = Teat.STEPS["right_mm"]
    least, most = steps.published if published else (steps.least, steps.most)
    places = sorted(range(least, most + 1, SIDEWAYS), key=lambda at: abs(at - teat.right_mm))
    yield teat
    yield from (replace(teat, right_mm=at) for at in places)


def nearest(found: Scene, part: P, put: Callable[[P, Scene], Scene]) -> Scene:
    """With ``part`` put as near to its plain place as it must be; without it if it can't stand."""
    put(part, found)  # refuses what another strategy draws
    tried = (put(near, found) for near in map(part.nearer, SHARES))
    return next((one for one in tried if not one.faults()), found)


def _numbers(plain: T, *, published: bool = False) -> SearchStrategy[T]:
    """``plain`` with numbers that hypothesis shrinks to 0."""
    steps = _steps(tuple(plain.STEPS.items()), published)
    return steps.map(lambda found: replace(plain, **found))


@cache
def _steps(named: tuple[tuple[str, Steps], ...], published: bool) -> SearchStrategy[dict[str, Any]]:
    """A number by each name."""
    numbers = {
        name: st.integers(*ends).map(steps.value)
        for name, steps in named
        if (ends := steps.published if published else (steps.least, steps.most)) != (0, 0)
    }
    given: SearchStrategy[dict[str, Any]] = st.fixed_dictionaries(numbers)
    return given


@cache
def _amounts(name: str) -> SearchStrategy[Applied]:
    plain, steps = AMOUNTS[name]
    counts = st.integers(steps.least, steps.most).filter(bool)
    return counts.map(lambda count: Applied(name, round(plain + count * steps.size, 6)))

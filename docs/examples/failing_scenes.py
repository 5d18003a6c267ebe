"""How many failing scenes of a detector some seconds of the processor find, and how soon the first.

    python failing_scenes.py fused --cpu-s 30 --things pipe rod hose hot_cup cold_teat

A test of hypothesis ends at its first failure and makes that simpler. Here it goes on instead, with
the same scenes and the same target, and another seed after every `EXAMPLES` scenes; three of four
scenes are then drawn beside a failure that is known, with as much of it as leaves them distinct.
Two failures are distinct where other things stand there, or where their numbers are apart by
`APART` of their ranges (root mean square).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import count, zip_longest
from random import Random
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings, target
from hypothesis import strategies as st

import bench
from bench.testing import Scene, SceneResult, layouts, look, objects, scenes

APART, EXAMPLES = 0.2, 40
KEPT = (0.85, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)  # of a known failure, as far as it is distinct


class OverError(BaseException):
    """The time is over."""


def search(
    detector: str, things: Sequence[str], cpu_s: float, first: int, rig: str = "emulated"
) -> list[tuple[float, Scene, SceneResult]]:
    """Scenes that were tried: at which second of the processor, and what came of them."""
    tried, known = list[tuple[float, Scene, SceneResult]](), list[Scene]()
    drawn = scenes(
        layouts=layouts(4, 4), objects=objects(*things), most_objects=6, most_perturbations=0
    )
    look(detector, Scene(), rig=rig)  # what is compiled or loaded once
    began_s = time.process_time()

    def every_end_is_found(scene: Scene) -> None:
        after_s = time.process_time() - began_s
        if after_s > cpu_s:
            raise OverError
        found = look(detector, scene, rig=rig)
        target(found.grade_mm)
        tried.append((after_s, scene, found))
        if found.fault and all(apart(scene, one) for one in known):
            known.append(scene)

    how = settings(
        max_examples=EXAMPLES,
        database=None,
        deadline=None,
        phases=[Phase.generate, Phase.target],
        suppress_health_check=list(HealthCheck),
    )
    with suppress(OverError):
        for number in count(1000 * first):
            # a round draws beside what was known before it
            seed(number)(how(given(beside(drawn, tuple(known)))(every_end_is_found)))()
    return tried


@st.composite
def beside(draw: st.DrawFn, drawn: st.SearchStrategy[Scene], known: Sequence[Scene]) -> Scene:
    """A scene, or some of a new one in a known failure."""
    new = draw(drawn)
    if not known or not draw(st.integers(0, 3)):
        return new
    old, chance = draw(st.sampled_from(known)), draw(st.randoms(use_true_random=False))
    tried = (mixed(old, new, share, chance) for share in KEPT)
    fitting = (one for one in tried if not one.faults() and all(apart(one, of) for of in known))
    return next(fitting, new)


def mixed(old: Scene, new: Scene, share: float, chance: Random) -> Scene:
    """About a ``share`` of the old one."""

    def of(one: Any, other: Any) -> Any:
        if one is None or other is None or getattr(one, "kind", "") != getattr(other, "kind", ""):
            return one if chance.random() < share else other
        taken = [name for name in one.STEPS if chance.random() >= share]
        return replace(one, **{name: getattr(other, name) for name in taken})

    things = (of(*pair) for pair in zip_longest(old.objects, new.objects))
    return replace(
        of(old, new),
        teats=tuple(of(*pair) for pair in zip(old.teats, new.teats, strict=True)),
        objects=tuple(one for one in things if one is not None),
        paint=(old if chance.random() < share else new).paint,
    )


def apart(one: Scene, other: Scene) -> bool:
    """Whether two failures are distinct."""
    if [thing.kind for thing in one.objects] != [thing.kind for thing in other.objects]:
        return True
    parts = [
        (one, other),
        *zip((*one.teats, *one.objects), (*other.teats, *other.objects), strict=True),
    ]
    shares = [
        (getattr(a, name) - getattr(b, name)) / ((steps.most - steps.least) * steps.size)
        for a, b in parts
        for name, steps in a.STEPS.items()
    ]
    return math.sqrt(sum(share**2 for share in shares) / len(shares)) > APART


def main(
    detector: str, things: Sequence[str] = (), cpu_s: float = 30.0, first: int = 0, **more: str
) -> str:
    """One line; each distinct failure before it."""
    tried = search(detector, things, cpu_s, first, **more)
    failed = [(after_s, scene, found) for after_s, scene, found in tried if found.fault]
    distinct: list[Scene] = []
    for after_s, scene, found in failed:
        if all(apart(scene, one) for one in distinct):
            distinct.append(scene)
            print(f"{after_s:.1f} s: {found.fault}: {scene}")
    different, soonest = (
        len({scene for _, scene, _ in failed}),
        failed[0][0] if failed else math.inf,
    )
    return (
        f"{different} failing scenes of {len({scene for _, scene, _ in tried})}, {len(distinct)}"
        f" distinct, the first after {soonest:.1f} s of {cpu_s:g} s"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("detector")
    parser.add_argument("--things", nargs="*", default=())
    parser.add_argument("--cpu-s", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    with bench.program(__doc__):
        print(main(asked.detector, asked.things, asked.cpu_s, asked.seed))

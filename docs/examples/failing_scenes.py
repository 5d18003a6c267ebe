"""How many failing scenes of a detector some seconds of the processor find, and how soon the first.

    python failing_scenes.py fused --cpu-s 30 --things pipe rod hose hot_cup cold_teat

A test of hypothesis ends at its first failure and makes that simpler. Here it goes on instead, with
the same scenes and the same target, and another seed after every `EXAMPLES` scenes. Two failures
are distinct where other things stand there, or where their numbers are apart by `APART` of their
ranges (root mean square).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import count

from hypothesis import HealthCheck, Phase, given, seed, settings, target

import bench
from bench.testing import Scene, SceneResult, layouts, look, objects, scenes

APART, EXAMPLES = 0.2, 200


class OverError(BaseException):
    """The time is over."""


def search(
    detector: str, things: Sequence[str], cpu_s: float, first: int, rig: str = "emulated"
) -> list[tuple[float, Scene, SceneResult]]:
    """Scenes that were tried: at which second of the processor, and what came of them."""
    tried: list[tuple[float, Scene, SceneResult]] = []
    drawn = scenes(
        layouts=layouts(4, 4), objects=objects(*things), most_objects=6, most_perturbations=0
    )
    look(detector, Scene(), rig=rig)  # what is compiled or loaded once
    began_s = time.process_time()

    @settings(
        max_examples=EXAMPLES,
        database=None,
        deadline=None,
        phases=[Phase.generate, Phase.target],
        suppress_health_check=list(HealthCheck),
    )
    @given(drawn)
    def every_end_is_found(scene: Scene) -> None:
        after_s = time.process_time() - began_s
        if after_s > cpu_s:
            raise OverError
        found = look(detector, scene, rig=rig)
        target(found.grade_mm)
        tried.append((after_s, scene, found))

    with suppress(OverError):
        for number in count(1000 * first):
            seed(number)(every_end_is_found)()
    return tried


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

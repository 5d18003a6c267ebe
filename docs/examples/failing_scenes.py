"""How many failing scenes of a detector some seconds of the processor find, and how soon the first.

    python failing_scenes.py fused --cpu-s 30 --things pipe rod hose hot_cup cold_teat

A test of hypothesis ends at its first failure and makes that simpler. Here it goes on instead, with
the same scenes and another seed after every `EXAMPLES` scenes. The error is its target until a
scene failed. Most scenes are then a known failure with numbers of a new scene, until it is distinct
from all that are known: numbers that mattered least to failures are taken first.
Two failures are distinct where other things stand there, or where their numbers are apart by
`APART` of their ranges (root mean square).
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from itertools import count

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings, target
from scene_numbers import Key, Numbers, built, distance, numbers, take

import bench
from bench.testing import Scene, SceneResult, layouts, look, objects, scenes

APART, EXAMPLES = 0.2, 100
NEW = 0.1  # the share of scenes that are new ones, where failures are known
TRIES = 20
CERTAINTY = 3.0  # how much what was seen decides which numbers are taken


class OverError(BaseException):
    """The time is over."""


class Search:
    """What was ``tried``: at which second of the processor, and what came of it; the distinct
    failures; how often a scene failed with each number that was taken from a new one.
    """

    def __init__(self, first: int) -> None:
        self.chance = np.random.default_rng(first)
        self.tried = list[tuple[float, Scene, SceneResult]]()
        self.known = dict[Scene, Numbers]()
        self.taken, self.failed = Counter[Key](), Counter[Key]()

    def beside(self, new: Scene) -> tuple[Scene, Sequence[Key]]:
        """A known failure with numbers of a new scene, and which; or all of the new one."""
        others = numbers(new)
        for _ in range(TRIES if self.known and self.chance.random() > NEW else 0):
            known, were = list(self.known.items())[self.chance.integers(len(self.known))]
            found, order = dict(were), sorted({**were, **others}, key=self._rank)
            for i, key in enumerate(order, 1):
                take(key, others, found)
                if all(distance(found, one) > APART for one in (were, *self.known.values())):
                    if not (scene := built(found, known)).faults():
                        return scene, order[:i]
                    break
        return new, ()

    def _rank(self, key: Key) -> float:
        """By chance; lower, the more often a scene failed with another number."""
        failing = (1 + self.failed[key]) / (2 + self.taken[key])
        return self.chance.exponential(failing**-CERTAINTY)

    def add(self, after_s: float, scene: Scene, taken: Sequence[Key], found: SceneResult) -> None:
        self.tried.append((after_s, scene, found))
        self.taken.update(taken)
        if found.fault:
            self.failed.update(taken)
            if self.is_distinct(are := numbers(scene)):
                self.known[scene] = are

    def is_distinct(self, found: Numbers) -> bool:
        return all(
            found.keys() != one.keys() or distance(found, one) > APART
            for one in self.known.values()
        )


def search(
    detector: str, things: Sequence[str], cpu_s: float, first: int, rig: str = "emulated"
) -> Search:
    state = Search(first)
    drawn = scenes(
        layouts=layouts(4, 4), objects=objects(*things), most_objects=6, most_perturbations=0
    )
    look(detector, Scene(), rig=rig)  # what is compiled or loaded once
    began_s = time.process_time()

    def every_end_is_found(new: Scene) -> None:
        scene, taken = state.beside(new)
        if (after_s := time.process_time() - began_s) > cpu_s:
            raise OverError
        if not state.is_distinct(numbers(scene)):
            return
        found = look(detector, scene, rig=rig)
        if not state.known:
            target(found.grade_mm)
        state.add(after_s, scene, taken, found)

    how = settings(
        max_examples=EXAMPLES,
        database=None,
        deadline=None,
        phases=[Phase.generate, Phase.target],
        suppress_health_check=list(HealthCheck),
    )
    with suppress(OverError):
        for number in count(1000 * first):
            seed(number)(how(given(drawn)(every_end_is_found)))()
    return state


def main(
    detector: str, things: Sequence[str] = (), cpu_s: float = 30.0, first: int = 0, **more: str
) -> str:
    """One line; each distinct failure before it."""
    state = search(detector, things, cpu_s, first, **more)
    failed = {
        scene: (after_s, found) for after_s, scene, found in reversed(state.tried) if found.fault
    }
    for scene in state.known:
        after_s, found = failed[scene]
        print(f"{after_s:.1f} s: {found.fault}: {scene}")
    soonest = min((after_s for after_s, _ in failed.values()), default=math.inf)
    return (
        f"{len(failed)} failing scenes of {len({scene for _, scene, _ in state.tried})},"
        f" {len(state.known)} distinct, the first after {soonest:.1f} s of {cpu_s:g} s"
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

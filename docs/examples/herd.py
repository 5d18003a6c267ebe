"""What a cow's history is worth: cows that come several times, with teats that a post hides now
and then. Their ends are predicted from earlier visits, and compared with the last visit alone.

    python docs/examples/herd.py 10 12 herd.csv --seed 2

Udders fill between milkings and shrink by them (Miller 1995: rear teats come nearer to each other
by 45 to 50 %, others by 25 to 29 %), and each teat stands a millimetre elsewhere at each visit.
Only confirmed ends (attached, touched) make the history: what was only detected would feed itself.
"""

import argparse
import csv
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import bench
from detector import Context, Visit, last_visit
from instruments import EYES_MM, Phantom, PlatePose, Situation, make_object, situation_faults

DETECTOR = "fused"  # the one that ships and makes use of a history
SPREAD = 1.25  # of a full udder against the family's, so that teats stay apart when it is empty
HIDDEN, MOST_HIDDEN, BY_HAND = 0.2, 2, 0.5  # shares of teats; of hidden ones attached after all
OWN_MM, ATTACHED_MM = 1.0, 0.4  # a teat's own variation; how well an attached end is known
NEAR_MM, POST_MM = 30.0, 38.0  # a prediction of an end; a post before a hidden one
FIRST = 3  # visits that only make the history
CHI2_95_OF_3 = 7.815
Row = dict[str, Any]


class Cow:
    """Cow ``number`` of a herd; all of her visits follow from both numbers."""

    def __init__(self, seed: int, number: int) -> None:
        self._chance = np.random.default_rng([seed, number, *b"herd"])
        self._full = bench.member("ideal", 1000 * seed + number)
        self._filling_h = self._chance.uniform(6.0, 10.0)
        rear, others = self._chance.uniform(0.45, 0.50), self._chance.uniform(0.25, 0.29)
        self._shrinks = np.array([[rear, others], [rear, others], [others] * 2, [others] * 2])

    def stands(self, hours: float) -> Phantom:
        """Her udder so long after a milking."""
        share = 1.0 - self._shrinks * math.exp(-hours / self._filling_h)
        teats = self._full.phantom.teats
        bases = np.array([teat.base_mm for teat in teats])
        bases = bases.mean(axis=0) + (bases - bases.mean(axis=0)) * share * SPREAD
        bases += self._chance.normal(0.0, OWN_MM, bases.shape)
        moved = [
            replace(teat, base_mm=(float(x), float(y)))
            for teat, (x, y) in zip(teats, bases, strict=True)
        ]
        x, y = self._chance.uniform(-12.0, 12.0, 2)
        turn = math.radians(self._chance.uniform(-4.0, 4.0))
        return Phantom(tuple(moved), PlatePose(float(x), float(y), 0.0, turn))

    def visit(self, hours: float) -> tuple[Situation, set[int]]:
        """The scene of a visit: a post before each hidden teat that has room for one."""
        found = replace(self._full, name="herd", phantom=self.stands(hours))
        eye, ends, hidden = np.mean(EYES_MM, axis=0), found.phantom.ends_mm, set[int]()
        for teat in np.flatnonzero(self._chance.random(len(ends)) < HIDDEN)[:MOST_HIDDEN].tolist():
            end = ends[teat]
            y = float(end[1]) - POST_MM
            x = float(eye[0] + (end[0] - eye[0]) * (y - eye[1]) / (end[1] - eye[1]))
            tall = float(end[2]) + 22.0
            post = make_object("rod", x_mm=x, y_mm=y, height_mm=tall, radius_mm=15.0)
            tried = replace(found, objects=(*found.objects, post))
            if not situation_faults(tried):
                found, hidden = tried, hidden | {teat}
        return found, hidden

    def confirmed(self, ends: Any, hidden: set[int]) -> tuple[tuple[int, ...], Any]:
        """Teats (from 1) and their ends as attached; a hidden one only now and then."""
        kept = [i for i in range(len(ends)) if i not in hidden or self._chance.random() < BY_HAND]
        teats = tuple(i + 1 for i in kept)
        return teats, ends[kept] + self._chance.normal(0.0, ATTACHED_MM, (len(kept), 3))


def guesses(seed: int, number: int, visits: int, rig: Any, detector: Any) -> Iterator[Row]:
    """A row for each end that no camera sees: how far off its prediction is, and the last visit."""
    cow = Cow(seed, number)
    at_h, known = 0.0, list[tuple[float, float, tuple[int, ...], Any]]()
    for visit in range(visits):
        hours = float(cow._chance.uniform(4.0, 14.0))
        at_h += hours
        scene, hidden = cow.visit(hours)
        if visit >= FIRST:
            shot = bench.draw(scene, rig=rig, seed=seed + visit)
            sure = ATTACHED_MM**2 * np.eye(3)
            context = Context(
                hours,
                None,
                tuple(
                    Visit(at_h - at, since, teats, ends, np.array([sure] * len(teats)))
                    for at, since, teats, ends in known
                ),
            )
            answer = detector.detect_with(shot.frames, shot.calibration, context)
            last = last_visit(context, answer.teats)
            for row in (row for row in shot.truth if not row.visible):
                end, teat = np.array(row.xyz_mm), int(row.teat)
                near = [
                    one for one in answer.predicted if np.linalg.norm(one.world_mm - end) < NEAR_MM
                ]
                miss = near[0].world_mm - end if near else None
                inside = None
                if miss is not None and near[0].covariance_mm2 is not None:
                    nees = miss @ np.linalg.solve(near[0].covariance_mm2, miss)
                    inside = bool(nees < CHI2_95_OF_3)
                yield {
                    "cow": number,
                    "visit": visit,
                    "teat": teat,
                    "error_mm": None if miss is None else float(np.linalg.norm(miss)),
                    "last_mm": float(np.linalg.norm(last[teat] - end)) if teat in last else None,
                    "inside_95": inside,
                }
        known.append((at_h, hours, *cow.confirmed(scene.phantom.ends_mm, hidden)))


def main(cows: int, visits: int, out: Path, seed: int = 1, rig: str = "emulated") -> str:
    """Write a row an unseen end; gives back the summary."""
    with out.open("w", encoding="utf-8", newline="") as file:
        rows = list[Row]()
        for number in range(cows):
            with bench.open_detector(DETECTOR) as detector:
                rows += guesses(seed, number, visits, rig, detector)
        writer = csv.DictWriter(file, ["cow", "visit", "teat", "error_mm", "last_mm", "inside_95"])
        writer.writeheader()
        writer.writerows(rows)
    own, last = (
        np.array([row[key] for row in rows if row[key] is not None])
        for key in ("error_mm", "last_mm")
    )
    return (
        f"{len(rows)} unseen ends, {len(own)} predicted: {np.median(own):.1f} mm off in the median;"
        f" by the last visit {np.median(last):.1f} mm."
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    for name, kind in (("cows", int), ("visits", int), ("out", Path)):
        parser.add_argument(name, type=kind)
    parser.add_argument("--seed", type=int, default=1)
    with bench.program(__doc__):
        print(main(**vars(parser.parse_args())))

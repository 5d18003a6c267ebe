"""Ends expected by a cow's history, on cows of numbers alone: udders that fill and shrink, teats
that vary by a millimetre.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from detector.geometry import Array
from detector.history import laid_over, last_visit, predicted, udder_of
from detector.protocol import Context, Teat, Visit

SURE = 0.16 * np.eye(3)


@dataclass(frozen=True)
class Seen:
    """A visit with a hidden teat: her history, the other ends, and where the hidden one is."""

    context: Context
    teats: tuple[Teat, ...]
    hidden: int
    end_mm: Array


def cow(seed: int, visits: int = 16) -> list[Seen]:
    rng = np.random.default_rng(seed)
    wide = np.array([[-65.0, 40.0], [65.0, 40.0], [-36.0, -40.0], [36.0, -40.0]])
    wide = wide * rng.uniform(0.8, 1.25, (1, 2)) + rng.uniform(-6.0, 6.0, (4, 2))
    high, filling_h = rng.uniform(118.0, 150.0, 4), rng.uniform(6.0, 10.0)
    shrinks = np.array([[0.27, 0.27], [0.27, 0.27], [0.47, 0.27], [0.47, 0.27]])
    known: list[tuple[float, Visit]] = []
    found, now = [], 0.0
    for _ in range(visits):
        hours = float(rng.uniform(3.0, 14.0))
        now += hours
        flat = wide * (1.0 - shrinks * np.exp(-hours / filling_h))
        ends = np.column_stack([flat, high]) + rng.normal(0.0, 1.0, (4, 3))
        angle = rng.normal(0.0, 0.06)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        ends[:, :2] = ends[:, :2] @ turn.T
        ends += np.array([-130.0, 240.0, 0.0]) + rng.normal(0.0, [15.0, 15.0, 4.0])
        hidden = int(rng.integers(4))
        others = [k for k in range(4) if k != hidden]
        history = tuple(replace(one, hours_ago=now - at) for at, one in known)
        teats = tuple(Teat(ends[k] + rng.normal(0.0, 0.2, 3), 0.04 * np.eye(3)) for k in others)
        found.append(Seen(Context(hours, None, history), teats, hidden + 1, ends[hidden]))
        at = others if rng.random() < 0.7 else [0, 1, 2, 3]  # what was hidden is attached too
        touched = ends[at] + rng.normal(0.0, 0.4, (len(at), 3))
        names = tuple(k + 1 for k in at)
        known.append((now, Visit(0.0, hours, names, touched, np.tile(SURE, (len(at), 1, 1)))))
    return found


def later(seeds: range) -> Iterator[Seen]:
    for seed in seeds:
        yield from cow(seed)[4:]


@pytest.mark.weekly
def test_own_visits_and_hours_tell_more_than_the_last_visit_and_regions_hold() -> None:
    errors, last, inside = [], [], []
    for seen in later(range(16)):
        ends = predicted(seen.context, seen.teats)
        if seen.hidden in ends:
            miss = ends[seen.hidden].world_mm - seen.end_mm
            covariance = ends[seen.hidden].covariance_mm2
            assert covariance is not None
            errors.append(float(np.linalg.norm(miss)))
            inside.append(bool(miss @ np.linalg.solve(covariance, miss) < 7.815))
        before = last_visit(seen.context, seen.teats)
        if seen.hidden in before:
            last.append(float(np.linalg.norm(before[seen.hidden] - seen.end_mm)))
    assert len(errors) > 160
    assert np.median(errors) < 0.55 * np.median(last)
    assert np.mean(np.array(errors) < 5.0) > 0.9
    assert 0.93 < np.mean(inside) < 0.99


@pytest.mark.slow
def test_another_cow_s_history_gains_nothing() -> None:
    others = [seen.context for seen in later(range(40, 46))]
    for seen, other in zip(later(range(6)), others, strict=True):
        ends = predicted(replace(other, hours_since_milking=9.0), seen.teats)
        assert all(np.linalg.norm(one.world_mm - seen.end_mm) > 3.0 for one in ends.values())


def test_nothing_is_predicted_without_a_history_of_two_visits_or_two_ends() -> None:
    seen = cow(3)[10]
    first = replace(seen.context, visits=seen.context.visits[:1])
    assert udder_of(first) is None
    assert predicted(first, seen.teats) == {}
    assert predicted(seen.context, seen.teats[:1]) == {}
    assert predicted(seen.context, ()) == {}


def test_a_teat_that_the_last_two_visits_did_not_have_may_be_gone() -> None:
    seen = cow(4)[10]
    lost = []
    for k, visit in enumerate(seen.context.visits):
        here = [i for i, teat in enumerate(visit.teats) if k < 8 or teat != seen.hidden]
        names = tuple(visit.teats[i] for i in here)
        lost.append(Visit(visit.hours_ago, visit.hours_since_milking, names, visit.ends_mm[here],
                          visit.covariances_mm2[here]))  # fmt: skip
    assert seen.hidden in predicted(seen.context, seen.teats)
    assert seen.hidden not in predicted(replace(seen.context, visits=tuple(lost)), seen.teats)


def test_a_turn_and_a_shift_are_found() -> None:
    ends = np.array([[0.0, 0.0, 5.0], [40.0, 10.0, 6.0], [-30.0, 60.0, 7.0]])
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    found, shift = laid_over(ends, ends @ turn.T + [1.0, 2.0, 3.0])
    assert found == pytest.approx(turn)
    assert shift == pytest.approx([1.0, 2.0, 3.0])

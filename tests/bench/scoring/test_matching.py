"""Matching against brute force, its rules for hidden teats, and GOSPA as a metric."""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations
from math import sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from bench.scoring.matching import Counts, Match, gate_mm, gospa_mm, match
from bench.scoring.points import Floats
from bench.scoring.rates import Rate

SQUARE = np.array([[0.0, 0, 0], [60, 0, 0], [0, 60, 0], [60, 60, 0]])
ALL = np.ones(4, dtype=bool)
COORDINATE = st.floats(-40, 40, allow_nan=False).map(lambda v: round(v, 3))


def clouds(most: int = 4) -> st.SearchStrategy[Floats]:
    return st.integers(0, most).flatmap(lambda n: hnp.arrays(np.float64, (n, 3), elements=COORDINATE))


def cost(m: Match, found: Floats, truth: Floats) -> float:
    """What the assignment costs: squared distances (half of them on hidden teats), c^2/2 for a miss and for a false finding."""
    on_hidden = sum(float(((found[i] - truth[j]) ** 2).sum()) / 2 for i, j in m.hidden_pairs)
    return sum(d * d for d in m.distances_mm) + on_hidden + m.gate_mm**2 / 2 * (len(m.missed) + len(m.false))


def cheapest(found: Floats, truth: Floats, visible: list[bool], c: float) -> float:
    """By trying every way to give each finding one teat or none."""
    n, m = len(found), len(truth)
    best = float("inf")
    for choice in set(permutations([*range(m), *[-1] * n], n)):
        total, taken = 0.0, set()
        for i, j in enumerate(choice):
            d = float(np.linalg.norm(found[i] - truth[j])) if j >= 0 else float("inf")
            if d > c:
                total += c * c / 2
            else:
                total += d * d if visible[j] else d * d / 2
                taken.add(j)
        total += c * c / 2 * sum(visible[j] and j not in taken for j in range(m))
        best = min(best, total)
    return best


@settings(max_examples=60, deadline=None)
@given(clouds(3), clouds(3), st.data())
def test_no_other_assignment_is_cheaper(found: Floats, truth: Floats, data: st.DataObject) -> None:
    visible = data.draw(st.lists(st.booleans(), min_size=len(truth), max_size=len(truth)))
    c = data.draw(st.floats(1, 60))
    result = match(found, truth, np.array(visible, dtype=bool), c)
    assert cost(result, found, truth) == pytest.approx(cheapest(found, truth, visible, c), abs=1e-6)


@given(clouds(), clouds(), st.integers(0, 2**32 - 1), st.floats(1, 60))
def test_order_does_not_matter(found: Floats, truth: Floats, seed: int, c: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.permutation(len(found)), rng.permutation(len(truth))
    assert gospa_mm(found, truth, c) == pytest.approx(gospa_mm(found[a], truth[b], c), abs=1e-9)


@given(clouds(), clouds(), st.floats(1, 60), st.data())
def test_every_finding_and_every_teat_is_accounted_for_once(found: Floats, truth: Floats, c: float, data: st.DataObject) -> None:
    visible = data.draw(st.lists(st.booleans(), min_size=len(truth), max_size=len(truth)))
    m = match(found, truth, visible, c)
    assert sorted([i for i, _ in m.pairs + m.hidden_pairs] + list(m.false)) == list(range(len(found)))
    assert sorted([j for _, j in m.pairs] + list(m.missed)) == [j for j in range(len(truth)) if visible[j]]
    assert all(not visible[j] for _, j in m.hidden_pairs)
    assert all(0 <= d <= c for d in m.distances_mm)
    assert m.counts.found == len(found)


@given(clouds(), clouds(), clouds(), st.floats(1, 60))
def test_gospa_is_a_metric(a: Floats, b: Floats, x: Floats, c: float) -> None:
    assert gospa_mm(a, a, c) == 0.0
    assert gospa_mm(a, b, c) == pytest.approx(gospa_mm(b, a, c), abs=1e-9)
    assert gospa_mm(a, b, c) <= gospa_mm(a, x, c) + gospa_mm(x, b, c) + 1e-9


def test_identical_sets_match_perfectly() -> None:
    m = match(SQUARE[::-1], SQUARE, ALL, gate_mm(SQUARE))
    assert m.pairs == ((3, 0), (2, 1), (1, 2), (0, 3))
    assert m.distances_mm == (0.0, 0.0, 0.0, 0.0)
    assert (m.missed, m.false, m.gospa_mm) == ((), (), 0.0)


def test_gospa_of_one_pair_one_miss_and_one_false_finding() -> None:
    found = np.array([[3.0, 4, 0], [500, 0, 0]])  # 5 mm from the first teat; nowhere
    m = match(found, SQUARE[:2], [True, True], 20.0)
    assert (m.pairs, m.missed, m.false) == (((0, 0),), (1,), (1,))
    assert m.gospa_mm == pytest.approx(sqrt(25 + 200 * 2))


def test_a_pair_beyond_the_gate_is_a_miss_and_a_false_finding() -> None:
    m = match([[0, 0, 25.1]], [[0, 0, 0]], [True], 25.0)
    assert m.counts == Counts(visible=1, matched=0, missed=1, false=1)
    assert match([[0, 0, 25.0]], [[0, 0, 0]], [True], 25.0).counts == Counts(visible=1, matched=1)


def test_the_gate_is_half_the_least_spacing_and_at_most_25_mm() -> None:
    assert gate_mm(SQUARE) == 25.0
    assert gate_mm(SQUARE / 2) == 15.0
    assert gate_mm([[1, 2, 3]]) == gate_mm([]) == 25.0


def test_a_pair_that_crosses_over_is_resolved_as_a_whole() -> None:
    truth, found = [[0, 0, 0], [10, 0, 0]], [[6, 0, 0], [16, 0, 0]]
    m = match(found, truth, [True, True], 25.0)  # nearest first would pair 6 with 10 and leave 16 to 0
    assert m.distances_mm == (6.0, 6.0)


class TestHiddenTeats:
    TRUTH = np.array([[0.0, 0, 0], [30, 0, 0]])
    VISIBLE = (True, False)

    def test_absent_it_is_not_missed(self) -> None:
        assert match([[1, 0, 0]], self.TRUTH, self.VISIBLE, 15).counts == Counts(visible=1, hidden=1, matched=1)

    def test_found_it_is_not_false(self) -> None:
        m = match([[1, 0, 0], [29, 0, 0]], self.TRUTH, self.VISIBLE, 15)
        assert m.counts == Counts(visible=1, hidden=1, matched=1, on_hidden=1)
        assert m.hidden_pairs == ((1, 1),)

    def test_a_finding_on_it_does_not_hide_a_miss(self) -> None:
        assert match([[29, 0, 0]], self.TRUTH, self.VISIBLE, 15).counts == Counts(visible=1, hidden=1, missed=1, on_hidden=1)

    def test_a_second_finding_on_it_is_false(self) -> None:
        m = match([[29, 0, 0], [31, 0, 0], [0, 0, 0]], self.TRUTH, self.VISIBLE, 15)
        assert m.counts == Counts(visible=1, hidden=1, matched=1, false=1, on_hidden=1)

    def test_a_finding_on_it_does_not_take_a_visible_teat_from_a_nearer_finding(self) -> None:
        found = [[24, 0, 0], [3, 0, 0]]  # a wide gate: the first is within reach of both teats
        assert match(found, self.TRUTH, self.VISIBLE, 40).pairs == ((1, 0),)

    def test_it_does_not_take_the_only_finding_of_a_visible_teat(self) -> None:
        m = match([[16, 0, 0]], self.TRUTH, self.VISIBLE, 25)  # 16 mm from the visible teat, 14 mm from the hidden one
        assert (m.pairs, m.hidden_pairs, m.missed) == (((0, 0),), (), ())

    def test_precision_and_recall_leave_it_out(self) -> None:
        counts = match([[1, 0, 0], [29, 0, 0]], self.TRUTH, self.VISIBLE, 15).counts
        assert counts.precision == counts.recall == Rate(1, 1)


def test_empty_arrays() -> None:
    assert match([], [], [], 25.0).counts == Counts()
    assert match([[0, 0, 0]], [], [], 25.0).counts == Counts(false=1)
    assert match(np.zeros((0, 3)), [[0, 0, 0], [50, 0, 0]], [1, 0], 25.0).counts == Counts(visible=1, hidden=1, missed=1)
    assert match([], [], [], 25.0).counts.recall.value is None


@given(st.lists(st.builds(Counts, *[st.integers(0, 9)] * 6), max_size=6))
def test_counts_add(parts: list[Counts]) -> None:
    total = sum(parts, Counts())
    assert total.visible == sum(c.visible for c in parts)
    assert total.on_hidden == sum(c.on_hidden for c in parts)
    assert total.found == sum(c.found for c in parts)
    assert total == sum(reversed(parts), Counts())


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: match([[0, 0]], SQUARE, ALL, 25), r"found: expected points of shape \(n, 3\).*\(1, 2\)"),
        (lambda: match([[0, np.nan, 0]], SQUARE, ALL, 25), "found: point 0 .*not finite"),
        (lambda: match([], SQUARE, [True], 25), "one flag for each of the 4 teats"),
        (lambda: match([], SQUARE, [2, 0, 0, 0], 25), "true or false"),
        (lambda: match([], SQUARE, ALL, 0), "gate: 0 mm"),
        (lambda: gate_mm([[1, 1, 1], [0, 0, 0], [1, 1, 1]]), "teats 0 and 2 are at the same place"),
    ],
)
def test_bad_input_is_refused_with_its_place(call: Callable[[], object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        call()

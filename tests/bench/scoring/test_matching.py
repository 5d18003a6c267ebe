"""Matching against scipy and motmetrics, its rules for hidden teats, and GOSPA as a metric."""

from __future__ import annotations

from collections.abc import Callable
from math import sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.optimize import linear_sum_assignment  # type: ignore[attr-defined, unused-ignore]

from bench.scoring.errors import Floats
from bench.scoring.matching import Counts, Match, gate_mm, match
from tests.examples import examples

SQUARE = np.array([[0.0, 0, 0], [60, 0, 0], [0, 60, 0], [60, 60, 0]])
ALL = np.ones(4, dtype=bool)
COORDINATE = st.floats(-40, 40, allow_nan=False).map(lambda v: round(v, 3))


def clouds(most: int = 4) -> st.SearchStrategy[Floats]:
    return st.integers(0, most).flatmap(
        lambda n: hnp.arrays(np.float64, (n, 3), elements=COORDINATE)
    )


def cost(m: Match, found: Floats, truth: Floats) -> float:
    """Squared distances (half of them on hidden teats), c^2/2 for a miss and a false finding."""
    on_hidden = sum(float(((found[i] - truth[j]) ** 2).sum()) / 2 for i, j in m.hidden_pairs)
    return m.gospa_mm**2 + on_hidden


def gospa_mm(a: Floats, b: Floats, c: float) -> float:
    return match(a, b, np.ones(len(b), dtype=bool), c).gospa_mm


def scene(seed: int, teats: int, spread_mm: float) -> tuple[Floats, Floats]:
    """Teats on a grid, and findings about them: some near, some twice, some nowhere."""
    rng = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(4), np.arange(4), [0]), axis=-1).reshape(-1, 3) * 30.0
    truth = grid[rng.permutation(16)[:teats]] + rng.normal(0, 4, (teats, 3))
    found = np.repeat(truth, rng.integers(0, 3, teats), axis=0)
    found = found + rng.normal(0, spread_mm, found.shape)
    return np.vstack([found, rng.uniform(-50, 150, (2, 3))]), truth


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1), st.integers(2, 6), st.floats(0.5, 15))
def test_under_the_benchs_gate_against_motmetrics(seed: int, teats: int, spread_mm: float) -> None:
    import motmetrics  # type: ignore[import-untyped]

    found, truth = scene(seed, teats, spread_mm)
    gate = gate_mm(truth)
    mine = match(found, truth, np.ones(teats, dtype=bool), gate)
    distances = np.linalg.norm(truth[:, None] - found[None], axis=2)
    costs = np.where(distances <= gate, distances**2, np.nan)
    rows, cols = motmetrics.lap.linear_sum_assignment(costs, solver="scipy")
    theirs = [
        (int(i), int(j)) for j, i in sorted(zip(rows, cols, strict=True)) if distances[j, i] <= gate
    ]
    assert mine.pairs == tuple(theirs)
    book = motmetrics.MOTAccumulator()
    book.update(list(range(teats)), list(range(len(found))), costs, frameid=0)
    names = ["num_misses", "num_false_positives", "recall", "precision"]
    row = motmetrics.metrics.create().compute(book, metrics=names).iloc[0]
    assert (len(mine.missed), len(mine.false)) == (row[names[0]], row[names[1]])
    assert mine.counts.recall.value == pytest.approx(float(row["recall"]))
    assert mine.counts.precision.value == pytest.approx(float(row["precision"]))


SCENES = st.builds(scene, st.integers(0, 2**32 - 1), st.integers(1, 6), st.floats(0.5, 30))


@pytest.mark.slow
@settings(max_examples=examples(60), deadline=None)
@given(SCENES | st.tuples(clouds(), clouds()), st.floats(1, 60), st.integers(0, 63))
def test_no_other_assignment_is_cheaper(
    given: tuple[Floats, Floats], gate: float, hidden: int
) -> None:
    """The cost by scipy's assignment of everything to everything."""
    found, truth = given
    seen = [not hidden >> k & 1 for k in range(len(truth))]
    squared = ((found[:, None] - truth[None]) ** 2).sum(axis=2)
    gain = np.where(seen, 1.0, 0.5) * (np.minimum(squared, gate**2) - gate**2)
    least = float(gain[linear_sum_assignment(gain)].sum()) + gate**2 / 2 * (len(found) + sum(seen))
    result = match(found, truth, np.array(seen, dtype=bool), gate)
    assert cost(result, found, truth) == pytest.approx(least, abs=1e-6)


@pytest.mark.slow
@given(clouds(), clouds(), st.floats(1, 60), st.data())
def test_every_finding_and_every_teat_is_accounted_for_once(
    found: Floats, truth: Floats, c: float, data: st.DataObject
) -> None:
    visible = data.draw(st.lists(st.booleans(), min_size=len(truth), max_size=len(truth)))
    m = match(found, truth, visible, c)
    findings = [i for i, _ in m.pairs + m.hidden_pairs]
    assert sorted([*findings, *m.false]) == list(range(len(found)))
    teats = [j for _, j in m.pairs]
    assert sorted([*teats, *m.missed]) == [j for j in range(len(truth)) if visible[j]]
    assert all(not visible[j] for _, j in m.hidden_pairs)
    assert all(0 <= d <= c for d in m.distances_mm)
    assert m.counts.found == len(found)
    assert (m.counts.visible, m.counts.hidden) == (visible.count(True), visible.count(False))


@pytest.mark.slow
@given(clouds(), clouds(), clouds(), st.floats(1, 60))
def test_gospa_is_a_metric(a: Floats, b: Floats, x: Floats, c: float) -> None:
    assert gospa_mm(a, a, c) == 0.0
    assert gospa_mm(a, b, c) == pytest.approx(gospa_mm(b, a, c), abs=1e-9)
    assert gospa_mm(a, b, c) <= gospa_mm(a, x, c) + gospa_mm(x, b, c) + 1e-9


def test_gospa_of_one_pair_one_miss_and_one_false_finding() -> None:
    found = np.array([[3.0, 4, 0], [500, 0, 0]])  # 5 mm from the first teat; nowhere
    m = match(found, SQUARE[:2], [True, True], 20.0)
    assert (m.pairs, m.missed, m.false) == (((0, 0),), (1,), (1,))
    assert m.gospa_mm == pytest.approx(sqrt(25 + 200 * 2))


@pytest.mark.parametrize("way", np.eye(3))
def test_a_pair_beyond_the_gate_is_a_miss_and_a_false_finding(way: Floats) -> None:
    m = match([25.1 * way], [[0, 0, 0]], [True], 25.0)
    assert m.counts == Counts(visible=1, matched=0, missed=1, false=1)
    assert match([25.0 * way], [[0, 0, 0]], [True], 25.0).counts == Counts(visible=1, matched=1)


@pytest.mark.parametrize("found", [[[2.0, 0, 0], [-2.0, 0, 0]], [[-2.0, 0, 0], [2.0, 0, 0]]])
def test_of_two_findings_at_one_distance_the_first_is_taken(found: list[list[float]]) -> None:
    for truth in (SQUARE[:1], SQUARE[:2]):
        m = match(found, truth, ALL[: len(truth)], 25.0)
        assert (m.pairs, m.false) == (((0, 0),), (1,))
    # both are within the gate of both teats
    crowded = match(found, [[0.0, 0, 0], [0, 20.0, 0]], [True, True], 25.0)
    assert (crowded.pairs, crowded.false) == (((0, 0), (1, 1)), ())


@pytest.mark.parametrize("spacing_mm", [5.0, 5.1])
def test_ends_5_mm_apart_are_two_teats(spacing_mm: float) -> None:
    assert gate_mm(np.array([[0.0, 0.0, 0.0], [spacing_mm, 0.0, 0.0]])) == spacing_mm / 2


@pytest.mark.parametrize("spacing_mm", [4.9, 4.9999])
def test_ends_nearer_than_5_mm_are_one_end_touched_twice(spacing_mm: float) -> None:
    with pytest.raises(ValueError, match=r"teats 1 and 2 are .* apart.*touched twice"):
        gate_mm(np.array([[0.0, 0.0, 0.0], [spacing_mm, 0.0, 0.0]]))


def test_the_gate_is_half_the_least_spacing_and_at_most_25_mm() -> None:
    assert gate_mm(SQUARE) == 25.0
    assert gate_mm(SQUARE / 2) == 15.0
    assert gate_mm([[1, 2, 3]]) == gate_mm([]) == 25.0


def test_empty_arrays() -> None:
    assert match([], [], [], 25.0).counts == Counts()
    assert match([[0, 0, 0]], [], [], 25.0).counts == Counts(false=1)
    assert match(np.zeros((0, 3)), [[0, 0, 0], [50, 0, 0]], [1, 0], 25.0).counts == Counts(
        visible=1, hidden=1, missed=1
    )
    assert match([], [], [], 25.0).counts.recall.value is None


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (
            lambda: match([[0, 0]], SQUARE, ALL, 25),
            r"found: expected points of shape \(n, 3\).*\(1, 2\)",
        ),
        (lambda: match([[0, np.nan, 0]], SQUARE, ALL, 25), "found: point 0 .*not finite"),
        (lambda: match([*[[0.0] * 3] * 400, [0.0, 0.0, np.inf]], SQUARE, ALL, 25), "point 400 is"),
        (lambda: match([], SQUARE, [True], 25), "one flag for each of the 4 teats"),
        (lambda: match([], SQUARE, ALL, 0), "gate: 0 mm"),
        (
            lambda: gate_mm([[1, 1, 1], [99, 0, 0], [1, 1, 1]]),
            "teats 1 and 3 are 0.00 mm apart.*touched twice",
        ),
        (
            lambda: gate_mm([[99.0, 0.0, 0.0], [1.0, 1.0, 1.0], [1.0, 1.0, 1.3]]),
            "teats 2 and 3 are 0.30 mm apart",
        ),
    ],
)
def test_bad_input_is_refused_with_its_place(call: Callable[[], object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        call()

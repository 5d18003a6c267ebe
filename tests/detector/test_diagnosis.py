"""Each fault that a calibration may have is put in, and named; a sound one is not accused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from detector.calibration.cameras import coverage, pair_of, place_board
from detector.calibration.diagnosis import (
    Finding,
    against_the_arm,
    measured_again,
    outlier_views,
    remeasure,
    swapped,
)
from detector.calibration.rigid import WorldFit
from detector.calibration.values import Pair
from detector.geometry import Array, Motion
from tests.detector.boards_seen import (
    BOARD,
    Views,
    joined,
    joined_of,
    pair_views,
    seen,
    shifted,
    thesis_rig,
    world_fit,
)

SIZE = (1360, 1024)


@pytest.fixture(scope="module")
def pair() -> Pair:
    return pair_of(joined(1))


def found(pair: Pair, views: Views) -> list[str]:
    again = remeasure(pair, BOARD, pair_views(views))
    return [finding.name for finding in measured_again(again, pair)]


def bowl(points: Array) -> Array:
    """The board's rim 2 mm nearer to the cameras' far side than its middle."""
    middle = points.mean(axis=0)
    radius = np.linalg.norm(points - middle, axis=1)
    return np.asarray(points + np.outer(2.0 * (radius / radius.max()) ** 2, [0.0, 0.0, 1.0]))


@pytest.mark.slow
def test_a_sound_calibration_is_not_accused(pair: Pair) -> None:
    views = seen(thesis_rig(), 30)
    assert found(pair, views) == []
    assert swapped(pair.right_from_left) == []


def test_one_percent_of_baseline(pair: Pair) -> None:
    motion = pair.right_from_left
    longer = replace(pair, right_from_left=Motion(motion.R, 1.01 * motion.T))
    again = remeasure(longer, BOARD, pair_views(seen(thesis_rig(), 40)))
    (finding,) = measured_again(again, longer)
    assert finding.name == "wrong baseline"
    assert "1.0" in finding.sentence
    assert "too large at every distance" in finding.sentence


@pytest.mark.parametrize(
    ("by_px", "names"), [((0.0, 0.5), ["shifted rows"]), ((0.5, 0.0), ["shifted columns"])]
)
def test_half_a_pixel(pair: Pair, by_px: tuple[float, float], names: list[str]) -> None:
    views = seen(thesis_rig(), 41)
    assert found(pair, {"left": views["left"], "right": shifted(views["right"], by_px)}) == names


@pytest.mark.slow
def test_swapped_cameras(pair: Pair) -> None:
    views = seen(thesis_rig(), 42)
    other_way: Views = {"left": views["right"], "right": views["left"]}
    assert found(pair, other_way) == ["swapped cameras"]
    (finding,) = swapped(pair_of(joined_of(other_way)).right_from_left)
    assert finding.name == "swapped cameras"


@pytest.mark.slow
def test_a_bent_board_is_named_even_by_the_calibration_that_was_made_with_it() -> None:
    views = seen(thesis_rig(), 5, shape=bowl)
    assert found(pair_of(joined_of(views)), views)[0] == "bent board"


def world_of(scale: float) -> WorldFit:
    """18 touched points, seen by a pair whose board's squares were wrong by ``scale``."""
    rig, motion = thesis_rig(), thesis_rig().right_from_left
    note = Motion(motion.R, motion.T / scale)
    return world_fit(Pair(rig.left, rig.right, note, Motion.identity()), 3)


@pytest.mark.slow
def test_a_wrong_square_size_shows_against_the_arm() -> None:
    world = world_of(1.04)
    (finding,) = against_the_arm(world)
    assert finding.name == "wrong square size"
    assert "too short" in finding.sentence
    assert world.scale == pytest.approx(1.04, abs=4 * world.scale_sd)
    assert against_the_arm(world_of(1.0)) == []


def test_outlier_views_are_listed() -> None:
    errors = {str(n): 0.1 + 0.01 * n for n in range(8)} | {"7": 0.6}
    said = "view 7 of left misses by 0.60 px, the median view by 0.14 px: look at it, and decide"
    assert outlier_views(errors, "left") == [Finding("outlier view", said)]
    assert outlier_views({"1": 0.1, "2": 9.0}, "left") == []  # of two either may be it


class TestCoverage:
    def test_a_good_set_misses_nothing_but_the_cells_it_did_not_reach(self) -> None:
        views = seen(thesis_rig(), 6, count=60)["left"]
        poses = place_board("left", views, thesis_rig().left).fit.poses
        shown = coverage([view.pixels_px for view in views], SIZE, poses)
        assert shown.share > 0.7
        assert min(shown.tilted) >= 2
        words = ("tilt", "more views", "nearer")
        assert not any(word in text for text in shown.missing for word in words)

    @pytest.mark.parametrize(
        ("om", "side"),
        [
            ([0.0, 0.5, 0.0], "right"),
            ([0.0, -0.5, 0.0], "left"),
            ([0.5, 0.0, 0.0], "upper"),
            ([-0.5, 0.0, 0.0], "lower"),
        ],
    )
    def test_a_tilt_is_reported_by_the_edge_that_comes_nearer(
        self, om: list[float], side: str
    ) -> None:
        pose = Motion.from_vectors(om, [0.0, 0.0, 1000.0])
        edges = {"left": [-100.0, 0, 0], "right": [100.0, 0, 0]}
        edges |= {"upper": [0, -100.0, 0], "lower": [0, 100.0, 0]}
        depth = {name: float(pose.apply(np.array(point))[2]) for name, point in edges.items()}
        assert min(depth, key=lambda name: depth[name]) == side, "the referee: which edge is nearer"
        still = coverage([np.zeros((4, 2))] * 2, SIZE, [pose] * 2).missing
        assert not any(f"its {side} edge" in text for text in still)
        assert sum("edge towards the cameras" in text for text in still) == 3

    def test_an_empty_set_asks_for_everything(self) -> None:
        missing = coverage([], SIZE).missing
        assert any("12 more views" in text for text in missing)
        assert any("top far left" in text for text in missing)

"""A new detector against an old one: what is paired, and what turns the gate red."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from bench.scoring.comparison import (
    Compared,
    Discordance,
    ScenePair,
    common_errors,
    compare,
    why_failed,
)
from bench.scoring.decisions import Verdict
from bench.scoring.errors import Floats
from bench.scoring.scene import SceneScore, score_scene

TRUTH = np.array(
    [[-260.0, 267.0, 136.0], [-110.0, 284.0, 136.0], [-205.0, 200.0, 137.0], [-140.0, 205.0, 136.0]]
)
MET, NOT_MET, OPEN = Verdict.MET, Verdict.NOT_MET, Verdict.INCONCLUSIVE


def scored(found: Any, **changes: Any) -> SceneScore:
    settings: dict[str, Any] = {
        "u_mm": 0.2,
        "seconds": 0.4,
        "limit_mm": 5.0,
        "time_limit_s": 2.0,
        "hidden_claimed": 0,
    }
    return score_scene(found, TRUTH, [True] * 4, **(settings | changes))


def noisy(seed: int, sd_mm: float = 0.4) -> Floats:
    return TRUTH + np.random.default_rng(seed).normal(0, sd_mm, TRUTH.shape)


def pairs(olds: list[Any], news: list[Any], repeats: int = 1) -> list[ScenePair]:
    return [
        ScenePair(
            f"{k:03d}-a-{k % repeats + 1}",
            f"a-{k // repeats}",
            "ideal" if k % 2 else "dim",
            scored(old),
            scored(new),
        )
        for k, (old, new) in enumerate(zip(olds, news, strict=True))
    ]


def shifted(by_mm: float, scenes: int = 12) -> Compared:
    olds = [noisy(k) for k in range(scenes)]
    return compare(pairs(olds, [np.add(old, [0.0, by_mm, 0.0]) for old in olds]))


@pytest.mark.parametrize(("n", "verdict"), [(1, OPEN), (71, OPEN), (72, MET)])
def test_the_same_answers_are_shown_to_be_no_worse_by_72_poses(n: int, verdict: Verdict) -> None:
    """A twentieth of the poses, each worse by the limit, would make the margin; less than 72 poses
    might all miss them.
    """
    same = compare(pairs([noisy(1)] * n, [noisy(1)] * n))
    assert same.gate.verdict is verdict
    assert same.gate.margin_mm == pytest.approx(0.25)  # a twentieth of 5 mm
    assert same.pooled.radial.mean == 0.0
    told = "; ".join(same.gate.reasons)
    if verdict is MET:
        assert (
            "grew by at most 0.250 mm (margin 0.25 mm) and at most 5.0 % of poses are lost anew (72"
            " poses, 97.5 % confidence" in told
        )
    else:
        assert told.endswith("(margin 0.25 mm): 72 poses with such changes show less")


@pytest.mark.parametrize("n", [8, 20, 60])
def test_a_gate_is_hardly_ever_green_where_some_poses_got_worse_by_more_than_the_margin(
    n: int,
) -> None:
    """7 % of the poses are 4 mm worse, 0.28 mm in the mean: of 60 gates at most 6 green (99.9 %
    where 2.5 % are).
    """
    rng, start = np.random.default_rng(n), TRUTH[:1]
    green = 0
    for _ in range(60):
        worse = np.where(rng.random(n) < 0.07, 4.0, 0.0)
        olds = rng.normal(0.0, 0.1, n)
        scores = [
            (one(start, 0.5 + old), one(start, 0.5 + old + by))
            for old, by in zip(olds, worse, strict=True)
        ]
        found = compare(
            [ScenePair(str(k), str(k), "ideal", *both) for k, both in enumerate(scores)]
        )
        green += found.gate.verdict is MET
    assert green <= 6


def one(truth: Floats, by_mm: float) -> SceneScore:
    found = np.add(truth, [0.0, by_mm, 0.0])
    return score_scene(found, truth, [True], u_mm=0.2, seconds=0.4, limit_mm=5.0, time_limit_s=2.0)


@pytest.mark.parametrize("by_mm", [1.6, -1.6])
def test_a_depth_error_of_a_fifth_of_a_pixel_is_worse_either_way(by_mm: float) -> None:
    found = shifted(by_mm)  # 0.2 px of disparity at 8 mm a pixel
    assert found.gate.verdict is NOT_MET
    assert "mean distance to the teat end grew by 1." in found.gate.reasons[0]
    assert found.pooled.radial.mean is not None
    assert found.pooled.radial.mean > 0.25


def test_a_large_bias_across_does_not_hide_a_new_error() -> None:
    olds = [np.add(noisy(k, 0.3), [0.0, 0.0, -11.0]) for k in range(12)]
    found = compare(pairs(olds, [np.add(old, [0.0, 1.6, 0.0]) for old in olds]))
    assert found.pooled.radial.mean is not None
    assert found.pooled.radial.mean < 0.25
    assert found.gate.verdict is NOT_MET
    assert "error along y grew by 1." in found.gate.reasons[0]


def test_a_smaller_error_is_not_worse() -> None:
    olds = [noisy(k, 1.0) for k in range(60)]
    found = compare(pairs(olds, [TRUTH + 0.5 * (old - TRUTH) for old in olds]))
    assert found.gate.verdict is MET
    assert found.pooled.radial.mean is not None
    assert found.pooled.radial.mean < 0


def test_what_a_few_scenes_cannot_tell_is_inconclusive() -> None:
    one, two = (np.add(TRUTH, [by, 0.0, 0.0]) for by in (1.0, 2.0))
    found = compare(pairs([one, two, one, two], [two, one, two, one]))
    assert found.pooled.radial.mean == pytest.approx(0.0)
    assert found.gate.verdict is OPEN
    assert "don't tell from chance" in found.gate.reasons[0]
    assert "in 4 poses; poses that were not run may hide that it grew by" in found.gate.reasons[-1]


def test_a_scene_that_passed_and_now_fails_is_named() -> None:
    far = noisy(3).copy()
    far[2] = TRUTH[2] + [0, 0, 6.0]
    found = compare(pairs([noisy(k) for k in range(30)], [*(noisy(k) for k in range(29)), far]))
    assert found.gate.verdict is NOT_MET
    assert found.gate.reasons[0] == "029-a-1 passed and now fails: 6.00 mm off (limit 5 mm)"
    assert found.pooled.success == Discordance(both=29, only_old=1)


def test_a_false_teat_more_and_a_miss_more_in_scenes_that_failed_before() -> None:
    failing = noisy(1)[:3]
    false_more = compare(pairs([failing], [np.vstack([failing, [[0.0, 0.0, 100.0]]])]))
    assert false_more.gate.reasons == ("1 false teat more (1 instead of 0)",)
    missed_more = compare(pairs([failing], [failing[:1]]))
    assert missed_more.gate.reasons == ("2 missed teats more (3 instead of 1)",)


def test_scenes_without_a_counterpart_leave_it_open() -> None:
    same = [noisy(1)] * 72
    assert compare(pairs(same, same), unpaired=2).gate.reasons == (
        "2 scenes of the old one were not run with the new one",
    )


def test_nothing_found_by_both_compares_no_error() -> None:
    found = compare(pairs([[]], [[]]))
    assert (found.gate.verdict, found.pooled.teats, found.pooled.radial.mean) == (OPEN, 0, None)
    assert found.situations[0].radial_holm is None


def test_only_teats_that_both_found_are_compared_each_with_itself() -> None:
    old, new = noisy(1)[[0, 1, 3]], noisy(2)[[3, 2, 1]]
    a, b = common_errors(pairs([old], [new])[0])
    assert a == pytest.approx(noisy(1)[[1, 3]] - TRUTH[[1, 3]])
    assert b == pytest.approx(noisy(2)[[1, 3]] - TRUTH[[1, 3]])


def test_a_pose_succeeds_with_all_its_repeats() -> None:
    olds = [noisy(k) for k in range(6)]
    news = [*olds[:5], olds[5][:3]]
    found = compare(pairs(olds, news, repeats=3))
    assert (found.pooled.scenes, found.pooled.poses) == (6, 2)
    assert found.pooled.success == Discordance(both=1, only_old=1)


def test_situations_are_adjusted_for_being_several() -> None:
    found = shifted(0.3)
    assert [row.situation for row in found.situations] == ["dim", "ideal"]
    for row in found.situations:
        assert row.radial.p_value is not None
        assert row.radial_holm is not None
        assert row.radial.p_value <= row.radial_holm
    assert found.pooled.radial_holm is None
    assert sum(row.teats for row in found.situations) == found.pooled.teats == 48


@pytest.mark.parametrize(
    ("dim", "verdict", "says"),
    [(10, NOT_MET, "adjusted p = 0.0"), (4, OPEN, "don't tell from chance")],
)
def test_an_error_that_grew_in_one_situation_is_not_lost_among_the_others(
    dim: int, verdict: Verdict, says: str
) -> None:
    olds = [noisy(k, 0.1) for k in range(48)]
    news = [np.add(old, [0.0, 0.9, 0.0]) if k < dim else old for k, old in enumerate(olds)]
    found = compare(
        [
            ScenePair(str(k), str(k), "dim" if k < dim else "ideal", scored(a), scored(b))
            for k, (a, b) in enumerate(zip(olds, news, strict=True))
        ]
    )
    assert found.pooled.radial.mean is not None
    assert found.pooled.radial.mean < found.gate.margin_mm
    assert found.gate.verdict is verdict
    assert "in dim the mean distance to the teat end grew by 0." in found.gate.reasons[0]
    assert says in found.gate.reasons[0]


def test_why_a_scene_failed() -> None:
    assert why_failed(scored(TRUTH)) == "it succeeded"
    assert why_failed(scored(TRUTH[:3], seconds=3.0)) == "1 missed, too slow (3.00 s)"


def test_bad_questions() -> None:
    with pytest.raises(ValueError, match="no scene in common"):
        compare([])
    for margin in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="0 or more"):
            compare(pairs([TRUTH], [TRUTH]), margin_mm=margin)
    with pytest.raises(
        ValueError, match="scored within 5 mm and 10 mm; score both by the same rules"
    ):
        compare([ScenePair("001-a-1", "a", "dim", scored(TRUTH), scored(TRUTH, limit_mm=10.0))])

"""Starts that lead nowhere, and ends that are followed up their sides."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from detector.fused import depth_search, refits
from detector.fused.learned import learned
from detector.fused.parameters import Parameters
from detector.outline.model import CX
from tests.detector.fused.conftest import Body, Find
from tests.learn_fused import LIMITS


@pytest.mark.slow
def test_first_starts_that_lead_nowhere_leave_the_rest(
    find: Find, udder: list[Body], monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = depth_search.best_starts
    first = Parameters().first_starts

    def beside_and_usual(*given: Any) -> Any:
        teats = usual(*given)
        beside = np.repeat(teats[:1], first, axis=0)
        beside[:, CX] += 1e4  # in no picture
        return np.concatenate([beside, teats])

    monkeypatch.setattr("detector.fused.depth_search.best_starts", beside_and_usual)
    assert len(find(udder).teats) == len(udder)


@pytest.mark.slow
def test_a_bright_dome_isnt_the_whole_teat(find: Find, udder: list[Body]) -> None:
    """A flatter rim below the end has more contrast, before a thing as warm as the teat."""
    teat = replace(udder[2], end_mm=(-140.0, 205.0, 136.0), height=1.0, radius_mm=11.0, grey=60.0)
    rim = replace(teat, end_mm=(-140.0, 204.9, 130.0), height=0.4, grey=150.0, seen_by="LR")
    arm = replace(teat, end_mm=(-140.0, 330.0, 220.0), radius_mm=60.0, grey=85.0, kelvin=305.5)
    bodies = [teat, rim, arm, udder[0], udder[3]]
    found = find(bodies, noise=1.0)
    ways = [float(np.linalg.norm(one.world_mm - np.array(teat.end_mm))) for one in found.teats]
    near = [way for way in ways if way < 25.0]
    assert len(near) == 1
    assert near[0] < 1.0, near


def test_an_end_begins_again_beyond_the_learned_limit() -> None:
    teats = np.zeros((2, 8))
    teats[:, 0], teats[:, 5], teats[:, 7] = (0.0, 100.0), 11.0, 1.0
    decision: Any = SimpleNamespace(accepted=[0, 1], odds=np.ones(2), by_place=np.zeros(2, bool))
    evidence: Any = SimpleNamespace(sd_mm=np.array([0.2, 0.4]))
    for limit_mm, again in ((0.3, [1]), (0.5, [])):
        assert refits.unsure(teats, evidence, decision, {"sd, mm": limit_mm}, Parameters()) == again
    assert set(LIMITS) == set(learned().limits)

"""What a campaign's rows say, from rows whose figures are known; and the page made of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bench.campaign.chunk import ASIDE, CallTime, ChunkRows, SceneRow
from bench.campaign.numbers import Numbers, campaign_numbers
from bench.campaign.plan import CampaignPlan
from bench.campaign.shards import Shards
from bench.report.campaign import campaign_page
from reports.page import Figure, Score, Scoreboard, Table
from reports.render import render

SCENES = 120
FIRST = SceneRow("ideal", 0, "a", 4, 0, 4, 0, 0, None, 0.5, 0.4, "", "00" * 8, 0, 4, 4, 3.0)


def row(member: int) -> SceneRow:
    """`a` misses a teat where its third parameter is in the highest quarter of its range; `gain`
    says nothing. Member 5 is false, and sure of it.
    """
    shares = tuple(np.random.default_rng(member).integers(0, 256, 3).tolist())
    named = {"member": member, "parameters": "gain,udder_x_mm,lamp_x_mm_2", "shares": shares}
    good = replace(FIRST, **named)  # type: ignore[arg-type]
    if member == 5:
        return replace(good, failure="false", false_teats=1, sure_wrong=1)
    if shares[2] >= 192:
        return replace(
            good, failure="missed", found=3, missed=1, max_mm=2.0, stated=3, inside=2, nees=10.0
        )
    return good


@pytest.fixture(scope="module")
def plan() -> CampaignPlan:
    return CampaignPlan(families=("overlapping", "ideal"), scenes=SCENES, detectors=("fused",))


@pytest.fixture(scope="module")
def numbers(plan: CampaignPlan, tmp_path_factory: pytest.TempPathFactory) -> Numbers:
    folder = tmp_path_factory.mktemp("rows")
    rows = tuple(map(row, range(SCENES)))
    gone = replace(
        FIRST, family="overlapping", failure=ASIDE, visible=0, found=0, max_mm=None, nees=None
    )
    (folder / "shards").mkdir()
    for family, each in (("ideal", rows), ("overlapping", (gone,))):
        taken = tuple(CallTime(0.1, 0.1, "it ended" if one is gone else None) for one in each)
        Shards(folder).write(family, 0, ChunkRows(each, (), taken))
    return campaign_numbers(folder, plan)


@pytest.mark.slow
def test_rates_teats_and_what_is_stated(numbers: Numbers) -> None:
    missed = sum(row(member).failure == "missed" for member in range(SCENES))
    assert 20 < missed < 40
    rates = numbers.of("a")
    assert list(rates) == ["overlapping", "ideal"]  # as planned
    one = rates["ideal"]
    assert (one.scenes, one.failures, one.missed, one.false) == (SCENES, missed + 1, missed, 1)
    assert (one.visible, one.found) == (4 * SCENES, 4 * SCENES - missed)
    assert (one.false_teats, one.sure_wrong) == (1, 1)
    assert (one.stated, one.inside) == (4 * SCENES - missed, 4 * SCENES - 2 * missed)
    squared = (4 * (SCENES - missed) * 3.0 + 3 * missed * 10.0) / (4 * SCENES - missed)
    assert one.nees == pytest.approx(squared)
    assert one.spread_mm is not None
    assert (one.spread_mm[0], one.spread_mm[2], one.spread_mm[4]) == (0.5, 0.5, 2.0)
    assert (rates["overlapping"].scenes, rates["overlapping"].spread_mm) == (0, None)
    assert numbers.aside == {"overlapping-0000": "it ended"}
    assert numbers.worst["a"][0][1] == 5
    assert len(numbers.worst["a"]) == 25


def test_the_parameter_that_failures_depend_on_comes_first(numbers: Numbers) -> None:
    first, *others = numbers.parameters
    assert (first.family, first.detector, first.name) == ("ideal", "a", "lamp_x_mm_2")
    assert first.p_value < 1e-6
    assert all(one.p_value > 0.05 for one in others)
    (map_,) = numbers.maps
    assert map_.parameters[0] == first
    assert sum(map(sum, map_.scenes)) == SCENES
    of_column = [sum(column) for column in zip(*map_.failures, strict=True)]
    assert of_column[-1] > 10 * max(of_column[:-1][:2])


@pytest.mark.slow
def test_the_page_says_them(numbers: Numbers, plan: CampaignPlan) -> None:
    page = campaign_page(Path("some where"), plan, {"teatbench": "0"}, numbers)
    board = next(part for part in page.parts() if isinstance(part, Scoreboard))
    name, scenes, (score,) = board.rows[1]
    assert (name, scenes) == ("ideal", "120")
    assert isinstance(score, Score)
    assert "1 sure and wrong" in score.shows
    assert board.rows[0][2] == (None,)
    assert len([part for part in page.parts() if isinstance(part, Figure)]) == 3
    html = render(page)
    assert "teatbench campaign show &#34;some where&#34; ideal-0005" in html
    assert "1 scene set aside" in html
    tables = [part.caption for part in page.parts() if isinstance(part, Table)]
    assert len(tables) == 5, tables


def test_a_campaign_without_a_row_has_a_page(plan: CampaignPlan, tmp_path: Path) -> None:
    nothing = campaign_numbers(tmp_path, plan)
    assert "No scene was scored" in render(campaign_page(tmp_path, plan, {}, nothing))

"""`campaign compare`: two campaigns scene by scene, from rows whose differences are known."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from bench.campaign.chunk import ASIDE, CallTime, ChunkRows, SceneRow, TeatRow
from bench.campaign.comparison import compare_campaigns
from bench.campaign.ledger import Ledger
from bench.campaign.perturbations import Applied
from bench.campaign.plan import CampaignPlan, plan_text
from bench.campaign.shards import Shards
from bench.scoring.decisions import Verdict
from tests.bench.commands import Said

pytestmark = pytest.mark.slow

SCENES = 40
MADE_BY = {"teatbench": "0.2.0 a", "rig": "emulated a", "calibration": "c", "detectors": "d 1 x"}


def written(
    folder: Path,
    lost: int = 0,
    *,
    off_mm: float = 0.2,
    frames: str = "00" * 8,
    false: int = 0,
    aside: int = 0,
    plan: dict[str, Any] | None = None,
    members: range = range(SCENES),
    chunk: int = 0,
) -> Path:
    """A campaign of two families: `d` loses so many of the second, its ends are so far off."""
    asked = CampaignPlan(**{"families": ("ideal", "overlapping"), "scenes": SCENES, **(plan or {})})
    (folder / "shards").mkdir(parents=True, exist_ok=True)
    Ledger(folder).write("plan.toml", plan_text(asked, MADE_BY).encode("utf-8"))
    for family in asked.families:
        rows, teats = [], []
        for member in members:
            key = (family, member, "d")
            fails = family == "overlapping" and member < lost
            row = SceneRow(*key, 2, 0, 2 - fails, fails, false, 0, off_mm, off_mm, "", frames)
            row = replace(row, failure="missed") if fails else row
            rows.append(replace(row, failure=ASIDE) if member >= SCENES - aside else row)
            teats.append(TeatRow(*key, 1, "found", 0.0, off_mm, 0.0))
            teats.append(
                TeatRow(*key, 2, "missed" if fails else "found", *[None if fails else 0.0] * 3)
            )
        Shards(folder).write(
            family, chunk, ChunkRows(tuple(rows), tuple(teats), (CallTime(0.1, 0.1),) * len(rows))
        )
    return folder


@pytest.fixture(scope="module")
def old(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("compared") / "old")


def test_the_gate_and_the_figures(old: Path, tmp_path: Path, said: Said) -> None:
    same = tmp_path / "same"
    shutil.copytree(old, same)
    lost = written(tmp_path / "lost", 12)
    # 80 scenes without a change rule out a fall by more than 4.6 % points: Tango's z^2 / (n + z^2)
    told = said(4, "campaign compare {} {} --gate", old, same).out
    assert "fell by 4.6 % points (margin 1)" in " ".join(told.split())
    met = said(0, "campaign compare {} {} --gate --margin-rate 0.05", old, same)
    assert "The new one is not worse" in met.out
    out = said(1, "campaign compare {} {} --gate --json --out {}", old, lost, tmp_path / "page")
    (found,) = json.loads(out.out)["comparisons"]
    assert found["gate"]["verdict"] == "worse"
    assert found["gate"]["margin_rate"] == 0.01
    assert (found["scenes"], found["same_frames"]) == (2 * SCENES, 2 * SCENES)
    everything, ideal, overlapping = found["rows"]
    assert (everything["success"]["only_old"], everything["teats"]) == (12, 4 * SCENES - 12)
    assert overlapping["success"]["p_value"] == pytest.approx(2 / 2**12)
    assert (ideal["success"]["p_value"], ideal["new"]["missed"]) == (1.0, 0)
    assert overlapping["new"]["missed"] == 12
    html = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    assert "in overlapping teats the share of right scenes fell by 30.0 % points" in html
    assert not re.search(r"\bposes?\b", html + told + met.out, re.IGNORECASE)
    far = written(tmp_path / "far", off_mm=0.9)
    grown = said(0, "campaign compare {} {}", old, far).out
    assert "the mean distance to the teat end grew by 0.35 mm" in grown


@pytest.mark.parametrize("false", [0, 1])
def test_answers_are_identical_where_no_end_is_false(tmp_path: Path, false: int) -> None:
    """A campaign keeps no place of a false end: it may have been elsewhere."""
    (found,) = compare_campaigns([written(tmp_path / name, false=false) for name in ("old", "new")])
    assert found.compared.identical is not bool(false)


@pytest.mark.weekly
def test_a_campaign_that_grew_is_looked_at_again_and_pays(tmp_path: Path, said: Said) -> None:
    """Two unfinished campaigns compared, then with more scenes done; the same data is one look."""
    both = [written(tmp_path / name, members=range(30)) for name in ("old", "new")]
    line = "campaign compare {} {} --gate --margin-mm 1 --margin-rate 0.055"

    def earlier() -> int:
        (found,) = compare_campaigns(both, margin_mm=1.0, margin_rate=0.055)
        assert found.look is not None
        return len(found.look.after)

    # of n scenes without a change z² / (n + z²): 6.0 % points of 60 at 2.5 %
    assert said(4, line, *both).out
    assert earlier() == earlier() == 0, "the same data again is the same look"
    for folder in both:
        written(folder, members=range(30, SCENES), chunk=1)
    # 4.6 of 80 at a first look; 5.9 at a further one, which has half of what is left
    assert said(4, line, *both).out
    assert earlier() == earlier() == 1
    fresh = [written(tmp_path / f"fresh {name}") for name in ("old", "new")]
    assert said(0, line, *fresh).out
    (found,) = compare_campaigns(both, margin_mm=1.0, margin_rate=0.06)
    assert found.look is not None
    assert found.look.after == [], "another claim"
    kept = Path(shutil.copytree(both[0], tmp_path / "kept"))
    assert Ledger(kept).looks(found.look.claim) == [found.look.data], "it goes with its folder"
    assert not Ledger(kept).damage("shards/")


def test_a_look_that_can_not_be_kept_shows_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = [written(tmp_path / name) for name in ("old", "new")]

    def full(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(Ledger, "add_look", full)
    (found,) = compare_campaigns(both, margin_mm=1.0, margin_rate=0.08)
    assert found.compared.gate.verdict is Verdict.INCONCLUSIVE
    assert "no space left" in found.compared.gate.reasons[0]


def test_other_pictures_are_compared_only_where_the_plans_say_why(
    old: Path, tmp_path: Path, said: Said
) -> None:
    other = written(tmp_path / "other", frames="11" * 8)
    why = said(2, "campaign compare {} {}", old, other).err
    assert f"{2 * SCENES} scenes have other pictures" in why
    assert "ideal-0000" in why
    dirty = {"perturbations": (Applied("dirt", 9.0),)}
    perturbed = written(tmp_path / "dirty", 3, frames="22" * 8, aside=2, plan=dirty)
    out = said(0, "campaign compare {} {}", old, perturbed).out
    assert "perturbations: none (old), dirt 9 (new)" in " ".join(out.split())
    assert "not compared: 4 trials of the old run" in " ".join(out.split())


def test_what_can_not_be_compared_is_refused(old: Path, tmp_path: Path, said: Said) -> None:
    strict = written(tmp_path / "strict", plan={"limit_mm": 3.0})
    assert "run both with one limit_mm" in said(2, "campaign compare {} {}", old, strict).err
    assert "has one detector, d" in said(2, "campaign compare {}", old).err
    assert "no campaign is there" in said(2, "campaign compare {} {}", old, tmp_path).err
    wrong = said(2, "campaign compare {} {} --detector e", old, strict).err
    assert "no detector of those named" in wrong
    (tmp_path / "strict" / "shards").rename(tmp_path / "strict" / "gone")
    assert (
        "missing: shards/ideal-000000.parquet" in said(2, "campaign compare {} {}", old, strict).err
    )

"""Campaigns compared scene by scene: two of them, or the detectors of one.

A scene is its family and member, whatever was done to its pictures. So two campaigns may differ in
what their plans say, as in perturbations or seeds, and are still pairs; where pictures differ and
the plans don't say why, the program draws other scenes, and nothing is compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.campaign.chunk import ASIDE, SceneId
from bench.campaign.ledger import Ledger
from bench.campaign.plan import CampaignPlan
from bench.campaign.run import plan_of
from bench.campaign.shards import Shards
from bench.config import ConfigError, check_within, several
from bench.record.looks import GATE, InterimLook, claim_of
from bench.record.reader import RunRecord
from bench.results.comparison import Comparison, Side, sides, unwritten
from bench.scoring.comparison import ScenePair, compare
from bench.scoring.matching import GATE_CEILING_MM, Match
from bench.scoring.scene import SceneScore
from textfiles.bounds import MARGIN, MARGIN_OF_RATE, SHARE

MARGIN_RATE = 0.01  # of right scenes
SCORES = """
SELECT family, member, frames, failure, hidden, false_teats, hidden_claimed, teats
FROM everything WHERE detector = ? AND failure != ? ORDER BY family, member
"""

Scores = dict[SceneId, tuple[SceneScore, str]]


def compare_campaigns(
    folders: Sequence[Path | str],
    detectors: Sequence[str] = (),
    *,
    margin_mm: float | None = None,
    margin_rate: float = MARGIN_RATE,
    confidence: float = 0.95,
) -> tuple[Comparison, ...]:
    """Each later campaign with the first, or each detector of one with its first, on the scenes
    that both have. ``margin_mm``, ``margin_rate``: how much larger an error (5 % of the limit for
    None) and the share of failures may be, at this ``confidence``. The look is written into the
    folders. Raises ConfigError where nothing can be compared.
    """
    check_within(SHARE, confidence=confidence)
    check_within(MARGIN, margin_mm=margin_mm)
    check_within(MARGIN_OF_RATE, margin_rate=margin_rate)
    detectors = several("detectors", detectors)
    plans = {folder: plan_of(folder) for folder in map(Path, several("folders", folders, 1))}
    runs = [_as_run(folder, plan) for folder, plan in plans.items()]
    found = []
    for old, new in sides(runs, detectors):
        plan, other = plans[old.run.folder], plans[new.run.folder]
        if plan.limit_mm != other.limit_mm:
            raise ConfigError.plain(
                f"{old.run.folder} was held against {plan.limit_mm:g} mm, {new.run.folder} against"
                f" {other.limit_mm:g} mm: run both with one `limit_mm`"
            )
        scores = _scores(old, plan), _scores(new, other)
        both = [scene for scene in scores[0] if scene in scores[1]]
        if not both:
            raise ConfigError.plain(
                f"{old.label} and {new.label} have no scored scene in common: run both on the same"
                " families and members (`families`, `first`, `scenes`)"
            )
        same = [scores[0][scene][1] == scores[1][scene][1] for scene in both]
        if not all(same):
            _refuse_unexplained(old.run, new.run, both[same.index(False)], same.count(False))
        pairs = tuple(
            ScenePair(
                *(scene.name, scene.name, scene.family),
                *(scores[0][scene][0], scores[1][scene][0]),
                same=not scores[0][scene][0].counts.false,  # whose places are not kept
            )
            for scene in both
        )
        alone = len(scores[0]) - len(both), len(scores[1]) - len(both)
        claim = claim_of(*map(_made_by, (old, new)), margin_mm, margin_rate, confidence)
        data = claim_of([(scene.name, scores[0][scene][1], scores[1][scene][1]) for scene in both])
        ledgers = Ledger(old.run.folder), Ledger(new.run.folder)
        before = list(dict.fromkeys(look for one in ledgers for look in one.looks(claim)))
        before = before[: before.index(data)] if data in before else before
        # how many scenes there are was decided by looking at them
        before += ["half_width"] * (plan.half_width is not None or other.half_width is not None)
        compared = compare(
            pairs,
            margin_mm=margin_mm,
            margin_rate=margin_rate,
            confidence=confidence,
            unpaired=alone[0],
            again=len(before),
        )
        verdicts = {"gate": compared.gate.verdict.value}
        look = InterimLook(GATE, claim, data, {}, {"poses": len(both)}, verdicts, before)
        one = Comparison(old, new, pairs, same.count(True), *alone, compared, look=look)
        found.append(_written(one) if len(runs) > 1 else one)
    return tuple(found)


def _made_by(side: Side) -> dict[str, Any]:
    """What a side is, however many of its scenes are done, and wherever its folder lies."""
    facts = side.run.facts
    own = {key: facts[key] for key in ("rig", "seed", "calibration_sha256", "perturbations")}
    return {**own, "program": facts["program"], side.detector: facts["items"].get(side.detector)}


def _written(one: Comparison) -> Comparison:
    """The comparison, its look in both ledgers; not shown to be no worse where it can't be."""
    try:
        for side in (one.old, one.new):
            if one.look:
                Ledger(side.run.folder).add_look(one.look.claim, one.look.data)
    except OSError as error:
        why = f"the look can't be written beside the campaign ({error.strerror or error})"
        return unwritten(one, f"{why}: it would be free")
    return one


def _as_run(folder: Path, plan: CampaignPlan) -> RunRecord:
    """What a comparison says of a campaign: its folder, detectors, and what made its rows."""
    made = plan.made_by
    items = {}
    for one in made.get("detectors", "").split(", "):
        name, _, rest = one.partition(" ")
        items[name] = {"version": rest.rpartition(" ")[0]}
    with Shards(folder).connect() as db:
        names = db.execute("SELECT DISTINCT detector FROM scenes ORDER BY detector").fetchall()
    there = [name for (name,) in names]
    done = ", ".join(f"{one.name} {one.amount:g}" for one in plan.perturbations)
    facts = {
        "kind": "emulated",
        "title": plan.title,
        "detectors": [*(n for n in items if n in there), *(n for n in there if n not in items)],
        "items": items,
        "rig": made.get("rig"),
        "seed": plan.seed,
        "calibration_sha256": made.get("calibration"),
        "program": made.get("teatbench"),
        "perturbations": done or "none",
        "ending": "finished",
    }
    if not there:
        raise ConfigError.plain(
            f"{folder}: no scene has been scored there; run it with 'teatbench campaign run'"
        )
    return RunRecord(folder, facts)


def _refuse_unexplained(old: RunRecord, new: RunRecord, scene: SceneId, count: int) -> None:
    """Raises ConfigError for other pictures of one plan."""
    if any(old.facts[key] != new.facts[key] for key in ("rig", "seed", "perturbations")):
        return
    raise ConfigError.plain(
        f"{count} scenes have other pictures in {new.folder} than in {old.folder}, {scene.name} for"
        " one, though rig, sensors, seed and perturbations are the same: the program draws them"
        f" differently (teatbench {old.facts['program']} there, {new.facts['program']} here). Run"
        " both with one version."
    )


def _scores(side: Side, plan: CampaignPlan) -> Scores:
    with Shards(side.run.folder).connect() as db:
        rows = db.execute(SCORES, [side.detector, ASIDE]).fetchall()
    scores: Scores = {}
    # which answer belongs to which teat is not kept
    for family, member, frames, failure, hidden, false, claimed, teats in rows:
        found = [teat for teat in teats if teat["status"] == "found"]
        errors = np.array([[teat[f"{axis}_mm"] for axis in "xyz"] for teat in found]).reshape(-1, 3)
        match = Match(
            pairs=tuple((number, teat["teat"] - 1) for number, teat in enumerate(found)),
            distances_mm=tuple(map(math.hypot, *errors.T)) if found else (),
            hidden_pairs=(),
            missed=tuple(teat["teat"] - 1 for teat in teats if teat["status"] == "missed"),
            false=tuple(range(len(found), len(found) + false)),
            hidden=hidden,
            gate_mm=GATE_CEILING_MM,
        )
        right = failure == ""
        one = SceneScore(match, errors, 0.0, True, plan.limit_mm, 0.0, right, (), claimed)
        scores[SceneId(family, member)] = one, frames
    return scores

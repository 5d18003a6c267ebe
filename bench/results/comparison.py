"""Runs compared: which detector of which run with which, on which pairs of trials; and several runs
judged as one.

Trials are a pair where their frames are the same bytes, else where pose, repeat and true teat ends
agree. The first run is the old one. Judged as one, counts, errors and times are added, never
averaged; a pose that several runs share is one pose. A look at several runs is written into their
records, and pays for those before it (`scoring.looks`).
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bench.config import ConfigError, did_you_mean
from bench.record.check import NOT_AS_WRITTEN, shortened
from bench.record.looks import (
    GATE,
    TOGETHER,
    InterimLook,
    claim_of,
    id_of,
    looks_before,
    write_looks,
)
from bench.record.reader import RunRecord, TrialRecord, read_run
from bench.record.recording import FILES
from bench.record.schema import SCRIPT
from bench.results.verdicts import (
    DetectorRequirement,
    Judgement,
    beside_tests,
    calls_of,
    decide_detector,
    has_answer,
    held_back,
    latency,
    run_verdict,
    scored_trials,
    stored_rules,
    truth_u_mm,
)
from bench.scoring.comparison import Gate, PairedComparison, ScenePair, compare
from bench.scoring.decisions import Decision, Verdict, overall
from bench.scoring.looks import FIRST, Looks
from bench.scoring.scene import Pool, pool
from bench.script.model import Rules, Script

ANSWERED = ("x_mm", "y_mm", "z_mm", "covariance_mm2")  # of each end that was found
SAME_PLACE_MM = 10.0  # a hand sets a phantom up within a few mm; scripts move it by 25 mm
# other pictures are a detector's own
CAMERAS = frozenset(Path(name).stem for name in FILES)


@dataclass(frozen=True, slots=True)
class Side:
    """One detector in one run."""

    run: RunRecord
    detector: str

    @property
    def label(self) -> str:
        """The detector, its version, and its run's folder."""
        version = self.run.facts["items"].get(self.detector, {}).get("version")
        named = f"{self.detector} {version}" if version else self.detector
        return f"{named} in {self.run.folder.resolve().name}"

    @property
    def trials(self) -> tuple[TrialRecord, ...]:
        """The trials that count and were scored."""
        return tuple(scored_trials(self.run, self.detector))


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two sides; ``elsewhere``: trials whose teats stood elsewhere; ``look``: in the ledger."""

    old: Side
    new: Side
    pairs: tuple[ScenePair, ...]
    same_frames: int
    only_old: int
    only_new: int
    compared: PairedComparison
    elsewhere: int = 0
    look: InterimLook | None = None


def scored_together(runs: Sequence[RunRecord], detector: str) -> Pool:
    """The scores of one detector over several runs as one. A pose of one script, or of one
    recording, is the same pose in every run of it; poses of two scripts differ.
    """
    scores, poses, answered = [], [], list[bool]()
    for run in runs:
        trials, of = scored_trials(run, detector), poses_of(run)
        scores += [trial.scores[detector] for trial in trials]
        poses += [(of, trial.pose) for trial in trials]
        answered += [has_answer(trial, detector) for trial in trials]
    return pool(scores, poses, answered)


def compare_folders(
    folders: Sequence[Path],
    detectors: Sequence[str] = (),
    *,
    margin_mm: float | None = None,
    confidence: float = 0.95,
    damage: tuple[str, ...] = (),
) -> tuple[Comparison, ...]:
    """Compare each later run with the first, or the detectors of one run with its first; ``damage``
    is that of their records. Raises ConfigError where nothing can be compared.
    """
    runs = [read_run(folder, damage) for folder in folders]
    found = []
    for old, new in sides(runs, detectors):
        one = compare_sides(old, new, margin_mm=margin_mm, confidence=confidence)
        if not damage and len(runs) > 1:
            try:
                write_looks((old.run, new.run), [one.look] if one.look else [])
            except ConfigError as error:
                one = unwritten(one, str(error))
        found.append(one)
    return tuple(found)


def unwritten(one: Comparison, why: str) -> Comparison:
    """A comparison whose look could not be written down: it shows nothing to be no worse."""
    gate = one.compared.gate
    if gate.verdict is Verdict.MET:
        gate = replace(gate, verdict=Verdict.INCONCLUSIVE, reasons=(why,))
    return replace(one, compared=replace(one.compared, gate=gate))


def compare_sides(
    old: Side, new: Side, *, margin_mm: float | None = None, confidence: float = 0.95
) -> Comparison:
    """Compare two detectors on their common trials. Raises ConfigError."""
    check_limits(old, new)
    for side in (old, new):
        if not side.trials:
            raise ConfigError.plain(
                f"{side.label} has no scored trial: 'teatbench runs' says how its run stands."
            )
    matched, elsewhere = _paired(old.trials, new.trials)
    if not matched:
        moved = f" {elsewhere} have the same name, but their teats stood at other places."
        raise ConfigError.plain(
            f"{old.label} and {new.label} have no scored trial in common."
            f"{moved if elsewhere else ''} Run both on one recording, or one script on one seed."
        )
    pairs = tuple(
        ScenePair(
            *(a.id, a.pose, str(a.head["situation"])),
            *(a.scores[old.detector], b.scores[new.detector]),
            same=_answer(a, old.detector) == _answer(b, new.detector),
        )
        for a, b in matched
    )
    frames = [(_frames(a), _frames(b)) for a, b in matched]
    same = sum(bool(first) and first == second for first, second in frames)
    only_old, only_new = len(old.trials) - len(matched), len(new.trials) - len(matched)
    claim = claim_of(_item(old), _item(new), margin_mm, confidence)
    data = claim_of(frames)
    before = looks_before((old.run, new.run), GATE, claim, data)
    found = compare(
        pairs,
        margin_mm=margin_mm,
        confidence=confidence,
        unpaired=only_old,
        again=len(before),
    )
    if damage := new.run.damage or old.run.damage:
        why = f"{NOT_AS_WRITTEN}: {shortened(damage)}"
        gate = Gate(Verdict.INCONCLUSIVE, (why,), found.gate.margin_mm)
        found = replace(found, gate=gate)
    elif found.identical and _item(old) == _item(new):  # the detector itself is the same, too
        found = replace(found, gate=replace(found.gate, verdict=Verdict.MET))
    ids = {id_of(side.run): side.run.folder.resolve().name for side in (old, new)}
    poses, verdicts = {"poses": found.pooled.poses}, {"gate": found.gate.verdict.value}
    look = InterimLook(GATE, claim, data, ids, poses, verdicts, [one.key for one in before])
    return Comparison(old, new, pairs, same, only_old, only_new, found, elsewhere, look)


def _answer(trial: TrialRecord, detector: str) -> list[list[Any]]:
    """What a detector answered, as recorded, without how long it took."""
    tables = ((trial.detections, ("hidden", "outcome")), (trial.found, ANSWERED))
    own = ((row, keys) for rows, keys in tables for row in rows if row["detector"] == detector)
    return [[row[key] for key in keys] for row, keys in own]


def _item(side: Side) -> Any:
    """What of a detector makes it another one."""
    item = side.run.facts.get("items", {}).get(side.detector, {})
    return [side.detector, item.get("version"), item.get("parameters")]


def sides(runs: Sequence[RunRecord], detectors: Sequence[str] = ()) -> Iterator[tuple[Side, Side]]:
    """Which is compared with which, of ``detectors`` if given. Raises ConfigError."""
    first, *others = runs
    if not others:
        names = detectors or first.detectors
        for name in names:
            if name not in first.detectors:
                raise ConfigError.plain(
                    f"{first.folder} has no detector {name!r}{did_you_mean(name, first.detectors)}"
                )
        if len(names) < 2:
            raise ConfigError.plain(
                f"{first.folder} has one detector, {names[0]}: name a second run to compare it with"
            )
        yield from ((Side(first, names[0]), Side(first, name)) for name in names[1:])
    for run in others:
        asked = set(detectors or run.detectors) & set(first.detectors)
        shared = [(name, name) for name in run.detectors if name in asked]
        if not shared and len(first.detectors) == len(run.detectors) == 1 and not detectors:
            shared = [(first.detectors[0], run.detectors[0])]
        if not shared:
            raise _none_shared((first, run), detectors, "both")
        yield from ((Side(first, old), Side(run, new)) for old, new in shared)


def _none_shared(runs: Sequence[RunRecord], detectors: Sequence[str], which: str) -> ConfigError:
    there = "; ".join(f"{run.folder} has {', '.join(run.detectors)}" for run in runs)
    named = " of those named" if detectors else ""
    return ConfigError.plain(f"no detector{named} is in {which} runs: {there}")


def _paired(
    old: Sequence[TrialRecord], new: Sequence[TrialRecord]
) -> tuple[list[tuple[TrialRecord, TrialRecord]], int]:
    """Pairs in the old order; how many shared only a name."""
    by_frames, by_name, ours = _unique(new, _frames), _unique(new, _name), _unique(old, _frames)
    pairs: dict[str, tuple[TrialRecord, TrialRecord]] = {}  # by the new one's id
    elsewhere = 0
    for trial in old:
        key = _frames(trial)
        other = by_frames.get(key) if key and key in ours else None
        if other is None and (other := by_name.get(_name(trial))) and not _same_place(trial, other):
            elsewhere += 1
        elif other is not None:
            pairs.setdefault(other.id, (trial, other))
    return list(pairs.values()), elsewhere


def _same_place(one: TrialRecord, other: TrialRecord) -> bool:
    """Whether the truths of both have the same teats, each end within SAME_PLACE_MM."""
    axes = ("x_mm", "y_mm", "z_mm")
    return len(one.truth) == len(other.truth) and all(
        str(a["teat"]) == str(b["teat"])
        and math.dist([a[axis] for axis in axes], [b[axis] for axis in axes]) <= SAME_PLACE_MM
        for a, b in zip(one.truth, other.truth, strict=True)
    )


def check_limits(old: Side, new: Side) -> None:
    """Raises ConfigError where the limit of the error, or of the time, differs."""
    errors = [{t.scores[side.detector].limit_mm for t in side.trials} for side in (old, new)]
    times = [{stored_rules(side.run.folder).time_limit_s} for side in (old, new)]
    for what, limits in (("mm", errors), ("s", times)):
        if all(limits) and limits[0] != limits[1]:
            note = " and ".join(", ".join(f"{one:g}" for one in sorted(each)) for each in limits)
            raise ConfigError.plain(
                f"{old.label} and {new.label} were held against different limits ({note} {what}):"
                " success would mean two things. Run or score both by the same rules."
            )


def poses_of(run: RunRecord) -> str:
    """What its poses belong to: a script's text, a recording's path; else the run alone."""
    script = run.folder / SCRIPT
    text = hashlib.sha256(script.read_bytes()).hexdigest() if script.is_file() else ""
    return f"{run.facts.get('script') or run.facts.get('about') or run.folder} {text}"


def _unique(
    trials: Sequence[TrialRecord], key: Callable[[TrialRecord], Hashable]
) -> dict[Hashable, TrialRecord]:
    keys = [*map(key, trials)]
    times = Counter(keys)
    return {one: trial for one, trial in zip(keys, trials, strict=True) if times[one] == 1}


def _frames(trial: TrialRecord) -> Hashable:
    return tuple(
        sorted((row["camera"], row["sha256"]) for row in trial.frames if row["camera"] in CAMERAS)
    )


def _name(trial: TrialRecord) -> Hashable:
    """Pose and repeat, or a recording's frame: the trial's name without its number."""
    return trial.id.partition("-")[2]


@dataclass(frozen=True, slots=True)
class PooledRuns:
    """One detector judged on several runs as one: ``looks`` by requirement are those taken before;
    ``scripts`` are named where there are several.
    """

    judgement: Judgement
    looks: Mapping[str, Looks]
    scripts: tuple[str, ...] = ()

    def lines(self) -> Iterator[str]:
        """Its verdict and its sentences; what was pooled, and looked at before."""
        yield f"{self.judgement.detector}, all runs together: {self.judgement.verdict}"
        if self.scripts:
            yield (
                "  OF DIFFERENT SCRIPTS, pooled because it was asked for:"
                f" {'; '.join(self.scripts)}. The figures hold for this mixture of situations only."
            )
        for decision in self.judgement.decisions:
            yield f"  {decision.name}: {decision.verdict}. {decision.sentence}"
        counts = {len(looks.own) + len(looks.pooled) for looks in self.looks.values()}
        if before := max(counts, default=0):
            yield (
                f"  A further look: {before} came before it, each run's own with them. They decide"
                " with what the first left of the chance of a false verdict, and hold all together."
                " Each run's own verdict stands on its own poses."
            )

    def as_dict(self) -> dict[str, Any]:
        """As JSON has it (docs/json.md)."""
        return {
            "detector": self.judgement.detector,
            "verdict": self.judgement.verdict,
            "decisions": [asdict(decision) for decision in self.judgement.decisions],
            "looks": {name: asdict(looks) for name, looks in self.looks.items()},
            "scripts": list(self.scripts),
        }


Together = PooledRuns  # its name in earlier releases, for one more


def judge_folders(
    folders: Sequence[Path],
    detectors: Sequence[str] = (),
    damage: tuple[str, ...] = (),
    *,
    across_scripts: bool = False,
) -> tuple[PooledRuns, ...]:
    """Each detector that all runs have (of those named), judged by the first run's requirements,
    and the look written into the record of each. Raises ConfigError where there is none, where
    limits or, unless asked for, scripts differ, and where a look can't be written.
    """
    runs = [read_run(folder, damage) for folder in folders]
    names = [
        name
        for name in runs[0].detectors
        if all(name in run.detectors for run in runs) and (not detectors or name in detectors)
    ]
    if not names:
        raise _none_shared(runs, detectors, "all")
    rules = stored_rules(runs[0].folder)
    for name in names:
        for other in runs[1:]:
            check_limits(Side(runs[0], name), Side(other, name))
    scripts = tuple(dict.fromkeys(script_of(run) for run in runs))
    if len(scripts) > 1 and not across_scripts:
        raise ConfigError.plain(
            f"these runs are of different scripts ({'; '.join(map(_called, runs))}): a rate over"
            " both is of neither's situations. `across_scripts` pools them all the same, and says"
            " so."
        )
    found = [_together(runs, name, rules) for name in names]
    if not damage:
        write_looks(runs, [look for _, look in found])
    several = tuple(map(_called, runs)) if len(scripts) > 1 else ()
    return tuple(replace(one, scripts=several) for one, _ in found)


def _together(runs: Sequence[RunRecord], name: str, rules: Rules) -> tuple[PooledRuns, InterimLook]:
    """One detector on all runs, and the look that this is."""
    held = [rule for rule in rules.requirements if isinstance(rule, DetectorRequirement)]
    claim = claim_of(_item(Side(runs[0], name)), [rule.model_dump() for rule in held])
    ids = {id_of(run): run.folder.resolve().name for run in runs}
    data = claim_of(sorted(ids))
    before = looks_before(runs, TOGETHER, claim, data)
    within = [look for look in before if look.runs.keys() <= ids.keys()]
    left_out = {run: name for look in before for run, name in look.runs.items() if run not in ids}
    series: list[set[str]] = []  # of runs that looks join
    for look in within:
        joined = [one for one in series if one & look.runs.keys()]
        series = [one for one in series if one not in joined]
        series.append(set(look.runs).union(*joined))
    decisions, looks = [], dict[str, Looks]()
    for rule in held:
        own = tuple(_decided_on([run], name, rule, FIRST).n for run in runs)
        if _decided_on(runs, name, rule, FIRST).n == max(own):
            own = ()  # no pose more than in a run's own look: what all repeats pass, it passed
        looks[rule.name] = Looks(
            planned=rules.looks,
            own=own,
            pooled=tuple(look.poses.get(rule.name, 0) for look in within) if own else (),
            left_out=tuple(sorted(left_out.values())),
            apart=max(1, len(series)),
        )
        decided = beside_tests(_decided_on(runs, name, rule, looks[rule.name]), runs)
        if left_out and decided.verdict in (Verdict.MET, Verdict.NOT_MET):
            why = (
                "An earlier look at some of these runs had also"
                f" {', '.join(looks[rule.name].left_out)}: judge them all, or runs that no look has"
                " seen"
            )
            why = f"{why}. {decided.sentence}"
            decided = replace(decided, verdict=Verdict.INCONCLUSIVE, sentence=why)
        decisions.append(decided)
    judgement = Judgement(name, held_back(decisions, NOT_AS_WRITTEN if runs[0].damage else ""))
    verdicts = {one.name: one.verdict.value for one in decisions}
    poses = {one.name: one.n for one in decisions}
    after = [one.key for one in before]
    look = InterimLook(TOGETHER, claim, data, ids, poses, verdicts, after)
    return PooledRuns(judgement, looks), look


def _decided_on(
    runs: Sequence[RunRecord], name: str, rule: DetectorRequirement, looks: Looks
) -> Decision:
    scores, rows = scored_together(runs, name), []
    for run in runs:
        of = poses_of(run)
        rows += [((of, pose), row) for pose, row in calls_of(run, name)]
    return decide_detector(rule, scores, latency(rows), truth_u_mm(runs, scores, name), looks)


def script_of(run: RunRecord) -> str:
    """What its poses are drawn from: the same for scripts that differ only in seed, names, and how
    many poses they have; of a recording, its situations.
    """
    rules = stored_rules(run.folder)
    if not isinstance(rules, Script):
        return claim_of(sorted({str(trial.head["situation"]) for trial in run.trials}))
    drawn = []
    for trial in rules.trials:
        table = trial.model_dump(mode="json", exclude=_OF_ONE_SCRIPT)
        if table["draw"]:
            del table["draw"]["count"]
        drawn.append(json.dumps(table, sort_keys=True))
    return claim_of(rules.bath.set_point_c, sorted(set(drawn)))


_OF_ONE_SCRIPT = {"name", "member", "set_up", "repeats", "cycles", "published"}


def _called(run: RunRecord) -> str:
    named = run.facts.get("script") or run.facts.get("about") or "no script"
    return f"{run.folder.resolve().name} of {named}"


def verdict_of(found: Sequence[Comparison] | Sequence[PooledRuns]) -> Verdict:
    """The one verdict on all of comparisons (is the new one no worse?) or runs together."""
    if judged := [one.judgement for one in found if isinstance(one, PooledRuns)]:
        return run_verdict(judged)
    return overall(one.compared.gate.verdict for one in found if isinstance(one, Comparison))

"""Runs compared: which detector of which run with which, on which pairs of trials; and several runs
judged as one.

Trials are a pair where their frames are the same bytes, else where pose, repeat and true teat ends
agree. The first run is the old one. Judged as one, counts, errors and times are added, never
averaged; a pose that several runs share is one pose.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from bench.config import ConfigError, did_you_mean
from bench.record.check import NOT_AS_WRITTEN, shortened
from bench.record.reader import RunRecord, TrialRecord, read_run
from bench.record.recording import FILES
from bench.record.schema import SCRIPT
from bench.results.verdicts import (
    DetectorRequirement,
    Judgement,
    calls_of,
    decide_detector,
    held_back,
    latency,
    scored_trials,
    stored_rules,
    truth_u_mm,
)
from bench.scoring.comparison import Compared, Gate, ScenePair, compare
from bench.scoring.decisions import Verdict
from bench.scoring.scene import Pool, pool

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
    """Two sides compared; ``elsewhere`` counts trials of one name whose teats stood at other
    places.
    """

    old: Side
    new: Side
    pairs: tuple[ScenePair, ...]
    same_frames: int
    only_old: int
    only_new: int
    compared: Compared
    elsewhere: int = 0


def scored_together(runs: Sequence[RunRecord], detector: str) -> Pool:
    """The scores of one detector over several runs as one. A pose of one script, or of one
    recording, is the same pose in every run of it; poses of two scripts differ.
    """
    scores, poses = [], []
    for run in runs:
        trials, of = scored_trials(run, detector), poses_of(run)
        scores += [trial.scores[detector] for trial in trials]
        poses += [(of, trial.pose) for trial in trials]
    return pool(scores, poses)


def compare_folders(
    folders: Sequence[Path],
    detectors: Sequence[str] = (),
    *,
    margin_mm: float | None = None,
    confidence: float = 0.95,
    seed: int = 0,
    damage: tuple[str, ...] = (),
) -> tuple[Comparison, ...]:
    """Compare each later run with the first, or the detectors of one run with its first; ``damage``
    is that of their records. Raises ConfigError where nothing can be compared.
    """
    runs = [read_run(folder, damage) for folder in folders]
    return tuple(
        compare_sides(old, new, margin_mm=margin_mm, confidence=confidence, seed=seed)
        for old, new in sides(runs, detectors)
    )


def compare_sides(
    old: Side, new: Side, *, margin_mm: float | None = None, confidence: float = 0.95, seed: int = 0
) -> Comparison:
    """Compare two detectors on their common trials. Raises ConfigError."""
    check_limits(old, new)
    matched, elsewhere = _paired(old.trials, new.trials)
    if not matched:
        moved = f" {elsewhere} have the same name, but their teats stood at other places."
        raise ConfigError.plain(
            f"{old.label} and {new.label} have no scored trial in common."
            f"{moved if elsewhere else ''} Run both on one recording, or one script on one seed."
        )
    pairs = tuple(
        ScenePair(
            a.id, a.pose, str(a.head["situation"]), a.scores[old.detector], b.scores[new.detector]
        )
        for a, b in matched
    )
    same = sum(bool(frames := _frames(a)) and frames == _frames(b) for a, b in matched)
    only_old, only_new = len(old.trials) - len(matched), len(new.trials) - len(matched)
    found = compare(pairs, margin_mm=margin_mm, confidence=confidence, seed=seed, unpaired=only_old)
    if damage := new.run.damage or old.run.damage:
        why = f"{NOT_AS_WRITTEN}: {shortened(damage)}"
        gate = Gate(Verdict.INCONCLUSIVE, (why,), found.gate.margin_mm)
        found = replace(found, gate=gate)
    return Comparison(old, new, pairs, same, only_old, only_new, found, elsewhere)


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
    times = Counter(key(trial) for trial in trials)
    return {key(trial): trial for trial in trials if times[key(trial)] == 1}


def _frames(trial: TrialRecord) -> Hashable:
    return tuple(
        sorted((row["camera"], row["sha256"]) for row in trial.frames if row["camera"] in CAMERAS)
    )


def _name(trial: TrialRecord) -> Hashable:
    """Pose and repeat, or a recording's frame: the trial's name without its number."""
    return trial.id.partition("-")[2]


def judge_folders(
    folders: Sequence[Path], detectors: Sequence[str] = (), damage: tuple[str, ...] = ()
) -> tuple[Judgement, ...]:
    """Each detector that all runs have (of those named), judged by the first run's requirements.
    Raises ConfigError where there is none, or limits differ.
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
    held = [rule for rule in rules.requirements if isinstance(rule, DetectorRequirement)]
    found = []
    for name in names:
        for other in runs[1:]:
            check_limits(Side(runs[0], name), Side(other, name))
        scores, rows = scored_together(runs, name), []
        for run in runs:
            of = poses_of(run)
            rows += [((of, pose), row) for pose, row in calls_of(run, name)]
        u_mm = truth_u_mm(runs, scores, name)
        decisions = (decide_detector(rule, scores, latency(rows), u_mm) for rule in held)
        found.append(Judgement(name, held_back(decisions, runs[0].damage)))
    return tuple(found)


def judgement_lines(judgement: Judgement) -> Iterator[str]:
    """Its verdict and its sentences."""
    yield f"{judgement.detector}, all runs together: {judgement.verdict}"
    for decision in judgement.decisions:
        yield f"  {decision.name}: {decision.verdict}. {decision.sentence}"

"""Runs side by side: which detector of which run is held against which, and which of their trials show the same scene.

Two trials are a pair where their frames are the same files, byte by byte; else where they have the same pose and repeat, as two runs of
one script have, whose noise differs then. The first run is the old one. May not judge: that is `bench.scoring.comparison`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from bench.config import ConfigError, did_you_mean
from bench.record import RunRecord, TrialRecord, read_run
from bench.scoring.comparison import Compared, ScenePair, compare
from bench.scoring.pool import Pool

CAMERAS = frozenset({"left", "right", "thermal", "thermal_radiometric"})  # other pictures are a detector's own


@dataclass(frozen=True, slots=True)
class Side:
    """One detector in one run."""

    run: RunRecord
    detector: str

    @property
    def label(self) -> str:
        """The detector, its version, and its run's folder."""
        version = self.run.facts["items"].get(self.detector, {}).get("version")
        return f"{self.detector}{f' {version}' if version else ''} in {self.run.folder.resolve().name}"

    @property
    def trials(self) -> tuple[TrialRecord, ...]:
        """The trials that count and were scored."""
        return tuple(trial for trial in self.run.counted if self.detector in trial.scores)


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two sides compared. `same_frames` of the pairs were detected in identical frames; `only_old` and `only_new` had no counterpart."""

    old: Side
    new: Side
    pairs: tuple[ScenePair, ...]
    same_frames: int
    only_old: int
    only_new: int
    compared: Compared


def scored_together(runs: Sequence[RunRecord], detector: str) -> Pool:
    """The scores of one detector over several runs as one: counts and errors side by side, so nothing is an average of averages.

    A pose of one script is the same pose in every run of it, and succeeds when it does in all; poses of two scripts differ.
    """
    sides = [Side(run, detector) for run in runs]
    rows = [((str(side.run.facts.get("script", side.run.folder)), trial.pose), trial) for side in sides for trial in side.trials]
    return Pool(tuple(trial.scores[detector] for _, trial in rows), tuple(pose for pose, _ in rows))


def compare_folders(
    folders: Sequence[Path],
    detectors: Sequence[str] = (),
    *,
    margin_mm: float | None = None,
    confidence: float = 0.95,
    seed: int = 0,
) -> tuple[Comparison, ...]:
    """Compare each later run with the first, or the detectors of one run with its first.

    Raises ConfigError where nothing can be compared.
    """
    runs = [read_run(folder) for folder in folders]
    return tuple(compare_sides(old, new, margin_mm=margin_mm, confidence=confidence, seed=seed) for old, new in sides(runs, detectors))


def compare_sides(old: Side, new: Side, *, margin_mm: float | None = None, confidence: float = 0.95, seed: int = 0) -> Comparison:
    """Compare two detectors on the trials that both have. Raises ConfigError where they have none in common."""
    matched = list(_paired(old.trials, new.trials))
    if not matched:
        raise ConfigError.plain(
            f"{old.label} and {new.label} have no scored trial in common. Run both on one recording, or one script on one seed."
        )
    pairs = tuple(ScenePair(a.id, a.pose, str(a.head["situation"]), a.scores[old.detector], b.scores[new.detector]) for a, b, _ in matched)
    only_old, only_new = len(old.trials) - len(matched), len(new.trials) - len(matched)
    found = compare(pairs, margin_mm=margin_mm, confidence=confidence, seed=seed, unpaired=only_old)
    return Comparison(old, new, pairs, sum(same for _, _, same in matched), only_old, only_new, found)


def sides(runs: Sequence[RunRecord], detectors: Sequence[str] = ()) -> Iterator[tuple[Side, Side]]:
    """Who is held against whom; `detectors` restricts to these names. Raises ConfigError where it isn't clear."""
    for run in runs:
        for name in detectors:
            if len(runs) == 1 and name not in run.detectors:
                raise ConfigError.plain(f"{run.folder} has no detector {name!r}{did_you_mean(name, run.detectors)}")
    first, *others = runs
    if not others:
        names = detectors or first.detectors
        if len(names) < 2:
            raise ConfigError.plain(f"{first.folder} has one detector, {names[0]}: name a second run to compare it with")
        yield from ((Side(first, names[0]), Side(first, name)) for name in names[1:])
    for run in others:
        yield from _between(first, run, detectors)


def _between(old: RunRecord, new: RunRecord, detectors: Sequence[str]) -> Iterator[tuple[Side, Side]]:
    shared = [name for name in new.detectors if name in old.detectors and (not detectors or name in detectors)]
    if shared:
        yield from ((Side(old, name), Side(new, name)) for name in shared)
    elif len(old.detectors) == len(new.detectors) == 1 and not detectors:
        yield Side(old, old.detectors[0]), Side(new, new.detectors[0])
    else:
        there = f"{old.folder} has {', '.join(old.detectors)}; {new.folder} has {', '.join(new.detectors)}"
        raise ConfigError.plain(f"no detector{' of those named' if detectors else ''} is in both runs: {there}")


def _paired(old: Sequence[TrialRecord], new: Sequence[TrialRecord]) -> Iterator[tuple[TrialRecord, TrialRecord, bool]]:
    """Trials of one scene, in the old one's order, and whether their frames are identical."""
    by_frames, by_name = _unique(new, _frames), _unique(new, _name)
    ours = Counter(_frames(trial) for trial in old)
    taken: set[str] = set()
    for trial in old:
        key = _frames(trial)
        other = by_frames.get(key) if key and ours[key] == 1 else None
        other = other or by_name.get(_name(trial))
        if other is not None and other.id not in taken:
            taken.add(other.id)
            yield trial, other, bool(key) and _frames(other) == key


def _unique(trials: Sequence[TrialRecord], key: Callable[[TrialRecord], Hashable]) -> dict[Hashable, TrialRecord]:
    times = Counter(key(trial) for trial in trials)
    return {key(trial): trial for trial in trials if times[key(trial)] == 1}


def _frames(trial: TrialRecord) -> Hashable:
    return tuple(sorted((row["camera"], row["sha256"]) for row in trial.frames if row["camera"] in CAMERAS))


def _name(trial: TrialRecord) -> Hashable:
    """Pose and repeat, or a recording's frame: the trial's name without its number."""
    return trial.id.partition("-")[2]

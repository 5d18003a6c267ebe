"""Several runs judged as one: their counts, errors and times side by side, held against the same requirements. No average is averaged.

A pose that several runs share is one pose, with all of them for repeats. What the bench itself has to meet (bath, arm, calibration) holds
for a run, and stands in that run's report.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.comparing.runs import Side, check_limits, poses_of, scored_together
from bench.config import ConfigError, read_config
from bench.detecting.latency import Latency, latency_of
from bench.record import RunRecord, read_run
from bench.script import Rules, Script
from bench.store import RULES, SCRIPT
from bench.verdicts import DetectorRequirement, Judgement, decide_detector, held_back, truth_u_mm


def judge_folders(folders: Sequence[Path], detectors: Sequence[str] = (), damage: tuple[str, ...] = ()) -> tuple[Judgement, ...]:
    """Each detector that all runs have (of those named, if any), judged by the first run's requirements.

    ``damage`` is that of their records. Raises ConfigError where there is none, or where the runs were held against other limits.
    """
    runs = [read_run(folder, damage) for folder in folders]
    names = [name for name in runs[0].detectors if all(name in run.detectors for run in runs) and (not detectors or name in detectors)]
    if not names:
        there = "; ".join(f"{run.folder} has {', '.join(run.detectors)}" for run in runs)
        raise ConfigError.plain(f"no detector{' of those named' if detectors else ''} is in all runs: {there}")
    folder = runs[0].folder
    script = folder / SCRIPT
    rules = read_config(script, Script, stored=True) if script.is_file() else read_config(folder / RULES, Rules, stored=True)
    return tuple(_judged(runs, rules, name) for name in names)


def _judged(runs: Sequence[RunRecord], rules: Rules, detector: str) -> Judgement:
    first, *others = (Side(run, detector) for run in runs)
    for other in others:
        check_limits(first, other)
    scores, timed = scored_together(runs, detector), timed_together(runs, detector)
    u_mm = truth_u_mm(runs, scores, detector)
    held = [rule for rule in rules.requirements if isinstance(rule, DetectorRequirement)]
    return Judgement(detector, held_back((decide_detector(rule, scores, timed, u_mm) for rule in held), first.run.damage))


def timed_together(runs: Sequence[RunRecord], detector: str) -> Latency:
    """The times of one detector over several runs, each with its pose."""
    times = [(poses_of(run), latency_of(run, detector)) for run in runs]
    seconds = tuple(second for _, one in times for second in one.seconds)
    cpu_s = tuple(value for _, one in times for value in one.cpu_s)
    loads = tuple(value for _, one in times for value in one.loads)
    silent: Counter[str] = sum((Counter(one.unanswered) for _, one in times), Counter())
    poses = tuple((names, pose) for names, one in times for pose in one.poses)
    asked = sum(one.asked for _, one in times)
    return Latency(seconds, unanswered=silent, poses=poses, asked=asked, cpu_s=cpu_s, loads=loads)


def told(judgement: Judgement) -> Iterator[str]:
    """Its verdict and its sentences."""
    yield f"{judgement.detector}, all runs together: {judgement.verdict}"
    for decision in judgement.decisions:
        yield f"  {decision.name}: {decision.verdict}. {decision.sentence}"

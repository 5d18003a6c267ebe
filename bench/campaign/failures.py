"""A search in its folder: what was found around members of families, their rates beside it, and
a failure kept as a case of a recording.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import ValidationError

from bench.campaign.chunk import digest_of_frames
from bench.campaign.ledger import Ledger
from bench.campaign.plan import Plan, open_plan
from bench.campaign.search import (
    NothingFitsError,
    Tried,
    distinct,
    evaluate_around,
    family_rate,
    search,
)
from bench.config import ConfigError, read_text, toml_of, writing
from bench.record.recording import RecordingError, RecordingWriter
from bench.results.answers import close_detectors
from bench.rig.loading import find_rig, load_rig
from bench.rig.scenes import draw, warm
from bench.scoring.weighted import WeightedRate
from bench.toml import toml_text
from instruments.world.situations import Around

SEARCH = "search.toml"


@dataclass(frozen=True, slots=True)
class Failure:
    """A failure that is distinct from the others of its member. ``point``: the parameters in shares
    of their ranges, which say what it is; ``values``: in their own units, to be read.
    """

    number: int
    family: str
    member: int
    failure: str
    grade_mm: float
    frames: str
    point: Mapping[str, float]
    values: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Hits:
    """What a search found around one member: no rate."""

    family: str
    member: int
    scenes: int
    failures: int
    distinct: int


@dataclass(slots=True)
class Found:
    """All of a search; ``rates`` by family are of scenes of their own."""

    plan: Plan
    made_by: Mapping[str, str]
    hits: list[Hits]
    failures: list[Failure]
    rates: dict[str, WeightedRate]


class Searching:
    """A search around ``members`` of each family of a plan, its first detector's failures, in
    ``folder``. Raises ConfigError for a folder that has one, and a plan that can't be opened.
    """

    def __init__(self, plan: Plan, folder: Path, members: int) -> None:
        if (folder / SEARCH).exists():
            raise ConfigError.plain(
                f"{folder} has a search already ({SEARCH}): name another --out, or remove it"
            )
        if len(plan.detectors) > 1:
            raise ConfigError.plain(
                f"a search is for one detector, not {len(plan.detectors)}: name one"
            )
        self._job, made_by = open_plan(plan, members)
        self._folder, self._members = folder, members
        self.found = Found(plan, made_by, [], [], {})

    def run(self, rate_scenes: int, report: Callable[[int, int, str], None]) -> Found:
        """Search, then measure the families' rates; ``report`` gets how many scenes are done, of
        how many, and the failures. What was found is written after each member and family.
        """
        plan, found, done = self.found.plan, self.found, 0
        total = len(plan.families) * (self._members * plan.most_scenes + rate_scenes)
        detectors = self._job.make_detectors()
        try:
            bench = self._job.bench(self._job.renderer(), detectors)
            for family in plan.families:
                for member in range(plan.first, plan.first + self._members):
                    around = Around(family, member)
                    tried: list[Tried] = []
                    evaluate = evaluate_around(bench, around)
                    seed, size = bench.seed + member, len(around.parameters)
                    with suppress(NothingFitsError):
                        for one in search(evaluate, size, plan.most_scenes, seed):
                            tried.append(one)
                            known = len(found.failures) + sum(one.failed for one in tried)
                            report(done + len(tried), total, f"failures: {known}")
                    done += plan.most_scenes
                    self._add(around, tried)
            for family in plan.families if rate_scenes else ():
                points = [one.point for one in found.failures if one.family == family]
                for rate in family_rate(bench, family, points, rate_scenes):
                    found.rates[family] = rate
                    report(done + rate.scenes, total, f"{family}: {rate.value:.2%}")
                done += rate_scenes
                write_found(found, self._folder)
        finally:
            close_detectors(detectors)
        return found

    def _add(self, around: Around, tried: list[Tried]) -> None:
        found, kept = self.found, distinct(tried)
        failed = sum(one.failed for one in tried)
        hits = Hits(around.name, around.seed, len(tried), failed, len(kept))
        found.hits.append(hits)
        for one in sorted(kept, key=lambda one: -one.grade_mm):
            shares = dict(zip(around.parameters, one.point.tolist(), strict=True))
            values = {name: what.value for name, what in around.at(shares)[1].items()}
            failure, frames = (one.row.failure, one.row.frames) if one.row else ("", "")
            number = len(found.failures) + 1
            what = (around.name, around.seed, failure, one.grade_mm, frames, shares, values)
            found.failures.append(Failure(number, *what))
        write_found(found, self._folder)


def write_found(found: Found, folder: Path) -> None:
    """Write `SEARCH` in ``folder``. Raises ConfigError where it can't be written."""
    plan = found.plan.model_dump(mode="json", exclude={"made_by"}, exclude_none=True)
    table = {
        "plan": {key: value for key, value in plan.items() if value != {}},
        "made_by": dict(found.made_by),
        "hits": [asdict(one) for one in found.hits],
        "rates": [{"family": family, **asdict(rate)} for family, rate in found.rates.items()],
        "failures": [asdict(one) for one in found.failures],
    }
    heading = (
        "A search of teatbench. [[hits]] are what it found, which is no rate; [[rates]] are of\n"
        "scenes of their own. Of [[failures]], worst first in each member, point says what it is in"
        " shares of the\nparameters' ranges; values are the parameters in their own units."
    )
    with writing(folder):
        Ledger(folder).write(SEARCH, toml_text(table, heading).encode("utf-8"))


def read_failures(folder: Path) -> tuple[Plan, dict[int, Failure]]:
    """The plan of a search and its failures by number. Raises ConfigError."""
    path = folder / SEARCH
    if not path.exists():
        raise ConfigError.plain(
            f"{folder}: no search is there; name the folder that 'teatbench campaign search --out'"
            " was given"
        )
    try:
        Ledger(folder).checked_bytes(SEARCH)
        table = toml_of(path)
        failures = [Failure(**one) for one in table.get("failures", ())]
        return Plan.model_validate(table["plan"]), {one.number: one for one in failures}
    except (KeyError, TypeError, ValidationError) as error:
        raise ConfigError.plain(f"{path}: is not as the search wrote it: {error}") from error


def keep(folder: Path, number: int, recording: Path, name: str | None = None) -> str:
    """Add a failure of a search to a recording; gives back the frame's name. Raises ConfigError."""
    plan, failures = read_failures(folder)
    if (one := failures.get(number)) is None:
        known = f"1 to {len(failures)}" if failures else "none"
        raise ConfigError.plain(f"{folder}: there is no failure {number} (there: {known})")
    frame = name or f"{one.family}-{one.member:04d}-{number}"
    job, _ = open_plan(plan)
    rig = load_rig(find_rig(plan.rig))
    stated = read_text(Path(plan.calibration) if plan.calibration else rig.calibration_path)
    there = recording / "calibration.toml"
    if there.exists() and read_text(there) != stated:
        raise ConfigError.plain(
            f"{recording} has another calibration than {folder}: name another --into"
        )
    bench = job.bench(job.renderer(), [])
    around = Around(one.family, one.member)
    try:
        found, _ = around.at(one.point)
    except ValueError as error:
        raise ConfigError.plain(f"{folder}: failure {number}: {error}") from error
    shot = (
        draw(bench.renderer, one.family, warm(found), [bench.seed, one.member]) if found else None
    )
    if shot is None or digest_of_frames(shot.frames) != one.frames:
        raise ConfigError.plain(
            f"{folder}: this version of the program draws failure {number} differently: search"
            " again"
        )
    new = not recording.exists()
    try:
        with writing(recording):
            writer = RecordingWriter(recording)
            writer.add(frame, shot.frames)
            writer.add_calibration(stated)
            writer.add_truth(frame, shot.truth)
    except RecordingError as error:
        if new:
            shutil.rmtree(recording)
        raise ConfigError.plain(f"{error}; give another --name") from error
    return frame

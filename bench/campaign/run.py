"""A campaign in its folder: begun, gone on with, ended; and what came of it so far.

`plan.toml` says what was asked and what made the rows, `shards/` holds them. A campaign that
stopped goes on where it was: what is done is what the folder holds.
"""

from __future__ import annotations

import hashlib
import uuid
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

from filelock import FileLock, Timeout

from bench.campaign.chunk import ASIDE, ChunkRows, SceneId
from bench.campaign.ledger import LEDGER, Ledger
from bench.campaign.ledger import LOCK as LEDGER_LOCK
from bench.campaign.plan import (
    CampaignPlan,
    Chunk,
    Job,
    differences,
    open_plan,
    plan_text,
    read_plan,
)
from bench.campaign.pool import LocalPool, Say
from bench.campaign.shards import SHARDS, Shards, no_campaign
from bench.config import ConfigError, writing
from bench.files import write_synced
from bench.scoring.rates import Rate
from bench.scoring.sequential import tight_enough
from bench.workers import processors
from textfiles.text import range_text
from textfiles.whole import new_folders, refusal, refuse_no_name, remove_empty, take_place

PLAN, LOCK = "plan.toml", "campaign.lock"


def plan_of(folder: Path) -> CampaignPlan:
    """The plan of the campaign in ``folder``. Raises ConfigError where there is none."""
    if not (folder / PLAN).is_file():
        raise no_campaign(folder)
    Ledger(folder).checked_bytes(PLAN)
    return read_plan(folder / PLAN)


class Executor(Protocol):
    """Works on chunks, in whatever order; asks for one when there is room."""

    def results(self, chunks: Iterator[Chunk]) -> Iterator[tuple[Chunk, ChunkRows]]: ...


@contextmanager
def executor(job: Job, workers: int | None, dask: str | None, say: Say) -> Iterator[Executor]:
    """Processes of this machine, all its processors for None, or a cluster. Raises ConfigError."""
    if dask is None:
        with closing(LocalPool(job, workers or processors(), say=say)) as pool:
            yield pool
        return
    try:
        from bench.campaign.dask_cluster import DaskPool
    except ImportError as error:
        raise ConfigError.plain(
            f"`dask` needs another package: pip install 'teatbench[campaign]' ({error})"
        ) from error
    with closing(DaskPool(job, dask, say=say)) as cluster:
        yield cluster


@dataclass(frozen=True, slots=True)
class CampaignStatus:
    """How far a campaign is. ``failures``: by detector, of the scenes that are done."""

    done: int
    planned: int
    failures: Mapping[str, int]
    aside: int


@dataclass(slots=True)
class _Family:
    """A family's chunks with failures and scenes by detector; none is needed from ``stopped``."""

    stopped: int
    chunks: dict[int, dict[str, Rate]] = field(default_factory=dict)
    looked_at: int = 0  # chunks from the first on, without a gap
    sums: dict[str, Rate] = field(default_factory=dict)  # of those
    whole: dict[str, Rate] = field(default_factory=dict)
    done: int = 0

    def add(self, number: int, rates: Mapping[str, Rate], scenes: int) -> None:
        self.chunks[number] = dict(rates)
        _add(self.whole, rates)
        self.done += scenes

    @property
    def aside(self) -> int:
        return self.done - min((rate.trials for rate in self.whole.values()), default=0)


def _add(sums: dict[str, Rate], rates: Mapping[str, Rate]) -> None:
    for detector, rate in rates.items():
        sums[detector] = sums.get(detector, Rate()) + rate


class Campaign:
    """A campaign in ``folder``, new or continued. Raises ConfigError for another one's rows."""

    def __init__(self, plan: CampaignPlan, folder: Path) -> None:
        self.plan, self.folder = plan, folder
        self.job, self.made_by = open_plan(plan)
        self.shards = Shards(folder)
        path = folder / PLAN
        self._text = plan_text(plan, self.made_by).encode("utf-8")
        if path.exists() and not self._restorable():
            kept = read_plan(path)
            if not kept.made_by:
                raise ConfigError.plain(
                    f"{path} was written by a person, not by a campaign: give the campaign a folder"
                    " of its own as `out`"
                )
            if lines := differences(kept, kept.made_by, plan, self.made_by):
                raise ConfigError.plain(
                    f"{folder} holds a campaign of another kind, whose rows don't go with these:\n"
                    f"{lines}\nName another `out`, or go back to what made it."
                )
            self.shards.ledger.checked_bytes(PLAN)
        elif (folder / SHARDS).exists() and not self._restorable():
            raise ConfigError.plain(f"{folder} has {SHARDS} but no {PLAN}; name another `out`")

    def _restorable(self) -> bool:
        """Whether the folder's plan was this one, whatever has become of its file."""
        digest = self.shards.ledger.state().get(PLAN)
        return digest == hashlib.sha256(self._text).hexdigest()

    def begin(self) -> None:
        """Write the plan, where it isn't there. Raises ConfigError where it can't be written."""
        with writing(self.folder), new_folders(self.folder / SHARDS):
            path = self.folder / PLAN
            if not path.exists() or (self._restorable() and path.read_bytes() != self._text):
                self.shards.ledger.add(PLAN, self._text)
                # a job array's first jobs may all be here at once, with the same text
                new = self.folder / f"plan-{uuid.uuid4().hex}"
                write_synced(new, self._text)
                take_place(new, path)

    def run(
        self,
        executor: Executor,
        report: Callable[[CampaignStatus], None],
        say: Callable[[str], None] = lambda _: None,
    ) -> CampaignStatus:
        """Do what is not done, or is damaged; ``report`` gets the progress after each chunk."""
        if damage := self.shards.remove_damaged():
            how = f"damaged ({damage})"
            if damage == replace(damage, changed=(), unknown=()):
                # their lines in the ledger came first
                how = f"{damage} (no room for them, killed as they were written, or deleted)"
            say(f"{self.folder}: rows are {how}; these chunks are done again")
        families = self._known()
        done = self.shards.done()
        report(self._status(families))

        def wanted() -> Iterator[Chunk]:
            for chunk in self.plan.chunks():
                key = (chunk.family, chunk.number)
                if key not in done and chunk.number < families[chunk.family].stopped:
                    yield chunk

        for chunk, rows in executor.results(wanted()):
            family = families[chunk.family]
            if chunk.number < family.stopped:
                self.shards.write(chunk.family, chunk.number, rows)
                rates: dict[str, Rate] = {}
                for row in rows.scenes:
                    right, counts = row.failure == "", row.failure != ASIDE
                    _add(rates, {row.detector: Rate(int(right), int(counts))})
                family.add(chunk.number, rates, len(chunk.members))
                self._look(chunk.family, family)
                report(self._status(families))
        self.shards.merge()
        return self._status(families)

    def do_chunk(self, number: int, executor: Executor) -> ChunkRows | None:
        """The rows of one chunk, written; None where it was done before."""
        chunk = self.plan.chunk(number)
        self.shards.remove_damaged(f"{chunk.family}-{chunk.number:06d}.")
        if (chunk.family, chunk.number) in self.shards.done():
            return None
        ((one, rows),) = executor.results(iter([chunk]))
        self.shards.write(one.family, one.number, rows)
        return rows

    def _known(self) -> dict[str, _Family]:
        """What the folder holds."""
        most = self.plan.chunks_a_family
        families = {name: _Family(most) for name in self.plan.families}
        with self.shards.connect() as db:
            found = db.execute(
                "SELECT family, (member - ?) // ? AS chunk, detector,"
                " count(*) FILTER (failure NOT IN ('', ?)), count(*) FILTER (failure != ?)"
                " FROM scenes GROUP BY ALL",
                [self.plan.first, self.plan.chunk_scenes, ASIDE, ASIDE],
            ).fetchall()
        chunks: dict[tuple[str, int], dict[str, Rate]] = defaultdict(dict)
        for name, number, detector, failures, scenes in found:
            chunks[name, number][detector] = Rate(scenes - failures, scenes)
        for (name, number), rates in chunks.items():
            families[name].add(number, rates, self.plan.scenes_of(number))
        for name, family in families.items():
            self._look(name, family)
        return families

    def _look(self, name: str, family: _Family) -> None:
        """Count chunks in order until the interval is tight enough, whichever ended first."""
        width = self.plan.half_width
        while family.looked_at in family.chunks and family.looked_at < family.stopped:
            _add(family.sums, family.chunks[family.looked_at])
            family.looked_at += 1
            if width is not None and all(
                tight_enough(rate.failures, rate.trials, width) for rate in family.sums.values()
            ):
                family.stopped = family.looked_at
                beyond = [
                    one
                    for one in self.shards.files()
                    if one.family == name and one.first >= family.stopped
                ]
                self.shards.remove(beyond)
                family.whole = dict(family.sums)
                family.done = sum(map(self.plan.scenes_of, range(family.stopped)))

    def _status(self, families: Mapping[str, _Family]) -> CampaignStatus:
        failures: dict[str, int] = defaultdict(int)
        done = planned = aside = 0
        for family in families.values():
            planned += min(family.stopped * self.plan.chunk_scenes, self.plan.most_scenes)
            done += family.done
            aside += family.aside
            for detector, rate in family.whole.items():
                failures[detector] += rate.failures
        return CampaignStatus(done, planned, failures, aside)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other campaign commands off the folder; of a new one without a plan at the end nothing
    stays. Raises ConfigError where one has it.
    """
    new = [one for one in (folder, *folder.parents) if not one.exists()]
    try:
        refuse_no_name(folder)
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        remove_empty(new)
        why = "a file of this name is there" if folder.is_file() else refusal(error)
        raise ConfigError.plain(f"`out` {folder}: no folder can be made: {why}") from error
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ConfigError.plain(
            f"{folder}: another 'teatbench campaign run' works in this folder; wait for its end"
        ) from None
    try:
        yield
    finally:
        lock.release()
        if new and not (folder / PLAN).exists():
            for name in (LOCK, LEDGER, LEDGER_LOCK):
                (folder / name).unlink(missing_ok=True)
            remove_empty(new)


def run_chunk(
    plan: CampaignPlan, number: int, out: Path | str, *, say: Say = lambda _: None
) -> dict[str, str] | None:
    """Do chunk ``number``, from 0, of a campaign in ``out``, as a batch system gives them out:
    `teatbench campaign chunk`; `run_campaign` then has what is left. The scenes set aside, each
    with the reason; None where it was done before. Raises ConfigError, PoolError.
    """
    if not 0 <= number < plan.chunk_count:
        there = range_text(0, plan.chunk_count - 1)
        raise ConfigError.plain(f"there is no chunk {number}; there is: {there}")
    campaign = Campaign(plan, Path(out))
    campaign.begin()
    with executor(campaign.job, 1, None, say) as made:
        rows = campaign.do_chunk(number, made)
    if rows is None:
        return None
    return {
        SceneId(row.family, row.member).name: one.reason or ""
        for row, one in zip(rows.scenes, rows.taken, strict=True)
        if row.failure == ASIDE
    }

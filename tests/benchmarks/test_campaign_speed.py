"""A campaign of two workers against one of one. `pytest tests/benchmarks --benchmark-only`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from pytest_benchmark.fixture import BenchmarkFixture

from bench.campaign.chunk import ChunkRows
from bench.campaign.plan import CampaignPlan, Chunk
from bench.campaign.pool import LocalPool
from bench.campaign.run import Campaign
from tests.benchmarks.figures import figure

WORKERS = 2
SCENES = 100  # of each of two families


class Counted:
    """A pool whose chunks' seconds are added up, of processors and real ones."""

    def __init__(self, inner: LocalPool) -> None:
        self._inner, self.cpu_s, self.busy_s = inner, 0.0, 0.0

    def results(self, chunks: Iterator[Chunk]) -> Iterator[tuple[Chunk, ChunkRows]]:
        for chunk, rows in self._inner.results(chunks):
            self.cpu_s += rows.cpu_s
            self.busy_s += rows.seconds
            yield chunk, rows


def test_two_workers_against_one(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    """Two minutes on two idle processors, shared with nothing. Start and end weigh the same however
    many scenes there are; so the efficiency of 20 000 follows from the parts.
    """
    walls: list[float] = []
    pools: list[Counted] = []

    def work(workers: int) -> None:
        campaign = Campaign(
            CampaignPlan(families=("ideal", "cluttered"), scenes=SCENES), tmp_path / f"{workers}"
        )
        campaign.begin()
        begun_s = time.perf_counter()
        with closing(LocalPool(campaign.job, workers, say=print)) as pool:
            pools.append(Counted(pool))
            campaign.run(pools[-1], lambda _: None)
        walls.append(time.perf_counter() - begun_s)

    work(1)
    benchmark.pedantic(work, args=(WORKERS,), rounds=1)
    (one_s, all_s), (one, every) = walls, pools
    outside_s = all_s - every.busy_s / WORKERS  # of a worker: start, end, waiting for its next
    slower = every.cpu_s / one.cpu_s
    figure(benchmark, "one worker, s", one_s, "none")
    figure(benchmark, f"{WORKERS} workers, s", all_s, "none")
    figure(benchmark, "wall efficiency, %", 100.0 * one_s / all_s / WORKERS, "at least 95")
    figure(benchmark, "CPU s of the same scenes, to one worker's", slower, "at most 1.05")
    figure(benchmark, "a worker outside of scenes, s", outside_s, "none; once a campaign")
    shared = 100.0 * (1.0 - every.cpu_s / every.busy_s)
    figure(benchmark, "waiting for a processor, % of scenes' time", shared, "0 on an idle machine")
    scene_s = one.cpu_s / (2 * SCENES)
    for label, scenes in (("200", 200), ("20 000", 20_000)):
        ideal_s = scenes * scene_s / WORKERS
        share = 100.0 * ideal_s / (ideal_s * slower + outside_s)
        figure(
            benchmark, f"efficiency of {label} such scenes, from the parts, %", share, "at least 95"
        )

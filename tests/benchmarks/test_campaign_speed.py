"""What a campaign takes beside its chunks, in seconds of processors: they don't depend on what else
the machine does. `pytest tests/benchmarks --benchmark-only`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from multiprocessing import get_context
from pathlib import Path

import cv2
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bench.campaign.chunk import Rows, run_scene
from bench.campaign.plan import CampaignPlan, Chunk, Job
from bench.campaign.pool import LocalPool
from bench.campaign.run import Campaign
from bench.campaign.worker import ONE_THREAD
from tests.benchmarks.figures import figure

WORKERS = 2
SCENES = 100  # of each of two families


class Counted:
    """A pool whose chunks' seconds are added up, of processors and real ones."""

    def __init__(self, inner: LocalPool) -> None:
        self._inner, self.cpu_s, self.busy_s = inner, 0.0, 0.0

    def results(self, chunks: Iterator[Chunk]) -> Iterator[tuple[Chunk, Rows]]:
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


def plain_loop(job: Job, chunks: Sequence[Chunk]) -> float:
    """CPU seconds of the chunks, one after the other, in this process."""
    cv2.setNumThreads(1)
    bench = job.bench(job.renderer(), job.make_detectors())
    return sum(run_scene(bench, scene).cpu_s for chunk in chunks for scene in chunk.scenes)


@pytest.mark.skipif(sys.platform == "win32", reason="counts the time of children")
def test_what_a_campaign_takes_beside_its_chunks(
    benchmark: BenchmarkFixture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import resource

    def children_s() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    campaign = Campaign(CampaignPlan(families=("ideal", "overlapping"), scenes=SCENES), tmp_path)
    campaign.begin()
    plan, job = campaign.plan, campaign.job
    parent_s, workers_s = -time.process_time(), -children_s()

    def work() -> float:
        with closing(LocalPool(job, 1, say=print)) as pool:
            counted = Counted(pool)
            campaign.run(counted, lambda _: None)
        return counted.cpu_s

    chunks_s = float(benchmark.pedantic(work, rounds=1))
    parent_s, workers_s = parent_s + time.process_time(), workers_s + children_s()
    # numeric libraries read their number of threads when they are loaded: in a new process
    for name, value in ONE_THREAD.items():
        monkeypatch.setenv(name, value)
    with ProcessPoolExecutor(1, get_context("spawn")) as alone:
        plain_s = alone.submit(plain_loop, job, tuple(plan.chunks())).result()
    start_s = workers_s - chunks_s
    share = 100.0 * parent_s / chunks_s
    figure(benchmark, "a chunk, CPU s", chunks_s / plan.chunk_count, "5 to 30")
    figure(benchmark, "parent, % of the chunks", share, "at most 3")
    figure(
        benchmark, "chunks in a worker against the plain loop", chunks_s / plain_s, "at most 1.03"
    )
    figure(benchmark, "a worker outside of chunks (start), CPU s", start_s, "none; once a worker")
    longer = 100.0 * (parent_s * 10 + start_s) / (10.0 * plain_s)
    figure(benchmark, "all overhead of ten times as many scenes, %", longer, "at most 3")

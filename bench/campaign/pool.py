"""Processes of this machine that work on scenes. One that ends or is silent too long is replaced,
and its scene is tried again. A scene at which two processes ended is tried alone in a new process;
where that ends too, the scene is set aside.

The standard library's pools can't do this: one lost process breaks a `ProcessPoolExecutor`, and
`multiprocessing.Pool` waits without end for the work of a killed one.
"""

from __future__ import annotations

import queue
import statistics
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Any

from bench.campaign.chunk import ChunkRows, SceneId, set_aside
from bench.campaign.plan import CampaignPlan, Chunk, Job
from bench.campaign.worker import ONE_THREAD
from bench.workers import WorkerProcess
from instruments.clock import stopwatch_s

AHEAD = 2  # scenes given to a process, so that it never waits for the next
DEATHS = 3  # of processes at one scene, the last of them alone
START_DEATHS = 3  # of workers one after the other that never began, where none ever did
MORE_START_DEATHS = 30  # where one did: a machine that is short of memory for a while
USUAL_TIMES = 10  # a worker may be silent for so many usual chunk times
LEAST_LIMIT_S = 60.0  # of silence
FIRST_LIMIT_S = 600.0  # of silence, while no chunk time is known
START_LIMIT_S = 120.0  # until a worker is ready, which takes 2 s on an idle machine
TIMES_KEPT = 400  # times that are kept
LOOK_S = 0.5  # between two looks whether one is silent for too long
Say = Callable[[str], None]


class PoolError(Exception):
    """No worker can be started; the message says why."""


def silence_limit_s(plan: CampaignPlan, chunk_s: Sequence[float]) -> float:
    """The plan's ``chunk_limit_s``; where that is 0, ten times what a chunk took."""
    if plan.chunk_limit_s or not chunk_s:
        return plan.chunk_limit_s or FIRST_LIMIT_S
    return max(LEAST_LIMIT_S, USUAL_TIMES * statistics.median(chunk_s))


class _Worker(WorkerProcess):
    """A process, and the scenes that it was given."""

    def __init__(
        self, job: Job, number: int, messages: queue.SimpleQueue[tuple[_Worker, Any]]
    ) -> None:
        self.number = number
        self.scenes: deque[SceneId] = deque()
        self.ready = False
        self.last_message_s = stopwatch_s()
        super().__init__(
            "bench.campaign.worker", lambda value: messages.put((self, value)), ONE_THREAD
        )
        self.ask(job)

    def give(self, scene: SceneId) -> None:
        if not self.scenes:
            self.last_message_s = stopwatch_s()
        self.scenes.append(scene)
        self.ask(scene)  # a few bytes: a stopped one's pipe doesn't fill up


class LocalPool:
    """``workers`` processes, until it is closed. ``say`` gets a sentence for whatever went wrong.
    A worker that is silent for longer than `silence_limit_s` is killed.
    """

    def __init__(self, job: Job, workers: int, *, say: Say) -> None:
        self.say = say
        self._job, self._count = job, workers
        self._messages: queue.SimpleQueue[tuple[_Worker, Any]] = queue.SimpleQueue()
        self._workers: list[_Worker] = []
        self._scenes: deque[SceneId] = deque()  # given to no process yet
        self._open: dict[Chunk, dict[SceneId, ChunkRows]] = {}
        self._deaths: Counter[SceneId] = Counter()
        self._chunk_s: deque[float] = deque(maxlen=TIMES_KEPT)  # by each scene
        self._starts_failed = self._started = 0
        self._began = False

    def close(self) -> None:
        """End the processes; once more is no error."""
        for worker in self._workers:
            if worker.scenes:
                worker.kill("no longer needed")
            else:
                worker.ask(None)
        for worker in self._workers:
            worker.end()
        self._workers.clear()

    @property
    def pids(self) -> list[int]:
        """The numbers of the processes."""
        return [worker.process.pid for worker in self._workers]

    def results(self, chunks: Iterator[Chunk]) -> Iterator[tuple[Chunk, ChunkRows]]:
        """The rows of each chunk, as they are done. Raises PoolError where no worker starts."""
        while True:
            self._fill(chunks)
            if not self._open:
                return
            with suppress(queue.Empty):
                self._take(*self._messages.get(timeout=LOOK_S))
            for chunk in [one for one, rows in self._open.items() if len(rows) == len(one.members)]:
                done = self._open.pop(chunk)
                yield chunk, sum((done[scene] for scene in chunk.scenes), ChunkRows())
            self._kill_silent()

    def _fill(self, chunks: Iterator[Chunk]) -> None:
        """Give each process its next scenes; what is tried alone goes to a new process."""
        for load in range(AHEAD):
            for place in range(self._count):
                if not self._scenes and (chunk := next(chunks, None)):
                    self._open[chunk] = {}
                    self._scenes.extend(chunk.scenes)
                new = place >= len(self._workers)
                given = () if new else self._workers[place].scenes
                if len(given) > load or any(map(self._alone, given)):
                    continue
                fitting = (scene for scene in self._scenes if new or not self._alone(scene))
                scene = next(fitting, None)
                if scene is None:
                    continue
                self._scenes.remove(scene)
                if new:
                    self._started += 1
                    self._workers.append(_Worker(self._job, self._started, self._messages))
                self._workers[-1 if new else place].give(scene)

    def _alone(self, scene: SceneId) -> bool:
        return self._deaths[scene] == DEATHS - 1

    def _take(self, worker: _Worker, value: object) -> None:
        """Its message: it is ready, has the rows of a scene, or has ended."""
        if value is None:
            self._replace(worker)
            return
        now_s = stopwatch_s()
        if isinstance(value, ChunkRows):
            self._store(worker.scenes.popleft(), value)
            self._chunk_s.append((now_s - worker.last_message_s) * self._job.plan.chunk_scenes)
        else:
            worker.ready = self._began = True
            self._starts_failed = 0
        worker.last_message_s = now_s

    def _store(self, scene: SceneId, rows: ChunkRows) -> None:
        (chunk,) = (
            one for one in self._open if one.family == scene.family and scene.member in one.members
        )
        self._open[chunk][scene] = rows

    def _replace(self, worker: _Worker) -> None:
        """Put the work of one that ended back, or set its scene aside."""
        self._workers.remove(worker)
        how = worker.end()
        self._scenes.extendleft(reversed(worker.scenes))
        if not worker.ready:
            self._starts_failed += 1
            self.say(f"worker {worker.number} {how} before it was ready")
            if self._starts_failed >= (MORE_START_DEATHS if self._began else START_DEATHS):
                raise PoolError(
                    f"{self._starts_failed} workers one after the other {how} before they were"
                    " ready. Is there memory for them? 'python -m bench.campaign.worker' shows an"
                    " error of the installation."
                )
        elif worker.scenes:
            scene = worker.scenes[0]
            self._deaths[scene] += 1
            text = f"worker {worker.number} {how} at scene {scene.name}"
            if self._deaths[scene] < DEATHS:
                apart = " alone, in a new process" if self._alone(scene) else ""
                self.say(f"{text}; the scene is tried again{apart}")
                return
            self.say(f"{text}, alone: the scene is set aside")
            why = f"its process {how}, {DEATHS} times, at last with this scene alone"
            self._scenes.remove(scene)
            self._store(scene, set_aside(scene, self._job.detector_names, why))

    def _kill_silent(self) -> None:
        if not self._messages.empty():  # came while rows were written; taken first
            return
        now_s = stopwatch_s()
        usual_s = silence_limit_s(self._job.plan, self._chunk_s)
        for worker in self._workers:
            limit_s = usual_s if worker.ready else START_LIMIT_S
            if worker.scenes and not worker.killed and now_s - worker.last_message_s > limit_s:
                worker.kill(f"gave no sign of life for {limit_s:.0f} s and was killed")

"""Processes of this machine that work on chunks. One that ends or is silent for too long is
replaced, and its chunk continues at that scene. A scene at which two processes ended is tried alone
in a new process; where that ends too, the scene is set aside.

The standard library's pools can't do this: one lost process breaks a `ProcessPoolExecutor`, and
`multiprocessing.Pool` waits without end for the work of a killed one.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import statistics
import subprocess
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import IO, Any, cast

from bench.campaign.chunk import Rows, Scene, set_aside
from bench.campaign.plan import Chunk, Job, Plan
from bench.campaign.worker import ONE_THREAD
from instruments.clock import stopwatch_s

AHEAD = 2  # chunks in flight a worker, so that none waits for its next
LEAST_SCENES = 2  # in one piece of the last chunks
DEATHS = 2  # on one scene, until it is tried alone
START_DEATHS = 3  # of workers one after the other that never began, where none ever did
MORE_START_DEATHS = 30  # where one did: a machine that is short of memory for a while
USUAL_TIMES = 10  # a worker may take so many usual chunk times without a word
LEAST_LIMIT_S, FIRST_LIMIT_S = 60.0, 600.0  # of silence: at least, and while nothing is known
START_LIMIT_S = 120.0  # until a worker is ready, which takes 2 s on an idle machine
REMEMBERED = 400  # times that are kept
CLOSING_S = 5.0
LOOK_S = 0.5  # between two looks whether one is silent for too long
Say = Callable[[str], None]


class PoolError(Exception):
    """No worker can be started; the message says why."""


def silence_limit_s(plan: Plan, chunk_s: Sequence[float]) -> float:
    """The plan's ``chunk_limit_s``; where that is 0, ten times what a chunk took."""
    if plan.chunk_limit_s:
        return plan.chunk_limit_s
    if not chunk_s:
        return FIRST_LIMIT_S
    return max(LEAST_LIMIT_S, USUAL_TIMES * statistics.median(chunk_s))


@dataclass(slots=True, eq=False)
class Whole:
    """A chunk, and the rows of those of its scenes that are done, in pieces."""

    chunk: Chunk
    done: list[Rows] = field(default_factory=list)

    @property
    def rows(self) -> Rows | None:
        """Of all its scenes, in their order; None while one is missing."""
        scenes = {(row.family, row.member) for piece in self.done for row in piece.scenes}
        if len(scenes) < len(self.chunk.members):
            return None
        return sum(sorted(self.done, key=lambda rows: rows.scenes[0].member), Rows())


@dataclass(slots=True, eq=False)
class _Part:
    """What is left of a chunk, or of a piece of it; ``alone``: its next scene is tried alone."""

    whole: Whole
    left: range
    alone: bool = False

    @property
    def scene(self) -> Scene:
        """The one that is next."""
        return Scene(self.whole.chunk.family, self.left[0])


class _Worker:
    """A process, and a thread that passes on its messages; ``None`` is its end."""

    def __init__(
        self, job: Job, number: int, messages: queue.SimpleQueue[tuple[_Worker, Any]]
    ) -> None:
        self.number = number
        self.parts: deque[_Part] = deque()
        self.ready, self.killed = False, ""
        self.last_message_s = stopwatch_s()
        self._messages = messages
        self._process = subprocess.Popen(
            [sys.executable, "-m", "bench.campaign.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **ONE_THREAD},
        )
        self._requests = cast(IO[bytes], self._process.stdin)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        self.ask(job)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def busy_alone(self) -> bool:
        """It works on a scene that is tried alone."""
        return any(part.alone for part in self.parts)

    def give(self, part: _Part) -> None:
        if not self.parts:
            self.last_message_s = stopwatch_s()
        self.parts.append(part)
        # a few bytes however large the chunk is: a stopped one's pipe doesn't fill up
        self.ask(replace(part.whole.chunk, members=part.left[:1] if part.alone else part.left))

    def ask(self, value: object) -> None:
        with suppress(OSError):  # its end is a message of its own
            pickle.dump(value, self._requests)
            self._requests.flush()

    def kill(self, why: str) -> None:
        self.killed = self.killed or why
        self._process.kill()

    def end(self) -> str:
        """Wait for its end; gives back how it ended."""
        with suppress(OSError):
            self._requests.close()
        try:
            code = self._process.wait(CLOSING_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            code = self._process.wait()
        self._thread.join()
        if self.killed:
            return self.killed
        if code < 0:
            with suppress(ValueError):
                return f"ended by {signal.Signals(-code).name}"
        return f"ended with code {code}"

    def _listen(self) -> None:
        with cast(IO[bytes], self._process.stdout) as source:
            while True:
                try:
                    value = pickle.load(source)  # noqa: S301 - of a process that we started
                except Exception:  # cut off at its end, or damaged
                    break
                self._messages.put((self, value))
        self._messages.put((self, None))


class LocalPool:
    """``workers`` processes, until it is closed. ``say`` gets a sentence for whatever went wrong.
    A worker that is silent for longer than `silence_limit_s` is killed.
    """

    def __init__(self, job: Job, workers: int, *, say: Say) -> None:
        self.say = say
        self._job, self._count = job, workers
        self._messages: queue.SimpleQueue[tuple[_Worker, Any]] = queue.SimpleQueue()
        self._workers: list[_Worker] = []
        self._again: deque[_Part] = deque()
        self._waiting: deque[_Part] = deque()  # a chunk a worker, so that the end is seen before
        self._ending = False  # no more chunks come
        self._deaths: Counter[Scene] = Counter()
        self._chunk_s: deque[float] = deque(maxlen=REMEMBERED)  # by each scene
        self._starts_failed = self._started = 0
        self._began = False

    def close(self) -> None:
        """End the processes; once more is no error."""
        for worker in self._workers:
            if worker.parts:
                worker.kill("no longer needed")
            else:
                worker.ask(None)
        for worker in self._workers:
            worker.end()
        self._workers.clear()

    @property
    def pids(self) -> list[int]:
        """The processes, for who watches them."""
        return [worker.pid for worker in self._workers]

    def results(self, chunks: Iterator[Chunk]) -> Iterator[tuple[Chunk, Rows]]:
        """The rows of each chunk, as they are done. Raises PoolError where no worker starts."""
        self._ending = False
        while True:
            self._fill(chunks)
            if not any(worker.parts for worker in self._workers) and not self._again:
                return
            try:
                worker, value = self._messages.get(timeout=LOOK_S)
            except queue.Empty:
                self._kill_silent()
                continue
            if value is None:
                part = self._replace(worker)
            elif isinstance(value, Rows):
                part = self._take(worker, value)
            else:
                worker.ready = self._began = True
                self._starts_failed, part = 0, None
                worker.last_message_s = stopwatch_s()
            if part and (rows := part.whole.rows):
                yield part.whole.chunk, rows
            self._kill_silent()

    def _fill(self, chunks: Iterator[Chunk]) -> None:
        for load in range(AHEAD):
            if load and self._ending:
                return
            for place in range(self._count):
                worker = self._workers[place] if place < len(self._workers) else None
                if worker and (len(worker.parts) > load or worker.busy_alone):
                    continue
                part = self._next(chunks, new=worker is None)
                if part is not None:
                    (worker or self._start()).give(part)

    def _next(self, chunks: Iterator[Chunk], *, new: bool) -> _Part | None:
        """What to do next; a part that is tried alone needs a ``new`` process."""
        fitting = (part for part in self._again if new or not part.alone)
        # those first: a place is left for each
        if part := max(fitting, key=lambda one: one.alone, default=None):
            self._again.remove(part)
            return part
        while not self._ending and len(self._waiting) <= self._count:
            if (chunk := next(chunks, None)) is None:
                self._ending = True
            else:
                self._waiting.append(_Part(Whole(chunk), chunk.members))
        if not self._waiting:
            return None
        part = self._waiting.popleft()
        if self._ending and self._count > 1:
            # smaller and smaller pieces, so that all workers end together
            left = len(part.left) + sum(len(one.left) for one in self._waiting)
            piece = max(-(-left // (2 * self._count)), LEAST_SCENES)
            if piece < len(part.left):
                self._waiting.appendleft(_Part(part.whole, part.left[piece:]))
                part.left = part.left[:piece]
        return part

    def _start(self) -> _Worker:
        self._started += 1
        worker = _Worker(self._job, self._started, self._messages)
        self._workers.append(worker)
        return worker

    def _take(self, worker: _Worker, rows: Rows) -> _Part:
        now_s = stopwatch_s()
        self._chunk_s.append((now_s - worker.last_message_s) * self._job.plan.chunk_scenes)
        worker.last_message_s = now_s
        part = worker.parts[0]
        part.left = part.left[1:]
        part.whole.done.append(rows)
        if part.alone and part.left:
            self._again.appendleft(part)
        if part.alone or not part.left:
            worker.parts.popleft()
        part.alone = False
        return part

    def _replace(self, worker: _Worker) -> _Part | None:
        """Put the work of one that ended back; gives back a part of which nothing is left."""
        self._workers.remove(worker)
        how = worker.end()
        parts, worker.parts = worker.parts, deque()
        if not worker.ready:
            self._again.extendleft(reversed(parts))
            self._starts_failed += 1
            self.say(f"worker {worker.number} {how} before it was ready")
            if self._starts_failed >= (MORE_START_DEATHS if self._began else START_DEATHS):
                raise PoolError(
                    f"{self._starts_failed} workers one after the other {how} before they were"
                    " ready. Is there memory for them? 'python -m bench.campaign.worker' shows an"
                    " error of the installation."
                )
            return None
        if not parts:
            return None
        current = parts.popleft()
        self._again.extendleft(reversed(parts))
        scene = current.scene
        self._deaths[scene] += 1
        text = f"worker {worker.number} {how} at scene {scene.name}"
        if not current.alone:
            current.alone = self._deaths[scene] >= DEATHS
            apart = " alone, in a new process" if current.alone else ""
            self.say(f"{text}; the scene is tried again{apart}")
            self._again.appendleft(current)
            return None
        self.say(f"{text}, alone: the scene is set aside")
        why = f"its process {how}, {self._deaths[scene]} times, at last with this scene alone"
        current.left, current.alone = current.left[1:], False
        current.whole.done.append(set_aside(scene, self._job.detector_names, why))
        if current.left:
            self._again.appendleft(current)
        return current

    def _kill_silent(self) -> None:
        if not self._messages.empty():  # came while rows were written; taken first
            return
        now_s = stopwatch_s()
        usual_s = silence_limit_s(self._job.plan, self._chunk_s)
        for worker in self._workers:
            limit_s = usual_s if worker.ready else START_LIMIT_S
            if worker.parts and not worker.killed and now_s - worker.last_message_s > limit_s:
                worker.kill(f"gave no sign of life for {limit_s:.0f} s and was killed")


def usable_processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1

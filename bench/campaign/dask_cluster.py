"""Chunks on a Dask cluster. Each of its workers does them in a process of its own (`pool`), so that
a scene kills neither that worker nor the worker's other tasks.

Dask would run a task again itself when a worker is lost, up to a number of times that counts its
neighbours' deaths too; then the task has failed. Here such a chunk is halved, and a single scene
that is left set aside. A cluster that does nothing any more is reached anew.
"""

from __future__ import annotations

import statistics
import threading
import uuid
from collections import Counter, deque
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any

from distributed import Client, Future, KilledWorker, wait
from distributed import TimeoutError as DaskTimeoutError

from bench.campaign.chunk import Rows, set_aside
from bench.campaign.plan import Chunk, Job, of_program
from bench.campaign.pool import (
    AHEAD,
    FIRST_LIMIT_S,
    LEAST_LIMIT_S,
    REMEMBERED,
    USUAL_TIMES,
    LocalPool,
    PoolError,
    Say,
)
from instruments.clock import stopwatch_s

LOST = 2  # of a chunk's workers, until it is halved
RENEWALS = 3  # of the connection, one after the other without a result
CONNECT_S = 30.0
# a worker settles a scene that never ends by itself, which takes it three of its limits
PATIENCE = 4
LOOK_S = 2.0


@dataclass(frozen=True, slots=True)
class Done:
    """What a Dask worker gives back: rows, what went wrong meanwhile, and what made them."""

    rows: Rows
    said: tuple[str, ...]
    program: dict[str, str]


class _Kept:
    """The pools of a Dask worker's process: one a thread that has been busy at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._key = ""
        self._idle: list[tuple[LocalPool, list[str]]] = []

    @contextmanager
    def pool(
        self, key: str, job: Job, chunk_scenes: int, limit_s: float
    ) -> Iterator[tuple[LocalPool, list[str]]]:
        with self._lock:
            others = [] if key == self._key else self._idle
            if key != self._key:
                self._key, self._idle = key, []
            taken = self._idle.pop() if self._idle else None
        for pool, _ in others:
            pool.close()
        if taken is None:
            said: list[str] = []
            made = LocalPool(job, 1, say=said.append, chunk_scenes=chunk_scenes, limit_s=limit_s)
            taken = made, said
        try:
            yield taken
        except BaseException:
            taken[0].close()
            raise
        with self._lock:
            if key == self._key:
                self._idle.append(taken)
                return
        taken[0].close()

    def close(self, key: str) -> None:
        """End those of a client that has gone."""
        with self._lock:
            ended = self._idle if key == self._key else []
            self._idle = [] if key == self._key else self._idle
        for pool, _ in ended:
            pool.close()


_KEPT = _Kept()


def clear(key: str) -> None:
    """What is run on each Dask worker when a client goes."""
    _KEPT.close(key)


def work(key: str, job: Job, chunk: Chunk, chunk_scenes: int, limit_s: float) -> Done:
    """What is run on a Dask worker: a chunk in a process beside it."""
    with _KEPT.pool(key, job, chunk_scenes, limit_s) as (pool, said):
        said.clear()
        ((_, rows),) = pool.results(iter([chunk]))
        return Done(rows, tuple(said), of_program())


@dataclass(slots=True)
class _Open:
    """A chunk that is not whole yet."""

    chunk: Chunk
    missing: int
    rows: list[Rows]


class DaskPool:
    """The cluster of a scheduler at ``address``; to be used with ``with``. As `LocalPool`."""

    def __init__(
        self, job: Job, address: str, *, say: Say, chunk_scenes: int, limit_s: float = 0.0
    ) -> None:
        self._job, self._address, self._say = job, address, say
        self._chunk_scenes, self._limit_s = chunk_scenes, limit_s
        self._key = uuid.uuid4().hex
        self._client: Client | None = None
        self._given: dict[Future[Done], Chunk] = {}
        self._again: deque[Chunk] = deque()
        self._open: dict[str, _Open] = {}
        self._lost: Counter[Chunk] = Counter()
        self._chunk_s: deque[float] = deque(maxlen=REMEMBERED)
        self._submitted = self._renewed = 0
        self._heard_s = stopwatch_s()

    def __enter__(self) -> DaskPool:
        self._connect()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._client is not None and not self._given:
            with suppress(Exception):  # workers that went have nothing to clear
                self._client.run(clear, self._key, nanny=False, on_error="ignore")
        self._disconnect()

    @property
    def limit_s(self) -> float:
        """How long nothing may be heard from the cluster before that is told."""
        if self._limit_s:
            return self._limit_s
        if not self._chunk_s:
            return FIRST_LIMIT_S
        return max(LEAST_LIMIT_S, USUAL_TIMES * statistics.median(self._chunk_s))

    def results(self, chunks: Iterator[Chunk]) -> Iterator[tuple[Chunk, Rows]]:
        """The rows of each chunk, as they are done. ``chunks`` is asked for one when there is room.
        Raises PoolError where the cluster can't be reached or can't work.
        """
        self._heard_s, told = stopwatch_s(), False
        while True:
            self._fill(chunks)
            if not self._given and not self._again:
                return
            ended = self._wait()
            for future in ended:
                part = self._given.pop(future)
                yield from self._take(part, future)
            if ended:
                self._heard_s, self._renewed, told = stopwatch_s(), 0, False
                continue
            silent_s = stopwatch_s() - self._heard_s
            dead = self._client is None or self._client.status != "running" or not self._threads()
            if silent_s > self.limit_s and not told:
                told = True
                self._say(f"no chunk was done for {silent_s:.0f} s by the cluster {self._address}")
            if silent_s > self.limit_s * (1 if dead else PATIENCE):
                self._renew()
                told = False

    def _fill(self, chunks: Iterator[Chunk]) -> None:
        room = AHEAD * max(1, self._threads())
        while self._client is not None and len(self._given) < room:
            if self._again:
                part = self._again.popleft()
            elif chunk := next(chunks, None):
                part = chunk
                self._open[chunk.name] = _Open(chunk, len(chunk.members), [])
            else:
                return
            self._submitted += 1
            limits = self._chunk_scenes, self._limit_s
            name = f"teatbench-{self._key}-{self._submitted}-{part.name}"
            try:
                future = self._client.submit(
                    work, self._key, self._job, part, *limits, key=name, pure=False, retries=0
                )
            except Exception:  # whatever a closed connection raises: it is reached anew
                self._again.appendleft(part)
                return
            self._given[future] = part

    def _wait(self) -> list[Future[Done]]:
        """Those that have ended, after `LOOK_S` perhaps none."""
        if not self._given:
            threading.Event().wait(LOOK_S)
            return []
        try:
            with suppress(DaskTimeoutError):
                wait(list(self._given), timeout=LOOK_S, return_when="FIRST_COMPLETED")
        except (CancelledError, OSError):  # the scheduler went
            self._put_back([one for one in self._given if one.status in ("cancelled", "lost")])
            threading.Event().wait(LOOK_S)
            return []
        return [one for one in self._given if one.status in ("finished", "error")]

    def _put_back(self, futures: list[Future[Done]]) -> None:
        for future in futures:
            self._again.append(self._given.pop(future))

    def _take(self, part: Chunk, future: Future[Done]) -> Iterator[tuple[Chunk, Rows]]:
        found: Done | None
        try:
            found = future.result(timeout=CONNECT_S)
        except KilledWorker:
            found = self._worker_lost(part)
        except (CancelledError, OSError, DaskTimeoutError):
            self._again.append(part)
            return
        except Exception as error:
            raise PoolError(
                f"a worker of {self._address} can't work: {type(error).__name__}: {error}. Has it"
                " the same teatbench and detectors as this computer?"
            ) from error
        if found is None:
            return
        self._check(found.program)
        for text in found.said:
            self._say(text)
        self._chunk_s.append(found.rows.seconds / len(part.members) * self._chunk_scenes)
        whole = self._open[part.name]
        whole.rows.append(found.rows)
        whole.missing -= len(part.members)
        if not whole.missing:
            del self._open[part.name]
            ordered = sorted(whole.rows, key=lambda rows: rows.scenes[0].member)
            yield whole.chunk, sum(ordered, Rows())

    def _worker_lost(self, part: Chunk) -> Done | None:
        """Workers went with this chunk, or with another that they had: halve it in the end."""
        self._lost[part] += 1
        self._say(f"the cluster lost its workers at {part.name}")
        if self._lost[part] < LOST:
            self._again.append(part)
        elif len(part.members) > 1:
            half = len(part.members) // 2
            self._again.append(replace(part, members=part.members[:half]))
            self._again.append(replace(part, members=part.members[half:]))
        else:
            why = "the cluster's workers went with it each time"
            return Done(set_aside(part.scenes[0], self._job.detector_names, why), (), of_program())
        return None

    def _check(self, program: dict[str, str]) -> None:
        here = of_program()
        if program != here:
            other = "; ".join(
                f"{key}: {program.get(key)} there, {here[key]} here"
                for key in here
                if program.get(key) != here[key]
            )
            raise PoolError(
                f"the cluster {self._address} has another program, whose rows don't go with this"
                f" one's: {other}. Install the same on all."
            )

    def _threads(self) -> int:
        """Of all workers together; none where the scheduler doesn't answer."""
        if self._client is None:
            return 0
        try:
            return sum(self._client.nthreads().values())
        except Exception:  # whatever a closed connection raises
            return 0

    def _renew(self) -> None:
        self._renewed += 1
        if self._renewed > RENEWALS:
            raise PoolError(
                f"the cluster {self._address} did nothing for {RENEWALS + 1} times"
                f" {self.limit_s:.0f} s. Are its scheduler and workers there?"
            )
        self._say(f"the cluster {self._address} is reached anew")
        self._put_back(list(self._given))
        self._disconnect()
        with suppress(PoolError):
            self._connect()
        self._heard_s = stopwatch_s()

    def _connect(self) -> None:
        try:
            self._client = Client(self._address, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise PoolError(
                f"no Dask scheduler answers at {self._address}: {error}. 'dask scheduler' starts"
                " one."
            ) from error

    def _disconnect(self) -> None:
        client: Any = self._client
        self._client = None
        self._given.clear()
        if client is not None:
            with suppress(Exception):  # of a scheduler that went there is nothing to close
                client.close(timeout=2)

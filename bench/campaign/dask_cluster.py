"""Chunks on a Dask cluster. Each Dask worker runs them in a process of its own (`pool`), so that a
scene ends neither that worker nor its other tasks.

Dask retries the tasks of a lost worker itself, and counts losses by other tasks too. Here it
retries nothing: a chunk that lost its workers is halved, and a single scene that is left is set
aside. A cluster that has stopped is connected to again.
"""

from __future__ import annotations

import threading
import uuid
from collections import Counter, defaultdict, deque
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from distributed import Client, Future, KilledWorker, wait
from distributed import TimeoutError as DaskTimeoutError

from bench.campaign.chunk import ChunkRows, set_aside
from bench.campaign.plan import Chunk, Job, of_program
from bench.campaign.pool import AHEAD, TIMES_KEPT, LocalPool, PoolError, Say, silence_limit_s
from instruments.clock import stopwatch_s

LOST = 2  # of a chunk's workers, until it is halved
RENEWALS = 3  # of the connection, one after the other without a result
CONNECT_S = 30.0
# a worker handles a scene that never ends itself, which takes three of its limits
PATIENCE = 4
LOOK_S = 2.0


@dataclass(frozen=True, slots=True)
class ChunkResult:
    """What a Dask worker gives back: rows, what went wrong meanwhile, and what made them."""

    rows: ChunkRows
    said: tuple[str, ...]
    program: dict[str, str]


# of a Dask worker's process: idle pools by client
_IDLE: defaultdict[str, list[LocalPool]] = defaultdict(list)
_LOCK = threading.Lock()


def work(key: str, job: Job, chunk: Chunk) -> ChunkResult:
    """The task of a Dask worker: runs a chunk in a process that stays for the client's next one."""
    said: list[str] = []
    with _LOCK:
        gone = [one for other in list(_IDLE) if other != key for one in _IDLE.pop(other)]
        pool = _IDLE[key].pop() if _IDLE[key] else None
    for one in gone:
        one.close()
    if pool is None:
        pool = LocalPool(job, 1, say=said.append)
    pool.say = said.append
    try:
        ((_, rows),) = pool.results(iter([chunk]))
    except BaseException:
        pool.close()
        raise
    with _LOCK:
        wanted = key in _IDLE
        if wanted:
            _IDLE[key].append(pool)
    if not wanted:
        pool.close()
    return ChunkResult(rows, tuple(said), of_program())


def clear(key: str) -> None:
    """The task that ends a client's pools, on each Dask worker."""
    with _LOCK:
        ended = _IDLE.pop(key, [])
    for pool in ended:
        pool.close()


class DaskPool:
    """The cluster of a scheduler at ``address``, as `LocalPool`. Raises PoolError for none."""

    def __init__(self, job: Job, address: str, *, say: Say) -> None:
        self._job, self._address, self._say = job, address, say
        self._key = uuid.uuid4().hex
        self._client: Client | None = None
        self._given: dict[Future[ChunkResult], Chunk] = {}
        self._again: deque[Chunk] = deque()
        self._open: dict[str, tuple[Chunk, list[ChunkRows]]] = {}  # and its pieces that are done
        self._lost: Counter[Chunk] = Counter()
        self._chunk_s: deque[float] = deque(maxlen=TIMES_KEPT)
        self._renewed = 0
        self._last_result_s = stopwatch_s()
        self._connect()

    def close(self) -> None:
        """Leave the cluster."""
        if self._client is not None and not self._given:
            with suppress(Exception):  # workers that went have nothing to clear
                self._client.run(clear, self._key, nanny=False, on_error="ignore")
        self._disconnect()

    def results(self, chunks: Iterator[Chunk]) -> Iterator[tuple[Chunk, ChunkRows]]:
        """As `LocalPool.results`. Raises PoolError where the cluster can't be used."""
        self._last_result_s, warned = stopwatch_s(), False
        while True:
            self._fill(chunks)
            if not self._given and not self._again:
                return
            ended = self._wait()
            for future in ended:
                part = self._given.pop(future)
                yield from self._take(part, future)
            if ended:
                self._last_result_s, self._renewed, warned = stopwatch_s(), 0, False
                continue
            silent_s = stopwatch_s() - self._last_result_s
            limit_s = silence_limit_s(self._job.plan, self._chunk_s)
            dead = self._client is None or self._client.status != "running" or not self._threads()
            if silent_s > limit_s and not warned:
                warned = True
                self._say(f"no chunk was done for {silent_s:.0f} s by the cluster {self._address}")
            if silent_s > limit_s * (1 if dead else PATIENCE):
                self._renewed += 1
                if self._renewed > RENEWALS:
                    raise PoolError(
                        f"the cluster {self._address} did nothing for {RENEWALS + 1} times"
                        f" {limit_s:.0f} s. Are its scheduler and workers there?"
                    )
                self._say(f"the cluster {self._address} is reached anew")
                self._put_back(list(self._given))
                self._disconnect()
                with suppress(PoolError):
                    self._connect()
                self._last_result_s = stopwatch_s()
                warned = False

    def _fill(self, chunks: Iterator[Chunk]) -> None:
        room = AHEAD * max(1, self._threads())
        while self._client is not None and len(self._given) < room:
            if self._again:
                part = self._again.popleft()
            elif chunk := next(chunks, None):
                part = chunk
                self._open[chunk.name] = chunk, []
            else:
                return
            name = f"teatbench-{uuid.uuid4().hex}-{part.name}"
            try:
                future = self._client.submit(
                    work, self._key, self._job, part, key=name, pure=False, retries=0
                )
            except Exception:  # whatever a closed connection raises: it is reached anew
                self._again.appendleft(part)
                return
            self._given[future] = part

    def _wait(self) -> list[Future[ChunkResult]]:
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

    def _put_back(self, futures: list[Future[ChunkResult]]) -> None:
        for future in futures:
            self._again.append(self._given.pop(future))

    def _take(self, part: Chunk, future: Future[ChunkResult]) -> Iterator[tuple[Chunk, ChunkRows]]:
        found: ChunkResult | None
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
        if other := "; ".join(
            f"{key}: {found.program.get(key)} there, {here} here"
            for key, here in of_program().items()
            if found.program.get(key) != here
        ):
            raise PoolError(
                f"the cluster {self._address} has another program, whose rows don't go with this"
                f" one's: {other}. Install the same on all."
            )
        for text in found.said:
            self._say(text)
        self._chunk_s.append(found.rows.seconds / len(part.members) * self._job.plan.chunk_scenes)
        chunk, done = self._open[part.name]
        done.append(found.rows)
        there = {row.member for rows in done for row in rows.scenes}
        if len(there) == len(chunk.members):
            del self._open[part.name]
            yield chunk, sum(sorted(done, key=lambda rows: rows.scenes[0].member), ChunkRows())

    def _worker_lost(self, part: Chunk) -> ChunkResult | None:
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
            return ChunkResult(
                set_aside(part.scenes[0], self._job.detector_names, why), (), of_program()
            )
        return None

    def _threads(self) -> int:
        """Of all workers together; none where the scheduler doesn't answer."""
        if self._client is None:
            return 0
        try:
            return sum(self._client.nthreads().values())
        except Exception:  # whatever a closed connection raises
            return 0

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

"""Processes of this Python that work for this one: pickled requests in, pickled answers out. One
ends when its input does, in the middle of whatever it does: a client that died leaves none behind.

The standard library's pools run the program's own file again in each process, and so the run of
whoever calls this from a file without a guard.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import IO, Any, cast

CLOSING_S = 5.0


class WorkerProcess:
    """``python -m module``, and a thread that passes on what it answers; ``None`` is its end."""

    def __init__(
        self, module: str, answered: Callable[[Any], None], more: Mapping[str, str] | None = None
    ) -> None:
        """``more``: of its environment. Raises OSError where there is no other process."""
        self.killed = ""
        self.process = subprocess.Popen(  # noqa: S603 - a module of our own
            [sys.executable, "-m", module],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, **(more or {})},
        )
        self._requests = cast(IO[bytes], self.process.stdin)
        self._thread = threading.Thread(target=self._listen, args=(answered,), daemon=True)
        self._thread.start()

    def ask(self, value: object) -> None:
        with suppress(OSError):  # its end is a message of its own
            pickle.dump(value, self._requests)
            self._requests.flush()

    def kill(self, why: str) -> None:
        self.killed = self.killed or why
        self.process.kill()

    def end(self) -> str:
        """Wait for its end; gives back how it ended."""
        with suppress(OSError):
            self._requests.close()
        try:
            code = self.process.wait(CLOSING_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            code = self.process.wait()
        self._thread.join()
        if self.killed:
            return self.killed
        if code < 0:
            with suppress(ValueError):
                return f"ended by {signal.Signals(-code).name}"
        return f"ended with code {code}"

    def _listen(self, answered: Callable[[Any], None]) -> None:
        with cast(IO[bytes], self.process.stdout) as source:
            while True:
                try:
                    value = pickle.load(source)  # noqa: S301 - of a process that we started
                except Exception:  # cut off at its end, or damaged
                    break
                answered(value)
        answered(None)


def processors() -> int:
    """That this process may use."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return usable or 1


def opened() -> tuple[Callable[[], Any], Callable[[object], None]]:
    """In such a process: what gives the next request, and what answers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the client's, who ends its workers
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no answer
    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(sys.stdin.buffer, requests), daemon=True).start()
    return requests.get, partial(_answer, answers)


def _read(source: IO[bytes], requests: queue.SimpleQueue[Any]) -> None:
    while True:
        try:
            requests.put(pickle.load(source))  # noqa: S301 - of the process that started this one
        except Exception:  # its end, or what this installation can't read
            os._exit(1)


def _answer(to: IO[bytes], value: object) -> None:
    pickle.dump(value, to)
    to.flush()

"""``python -m bench.campaign.worker``: a process that works on scenes for `pool`.

Its standard input brings a `Job`, then scenes, its standard output takes the `ChunkRows` of each,
all pickled. It ends when its input does, in the middle of whatever it does: a client that died
leaves no worker behind.
"""

from __future__ import annotations

import os
import pickle
import queue
import signal
import sys
import threading
from typing import IO, Any

import cv2

from bench.campaign.chunk import Bench, ChunkRows, SceneId, run_scene, set_aside
from bench.campaign.plan import Job
from bench.results.answers import close_detectors
from textfiles.text import named

# of numeric libraries, which read them when they are loaded; OpenCV has a call
ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
        "NUMEXPR_NUM_THREADS",
    ),
    "1",
)


def attempt(bench: Bench, scene: SceneId) -> ChunkRows:
    """The rows of a scene; what the bench can't do is set aside with its reason."""
    try:
        return run_scene(bench, scene)
    except Exception as error:
        names = (detector.name for detector in bench.detectors)
        return set_aside(scene, names, named(error))


def main() -> None:
    """Work until the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the client's, who ends its workers
    cv2.setNumThreads(1)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a detector's libraries print is no answer
    requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_read, args=(sys.stdin.buffer, requests), daemon=True).start()
    job: Job = requests.get()
    renderer = job.renderer()
    _answer(answers, "ready")
    detectors = job.make_detectors()
    try:
        bench = job.bench(renderer, detectors)
        while (scene := requests.get()) is not None:
            _answer(answers, attempt(bench, scene))
    finally:
        close_detectors(detectors)


def _read(source: IO[bytes], requests: queue.SimpleQueue[Any]) -> None:
    while True:
        try:
            requests.put(pickle.load(source))  # noqa: S301 - of the process that started this one
        except Exception:  # its end, or what this installation can't read
            os._exit(1)


def _answer(to: IO[bytes], value: object) -> None:
    pickle.dump(value, to)
    to.flush()


if __name__ == "__main__":
    main()

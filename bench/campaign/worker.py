"""``python -m bench.campaign.worker``: a process that works on scenes for `pool`.

It is asked a `Job`, then scenes, and answers the `ChunkRows` of each.
"""

from __future__ import annotations

import cv2

from bench.campaign.chunk import Bench, ChunkRows, SceneId, run_scene, set_aside
from bench.campaign.plan import Job
from bench.results.answers import close_detectors
from bench.workers import opened
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
    cv2.setNumThreads(1)
    asked, answer = opened()
    job: Job = asked()
    renderer = job.renderer()
    answer("ready")
    detectors = job.make_detectors()
    try:
        bench = job.bench(renderer, detectors)
        while (scene := asked()) is not None:
            answer(attempt(bench, scene))
    finally:
        close_detectors(detectors)


if __name__ == "__main__":
    main()

"""Campaigns whose cameras have a quarter of the pixels along each axis: a scene takes a tenth of the
time; and an executor without processes.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bench.campaign.chunk import Bench, ChunkRows, SceneId, run_scene
from bench.campaign.plan import CampaignPlan, Chunk, Job
from bench.rig.loading import RIGS, LoadedRig
from bench.rig.scenes import rig_renderer
from detector.calibration import Calibration
from detector.protocol import Detection, Detector, Frames, Teat
from tests.bench.small_cameras import write_calibration
from tests.conftest import ROOT

KILLS = os.environ.get("TEATBENCH_KILLS")


def write_small_rig(folder: Path) -> Path:
    """A rig file; gives back its path."""
    write_calibration(folder, thermal=True)
    rig = folder / "rig.toml"
    rig.write_text((RIGS / "emulated.toml").read_text(encoding="utf-8"), encoding="utf-8")
    return rig


def small_plan(folder: Path, **more: Any) -> CampaignPlan:
    """Sixteen scenes of two families in chunks of three, the thesis's detector."""
    asked = {"families": ("ideal", "overlapping"), "scenes": 8, "chunk_scenes": 3, "seed": 7}
    asked |= {"detectors": ("thesis",), "rig": str(write_small_rig(folder))}
    return CampaignPlan.model_validate({**asked, **more})


def run_chunk(bench: Bench, scenes: Iterable[SceneId]) -> ChunkRows:
    """The rows of these scenes."""
    return sum((run_scene(bench, scene) for scene in scenes), ChunkRows())


def small_bench(rig: LoadedRig, *detectors: Detector) -> Bench:
    """The cameras of a rig as they are drawn."""
    return Bench(rig_renderer(rig, 1), rig.calibration, detectors, 1, exact=True)


@dataclass(slots=True)
class Knowing:
    """Gives set points with one covariance, off by ``error_mm``, and notes what it is told of the
    cameras; with ``breaks`` it fails instead.
    """

    ends_mm: list[Any]
    error_mm: float = 0.0
    breaks: bool = False
    name: str = "knowing"
    note: list[Calibration] = field(default_factory=list)
    parameters: Mapping[str, Any] = field(default_factory=dict)

    version = "7"

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        self.note.append(calibration)
        if self.breaks:
            raise RuntimeError("no")
        ends = (np.add(end, (0.0, self.error_mm, 0.0)) for end in self.ends_mm)
        return Detection(tuple(Teat(end, 0.25 * np.eye(3)) for end in ends))


class Here:
    """The plain loop, in this process; ``order`` of a whole list of chunks."""

    def __init__(self, job: Job, order: Callable[[list[Chunk]], list[Chunk]] = list) -> None:
        self._job, self._order = job, order
        self._bench = job.bench(job.renderer(), job.make_detectors())

    def results(self, chunks: Iterator[Chunk]) -> Iterator[tuple[Chunk, ChunkRows]]:
        for chunk in self._order(list(chunks)):
            yield chunk, run_chunk(self._bench, chunk.scenes)


def module(name: object, *words: object) -> subprocess.Popen[str]:
    """A module of Python with these words, in a process of its own; what it says isn't kept."""
    return subprocess.Popen(
        [sys.executable, "-m", *map(str, (name, *words))],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        encoding="utf-8",
    )

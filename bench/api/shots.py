"""One frame set with what belongs to it: drawn, asked about, scored."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from bench.api.loading import AnyRig, load_rig
from bench.arguments import bare, lent
from bench.config import ConfigError, check_within, wrong_use
from bench.record.recording import TruthRow
from bench.results.answers import (
    LIMIT_MM,
    TIMEOUT_S,
    Answer,
    close_detectors,
    examine,
    score_answer,
)
from bench.rig.loading import LoadedRig
from bench.rig.loading import load_rig as load_rig_file
from bench.rig.scenes import Perturbation, rig_renderer, warm
from bench.rig.scenes import draw as draw_state
from bench.scoring.scene import SceneScore
from bench.script.detectors import declared, make_detectors, refusals
from detector import registry
from detector.calibration import Calibration
from detector.protocol import Detection, Detector, DetectorProcess
from instruments.camera.frame import FrameSet
from instruments.drivers.entry_points import undisturbed
from instruments.world.labels import Labeller, Labels
from instruments.world.scene import Renderer
from instruments.world.setups import Situation
from instruments.world.situations import SITUATIONS, situation
from instruments.world.state import SceneState
from textfiles.bounds import ABOVE_0, FROM_0

AnyScene = str | Situation | SceneState


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """A frame set, the calibration of its cameras, and the truth of its teat ends where it is
    known. ``state``: the scene that was drawn.
    """

    frames: FrameSet
    calibration: Calibration
    truth: tuple[TruthRow, ...] = ()
    state: SceneState | None = None


def families() -> tuple[str, ...]:
    """The names of all situation families."""
    return tuple(SITUATIONS)


def member(family: str, number: int) -> Situation:
    """Member ``number`` (from 0) of a situation family. Raises ConfigError for an unknown name."""
    with wrong_use():
        return situation(family, number)


def _cameras(rig: LoadedRig, seed: int) -> tuple[LoadedRig, Renderer]:
    """Those of before, where neither the rig file nor its calibration is another now."""
    _ = rig.calibration  # there is one
    return _made(rig.path, rig.text, rig.calibration_path.read_bytes(), seed)


@lru_cache(maxsize=4)
def _made(path: Path, text: str, table: bytes, seed: int) -> tuple[LoadedRig, Renderer]:  # noqa: ARG001
    rig = load_rig_file(path)
    return rig, rig_renderer(rig, seed)


def draw(
    scene: AnyScene,
    number: int = 0,
    *,
    rig: AnyRig = "emulated",
    seed: int = 1,
    perturbations: Sequence[Perturbation] = (),
) -> Shot:
    """Draw a scene with the emulated cameras of ``rig``, with exact truth. ``scene`` is a family,
    of which member ``number`` is drawn, a situation, or a state. ``seed``: of the cameras' noise
    and fixed patterns. Raises ConfigError for an unknown name or a thing too near a camera.
    """
    check_within(FROM_0, number=number, seed=seed)
    found, renderer = _cameras(load_rig(rig), seed)
    name = scene if isinstance(scene, str) else getattr(scene, "name", "scene")
    if isinstance(scene, str):
        scene = member(scene, number)
    state = warm(scene) if isinstance(scene, Situation) else scene
    number = scene.seed if isinstance(scene, Situation) else number
    calibration = found.calibration
    for one in perturbations:
        calibration = one.stated(calibration)
    chance = (seed, number, *name.encode())
    with wrong_use():
        drawn = draw_state(renderer, name, state, [seed, number], perturbations, chance)
    return Shot(drawn.frames, calibration, drawn.truth, drawn.state)


def labels(shot: Shot, *, rig: AnyRig = "emulated") -> tuple[Labels, Labels, Labels]:
    """Which teat each pixel of a drawn shot shows, and where ends and bases are: of the left, the
    right and the thermal picture, as the cameras of ``rig`` drew it. Raises ConfigError without a
    scene.
    """
    if shot.state is None:
        why = "shot was not drawn, so what its pixels show is not known"
        raise ConfigError.plain(why)
    return _labeller(_cameras(load_rig(rig), 1)[1]).of(shot.state)


@lru_cache(maxsize=1)
def _labeller(renderer: Renderer) -> Labeller:
    return Labeller(renderer)


def detectors() -> dict[str, str]:
    """Each detector by its name, with a line on it: shipped, of other packages, declared in the
    folder ``detectors``. One that can't be used is BROKEN.
    """
    with undisturbed():  # each is loaded
        faulty = {name: f"BROKEN: {why}" for name, why in registry.broken().items()}
    return {**declared(), **registry.available(), **faulty}


@contextmanager
def open_detector(
    detector: str | Detector, calibration: Calibration | None = None
) -> Iterator[Detector]:
    """A detector by name, file or ``exec:COMMAND``, its process ended in the end, and not to be
    used then. Raises ConfigError, also where it can't be used with the rig of ``calibration``.
    """
    with _opened(detector, calibration) as used, lent(used, "detector") as given:
        yield given if isinstance(detector, str) else used


@contextmanager
def _opened(detector: str | Detector, calibration: Calibration | None) -> Iterator[Detector]:
    named = [detector] if isinstance(detector, str) else []
    made = make_detectors(named, gives_up=False)
    used = detector if not isinstance(detector, str) else made[0]
    try:
        for why in refusals([used], calibration):
            raise ConfigError.plain(why)
        yield used
    finally:
        close_detectors(made)


def detect(detector: str | Detector, shot: Shot, *, timeout_s: float | None = None) -> Answer:
    """Ask a detector about a shot, and check its answer, which counts as none when it comes later:
    for a program ``timeout_s`` ends start and answer together, None leaves it its own limits. A
    failure of the detector is an answer with an ``outcome``, never an exception. Raises ConfigError
    for a detector that isn't there.
    """
    check_within(ABOVE_0, timeout_s=timeout_s)
    with _opened(detector, None) as opened:
        asked = bare(opened)
        if isinstance(asked, DetectorProcess):
            asked.most_s = timeout_s or math.inf
        limit_s = timeout_s or TIMEOUT_S
        return examine(asked, shot.frames, shot.calibration, timeout_s=limit_s)


def score(
    answer: Answer | Detection,
    truth: Shot | Sequence[TruthRow],
    *,
    limit_mm: float = LIMIT_MM,
    time_limit_s: float = math.inf,
) -> SceneScore:
    """Score an answer: ``counts``, ``errors_mm`` (k, 3) found - truth, ``success``. An empty
    ``truth`` says that there is no end to be found. Raises ConfigError for a shot without truth.
    """
    check_within(ABOVE_0, limit_mm=limit_mm)
    rows = truth.truth if isinstance(truth, Shot) else truth
    if isinstance(truth, Shot) and not rows and truth.state is None:
        raise ConfigError.plain("truth: this shot has none: touch its teat ends, or draw the scene")
    if isinstance(answer, Detection):
        answer = Answer("detector", answer, 0.0)
    return score_answer(answer, rows, limit_mm=limit_mm, time_limit_s=time_limit_s)

"""Detectors asked in scenes in which one quantity is varied. Draws, asks, counts; may not know how it is shown.

The same members, the same noise and the same errors of calibration at every value of a quantity, so that what differs is the quantity.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bench.config import ConfigError, read_text
from bench.detecting.examine import examine, points_of
from bench.rig import LoadedRig
from bench.scene_recording import warm
from bench.scoring.matching import gate_mm, match
from bench.sensitivity import limits
from bench.sensitivity.values import Limit, Measured, Optics, Quantity, Tally
from detector.calibration import Calibration
from detector.geometry import Array
from detector.protocol import Detector, Outcome
from instruments.camera.frame import FrameSet
from instruments.world.scene import Renderer, SceneState

QUANTILES = (0.5, 0.95)
DISPARITY_PX = 0.03  # what sub-pixel methods reach on real edges: 0.2 to 0.3 mm of depth on the thesis's geometry
MEDIAN_OF_NORMAL = 0.6745  # of |e|, in standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class Bench:
    """What stays the same: the rig whose cameras are emulated, the detectors, the members' seeds, the seed of noise and cameras."""

    rig: LoadedRig
    detectors: Sequence[Detector]
    members: Sequence[int]
    seed: int


def measure(bench: Bench, quantity: Quantity) -> Iterator[Measured]:
    """What every detector does at each value, one by one. Cameras are made anew only where their sensors change.

    Raises ConfigError for a scene that can't be set up before these cameras.
    """
    table = tomllib.loads(read_text(bench.rig.calibration_path))
    said = bench.rig.rig.emulation
    usual = Optics(said.optical.sensor(), said.thermal.sensor(table))
    optics, renderer = None, None
    for value in quantity.values:
        wanted = quantity.optics(value, usual)
        if renderer is None or wanted != optics:
            optics = wanted
            renderer = Renderer.from_calibration(table, bench.seed, optical=wanted.optical, thermal=wanted.thermal)
        yield _at(bench, quantity, value, renderer)


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """One member at one value: what stands there, which ends every camera sees, what the cameras took, what detectors are told."""

    state: SceneState
    teats: list[int]
    frames: FrameSet
    told: Calibration


def _at(bench: Bench, quantity: Quantity, value: float, renderer: Renderer) -> Measured:
    tallies = {detector.name: Tally() for detector in bench.detectors}
    bounds = []
    for member in bench.members:
        scene = _drawn(bench, quantity, value, member, renderer)
        for detector in bench.detectors:
            tallies[detector.name] += _asked(detector, scene)
        if scene.teats:
            bounds.append(_bounds(scene, renderer, bench.rig.calibration, thermal=quantity.thermal))
    return Measured(value, sum(len(bound.shifts_mm) for bound in bounds), tallies, _limit(bounds) if bounds else None)


def _drawn(bench: Bench, quantity: Quantity, value: float, member: int, renderer: Renderer) -> _Scene:
    try:
        state = warm(quantity.set_up(value, member, renderer))
        taken = renderer.render(state, np.random.default_rng([bench.seed, member, *quantity.name.encode()]))
    except ValueError as error:
        raise ConfigError.plain(
            f"{quantity.name} {value:g} can't be set up for member {member}: {error}; choose others by --first"
        ) from error
    teats = np.flatnonzero(renderer.visible_ends(state).all(axis=1))
    frames = FrameSet(taken.left, taken.right, taken.thermal_8bit, taken.thermal_ck)
    return _Scene(state, teats.tolist(), frames, quantity.told(value, member, bench.rig.calibration))


def _asked(detector: Detector, scene: _Scene) -> Tally:
    ends = scene.state.phantom.ends_mm
    answer = examine(detector, scene.frames, scene.told)
    found = match(points_of(answer.detection), ends, [i in scene.teats for i in range(len(ends))], gate_mm(ends))
    return Tally(found.distances_mm, len(found.false), int(answer.outcome is not Outcome.ANSWERED))


@dataclass(frozen=True, slots=True, eq=False)
class _Bounds:
    """For each visible end of a scene: least covariance (n, 3, 3), shift (n, 3), depth a pixel of disparity (n,), share nominated."""

    covariances_mm2: Array
    shifts_mm: Array
    depth_per_px_mm: Array
    share: float | None


def _bounds(scene: _Scene, renderer: Renderer, truth: Calibration, *, thermal: bool) -> _Bounds:
    ends = scene.state.phantom.ends_mm[scene.teats]
    covariances = limits.end_covariances(renderer, scene.state, scene.teats)
    share = limits.nominated_share(renderer, scene.state, scene.teats) if thermal else None
    return _Bounds(covariances, shifts_mm(truth, scene.told, ends), truth.depth_per_disparity_px_mm(ends), share)


def shifts_mm(calibration: Calibration, told: Calibration, ends_mm: Array) -> Array:
    """How far (n, 3) the ends' own pixels, free of any error, are triangulated from where the ends are, by the calibration told."""
    return told.pair.place(*calibration.pair.see(ends_mm)) - ends_mm


def _limit(bounds: Sequence[_Bounds]) -> Limit:
    covariances, shifts = (np.concatenate(each) for each in zip(*((b.covariances_mm2, b.shifts_mm) for b in bounds), strict=True))
    median, p95 = limits.error_quantiles_mm(covariances, shifts, QUANTILES)
    disparity = MEDIAN_OF_NORMAL * DISPARITY_PX * float(np.median(np.concatenate([b.depth_per_px_mm for b in bounds])))
    shares = [(len(b.shifts_mm), b.share) for b in bounds if b.share is not None]
    share = sum(n * one for n, one in shares) / sum(n for n, _ in shares) if shares else None
    return Limit(median, p95, disparity, share)

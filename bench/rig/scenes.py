"""Members of the situation families drawn by the emulated cameras, as a contact sheet or as a
recording with exact truth.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from bench.config import (
    ConfigError,
    check_within,
    did_you_mean,
    read_text,
    several,
    toml_of,
    writing,
)
from bench.files import write_synced
from bench.record.recording import TruthRow, added_to
from bench.rig.loading import AnyRig, LoadedRig, any_rig
from bench.rig.model import make_renderer
from detector.calibration import Calibration, dump_calibration
from instruments.camera.emulator import frame_set
from instruments.camera.frame import FrameSet
from instruments.world.optics import CameraModel
from instruments.world.plant import PlantConstants
from instruments.world.scene import Renderer, contact_sheet
from instruments.world.setups import Situation
from instruments.world.situations import SITUATIONS, situation, spoken
from instruments.world.state import SceneState
from textfiles.bounds import FROM_0
from textfiles.documents import read_toml

BOARD_DEPTHS_MM = (450.0, 1300.0)


def chosen(names: Sequence[str]) -> tuple[str, ...]:
    """The families of these names, all for none. Raises ConfigError for one that isn't known."""
    for name in names:
        if name not in SITUATIONS:
            near = did_you_mean(name, SITUATIONS)
            raise ConfigError.plain(
                f'there is no situation "{name}"{near} (known: {", ".join(SITUATIONS)})'
            )
    return tuple(dict.fromkeys(names)) or tuple(SITUATIONS)


def rig_renderer(rig: LoadedRig, seed: int) -> Renderer:
    """The cameras of a rig file as emulated; ``seed`` is theirs."""
    table, emulation = toml_of(rig.calibration_path), rig.rig.emulation
    return make_renderer(table, seed, emulation.optical, emulation.thermal, emulation.depth)


def named_cameras(renderer: Renderer, names: Sequence[str]) -> list[CameraModel]:
    """A renderer's cameras of these names. Raises ConfigError for another name, and for none."""
    there = {camera.name: camera for camera in renderer.cameras}
    for name in several("cameras", names, 1):
        if name not in there:
            raise ConfigError.plain(f"cameras has {name!r}, not one of: {', '.join(there)}")
    return [camera for name, camera in there.items() if name in names]


def renderer_of(calibration: Calibration, usual: Renderer, seed: int) -> Renderer:
    """Cameras of another calibration, with sensors like those of ``usual``."""
    optical, thermal = usual.left.readout.sensor, usual.thermal.readout.sensor
    columns, rows = calibration.thermal.sensor_size
    thermal = replace(thermal, width_px=columns, height_px=rows)
    table = read_toml(dump_calibration(calibration))
    return Renderer.from_calibration(table, seed, optical=optical, thermal=thermal)


def warm(found: Situation) -> SceneState:
    """A situation with its bath settled, at temperatures that vary as between days."""
    rng = np.random.Generator(np.random.PCG64([found.seed, *found.name.encode(), *b"warmth"]))
    water_c, ambient_c = float(rng.uniform(32.5, 33.5)), float(rng.uniform(17.0, 24.0))
    ambient_c = ambient_c if found.room_c is None else found.room_c
    noise = rng.normal(0.0, 0.15, len(found.phantom.teats))
    teats_c = tuple((teat_temp_c(water_c, ambient_c) + noise).tolist())
    time_s = float(rng.uniform(0.0, 3600.0))
    return found.state(teats_c, water_c - 0.02, ambient_c, time_s=time_s)


def teat_temp_c(water_c: float, ambient_c: float) -> float:
    """Of a teat that has settled between its water and the room."""
    constants = PlantConstants()
    share = constants.teat_in_w_per_k / (constants.teat_in_w_per_k + constants.teat_out_w_per_k)
    return ambient_c + share * (water_c - ambient_c)


def write_sheet(
    rig: AnyRig, names: Sequence[str], seeds: Sequence[int], path: Path | str, seed: int
) -> None:
    """One PNG, a row for each family and seed. Raises ConfigError."""
    names, seeds = _asked(names, seeds, seed)
    states = {
        f"{spoken(name)} {one}": warm(situation(name, one)) for name in names for one in seeds
    }
    good, data = cv2.imencode(".png", contact_sheet(states, rig_renderer(any_rig(rig), seed), seed))
    if not good:
        raise ConfigError.plain(f"{path}: the sheet is too large for a PNG: ask for fewer seeds")
    with writing(Path(path)):
        write_synced(Path(path), data.tobytes())


def _asked(
    names: Sequence[str], seeds: Sequence[int], seed: int
) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Families and members that can be drawn. Raises ConfigError."""
    for one in (members := several("seeds", seeds)):
        check_within(FROM_0, seeds=one)
    check_within(FROM_0, seed=seed)
    return chosen(several("names", names)), members


class Perturbation(Protocol):
    """What `bench.campaign.perturbations` does to a scene, its pictures, or the calibration."""

    def state(self, state: SceneState, seeds: Sequence[int]) -> SceneState: ...
    def frames(self, frames: FrameSet, seeds: Sequence[int]) -> FrameSet: ...
    def rig(self, calibration: Calibration, seeds: Sequence[int]) -> Calibration: ...
    def stated(self, calibration: Calibration) -> Calibration: ...


def record_scenes(
    rig: AnyRig,
    names: Sequence[str],
    seeds: Sequence[int],
    folder: Path | str,
    seed: int,
    perturbations: Sequence[Perturbation] = (),
) -> Iterator[str]:
    """Add a frame a family and seed; yields their names. Raises ConfigError, RecordingError."""
    families, seeds = _asked(names, seeds, seed)
    rig = any_rig(rig)
    renderer, stated = rig_renderer(rig, seed), rig.calibration
    for one in perturbations:
        stated = one.rig(stated, [seed])
    if stated is not rig.calibration:
        renderer = renderer_of(stated, renderer, seed)
    for one in perturbations:
        stated = one.stated(stated)
    text = read_text(rig.calibration_path)
    if stated is not rig.calibration:
        text = dump_calibration(stated, "perturbed: not what the cameras are")
    with added_to(folder, text) as writer:
        for name in families:
            for member in seeds:
                frame, chance = f"{name}-{member:04d}", (seed, member, *name.encode())
                state = warm(situation(name, member))
                shot = draw(renderer, name, state, [seed, member], perturbations, chance)
                writer.add(frame, shot.frames, shot.truth)
                yield frame


@dataclass(frozen=True, slots=True, eq=False)
class DrawnScene:
    """A scene as the cameras see it, with its exact truth; ``state``: the scene, as perturbed."""

    frames: FrameSet
    truth: tuple[TruthRow, ...]
    state: SceneState


def draw(
    renderer: Renderer,
    name: str,
    state: SceneState,
    seeds: Sequence[int],
    perturbations: Sequence[Perturbation] = (),
    chance: Sequence[int] = (),
) -> DrawnScene:
    """One scene, its noise by ``name`` and ``seeds``. Raises ValueError: a thing is too near."""
    for one in perturbations:
        state = one.state(state, chance)
    frames = taken(renderer, state, np.random.default_rng([*seeds, *name.encode()]))
    for one in perturbations:
        frames = one.frames(frames, chance)
    ends = zip(state.phantom.ends_mm.tolist(), renderer.visible_ends(state), strict=True)
    rows = (
        TruthRow(name, str(i), (x, y, z), bool(seen.all()), 0.0)
        for i, ((x, y, z), seen) in enumerate(ends, 1)
    )
    return DrawnScene(frames, tuple(rows), state)


def taken(renderer: Renderer, state: SceneState, rng: np.random.Generator) -> FrameSet:
    """What the cameras see of a state."""
    return frame_set(renderer.render(state, rng))

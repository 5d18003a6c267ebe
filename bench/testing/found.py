"""Scenes that tests found: written beside each other, and kept as cases of a recording."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from zlib import crc32

import cv2
from pydantic import TypeAdapter, ValidationError

from bench.api.loading import load_rig
from bench.campaign.chunk import digest_of_frames
from bench.config import ConfigError, read_text, toml_of
from bench.files import write_together
from bench.record.recording import RecordingError, added_to
from bench.results.answers import name_of
from bench.testing.checking import SceneFailedError
from bench.testing.scene import Scene
from bench.toml import toml_text
from detector.calibration import dump_calibration

SCENE, PICTURE, TEST = "scene.toml", "scene.png", "test_scene.py"
LONGEST = 100  # characters of a folder's name
HEADING = (
    "The simplest scene on which a test failed; 'teatbench campaign keep' adds it to a recording."
)


def write_found(error: SceneFailedError, folder: Path) -> Path:
    """Write the scene, its picture and a test of it alone into ``folder``. Raises OSError."""
    near = error.neighbourhood()
    table = {
        "detector": name_of(error.detector),
        "fault": error.look.fault,
        "limit_mm": error.limit_mm,
        "rig": error.rig,
        "frames": digest_of_frames(error.scene.draw(error.rig).frames),
        "neighbours": near.there,
        "neighbours_looked_at": near.of,
        "neighbours_failing": near.failing,
        "scene": TypeAdapter(Scene).dump_python(error.scene, mode="json", exclude_defaults=True),
    }
    _, png = cv2.imencode(".png", error.picture())
    data = {SCENE: toml_text(table, HEADING).encode(), PICTURE: png.tobytes()}
    write_together(folder, {**data, TEST: error.lines().encode()}.items())
    return folder


def folder_name(test: str) -> str:
    """A folder's name for a test's; a long one is cut, and ends in its digest."""
    name = re.sub(r"[^A-Za-z0-9_.-]+", "-", test).strip("-.") or "scene"
    return name if len(name) <= LONGEST else f"{name[:LONGEST]}-{crc32(test.encode()):08x}"


def read_scene(path: Path) -> tuple[Scene, dict[str, Any]]:
    """A scene of `write_found`, and what else its file says. Raises ConfigError."""
    table = toml_of(path)
    try:
        return TypeAdapter(Scene).validate_python(table.pop("scene")), table
    except (KeyError, ValidationError) as error:
        raise ConfigError.plain(f"{path}: is no scene that a test found: {error}") from error


def keep(folder: Path | str, into: Path | str, name: str | None = None) -> str:
    """Add a found scene to a recording; gives back the frame's name. Raises ConfigError."""
    folder, recording = Path(folder), Path(into)
    path = folder if folder.is_file() else folder / SCENE
    if not path.exists():
        what = f"no scene is there; name a folder that a failing test has written ({SCENE})"
        raise ConfigError.plain(f"{folder}: {what}")
    scene, facts = read_scene(path)
    rig = load_rig(str(facts.get("rig", "emulated")))
    frame = name or path.resolve().parent.name
    try:
        shot = scene.draw(rig)
    except ConfigError as error:
        raise ConfigError.plain(f"{path}: {error}") from error
    if digest_of_frames(shot.frames) != facts.get("frames"):
        what = "this version of the program draws the scene differently: run its test again"
        raise ConfigError.plain(f"{path}: {what}")
    stated = read_text(rig.calibration_path)
    if shot.calibration is not rig.calibration:
        stated = dump_calibration(shot.calibration, "perturbed: not what the cameras are")
    try:
        with added_to(recording, stated) as writer:
            writer.add(frame, shot.frames, shot.truth)
    except RecordingError as error:
        raise ConfigError.plain(f"{error}; give another `name`") from error
    return frame

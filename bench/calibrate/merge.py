"""One calibration from the steps' files: what each holds is put together, and what doesn't fit
together is refused. The world's step depends on the very cameras that it was made with, and so does
the thermal one's: their records name the cameras' file by its hash.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.config import ConfigError, located, read_text
from detector.calibration import (
    Calibration,
    CalibrationError,
    ParameterCovariance,
    Part,
    Record,
    file_hash,
    load_part,
)

CAMERAS_INPUT = "cameras file"  # the record's name for the file that a later step was made with
_BLOCKS = {
    "left": "cameras.left",
    "right": "cameras.right",
    "right_from_left": "stereo",
    "thermal": "cameras.thermal",
    "thermal_from_left": "thermal",
    "homographies": "homography",
    "world_from_right": "world",
}
_STEPS = {
    "left": "cameras",
    "right": "cameras",
    "right_from_left": "cameras",
    "thermal": "thermal",
    "homographies": "thermal",
}


@dataclass(frozen=True, slots=True, eq=False)
class PartFile:
    """A step's file as read."""

    path: Path
    part: Part
    sha256: str


def read_part(path: Path) -> PartFile:
    """A step's file. Raises ConfigError that shows each fault in its place."""
    try:
        return PartFile(path, load_part(path), file_hash(path))
    except CalibrationError as error:
        text = read_text(path)
        raise located(
            path, text, [(fault.key, fault.message, False) for fault in error.faults]
        ) from error


def merge(files: Sequence[PartFile], record: Record) -> Calibration:
    """The whole calibration. Raises ConfigError for a part that is missing, there twice, or made
    with another pair.
    """
    found: dict[str, PartFile] = {}
    for file in files:
        for name in _BLOCKS:
            if getattr(file.part, name) is None:
                continue
            if name in found:
                raise ConfigError.plain(
                    f"[{_BLOCKS[name]}] is in {found[name].path} and in {file.path}: leave one of"
                    " them out"
                )
            found[name] = file
    for name, block in _BLOCKS.items():
        if name not in found and name != "thermal_from_left":
            step = _STEPS.get(name, "world")
            raise ConfigError.plain(
                f"[{block}] is in none of the files: add the file that 'teatbench calibrate {step}'"
                " wrote"
            )
    _refuse_other_pair(found)
    values = {name: getattr(file.part, name) for name, file in found.items()}
    values.setdefault("thermal_from_left", None)
    return Calibration(
        **values, covariance=_together(files, found), record=_whole_record(files, record)
    )


def _refuse_other_pair(found: Mapping[str, PartFile]) -> None:
    cameras = found["left"]
    for file in {
        found[name].path: found[name] for name in ("thermal", "world_from_right")
    }.values():
        made_with = file.part.record.inputs.get(CAMERAS_INPUT) if file.part.record else None
        if made_with is not None and made_with != cameras.sha256 and file.path != cameras.path:
            raise ConfigError.plain(
                f"{file.path} was made with another cameras' file than {cameras.path}: make that"
                " step again with this one"
            )


def _together(
    files: Sequence[PartFile], found: Mapping[str, PartFile]
) -> ParameterCovariance | None:
    """One covariance: the world's file tells that of the pair too; parts that know nothing of each
    other are taken for independent.
    """
    world, cameras = found["world_from_right"], found["left"]
    kept: list[ParameterCovariance] = []
    for file in files:
        told = file.part.covariance
        if told is None or (
            file is cameras
            and world is not cameras
            and world.part.covariance is not None
            and _tells_pair(world)
        ):
            continue
        kept.append(told)
    if not kept:
        return None
    names = tuple(name for told in kept for name in told.names)
    matrix = np.zeros((len(names), len(names)))
    at = 0
    for told in kept:
        matrix[at : at + len(told.names), at : at + len(told.names)] = told.matrix
        at += len(told.names)
    return ParameterCovariance(names, matrix)


def _tells_pair(file: PartFile) -> bool:
    return file.part.covariance is not None and any(
        owner != "world" for owner, _ in file.part.covariance.names
    )


def _whole_record(files: Sequence[PartFile], record: Record) -> Record:
    """The day of the oldest part: a calibration is as old as its oldest step. Every step's inputs
    are kept, under the step's file.
    """
    parts = [(file.path.name, file.part.record) for file in files if file.part.record]
    cameras = {name: identity for _, part in parts for name, identity in part.cameras.items()}
    inputs = {file.path.name: file.sha256 for file in files}
    inputs |= {
        f"{name}: {key}": value for name, part in parts for key, value in part.inputs.items()
    }
    made = min([part.made for _, part in parts] or [record.made])
    return Record(
        made,
        record.by,
        record.with_what,
        {**cameras, **record.cameras},
        {**inputs, **record.inputs},
    )

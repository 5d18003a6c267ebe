"""One calibration from the steps' files: what each holds is put together, and what doesn't fit
together is refused. The world's step depends on the very cameras that it was made with, and so does
the thermal one's: their records name the cameras' file by its hash.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from scipy.linalg import block_diag

from bench.config import ConfigError, located, read_text, several, write_file
from bench.version import __version__
from detector.calibration import (
    Calibration,
    CalibrationError,
    ParameterCovariance,
    Part,
    Record,
    check_text,
    dump_calibration,
    file_hash,
    load_part,
)
from detector.calibration.values import Pair
from detector.geometry import Motion
from instruments.clock import wall_time

CAMERAS_INPUT = "cameras file"  # the record's name for the file that a later step was made with
# each attribute of a part, its block in the file, and the step that makes it; a depth camera's are
# its maker's
_BLOCKS = {
    "left": ("cameras.left", "cameras"),
    "right": ("cameras.right", "cameras"),
    "right_from_left": ("stereo", "cameras"),
    "thermal": ("cameras.thermal", "thermal"),
    "thermal_from_left": ("thermal", "thermal"),
    "homographies": ("homography", "thermal"),
    "depth": ("cameras.depth", ""),
    "depth_from_left": ("depth", ""),
    "world_from_right": ("world", "world"),
}


@dataclass(frozen=True, slots=True, eq=False)
class PartFile:
    path: Path
    part: Part
    sha256: str


def read_part(path: Path | str) -> PartFile:
    """A step's file. Raises ConfigError that shows each fault in its place."""
    path = Path(path)
    try:
        return PartFile(path, load_part(path), file_hash(path))
    except CalibrationError as error:
        text = read_text(path)
        raise located(
            path, text, [(fault.key, fault.message, False) for fault in error.faults]
        ) from error


def pair_of_part(part: Part) -> Pair:
    """The pair in ``part``; without a world, the right camera's frame. Raises ConfigError."""
    if part.left is None or part.right is None or part.right_from_left is None:
        raise ConfigError.plain(
            "the file holds no stereo pair ([cameras.left], [cameras.right], [stereo]), as"
            " 'teatbench calibrate cameras' writes it"
        )
    world = part.world_from_right or Motion.identity()
    return Pair(part.left, part.right, part.right_from_left, world)


def merge_parts(files: Sequence[PartFile], record: Record) -> Calibration:
    """The whole. Raises ConfigError for a part missing, there twice, or of another pair."""
    found: dict[str, PartFile] = {}
    for file in files:
        for name, (block, _) in _BLOCKS.items():
            if getattr(file.part, name) is None:
                continue
            if name in found:
                raise ConfigError.plain(
                    f"[{block}] is in {found[name].path} and in {file.path}: leave one of them out"
                )
            found[name] = file
    for name, (block, step) in _BLOCKS.items():
        if name not in found and step and name != "thermal_from_left":
            raise ConfigError.plain(
                f"[{block}] is in none of the files: add the file that 'teatbench calibrate {step}'"
                " wrote"
            )
    cameras = found["left"]
    for file in (found["thermal"], found["world_from_right"]):
        made_with = file.part.record.inputs.get(CAMERAS_INPUT) if file.part.record else None
        if made_with not in (None, cameras.sha256) and file.path != cameras.path:
            raise ConfigError.plain(
                f"{file.path} was made with another cameras' file than {cameras.path}: make that"
                " step again with this one"
            )
    values = {name: getattr(file.part, name) for name, file in found.items()}
    values.setdefault("thermal_from_left", None)
    # the world's file has the pair's covariance too; other parts are independent
    world = found["world_from_right"]
    of_world = world.part.covariance
    has_pair = world is not cameras and any(
        owner != "world" for owner, _ in (of_world.names if of_world else ())
    )
    kept = [f.part.covariance for f in files if not (f is cameras and has_pair)]
    known = [one for one in kept if one]
    names = tuple(name for one in known for name in one.names)
    matrix = block_diag(*(one.matrix for one in known))
    covariance = ParameterCovariance(names, matrix) if known else None
    return Calibration(**values, covariance=covariance, record=_whole_record(files, record))


def _whole_record(files: Sequence[PartFile], record: Record) -> Record:
    """As old as its oldest step; every step's inputs are kept, under its file."""
    parts = [(file.path.name, file.part.record) for file in files if file.part.record]
    cameras = {name: identity for _, part in parts for name, identity in part.cameras.items()}
    inputs = {file.path.name: file.sha256 for file in files}
    inputs |= {
        f"{name}: {key}": value for name, part in parts for key, value in part.inputs.items()
    }
    made = min([part.made for _, part in parts] or [record.made])
    return Record(
        made, record.by, record.with_what, cameras | {**record.cameras}, inputs | {**record.inputs}
    )


def calibration_record(
    inputs: Sequence[Path | str] = (),
    *,
    by: str = "",
    cameras: Mapping[str, str] | None = None,
    pair: PartFile | None = None,
) -> Record:
    """The record of a step: made today, with this program, from the files ``inputs``, with
    ``cameras`` of these identities, and with the file of a ``pair``.
    """
    paths = [*map(Path, several("inputs", inputs))]
    names = [path.name for path in paths]
    again = {path: names.count(path.name) > 1 for path in paths}
    hashes = {f"{p.parent.name}/{p.name}" if again[p] else p.name: file_hash(p) for p in paths}
    today, program = wall_time().date().isoformat(), f"teatbench {__version__}"
    hashes |= {CAMERAS_INPUT: pair.sha256} if pair else {}
    return Record(today, by, program, cameras or {}, hashes)


def write_calibration(found: Part | Calibration, out: Path | str, command: str = "") -> None:
    """Write a step's file or the whole, with the ``command`` that made it. Raises ConfigError."""
    out = Path(out)
    text = dump_calibration(found, command)
    try:
        check_text(out, text, whole=isinstance(found, Calibration))
    except CalibrationError as error:
        raise ConfigError.plain(f"not written, for it can't be: {error}") from error
    write_file(out, text)

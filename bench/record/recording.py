"""Recordings: folders of frames with calibration and truth, read and written (recording-format.md).
Files are written beside their place and then moved there.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from shutil import rmtree
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.config import ConfigError, beside, read_text, writing
from bench.record.schema import DATABASE
from instruments.camera.cameras import KNOWN
from instruments.camera.frame import FrameSet, grey8, no_temperatures
from instruments.errors import DeviceError
from textfiles.tables import TableError, TextRow, read_table
from textfiles.text import TextError, text_of
from textfiles.whole import new_folders, replace_whole, take_place

PNG = b"\x89PNG\r\n\x1a\n"
PNG_FAST = (cv2.IMWRITE_PNG_COMPRESSION, 1)
# of a frame set, and its files: the last three have 16 bits
FIELDS = ("left", "right", "thermal", "thermal_ck", "depth_dmm", "amplitude")
FILES = (
    "left.png", "right.png", "thermal.png", "thermal_radiometric.png", "depth.png",
    "depth_amplitude.png",
)  # fmt: skip
UNITS = dict(zip(FILES[3:], ("centi-kelvin", "tenths of a millimetre", "counts"), strict=True))
LENGTHS = ("x_mm", "y_mm", "z_mm")
COLUMNS = ("frame", "situation", "teat", *LENGTHS, "visible")
# a teat is some 20 mm thick: two ends nearer than this are one end, measured twice
SAME_END_MM = 5.0
UNSAFE = set('<>:"/\\|?*')


class RecordingError(ValueError):
    """An incomplete or damaged folder; the message has the file, line and what was expected."""


@dataclass(frozen=True, slots=True)
class TruthRow:
    """A teat of a frame: end in world mm, whether all cameras see it, standard uncertainty mm."""

    situation: str
    teat: str
    xyz_mm: tuple[float, float, float]
    visible: bool
    u_mm: float | None = None


A_RECORDING = "A recording is a folder with its images in frames/<id>/."


class Recording:
    """A recording on disk; images are read on demand. Raises RecordingError."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        frames = self.path / "frames"
        if not self.path.is_dir():
            near = beside(self.path, DATABASE)
            why = "is a file." if self.path.exists() else f"there is no such folder{near}"
            raise RecordingError(f"{path}: {why} {A_RECORDING}")
        if not frames.is_dir():
            why = "is no recording: there is no folder frames in it."
            raise RecordingError(f"{path} {why} {A_RECORDING}")
        self.frames: tuple[str, ...] = tuple(sorted(p.name for p in frames.iterdir() if p.is_dir()))
        if not self.frames:
            what = "holds no frames; each is a folder with left.png and right.png"
            raise RecordingError(f"{frames}: {what}")
        self.calibration_path = self.path / "calibration.toml"
        self.truth: dict[str, tuple[TruthRow, ...]] = self._truth()

    def load(self, frame_id: str) -> FrameSet:
        """The images of a frame. Raises RecordingError."""
        folder = self.path / "frames" / frame_id
        if frame_id not in self.frames:
            first = f"the first of {len(self.frames)} is {self.frames[0]!r}"
            raise RecordingError(f"{folder}: there is no frame {frame_id!r}; {first}")
        left, right, thermal, *others = (folder / name for name in FILES)
        eight = read_grey(thermal) if thermal.exists() else None
        kelvin, depth, strength = (_counts(one) if one.exists() else None for one in others)
        if kelvin is not None and (wrong := no_temperatures(kelvin)):
            raise RecordingError(f"{others[0]}: {wrong}")
        pair = read_grey(left), read_grey(right)
        try:
            return FrameSet(*pair, eight, kelvin, depth_dmm=depth, amplitude=strength)
        except ValueError as fault:
            raise RecordingError(f"{folder}: {fault}") from fault

    def sizes(self, frame_id: str) -> dict[str, tuple[int, int]]:
        """Columns and rows of a frame's PNG files by name, from their heads alone."""
        folder = self.path / "frames" / frame_id
        return {name: size for name in FILES if (size := png_size(folder / name))}

    def _truth(self) -> dict[str, tuple[TruthRow, ...]]:
        path = self.path / "truth.csv"
        if not path.exists():
            return {}
        found: dict[str, list[TruthRow]] = {}
        line = 1
        try:
            for each in read_table(text_of(path), COLUMNS, (*LENGTHS, "u_mm")).rows:
                line = each.line
                frame, row = _truth_row(each)
                self._check(found.setdefault(frame, []), frame, row)
                found[frame].append(row)
        except (RecordingError, TableError) as fault:
            line = fault.line if isinstance(fault, TableError) else line
            raise RecordingError(f"{path}:{line}: {fault}") from fault
        except (OSError, TextError) as fault:
            why = getattr(fault, "strerror", None) or fault
            raise RecordingError(f"{path}: {why}") from fault
        return {frame: tuple(rows) for frame, rows in found.items()}

    def _check(self, rows: Sequence[TruthRow], frame: str, row: TruthRow) -> None:
        """Raise RecordingError for a row that contradicts the folder or the frame's rows above."""
        if frame not in self.frames:
            raise RecordingError(f"names frame {frame!r}, but frames/ has no such folder")
        if any(other.teat == row.teat for other in rows):
            raise RecordingError(f"teat {row.teat!r} of frame {frame!r} stands here a second time")
        for other in rows:
            if other.situation != row.situation:
                what = f"is {row.situation!r} here and {other.situation!r} above"
                raise RecordingError(f"frame {frame!r} {what}")
            if (apart := math.dist(other.xyz_mm, row.xyz_mm)) < SAME_END_MM:
                names = f"teats {other.teat!r} and {row.teat!r} of frame {frame!r}"
                what = "one was measured twice; measure them again"
                raise RecordingError(f"the ends of {names} are {apart:.2f} mm apart: {what}")


def _truth_row(row: TextRow) -> tuple[str, TruthRow]:
    x, y, z = (row.number(name, "mm") for name in LENGTHS)
    frame, situation, teat, visible = (row.cells[name] for name in (*COLUMNS[:3], "visible"))
    if visible not in ("0", "1"):
        raise RecordingError(f"visible must be 0 or 1, is {visible!r}")
    u_mm = row.number("u_mm", "mm") if row.cells.get("u_mm") else None
    if u_mm and u_mm < 0.0:
        what = f"u_mm, a standard uncertainty, can't be below zero: {row.cells['u_mm']}"
        raise RecordingError(what)
    return frame, TruthRow(situation, teat, (x, y, z), visible == "1", u_mm)


def _image(path: Path) -> NDArray[Any]:
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise RecordingError(f"{path}: missing; every frame needs it") from None
    except OSError as fault:
        raise RecordingError(f"{path}: can't be read: {fault.strerror or fault}") from fault
    # OpenCV takes some of these, and libpng writes about others to the terminal
    if damaged := _damaged_chunk(data):
        again = "Copy it again from where it was taken."
        raise RecordingError(f"{path}: is damaged: {damaged}. {again}")
    image, why = None, f"{len(data)} bytes"
    try:  # through memory, for imread takes only the ASCII paths of Windows
        if data:
            image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as fault:  # its header claims a size that no memory holds
        why = f"OpenCV refuses it: {fault.err}"
    if image is None:
        raise RecordingError(f"{path}: is not an image that can be read ({why})")
    return image


def png_size(path: Path) -> tuple[int, int] | None:
    """Columns and rows of a PNG from its head alone; None where there is none."""
    try:
        with path.open("rb") as file:
            head = file.read(24)
    except OSError:
        return None
    is_png = head.startswith(PNG) and head[12:16] == b"IHDR"
    return (int.from_bytes(head[16:20]), int.from_bytes(head[20:24])) if is_png else None


def _damaged_chunk(data: bytes) -> str:
    """The damage of a PNG's chunks by length and checksum; empty where whole, or no PNG."""
    at = len(PNG)
    while data.startswith(PNG):
        end = at + 8 + int.from_bytes(data[at : at + 4])
        if end + 4 > len(data):
            return "it is cut off"
        kind = data[at + 4 : at + 8]
        if zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4]):
            return f"the checksum of its chunk {kind!r} from byte {at} on is wrong"
        if kind == b"IEND":
            break
        at = end + 4
    return ""


def read_grey(path: Path) -> NDArray[np.uint8]:
    """The image in a file as 8-bit grey. Raises RecordingError where it is missing, or no image."""
    image = _image(path)
    try:
        return grey8(image)
    except ValueError as fault:
        raise RecordingError(f"{path}: {fault}") from fault


def _counts(path: Path) -> NDArray[np.uint16]:
    image = _image(path)
    if image.dtype != np.uint16 or image.ndim != 2:
        what = f"is {image.dtype} with {image.ndim} dimensions"
        raise RecordingError(f"{path}: must be 16-bit grey in {UNITS[path.name]}, {what}")
    return image


class RecordingWriter:
    """Writes frame by frame, each time a whole recording. Raises RecordingError, OSError."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        (self.path / "frames").mkdir(parents=True, exist_ok=True)
        self._truth: dict[str, tuple[TruthRow, ...]] = {}
        if (self.path / "truth.csv").exists():
            self._truth = Recording(self.path).truth

    def add_calibration(self, text: str) -> None:
        """Write calibration.toml, as the text that it was read from."""
        replace_whole(self.path / "calibration.toml", text.encode())

    def add(self, frame_id: str, frames: FrameSet, truth: Sequence[TruthRow] = ()) -> None:
        """Write a frame's images as PNG; the folder appears when all of them are there. Where its
        ``truth`` can't be written, it goes again.
        """
        if not isinstance(frames, FrameSet):
            raise RecordingError(f"frames is {frames!r}, no FrameSet")
        with self._made(frame_id) as making:
            for name, field in zip(FILES, FIELDS, strict=True):
                if (image := getattr(frames, field)) is None:
                    continue
                good, data = cv2.imencode(".png", image, PNG_FAST)
                if not good:
                    raise RecordingError(f"{image.shape} of {image.dtype} can't be written as PNG")
                replace_whole(making / name, data.tobytes())
        try:
            if truth:
                self.add_truth(frame_id, truth)
        except BaseException:
            rmtree(self.path / "frames" / frame_id)
            raise

    def copy(self, frame_id: str, folder: Path) -> None:
        """Write a frame's images as they are in ``folder``, under their names, byte for byte."""
        with self._made(frame_id) as making:
            for name in FILES:
                if name in FILES[:2] or (folder / name).exists():
                    _image(folder / name)
                    replace_whole(making / name, (folder / name).read_bytes())

    @contextmanager
    def _made(self, frame_id: str) -> Iterator[Path]:
        """A folder that becomes the frame's when all is in it."""
        safe = frame_id.isprintable() and not UNSAFE & set(frame_id)
        if not frame_id or frame_id != frame_id.strip(" .") or not safe:
            what = "a frame's id must be a name that any file system takes"
            raise RecordingError(f"{what}, is {frame_id!r}")
        folder = self.path / "frames" / frame_id
        if folder.exists():
            raise RecordingError(f"{folder}: there is such a frame already")
        # beside frames/, not in it: a reader must not take it for a frame
        making = self.path / f"making {frame_id}"
        making.mkdir(exist_ok=True)
        with ExitStack() as at_end:
            at_end.callback(rmtree, making, ignore_errors=True)
            yield making
            take_place(making, folder)

    def add_truth(self, frame_id: str, rows: Sequence[TruthRow]) -> None:
        """Add the truth of a frame, which `add` has written, and write truth.csv anew."""
        if not (self.path / "frames" / frame_id).is_dir():
            raise RecordingError(f"truth for frame {frame_id!r}, but no such frame was added")
        if frame_id in self._truth:
            raise RecordingError(f"{self.path}: frame {frame_id!r} has its truth already")
        if len({row.teat for row in rows}) != len(rows) or len({row.situation for row in rows}) > 1:
            got = [(row.situation, row.teat) for row in rows]
            raise RecordingError(f"frame {frame_id!r}: each teat once, one situation; got {got}")
        known = {**self._truth, frame_id: tuple(rows)}
        lines = [",".join((*COLUMNS, "u_mm"))]
        for frame, row in ((frame, row) for frame, those in known.items() for row in those):
            names = (frame, row.situation, row.teat)
            if set("".join(names)) & set(',"\r\n'):
                what = "names in truth.csv can't hold commas, quotes or line ends"
                raise RecordingError(f"frame {frame!r}: {what}, got {names}")
            u_mm = "" if row.u_mm is None else float(row.u_mm)
            values = *names, *map(float, row.xyz_mm), int(row.visible), u_mm
            lines.append(",".join(map(str, values)))
        replace_whole(self.path / "truth.csv", "\n".join([*lines, ""]).encode())
        self._truth = known


@contextmanager
def added_to(folder: Path | str, calibration: str | None) -> Iterator[RecordingWriter]:
    """A writer of the recording in ``folder``, with the text of its ``calibration``; nothing new
    stays where not one frame can be written. Raises RecordingError; ConfigError, also where the
    folder has another calibration, which its frames or a rig file are of.
    """
    frames, there = Path(folder) / "frames", Path(folder) / "calibration.toml"
    is_new = not there.exists()
    if calibration is not None and not is_new and read_text(there) != calibration:
        raise ConfigError.plain(f"{there} has another calibration: name another folder.")
    with writing(Path(folder)), new_folders(frames):
        try:
            writer = RecordingWriter(folder)
            if calibration is not None:
                writer.add_calibration(calibration)
            yield writer
        except BaseException:
            if is_new and not any(frames.glob("*")):
                there.unlink(missing_ok=True)
            raise


class RecordingCameras:
    """Cameras that play a recording's frames in order, once."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._next = 0

    @property
    def identity(self) -> Mapping[str, str]:
        """Where the pictures come from, for each camera."""
        return dict.fromkeys(KNOWN, f"recording {self._recording.path}")

    def capture(self) -> FrameSet:
        """The next frame set. Raises DeviceError after the last."""
        frames = self._recording.frames
        if self._next >= len(frames):
            who, played = f"cameras of {self._recording.path}", f"all {len(frames)} frames"
            hint = "Record more, or play fewer."
            raise DeviceError(who, f"{played} have been played", hint=hint)
        self._next += 1
        return self._recording.load(frames[self._next - 1])

    def close(self) -> None:
        """Nothing is held open."""

"""A record's files, which are on the disk whole or not at all, in folders that are synced too.

Pictures are PNG: 8 bits a pixel compressed, 16 bits of a sensor stored, since their lower half is
noise (docs/record.md has the figures).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from textfiles.whole import is_full, new_folders, replace_all, replace_whole

Picture = NDArray[np.uint8] | NDArray[np.uint16]

# On noise half the time of level 1, and smaller; a level would undo it. Differences to the row
# above are as small as those to the pixel before, and are read in three quarters of the time.
PNG = (
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP),
)
STORED = (cv2.IMWRITE_PNG_COMPRESSION, 0, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_NONE)
AT_ONCE = 4  # files; a disk syncs several in little more time than one
UNWRITTEN, FULL = "the record could not be written", "the disk is full"


def png_bytes(image: Picture) -> bytes:
    """``image`` as a PNG. Raises ValueError when it can't be one."""
    done, data = cv2.imencode(".png", image, STORED if image.dtype == np.uint16 else PNG)
    if not done:
        raise ValueError(f"OpenCV can't write {image.dtype} of shape {image.shape} as PNG")
    return bytes(data)


def write_pictures(pictures: Mapping[Path, Picture]) -> dict[Path, str]:
    """Write all as PNG, synced; gives back each SHA-256. Raises OSError, ValueError."""
    if not pictures:
        return {}
    folders = {path.parent for path in pictures}
    with ThreadPoolExecutor(AT_ONCE) as threads, new_folders(*folders, each=threads.map):
        digests = list(threads.map(_write_picture, pictures.keys(), pictures.values()))
    return dict(zip(pictures, digests, strict=True))


def _write_picture(path: Path, image: Picture) -> str:
    replace_whole(path, data := png_bytes(image), synced=True)
    return hashlib.sha256(data).hexdigest()


def write_synced(path: Path, data: bytes) -> None:
    """``data`` at ``path``, durable; after a crash whole or not at all."""
    write_together(path.parent, [(path.name, data)])


def write_together(folder: Path, files: Iterable[tuple[str, bytes]]) -> list[Path]:
    """Each name's data in ``folder``, durable: where one can't be written, none is."""
    with new_folders(folder):
        return replace_all(((folder / name, data) for name, data in files), synced=True)


def sha256_of(path: Path) -> str:
    """SHA-256 of a file's bytes. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def is_unreadable(error: OSError) -> bool:
    """Whether ``error`` refused a file or folder that is there, and that this user may not read."""
    if not isinstance(error, PermissionError) or not isinstance(error.filename, str | Path):
        return False
    path = Path(error.filename)
    if not os.access(path.parent, os.X_OK):
        return True
    wanted = os.R_OK | os.X_OK if path.is_dir() else os.R_OK
    return path.exists() and not os.access(path, wanted)


def unwritten(error: Exception) -> str:
    """Why a record, SQLite's too, could not be written: in a sentence without its stop."""
    return f"{UNWRITTEN}: {FULL if is_full(error) else getattr(error, 'strerror', None) or error}"

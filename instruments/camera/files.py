"""Pictures from files as a camera: PNG or TIFF of 8 or 16 bits, in the order of their names, the
pages of a TIFF one after the other. Each is given once, as it was stored.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from instruments.camera.frame import FrameError, FrameFault, Pixels, RawFrame
from instruments.clock import Clock
from instruments.errors import LinkError

ENDINGS = (".png", ".tif", ".tiff")


class FileCamera:
    """``place``: a folder, or a path with * and ?. Raises LinkError where there is no picture."""

    def __init__(self, name: str, place: Path, clock: Clock) -> None:
        self._name, self._who, self._clock = name, f"{name} camera files:{place}", clock
        self._paths = pictures_at(place)
        if not self._paths:
            hint = f"Name a folder of {', '.join(ENDINGS)}, or a path such as frames/*.tiff."
            raise LinkError(self._who, "no picture is there", hint=hint)
        self._pages = self._read()
        self._begun_s: float | None = None
        self.identity = f"files {place} ({len(self._paths)})"

    def prepare(self) -> None:
        """Nothing is needed."""

    def begin(self) -> None:
        """The next picture is wanted."""
        self._begun_s = self._clock.now()

    def take(self) -> RawFrame:
        """It. Raises LinkError after the last one, FrameError for one that can't be read."""
        page = next(self._pages, None)
        if page is None or self._begun_s is None:
            what = f"gave no frame: its {len(self._paths)} files are used up, or it was closed"
            raise LinkError(self._who, what, asked="a frame")
        path, image = page
        if image is None or image.dtype not in (np.uint8, np.uint16):
            kind = "no picture" if image is None else f"a picture of {image.dtype}"
            what = f"{path} is {kind}; 8 or 16 bits are wanted"
            raise FrameError(FrameFault.HALF, self._name, self._who, what)
        pixels: Pixels = np.ascontiguousarray(image)
        return RawFrame(pixels, self._begun_s, 8 * pixels.itemsize)

    def close(self) -> None:
        """Give no more; may be called again."""
        self._begun_s, self._pages = None, iter(())

    def _read(self) -> Iterator[tuple[Path, NDArray[np.generic] | None]]:
        for path in self._paths:
            try:
                data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
                whole, pages = cv2.imdecodemulti(data, cv2.IMREAD_UNCHANGED)
            except (OSError, cv2.error):
                whole, pages = False, ()
            yield from ((path, page) for page in (pages if whole and pages else (None,)))


def pictures_at(place: Path) -> list[Path]:
    """What `FileCamera` reads, by name; numbers in names count as numbers."""
    at = [place / "*"] if place.is_dir() else [place]
    found = [path for one in at for path in one.parent.glob(one.name) if path.is_file()]

    def by_number(path: Path) -> list[tuple[int, str]]:
        parts = re.split(r"(\d+)", path.name)
        return [(int(part), "") if part.isdecimal() else (0, part) for part in parts]

    return sorted((path for path in found if path.suffix.lower() in ENDINGS), key=by_number)

"""A video file's frames as they are stored, through PyAV: OpenCV scales a frame of another size to
the first one's without a word.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from instruments.errors import LinkError

COUNTS = "gray16le"
# metadata that are no UTF-8 are an error to PyAV before 19; later ones have no such option
LENIENT: dict[str, Any] = {"metadata_errors": "replace"} if av.__version__ < "19" else {}
DAMAGED = (av.FFmpegError, OSError, ValueError, LookupError)  # what the library raises for a file


class VideoFile:
    """``counts``: 16-bit grey is left as it is. Its methods are those of OpenCV's capture. Raises
    LinkError for a file that can't be read.
    """

    def __init__(self, path: Path, who: str, counts: bool) -> None:
        self._counts = counts
        self._frame: av.VideoFrame | None = None
        try:
            self._container = av.open(str(path), **LENIENT)
            self._frames = self._read(self._container.streams.video[0])
        except DAMAGED as error:
            hint = "Is it a video file, whole and of a common format?"
            raise LinkError(who, f"can't be read: {error}", hint=hint) from error

    def grab(self) -> bool:
        """Whether there is another frame, be it a damaged one."""
        try:
            self._frame = next(self._frames)
        except StopIteration:
            return False
        return True

    def retrieve(self) -> tuple[bool, NDArray[Any] | None]:
        """Whether the frame can be decoded, and it: blue-green-red, or 16-bit counts."""
        frame = self._frame
        if frame is None:
            return False, None
        as_is = self._counts and frame.format.name == COUNTS
        try:
            return True, np.asarray(frame.to_ndarray(format=COUNTS if as_is else "bgr24"))
        except DAMAGED:
            return False, None

    def release(self) -> None:
        """Close the file; may be called again."""
        self._frames = iter(())
        self._container.close()

    def _read(self, stream: av.VideoStream) -> Iterator[av.VideoFrame | None]:
        """Each frame; None for a packet that can't be decoded."""
        packets = self._container.demux(stream)
        while True:
            try:
                packet = next(packets)
            except StopIteration:
                return
            except DAMAGED:  # the file is cut
                yield None
                return
            try:
                yield from [one for one in packet.decode() if isinstance(one, av.VideoFrame)]
            except DAMAGED:
                yield None

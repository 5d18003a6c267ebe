"""Room on the disk that a run keeps for its last words: given back when the disk is full, so that the record can say how it ended.

May not know what the last words are.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

FILE = "reserve.bin"
BYTES = 1 << 19


class Reserve:
    """A file of BYTES in ``folder``, while a run lasts."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / FILE

    def keep(self) -> None:
        """Take the room; where there is none left, there is none to keep."""
        with suppress(OSError):
            self._path.write_bytes(b"\1" * BYTES)

    def give_back(self) -> None:
        """Let it go, once more is no error."""
        with suppress(OSError):
            self._path.unlink(missing_ok=True)

"""The room on the disk that a run keeps for its last entries (`RESERVE`)."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from bench.record.state import RESERVE

BYTES, BLOCK = 1 << 19, 1 << 14


class Reserve:
    """A file of BYTES in ``folder``, while a run lasts; its first BLOCK until the run has its end
    on record. Where others fill the disk at once, the end is written into that.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / RESERVE

    def keep(self) -> None:
        """Take the room; without an error where the disk has none."""
        with suppress(OSError):
            self._path.write_bytes(b"\1" * BYTES)

    def give_back(self) -> None:
        """Free all but the first block; once more is no error."""
        with suppress(OSError):
            os.truncate(self._path, min(BLOCK, self._path.stat().st_size))

    def end(self) -> None:
        """Remove it; once more is no error."""
        with suppress(OSError):
            self._path.unlink(missing_ok=True)

    def leave(self, end: Mapping[str, Any], events: Sequence[Mapping[str, Any]]) -> None:
        """Write what the record has no room for (see `end_in_reserve`): of many events the last."""
        while len(data := json.dumps({**end, "events": events}).encode()) > BLOCK and events:
            events = events[1:]
        with suppress(OSError), self._path.open("r+b") as file:  # a new file has no room
            file.write(data.ljust(BLOCK))

"""Files that are on the disk whole or not at all: written beside their place, then renamed."""

from __future__ import annotations

import os
import sys
from pathlib import Path


def replace_whole(path: Path, data: bytes, *, synced: bool = False) -> None:
    """``data`` at ``path``: who reads it finds all of it, or what was there; ``synced``: after a
    crash too. Raises OSError, which names the file; nothing is left beside it then.
    """
    if path.is_dir():  # before anything is left beside it
        raise IsADirectoryError(f"{path} is a folder")
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as file:
            file.write(data)
            if synced:
                file.flush()
                sync(file.fileno())
    except OSError as error:
        part.unlink(missing_ok=True)
        error.filename = error.filename or str(path)  # a full disk names none
        raise
    part.replace(path)


def sync_folder(folder: Path) -> None:
    """Make the names in ``folder`` durable; Windows does it with the rename."""
    if os.name == "nt":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        sync(handle)
    finally:
        os.close(handle)


def sync(handle: int) -> None:
    """Down to the platter: macOS's fsync stops at the drive's cache (fsync(2) there)."""
    if sys.platform == "darwin":
        import fcntl

        fcntl.fcntl(handle, fcntl.F_FULLFSYNC)
    else:
        os.fsync(handle)

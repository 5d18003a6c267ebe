"""Keeps two benches off one rig: a file beside the rig file that a running bench holds, and that tells who it is.

The system's own lock on the open file is what counts: it goes with the process, however that died, so a lock is never stale on its own
machine. What is written in it is for people, and for a folder shared with another machine, where the system's lock may not reach. An
emulated rig has none: each bench has emulators of its own. Two rig files for one rig have two locks. May not know what is locked.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from bench.config import ConfigError
from bench.rig import LoadedRig
from instruments.clock import wall_time
from instruments.errors import LimitError

ENDING, RUN_LOCK = ".lock.json", "bench.lock.json"
AT = 4096  # the locked byte lies behind the text: Windows keeps others from reading what is locked


class RigInUseError(LimitError):
    """Another bench has the rig."""


def run_lock(folder: Path) -> Path:
    """Where the lock of a run is, whatever its rig: nobody may go on with a run that is under way."""
    return folder / RUN_LOCK


def lock_path(rig: LoadedRig) -> Path | None:
    """Where the rig's lock is; None for an emulated rig."""
    return None if rig.rig.emulated else rig.path.with_name(rig.path.stem + ENDING)


@contextmanager
def locked(path: Path | None, what: str, tell: Callable[[str], None], who: str = "rig") -> Iterator[None]:
    """Hold the lock at ``path`` (None: there is none) for ``what``. ``tell`` hears where a dead bench's lock was taken over.

    Raises RigInUseError where another bench has it, ConfigError where the file can't be had at all.
    """
    if path is None:
        yield
        return
    try:
        file = path.open("r+b" if path.exists() else "w+b")
    except OSError as error:
        raise ConfigError.plain(f"{path}: the {who} can't be locked: {error.strerror or error}") from error
    with file:
        told = _told(file)
        if not _taken(file):
            raise _in_use(path, told, who)
        if told:
            if told.get("host") != platform.node():  # its process can't be seen from here
                raise _in_use(path, told, who)
            tell(f"the lock of a bench that died ({_who(told)}) was taken over")
        _write(file, {"host": platform.node(), "pid": os.getpid(), "since": wall_time().isoformat(timespec="seconds"), "run": what})
        try:
            yield
        finally:
            _write(file, {})
            _given_back(file)


def _told(file: IO[bytes]) -> dict[str, Any]:
    file.seek(0)
    try:
        told = json.loads(file.read(AT).rstrip(b"\0 ") or b"{}")
    except ValueError:
        return {"host": platform.node(), "run": "what it wrote can't be read"}
    return told if isinstance(told, dict) else {}


def _write(file: IO[bytes], told: dict[str, Any]) -> None:
    file.seek(0)
    file.truncate()
    file.write(json.dumps(told).encode() if told else b"")
    file.flush()


def _in_use(path: Path, told: dict[str, Any], who: str) -> RigInUseError:
    hint = f"Wait for it to end, or end it. Where you know that it is gone, delete {path}."
    return RigInUseError(who, f"another bench has it: {_who(told)}", hint=hint)


def _who(told: dict[str, Any]) -> str:
    known = [f"{name} {told[name]}" for name in ("pid", "host", "since", "run") if name in told]
    return ", ".join(known) or "it doesn't say who it is"


if sys.platform == "win32":
    import msvcrt

    def _taken(file: IO[bytes]) -> bool:
        file.seek(AT)
        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

    def _given_back(file: IO[bytes]) -> None:
        file.seek(AT)
        msvcrt.locking(file.fileno(), msvcrt.LK_UNLCK, 1)
else:
    import fcntl

    def _taken(file: IO[bytes]) -> bool:
        try:
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, AT)
        except OSError:
            return False
        return True

    def _given_back(file: IO[bytes]) -> None:
        fcntl.lockf(file, fcntl.LOCK_UN, 1, AT)

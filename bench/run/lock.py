"""Keeps two benches off one rig or run: a file that a running bench holds, with its name in it; and
the room on the disk that a run keeps for its last words.

What counts is the system's lock on the open file, which goes with the process, however it died.
The text in the file is for people, and for a folder shared with another machine, which the system's
lock may not reach. An emulated rig has no lock. Two rig files for one rig have two.
"""

from __future__ import annotations

import errno
import json
import os
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from io import FileIO
from pathlib import Path
from typing import Any, Protocol

from bench.config import ConfigError
from bench.rig.loading import LoadedRig
from instruments.clock import wall_time
from instruments.errors import LimitError

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


ENDING, RUN_LOCK = ".lock.json", "bench.lock.json"
TEXT_BYTES = 4096
# the locked byte, far behind the text and whatever a reader reads at once: Windows keeps others
# from reading it
AT = 1 << 30
# the system's words for "somebody has it"; any other means that it can't lock there
TAKEN = (errno.EACCES, errno.EAGAIN)


class RigInUseError(LimitError):
    """Another bench has the rig."""


def run_lock(folder: Path) -> Path:
    """Where a run's lock is, whatever its rig: nobody may go on with a run that is under way."""
    return folder / RUN_LOCK


def lock_path(rig: LoadedRig) -> Path | None:
    """Where the rig's lock is; None for an emulated rig."""
    return None if rig.rig.emulated else rig.path.with_name(rig.path.stem + ENDING)


class Msvcrt(Protocol):
    """What of Windows's C library is used: its `_locking` locks from the file's own pointer on."""

    LK_NBLCK: int
    LK_UNLCK: int

    def locking(self, fd: int, mode: int, nbytes: int, /) -> None:
        """Lock or unlock; raises OSError, EACCES where somebody has it."""


class SystemLock(Protocol):
    """Takes or gives back the system's lock on the byte `AT` of an open file. Raises OSError, with
    one of `TAKEN` where somebody has it.
    """

    def __call__(self, file: FileIO, *, take: bool) -> None: ...


@dataclass(frozen=True, slots=True)
class WindowsLock:
    """By handle: a second one in the same process is refused too."""

    library: Msvcrt

    def __call__(self, file: FileIO, *, take: bool) -> None:
        file.seek(AT)
        mode = self.library.LK_NBLCK if take else self.library.LK_UNLCK
        self.library.locking(file.fileno(), mode, 1)


@contextmanager
def locked(
    path: Path | None,
    what: str,
    tell: Callable[[str], None],
    who: str = "rig",
    lock: SystemLock | None = None,
) -> Iterator[None]:
    """Hold the lock at ``path`` (None: there is none) for ``what``. ``tell`` hears where a dead
    bench's lock was taken over.

    Raises RigInUseError where another bench has it, ConfigError where the file can't be had at all.
    """
    if path is None:
        yield
        return
    system = lock or SYSTEM
    with ExitStack() as stack:
        told: dict[str, Any] | None = None
        try:
            path.touch()
            # without a buffer: its pointer is the system's, and no more is read than asked for
            file = stack.enter_context(FileIO(path, "r+"))
            told = _told(file)
            system(file, take=True)
        except OSError as error:
            if told is not None and error.errno in TAKEN:
                raise _in_use(path, told, who) from error
            why = f"{path}: the {who} can't be locked: {error.strerror or error}"
            raise ConfigError.plain(why) from error
        if told:
            if told.get("host") != platform.node():  # its process can't be seen from here
                raise _in_use(path, told, who)
            tell(f"the lock of a bench that died ({_who(told)}) was taken over")
        since = wall_time().isoformat(timespec="seconds")
        me = {"host": platform.node(), "pid": os.getpid(), "since": since, "run": what}
        _write(file, json.dumps(me).encode())
        try:
            yield
        finally:
            _write(file, b"")
            system(file, take=False)


def _told(file: FileIO) -> dict[str, Any]:
    file.seek(0)
    try:
        told = json.loads(file.read(TEXT_BYTES).rstrip(b"\0 ") or b"{}")
    except ValueError:
        return {"host": platform.node(), "run": "what it wrote can't be read"}
    return told if isinstance(told, dict) else {}


def _write(file: FileIO, text: bytes) -> None:
    file.seek(0)
    file.truncate()
    file.write(text)


def _in_use(path: Path, told: dict[str, Any], who: str) -> RigInUseError:
    hint = f"Wait for it to end, or end it. Where you know that it is gone, delete {path}."
    return RigInUseError(who, f"another bench has it: {_who(told)}", hint=hint)


def _who(told: dict[str, Any]) -> str:
    known = [f"{name} {told[name]}" for name in ("pid", "host", "since", "run") if name in told]
    return ", ".join(known) or "it doesn't say who it is"


SYSTEM: SystemLock
if sys.platform == "win32":
    import msvcrt

    SYSTEM = WindowsLock(msvcrt)
else:
    import fcntl

    def _posix(file: FileIO, *, take: bool) -> None:
        """By process: it goes when any handle of the process on that file is closed."""
        fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB if take else fcntl.LOCK_UN, 1, AT)

    SYSTEM = _posix

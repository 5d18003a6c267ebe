"""Files that are on the disk whole or not at all: written beside their place, then renamed."""

from __future__ import annotations

import errno
import os
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePath, PureWindowsPath
from typing import TypeVar

from textfiles.text import full_stop, words_of

T = TypeVar("T")
ON_WINDOWS = sys.platform == "win32"
AGAIN_S, PAUSE_S = 5.0, 0.005
# names of devices in every folder, and what would be a stream beside a file
NO_NAME = re.compile(r"(?i)(con|prn|aux|nul|conin\$|conout\$|(com|lpt)[1-9¹²³]) *(\..*)?|.*:.*")
TRIED = 1 << 16  # more than a file that a person works for has


def replace_whole(
    path: Path, data: bytes, *, synced: bool = False, again_s: float | None = None
) -> None:
    """``data`` at ``path``: who reads it finds all of it, or what was there; ``synced``: after a
    crash too; ``again_s``: see `in_turn`. Raises OSError, which names the file; nothing is left
    beside it then.
    """
    replace_all([(path, data)], synced=synced, again_s=again_s)


def replace_all(
    files: Iterable[tuple[Path, bytes]], *, synced: bool = False, again_s: float | None = None
) -> list[Path]:
    """As `replace_whole`; none takes its place before all are written. Gives their paths."""
    parts: dict[Path, Path] = {}
    try:
        for path, data in files:
            refuse_no_name(path)
            if path.is_dir():  # before anything is left beside it
                raise IsADirectoryError(f"{path} is a folder")
            parts[path] = path.with_name(path.name + ".part")
            try:
                with parts[path].open("wb") as file:
                    file.write(data)
                    if synced:
                        file.flush()
                        sync(file.fileno())
            except OSError as error:
                error.filename = error.filename or str(path)  # a full disk names none
                raise
        for path, part in parts.items():
            take_place(part, path, again_s)
    except BaseException:
        for part in parts.values():
            part.unlink(missing_ok=True)
        raise
    return list(parts)


def take_place(part: Path, path: Path, again_s: float | None = None) -> None:
    """``part`` at ``path``, over what is there. Raises OSError, which names ``path``."""
    try:
        in_turn(lambda: part.replace(path), again_s)
    except PermissionError as error:
        error.filename = str(path)  # not the part, which a user does not know
        if ON_WINDOWS:
            error.strerror = f"{error.strerror} (is it read-only, or open in another program?)"
        raise


def in_turn(act: Callable[[], T], again_s: float | None = None) -> T:
    """What ``act`` gives. Windows replaces no file that a program has open, and opens none that is
    just replaced: there it is tried again for ``again_s`` (None: `AGAIN_S`). Raises as ``act``.
    """
    until_s = time.monotonic() + (AGAIN_S if again_s is None else again_s)
    while True:
        try:
            return act()
        except PermissionError:
            if not ON_WINDOWS or time.monotonic() >= until_s:
                raise
        time.sleep(PAUSE_S)


def try_write(path: Path) -> None:
    """Raises OSError where a file of `TRIED` bytes can't be written at ``path``. Leaves nothing."""
    refuse_no_name(path)
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(bytes(TRIED))
    finally:
        part.unlink(missing_ok=True)


def refuse_no_name(path: PurePath) -> None:
    """Raises OSError for a path of Windows in which a name is a device's (CON), or has a colon."""
    names = path.parts[1:] if path.anchor else path.parts
    if isinstance(path, PureWindowsPath) and (bad := [*filter(NO_NAME.fullmatch, names)]):
        why = f"no file or folder can have the name {bad[0]} on Windows"
        raise OSError(errno.EINVAL, why, str(path))


def nearest_there(path: Path) -> Path:
    """``path``, or the nearest folder above it that is there. Raises OSError: its drive isn't."""
    refuse_no_name(path)
    whole = path.resolve()
    for at in (whole, *whole.parents):
        if at.exists():
            return at
    raise FileNotFoundError(errno.ENOENT, f"there is no {whole.anchor}", str(path))


@contextmanager
def new_folders(*folders: Path, each: Callable[..., Iterable[None]] = map) -> Iterator[None]:
    """``folders``, made and synced; where the block fails, new ones that are empty go again."""
    made = [new for folder in folders for new in _made(folder)]
    try:
        list(each(sync_folder, {new.parent for new in made}))
        yield
        list(each(sync_folder, folders))
    except BaseException:
        remove_empty(made)
        raise


def _made(folder: Path) -> list[Path]:
    """Make ``folder``; gives back which are new, itself first."""
    refuse_no_name(folder)
    missing = [folder, *folder.parents]
    missing = missing[: next((k for k, one in enumerate(missing) if one.is_dir()), 0)]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        remove_empty(missing)
        raise
    return missing


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove those of ``folders``, inner ones first, in which nothing is."""
    for one in folders:
        with suppress(OSError):  # something is in it, or it was not made
            one.rmdir()


def is_full(error: BaseException | None) -> bool:
    """Whether it comes of a full disk, or a quota."""
    no_room = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)
    full = getattr(error, "errno", None) in no_room or "disk is full" in words_of(error)
    return full or (error is not None and is_full(error.__cause__))


def refusal(error: Exception, otherwise: str = "") -> str:
    """Why the system would not write. What to do: make room on a full disk, or ``otherwise``."""
    cure = "Make room." if is_full(error) else otherwise
    why = full_stop(str(getattr(error, "strerror", None) or error))
    return f"{why} {cure}".strip()


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
    """Down to the platter: macOS's fsync stops at the drive's cache (fsync(2) there), and what it
    needs instead is refused on a network's folder.
    """
    if sys.platform == "darwin":
        import fcntl

        with suppress(OSError):
            fcntl.fcntl(handle, fcntl.F_FULLFSYNC)
            return
    os.fsync(handle)

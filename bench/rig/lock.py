"""Keeps two benches off one rig or run: a file lock that a bench holds while it has the rig open,
or runs, and its name beside it.

What counts is the system's lock (`filelock`), which goes with the process, however it died. The
text is for people, and for a folder shared with another machine, which the lock may not reach. An
emulated rig has no lock. Two rig files for one rig have two.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from bench.config import ConfigError
from bench.record.state import holder_in, still_runs, this_process
from bench.rig.loading import LoadedRig
from instruments.clock import wall_time
from instruments.errors import LimitError

ENDING = ".lock.json"


class RigInUseError(LimitError):
    """Another bench has the rig."""


def lock_path(rig: LoadedRig) -> Path | None:
    """Where the rig's lock is; None for an emulated rig."""
    return None if rig.rig.simulated else rig.path.with_name(rig.path.stem + ENDING)


@contextmanager
def locked(
    path: Path | None, what: str, report: Callable[[str], None], who: str = "rig"
) -> Iterator[None]:
    """Hold the lock at ``path`` (None: there is none) for ``what`` ("": not given); ``report``
    gets a line where a dead bench's lock was taken over. Raises RigInUseError, ConfigError.
    """
    if path is None:
        yield
        return
    with ExitStack() as stack:
        try:
            path.touch()
            stack.enter_context(FileLock(path.with_suffix(""), timeout=0))  # beside the text
        except Timeout as error:
            raise _in_use(path, holder_in(path), who) from error
        except (OSError, NotImplementedError) as error:
            why = f"{path}: the {who} can't be locked: {getattr(error, 'strerror', None) or error}"
            raise ConfigError.plain(why) from error
        if holder := holder_in(path):
            if holder.get("host") != platform.node():  # its process can't be seen from here
                raise _in_use(path, holder, who)
            report(f"the lock of a bench that died ({_named(holder)}) was taken over")
        since = wall_time().isoformat(timespec="seconds")
        me = this_process() | {"since": since, "run": what}
        path.write_text(json.dumps(me), encoding="utf-8")
        stack.callback(_clear, path)
        yield


def _clear(path: Path) -> None:
    """Empty the text of the lock; its folder may be gone."""
    with suppress(OSError):
        path.write_bytes(b"")


def _in_use(path: Path, holder: dict[str, Any], who: str) -> RigInUseError:
    if still_runs(holder) and holder["pid"] == os.getpid():
        hint = f"Leave the block that opened it first, or use that one's {who}."
        return RigInUseError(who, f"this process has it: {_named(holder)}", hint=hint)
    hint = f"Wait for it to end, or end it. Where you know that it is gone, delete {path}."
    return RigInUseError(who, f"another bench has it: {_named(holder)}", hint=hint)


def _named(holder: dict[str, Any]) -> str:
    named = ("pid", "host", "since", "run")
    known = [f"{name} {holder[name]}" for name in named if holder.get(name)]
    return ", ".join(known) or "it doesn't say who it is"

"""The state of a run, one of six words on every surface, and which bench works in its folder.

The words are for people and for the key ``state``; the record's own ``ending`` has four values,
which scripts read, and stays as it is.
"""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Mapping
from contextlib import suppress
from enum import StrEnum
from pathlib import Path
from typing import Any

RUN_LOCK, RESERVE = "bench.lock.json", "reserve.bin"
TRIP = "trip"  # the kind of the event
CREATED_WITHIN_S = 5.0  # what a system's clock that is set moves when a process began
NO_ENDING = "interrupted"  # in the record: of a run that goes on, too


class State(StrEnum):
    """How a run stands. ``TRIPPED``: an interlock ended it; ``INTERRUPTED``: its bench died."""

    RUNNING = "running"
    FINISHED = "finished"
    FAULTED = "faulted"
    ABORTED = "aborted"
    TRIPPED = "tripped"
    INTERRUPTED = "interrupted"


def state_of(ending: str, *, tripped: bool, held: bool) -> State:
    """By the record's ``ending``, whether an interlock ``tripped`` in its last session, and whether
    a bench works on it: ``held``.
    """
    if ending == NO_ENDING:
        return State.RUNNING if held else State.INTERRUPTED
    if ending == State.FAULTED and tripped:
        return State.TRIPPED
    return State(ending) if ending in list(State) else State.INTERRUPTED


def run_lock(folder: Path) -> Path:
    """Where a run's lock is, whatever its rig: a run that is under way is left alone."""
    return folder / RUN_LOCK


def holder_of(folder: Path) -> dict[str, Any]:
    """Which bench runs in ``folder``; empty for none, or one of this machine that has died."""
    holder = holder_in(run_lock(folder))
    return holder if still_runs(holder) else {}


def holder_in(path: Path) -> dict[str, Any]:
    """The bench that a lock file names; empty for none. An older bench padded it with zeros."""
    if not path.is_file():
        return {}
    try:
        holder = json.loads(path.read_bytes().rstrip(b"\0 ") or b"{}")
    except ValueError:
        return {"host": platform.node(), "run": "what it wrote can't be read"}
    return holder if isinstance(holder, dict) else {}


def end_in_reserve(folder: Path, session: int) -> dict[str, Any]:
    """``facts`` and ``events`` of ``session``'s end that its record had no room for; else empty."""
    with suppress(OSError, ValueError):
        found = json.loads((folder / RESERVE).read_bytes())
        if isinstance(found, dict) and found.get("session") == session:
            return found
    return {}


def this_process() -> dict[str, Any]:
    """Host, number and start: no other process has all three, not after a restart either. The start
    is None where the system doesn't say it: a Linux without /proc.
    """
    import psutil

    pid, created = os.getpid(), None
    with suppress(psutil.Error, OSError):
        created = psutil.Process(pid).create_time()
    return {"host": platform.node(), "pid": pid, "created": created}


def still_runs(holder: Mapping[str, Any]) -> bool:
    """Whether the process that ``holder`` describes (`this_process`) still runs: neither one that
    has ended and waits for its parent, nor another that got its number. One on another machine is
    taken for running.
    """
    import psutil

    pid, created = holder.get("pid"), holder.get("created")
    if holder.get("host", platform.node()) != platform.node():
        return True
    if not isinstance(pid, int):
        return False
    try:
        process = psutil.Process(pid)
        same = created is None or abs(process.create_time() - created) < CREATED_WITHIN_S
        return bool(same and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return sys.platform == "linux" and _unseen(pid, Path(psutil.PROCFS_PATH))
    except (ValueError, OverflowError):
        return False
    except psutil.Error:  # another user's
        return True


def _unseen(pid: int, proc: Path) -> bool:
    """Whether Linux has the process without showing it: there is no /proc, or it is another's."""
    try:
        os.kill(pid, 0)
    except PermissionError:
        return True
    except (ProcessLookupError, OverflowError):
        return False
    return not (proc / "self").exists()

"""In which of six words every surface says how a run stands, and which bench works in its folder.

The words are for people and for the key ``state``; the record's own ``ending`` has four values,
which scripts read, and stays as it is.
"""

from __future__ import annotations

import json
import os
import platform
from enum import StrEnum
from pathlib import Path
from typing import Any

RUN_LOCK = "bench.lock.json"
TRIP = "trip"  # the kind of the event
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
    if holder.get("host") == platform.node() and not lives(holder.get("pid")):
        return {}
    return holder


def holder_in(path: Path) -> dict[str, Any]:
    """What a lock's text says; an older bench padded it with zeros."""
    if not path.is_file():
        return {}
    try:
        holder = json.loads(path.read_bytes().rstrip(b"\0 ") or b"{}")
    except ValueError:
        return {"host": platform.node(), "run": "what it wrote can't be read"}
    return holder if isinstance(holder, dict) else {}


def lives(pid: Any) -> bool:
    """Whether a process of this machine has this number."""
    if not isinstance(pid, int):
        return False
    if os.name == "nt":  # os.kill would end it
        import psutil

        return bool(psutil.pid_exists(pid))
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # another user's
        return True
    return True

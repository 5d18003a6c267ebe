"""One guardian a bath: the lock that a guardian holds from its start to its end, and how the next
one takes the bath over.

Each bath has two file locks of the system, in a folder of this machine. A guardian holds ``owner``;
one that waits for the bath holds ``next``. A guardian that acts for a bench that is gone looks
whether ``next`` is held, writes into its record that it hands over, and ends. A free lock shows
that it has ended: the system frees a lock with its process and never before. One that does not
answer is ended; one whose bench still runs keeps the bath.
"""

from __future__ import annotations

import json
import os
import re
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from bench.record.state import still_runs
from instruments.bath.connection import LineError, parse_line
from instruments.errors import LimitError
from textfiles.whole import replace_whole

HAND_OVER_S = 5.0  # a guardian that acts answers within a tenth of a second
POLL_S = 0.05
READERS_TURN_S = 0.2  # a bench or a console reads a note in far less
MODULE = ".guardian"  # in the command line of each
HANDED_OVER = "handed_over"


def write_note(path: Path, note: Mapping[str, Any]) -> None:
    """Whole or not at all; neither a disk that is full or gone keeps a guardian from acting, nor a
    program that has the note open on Windows.
    """
    with suppress(OSError):
        data = json.dumps(note, indent=1).encode()
        replace_whole(path, data, synced=True, again_s=READERS_TURN_S)


def bath_name(url: str) -> str:
    """A file's name for the bath at ``url``, however the URL is written."""
    try:
        line = parse_line(url)
    except LineError:
        place = url
    else:
        unit = f"-{line.unit_id}" if line.unit_id not in (None, 1) else ""
        place = line.device or f"{line.host}-{line.port}{unit}"
        if place.startswith("/"):  # a port may have several paths
            place = os.path.realpath(place)
    plain = re.sub(r"[^a-z0-9.]+", "-", place.lower()).strip("-")[:60]
    return f"{plain}-{sha256(place.lower().encode()).hexdigest()[:8]}"


def _folder() -> Path:
    return Path(tempfile.gettempdir()) / "teatbench-guardians"


def forget_guardian(url: str) -> None:
    """Of the emulator that has just begun to listen at ``url``: a note that a killed guardian left
    there is of another one. A guardian that still acts keeps its own.
    """
    note = _folder() / f"{bath_name(url)}.json"
    with suppress(OSError, Timeout):
        if note.exists():
            with FileLock(note.with_suffix(".owner"), mode=0o666).acquire(timeout=0):
                note.unlink(missing_ok=True)


class BathLock:
    """The lock of the bath at ``url``; ``record``: its guardian's file; ``bench``: the guarded."""

    def __init__(self, url: str, record: Path, bench: int) -> None:
        folder = _folder()
        folder.mkdir(exist_ok=True)
        with suppress(OSError):  # for each user of this machine; another one made it
            folder.chmod(0o1777)
        name = bath_name(url)
        self._owner, self._next = (
            FileLock(folder / f"{name}.{which}", mode=0o666) for which in ("owner", "next")
        )
        self._note = folder / f"{name}.json"
        self._me = {"pid": os.getpid(), "bench": bench, "record": str(record)}
        self._url = url

    def take(self) -> str:
        """Hold the bath; returns who may have left it on. Raises LimitError: a guardian has it."""
        ended = ""
        try:
            self._owner.acquire(timeout=0)
        except Timeout:
            try:
                self._next.acquire(timeout=HAND_OVER_S, poll_interval=POLL_S)
            except Timeout:
                raise self._kept("another session is just taking it over") from None
            try:
                ended = self._wait()
            finally:
                self._next.release()
        # one that has ended as it should takes its note away
        if (before := self._read()) and not ended:
            how = "handed the bath over" if before.get(HANDED_OVER) else "ended before handing over"
            ended = f"{_named(before)} {how}"
        self._say()
        return ended

    def acts(self) -> None:
        """The bench is gone: from now on the next guardian that waits may have the bath."""
        self._say(acting=True)

    def hand_over(self) -> None:
        """Note that the bath is handed over; this process has to end now."""
        self._say(acting=True, **{HANDED_OVER: True})

    @property
    def wanted(self) -> bool:
        """Whether another process waits for the bath."""
        try:
            with self._next.acquire(timeout=0):
                return False
        except Timeout:
            return True
        except OSError:  # a disk that is gone
            return False

    def release(self) -> None:
        """Nothing is left to do on the bath."""
        with suppress(OSError):
            self._note.unlink(missing_ok=True)
        self._owner.release()

    def _wait(self) -> str:
        """Until the bath is free; who had to be ended for that. Raises LimitError."""
        with suppress(Timeout):
            self._owner.acquire(timeout=HAND_OVER_S, poll_interval=POLL_S)
            return ""
        import psutil  # loaded only where it is needed

        holder, command = self._read(), list[str]()
        with suppress(psutil.Error):
            command = psutil.Process(int(holder["pid"])).cmdline() if holder else []
        if MODULE not in " ".join(command):
            raise self._kept("a process that doesn't say who it is holds it")
        if not holder.get("acting") and still_runs({"pid": holder["bench"]}):
            raise self._kept(f"{_named(holder)} guards it for a bench that still runs")
        with suppress(psutil.Error):
            psutil.Process(int(holder["pid"])).kill()
        with suppress(Timeout):
            self._owner.acquire(timeout=HAND_OVER_S, poll_interval=POLL_S)
            return f"{_named(holder)} did not answer for {HAND_OVER_S:g} s and was ended"
        raise self._kept(f"{_named(holder)} doesn't answer, and can't be ended")

    def _kept(self, why: str) -> LimitError:
        hint = "Wait for its end, or end that process."
        return LimitError(f"bath at {self._url}", f"another guardian has it: {why}", hint=hint)

    def _say(self, **more: bool) -> None:
        """In the note; another user's can't be written, and the lock is what counts."""
        write_note(self._note, self._me | more)

    def _read(self) -> Mapping[str, Any]:
        with suppress(OSError, ValueError, TypeError):
            return dict(json.loads(self._note.read_text(encoding="utf-8")))
        return {}


def free_bath(url: str, record: Path) -> None:
    """Wait until no guardian acts on the bath at ``url`` or writes. Raises LimitError."""
    lock = BathLock(url, record, os.getpid())
    lock.take()
    lock.release()


def _named(holder: Mapping[str, Any]) -> str:
    return f"the guardian of {holder.get('record')} (process {holder.get('pid')})"

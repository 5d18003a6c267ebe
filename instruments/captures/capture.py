"""A capture: the bytes of every link with time and direction, as JSON lines in one file.

The first line is the header, each further line an event, written through at once. A disk that fills
up ends the capture, not the run.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Protocol

from instruments.clock import Clock, wall_time
from instruments.tap import NoTap, Tap

FORMAT = "teatbench capture"
VERSION = 1
# of the header, beside format and version: all text
FACTS = ("teatbench", "wall_time", "command", "machine")
LINK_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,31}")
PIECE = 65536  # bytes an event; what is longer is written as several
SHOWN = 20  # faults that are listed of one file


class CaptureError(ValueError):
    """A capture that can't be written or read, with its faults as ``file:line: what``."""

    def __init__(self, path: Path, faults: Sequence[tuple[int, str]]) -> None:
        self.path = path
        self.faults = tuple(faults)
        lines = [
            f"{path}:{line}: {what}" if line else f"{path}: {what}"
            for line, what in self.faults[:SHOWN]
        ]
        if len(self.faults) > SHOWN:
            lines.append(f"... and {len(self.faults) - SHOWN} faults more")
        super().__init__("\n".join(lines))


class Captures(Protocol):
    """Where whoever opens a link asks for somebody to listen in on it."""

    def tap(self, link: str, clock: Clock) -> Tap:
        """A tap for the link ``arm``, ``bath`` or ``stage``, with times by ``clock``."""
        ...


class NoCapture:
    """Nothing is captured."""

    def tap(self, link: str, clock: Clock) -> Tap:  # noqa: ARG002 - nobody listens in, on whatever link
        return NoTap()


NO_CAPTURE = NoCapture()


class CaptureFile:
    """A capture being written to a new file, for any thread; to be closed, or used with ``with``.

    ``facts``: the header's, but for the time of day. ``fault``: why the capture ended early. Raises
    CaptureError when the file exists or can't be made.
    """

    def __init__(self, path: Path, facts: dict[str, str]) -> None:
        self.path = path
        self.fault = ""
        self.events = 0
        self._lock = threading.Lock()
        header = {
            "format": FORMAT,
            "version": VERSION,
            "wall_time": wall_time().isoformat(timespec="seconds"),
            **facts,
        }
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError:
            raise CaptureError(
                path,
                [(0, "is there already, and a capture is never written over. Name another file.")],
            ) from None
        except (OSError, ValueError) as error:
            raise CaptureError(
                path, [(0, f"can't be written: {getattr(error, 'strerror', None) or error}")]
            ) from error
        self._write(json.dumps(header))

    def tap(self, link: str, clock: Clock) -> Tap:
        """A tap for the link of this name. Raises ValueError for a name that is no plain word."""
        if not LINK_NAME.fullmatch(link):
            raise ValueError(
                f"no name for a link: {link!r}; letters, digits, _ and - are allowed, 32 at most, a"
                " letter first"
            )
        return _LinkTap(self, link, clock)

    def note(self, link: str, clock: Clock, event: str, **fact: str) -> None:
        """Write one event with the time by ``clock``; nothing after the end or a fault."""
        with self._lock:
            if not self._file.closed and not self.fault:
                self.events += 1
                self._write(
                    json.dumps({"t_s": round(clock.now(), 6), "link": link, "event": event, **fact})
                )

    def close(self) -> None:
        """End the capture; a file without any event is taken away. Once more is no error."""
        with self._lock:
            if self._file.closed:
                return
            self._file.close()
            if not self.events:
                self.path.unlink(missing_ok=True)

    def __enter__(self) -> CaptureFile:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _write(self, line: str) -> None:
        rest = memoryview(line.encode("utf-8") + b"\n")
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            self.fault = (
                f"{self.path} ends early, after {max(0, self.events - 1)} events:"
                f" {error.strerror or error}"
            )


class _LinkTap:
    """One link's lines in the file."""

    def __init__(self, file: CaptureFile, link: str, clock: Clock) -> None:
        self._file = file
        self._link = link
        self._clock = clock
        self._open = False

    def opened(self, url: str) -> None:
        self._open = True
        self._file.note(self._link, self._clock, "opened", url=url)

    def sent(self, data: bytes) -> None:
        self._note("sent", data)

    def received(self, data: bytes) -> None:
        self._note("received", data)

    def closed(self, why: str = "") -> None:
        if self._open:  # a link that broke is closed as well
            self._open = False
            self._file.note(self._link, self._clock, "closed", **({"why": why} if why else {}))

    def _note(self, event: str, data: bytes) -> None:
        for at in range(0, len(data), PIECE):
            self._file.note(self._link, self._clock, event, data=data[at : at + PIECE].hex())

"""A capture: the bytes of every link with time and direction, as JSON lines in one file.

The first line is the header, each further line an event, written through at once. A disk that fills
up ends the capture, not the run. Read back, it is each link's connections, and in each what the
host asked and what came; a last line that is cut is no fault, since a killed bench leaves one.
"""

from __future__ import annotations

import json
import re
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from instruments.clock import Clock, wall_time
from instruments.link import Tap

FORMAT = "teatbench capture"
VERSION = 1
# of the header, beside format and version: all text
FACTS = ("teatbench", "wall_time", "command", "machine")
LINK_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,31}")
PIECE = 65536  # bytes an event; what is longer is written as several
SHOWN = 20  # faults that are listed of one file
LONGEST_LINE = 1 << 20
ENOUGH = 1000  # faults after which a file is given up
# what each must say beside time, link and event; and what it may
EVENTS: dict[str, tuple[frozenset[str], frozenset[str]]] = {
    "opened": (frozenset({"url"}), frozenset()),
    "sent": (frozenset({"data"}), frozenset()),
    "received": (frozenset({"data"}), frozenset()),
    "closed": (frozenset(), frozenset({"why"})),
}
ALWAYS = frozenset({"t_s", "link", "event"})


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
    """Where whoever opens a link asks for a listener."""

    def tap(self, link: str, clock: Clock) -> Tap:
        """A tap for the link ``arm``, ``bath`` or ``stage``, with times by ``clock``."""
        ...


class NoCapture:
    """Nothing is captured."""

    def tap(self, link: str, clock: Clock) -> Tap:  # noqa: ARG002 - no listener on any link
        return Tap()


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

    def __exit__(self, *_: object) -> None:
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


class _LinkTap(Tap):
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


@dataclass(frozen=True, slots=True)
class Piece:
    """Bytes as the host read them in one go at ``t_s``; ``line`` of the file."""

    t_s: float
    data: bytes
    line: int


@dataclass(slots=True)
class Exchange:
    """Bytes of the host, the last at ``asked_s``, and all that came until the next; ``line`` is the
    first's.
    """

    asked_s: float
    line: int
    asked: bytearray = field(default_factory=bytearray)
    came: list[Piece] = field(default_factory=list)


@dataclass(slots=True)
class Conversation:
    """One connection; its first exchange is what came unasked. ``closed_s``: None where the capture
    ended first; ``broke``: why, empty where the host closed it.
    """

    url: str
    opened_s: float
    exchanges: list[Exchange]
    closed_s: float | None = None
    broke: str = ""


@dataclass(frozen=True, slots=True)
class Capture:
    """A file as read: header's ``facts``, connections by link, and whether the last line was
    ``cut``.
    """

    path: Path
    facts: Mapping[str, str]
    links: Mapping[str, list[Conversation]]
    cut: bool


def read_capture(path: Path) -> Capture:
    """The capture at ``path``. Raises CaptureError with all its faults."""
    try:
        with path.open("rb") as file:
            lines = iter(lambda: file.readline(LONGEST_LINE + 1), b"")
            return _Reader(path).read(lines)
    except OSError as error:
        raise CaptureError(path, [(0, f"can't be read: {error.strerror or error}")]) from error


class _WrongError(Exception):
    """What is wrong with a line."""


class _NoJsonError(_WrongError):
    """A line is no JSON at all, as one that was cut."""


class _Reader:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._faults: list[tuple[int, str]] = []
        self._links: dict[str, list[Conversation]] = {}
        self._last_s = 0.0
        self._cut = False

    def read(self, lines: Iterator[bytes]) -> Capture:
        facts = self._header(next(lines, b""))
        for number, line in enumerate(lines, 2):
            try:
                self._event(number, _parsed(line))
            except _WrongError as wrong:
                self._cut = isinstance(wrong, _NoJsonError) and not line.endswith(b"\n")
                if not self._cut:
                    self._faults.append((number, str(wrong)))
                if len(line) > LONGEST_LINE or len(self._faults) >= ENOUGH:
                    break
        if self._faults:
            raise CaptureError(self._path, self._faults)
        return Capture(self._path, facts, self._links, self._cut)

    def _header(self, line: bytes) -> dict[str, str]:
        """The first line's facts. Raises CaptureError at once for another kind of file."""
        hint = "is this a file that teatbench wrote with --capture?"
        if not line:
            raise CaptureError(self._path, [(0, f"is empty; {hint}")])
        try:
            message = _parsed(line)
            if message.pop("format", None) != FORMAT:
                raise _WrongError(f'no "format": "{FORMAT}"; {hint}')
            version = message.pop("version", None)
            if version != VERSION or isinstance(version, bool):
                raise _WrongError(
                    f"written in version {version!r} of the format, and only {VERSION} is"
                    " understood here: update teatbench"
                )
            _check_keys(message, frozenset(FACTS), frozenset())
            return {key: _text(message, key) for key in FACTS}
        except _WrongError as wrong:
            raise CaptureError(self._path, [(1, str(wrong))]) from None

    def _event(self, number: int, message: dict[str, Any]) -> None:
        kind = message.get("event")
        if not isinstance(kind, str) or kind not in EVENTS:
            raise _WrongError(f"no event {kind!r}; there are {', '.join(EVENTS)}")
        must, may = EVENTS[kind]
        _check_keys(message, ALWAYS | must, may)
        link, t_s = _text(message, "link"), self._time(message["t_s"])
        if not LINK_NAME.fullmatch(link):
            raise _WrongError(f"no name for a link: {link!r}")
        if kind == "opened":
            talk = Conversation(_text(message, "url"), t_s, [Exchange(t_s, number)])
            self._links.setdefault(link, []).append(talk)
            return
        if link not in self._links:
            raise _WrongError(
                f"{link} was {kind} before it was opened"
                if kind == "closed"
                else f"bytes {kind} before {link} was opened"
            )
        talk = self._links[link][-1]
        if kind == "received":  # also what is read only after the link broke
            talk.exchanges[-1].came.append(Piece(t_s, _bytes(message), number))
        elif kind == "closed":
            why = _text(message, "why") if "why" in message else ""
            if talk.closed_s is None:
                talk.closed_s, talk.broke = t_s, why
        else:
            data = _bytes(message)
            if talk.closed_s is None:  # into a broken link it never arrived
                if len(talk.exchanges) == 1 or talk.exchanges[-1].came:
                    talk.exchanges.append(Exchange(t_s, number))
                talk.exchanges[-1].asked += data
                talk.exchanges[-1].asked_s = t_s

    def _time(self, t_s: object) -> float:
        if (
            isinstance(t_s, bool)
            or not isinstance(t_s, int | float)
            or not 0 <= t_s <= sys.float_info.max
        ):
            raise _WrongError(f"t_s is no time: {t_s!r:.60}")
        if t_s < self._last_s:
            raise _WrongError(f"t_s goes back, from {self._last_s:g} to {t_s:g}")
        self._last_s = float(t_s)
        return self._last_s


def _parsed(line: bytes) -> dict[str, Any]:
    if len(line) > LONGEST_LINE:
        raise _WrongError(f"the line is longer than {LONGEST_LINE} bytes")
    try:
        message = json.loads(line.decode("utf-8"), object_pairs_hook=_no_key_twice)
    except UnicodeDecodeError as error:
        raise _NoJsonError(f"not UTF-8 text: {error}") from error
    except (ValueError, RecursionError) as error:
        raise _NoJsonError(f"not JSON: {error}") from error
    if not isinstance(message, dict):
        raise _WrongError("not a JSON object")
    return message


def _no_key_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    message = dict(pairs)
    if len(message) != len(pairs):
        raise ValueError("a key is there twice")
    return message


def _check_keys(message: Mapping[str, Any], must: frozenset[str], may: frozenset[str]) -> None:
    if missing := must - message.keys():
        raise _WrongError(f"{', '.join(sorted(missing))}: missing")
    if unknown := message.keys() - must - may:
        raise _WrongError(f"{', '.join(ascii(key) for key in sorted(unknown))}: unknown here")


def _text(message: Mapping[str, Any], key: str) -> str:
    if not isinstance(message[key], str):
        raise _WrongError(f"{key} is no text: {message[key]!r:.60}")
    return str(message[key])


def _bytes(message: Mapping[str, Any]) -> bytes:
    text = _text(message, "data")
    try:
        data = bytes.fromhex(text)
    except ValueError:
        raise _WrongError(f"data is not hex: {text!r:.60}") from None
    if not data:
        raise _WrongError("data is empty")
    return data

"""A capture: the bytes of every link with time and direction, as JSON lines in one file.

The first line is the header, each further line an event, written through at once. A disk that fills
up ends the capture, not the run. Read back, it is each link's connections, and in each what the
host asked and what came; a last line that is cut is no fault, since a killed bench leaves one.
"""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, field_validator

from instruments.clock import Clock, wall_time
from instruments.link import Tap
from textfiles.whole import refusal

FORMAT = "teatbench capture"
VERSION = 1
LINK_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,31}")
PIECE = 65536  # bytes an event; what is longer is written as several
SHOWN = 20  # faults that are listed of one file
LONGEST_LINE = 1 << 20
ENOUGH = 1000  # faults after which a file is given up


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


class CaptureFile:
    """A capture being written to a new file, from any thread. ``facts``: of the header, such as
    the ``command``; ``fault``: why it ended early. Raises CaptureError.
    """

    def __init__(self, path: Path | str, facts: Mapping[str, str] | None = None) -> None:
        self.path = path = Path(path)
        self.fault = ""
        self.events = 0
        self._lock = threading.Lock()
        header = {
            "format": FORMAT,
            "version": VERSION,
            "wall_time": wall_time().isoformat(timespec="seconds"),
            **(facts or {}),
        }
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError:
            raise CaptureError(
                path,
                [(0, "is there already, and a capture is never written over. Name another file.")],
            ) from None
        except (OSError, ValueError) as error:
            why = refusal(error, "Name another place.")
            raise CaptureError(path, [(0, f"can't be written: {why}")]) from error
        try:
            self._write(header)
        except OSError as error:
            self.close()
            why = refusal(error, "Name another place.")
            raise CaptureError(path, [(0, f"can't be written: {why}")]) from error

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
                t_s = round(clock.now(), 6)
                try:
                    self._write({"t_s": t_s, "link": link, "event": event, **fact})
                except OSError as error:
                    early = f"{self.path} ends early, after {self.events - 1} events"
                    self.fault = f"{early}: {refusal(error)}"

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

    def _write(self, message: Mapping[str, object]) -> None:
        line = json.dumps(message, ensure_ascii=False).encode("utf-8", errors="replace")
        rest = memoryview(line + b"\n")
        while rest:
            rest = rest[self._file.write(rest) :]


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
    """Bytes of the host, the last at ``asked_s``, and all that came until its next bytes."""

    asked_s: float
    line: int
    asked: bytearray = field(default_factory=bytearray)
    came: list[Piece] = field(default_factory=list)


@dataclass(slots=True)
class Conversation:
    """One connection; its first exchange is what came unasked. ``broke``: why the link broke."""

    url: str
    exchanges: list[Exchange]
    closed_s: float | None = None
    broke: str = ""


@dataclass(frozen=True, slots=True)
class Capture:
    """A file as read; ``cut``: its last line is incomplete."""

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


class _Line(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", defer_build=True)


class _Header(_Line):
    format: Literal["teatbench capture"]
    version: Literal[1]
    wall_time: str
    teatbench: str = ""
    command: str = ""
    machine: str = ""


class _Event(_Line):
    t_s: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    link: Annotated[str, Field(pattern=f"^{LINK_NAME.pattern}$")]


class _Opened(_Event):
    event: Literal["opened"]
    url: str


class _Bytes(_Event):
    event: Literal["sent", "received"]
    data: Annotated[str, Field(min_length=1)]

    @field_validator("data")
    @classmethod
    def _hex(cls, data: str) -> str:
        bytes.fromhex(data)
        return data


class _Closed(_Event):
    event: Literal["closed"]
    why: str = ""


_EVENT: TypeAdapter[_Opened | _Bytes | _Closed] = TypeAdapter(
    Annotated[_Opened | _Bytes | _Closed, Field(discriminator="event")],
    config=ConfigDict(defer_build=True),
)


class _Reader:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._faults: list[tuple[int, str]] = []
        self._links: dict[str, list[Conversation]] = {}
        self._last_s = 0.0

    def read(self, lines: Iterator[bytes]) -> Capture:
        cut, first = False, next(lines, b"")
        try:
            header = _Header.model_validate_json(first)
        except ValidationError as error:
            what = f"{_fault_of(error)}; is this a file that this teatbench wrote as a capture?"
            raise CaptureError(self._path, [(1, what)]) from None
        for number, line in enumerate(lines, 2):
            if len(line) > LONGEST_LINE:
                self._faults.append((number, f"the line is longer than {LONGEST_LINE} bytes"))
                break
            try:
                self._event(number, _EVENT.validate_json(line))
            except ValidationError as error:
                cut = error.errors()[0]["type"] == "json_invalid" and not line.endswith(b"\n")
                if not cut:
                    self._faults.append((number, _fault_of(error)))
            except ValueError as error:
                self._faults.append((number, str(error)))
            if len(self._faults) >= ENOUGH:
                break
        if self._faults:
            raise CaptureError(self._path, self._faults)
        facts = header.model_dump(exclude={"format", "version"})
        return Capture(self._path, facts, self._links, cut)

    def _event(self, number: int, event: _Opened | _Bytes | _Closed) -> None:
        """Add an event to its connection. Raises ValueError for one that can't be here."""
        link, t_s = event.link, event.t_s
        if t_s < self._last_s:
            raise ValueError(f"t_s goes back, from {self._last_s:g} to {t_s:g}")
        self._last_s = t_s
        if isinstance(event, _Opened):
            talk = Conversation(event.url, [Exchange(t_s, number)])
            self._links.setdefault(link, []).append(talk)
            return
        if link not in self._links:
            raise ValueError(f"{link}: {event.event} before it was opened")
        talk = self._links[link][-1]
        if isinstance(event, _Closed):
            if talk.closed_s is None:
                talk.closed_s, talk.broke = t_s, event.why
            return
        data = bytes.fromhex(event.data)
        if event.event == "received":  # also what is read only after the link broke
            talk.exchanges[-1].came.append(Piece(t_s, data, number))
        elif talk.closed_s is None:  # into a broken link it never arrived
            if len(talk.exchanges) == 1 or talk.exchanges[-1].came:
                talk.exchanges.append(Exchange(t_s, number))
            talk.exchanges[-1].asked += data
            talk.exchanges[-1].asked_s = t_s


def _fault_of(error: ValidationError) -> str:
    """The first fault of a line, printable whatever the line holds."""
    fault = error.errors(include_url=False)[0]
    text = "".join(f"{part}: " for part in fault["loc"][-1:]) + fault["msg"]
    if fault["type"] not in ("missing", "json_invalid", "union_tag_invalid"):
        text += f" (found {fault['input']!r:.60})"
    return "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in text)

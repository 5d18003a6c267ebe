"""Plays the far ends of a capture back: to a driver they are the instruments that were recorded.

Each link's listener plays its connections in order. What came of a request is sent once the whole
request was received, after the recorded time and in the recorded order; a host that asks otherwise
gets a `Mismatch` and no further answer. Modbus TCP transaction ids (implementation guide 1.0b,
3.1.3) may differ: they are exchanged both ways.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice, repeat
from pathlib import Path

from instruments.captures.capture import (
    Capture,
    CaptureError,
    Conversation,
    Exchange,
    read_capture,
)
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.errors import hex_bytes
from instruments.listener import Connection, Listener
from textfiles.text import did_you_mean

HEADER = struct.Struct(">HHH")  # transaction, protocol (0 is Modbus), bytes that follow
ID_BYTES = 2
LONGEST = 254
# A recorded time is when the host had read the bytes. To be read at that time again they leave
# earlier: by the rounding of the file under virtual time, by what loopback and a thread take under
# real time.
LEAD_VIRTUAL_S = 2e-6
LEAD_REAL_S = 2e-3
MODBUS_TCP = "tcp://"
SHOWN = 24  # bytes of a mismatch


class TransactionIds:
    """The ids of one connection, in both directions of its recorded streams."""

    def __init__(self, script: Conversation) -> None:
        self._asked = _ids(b"".join(exchange.asked for exchange in script.exchanges))
        self._came = _ids(
            b"".join(piece.data for exchange in script.exchanges for piece in exchange.came)
        )
        self._own: dict[bytes, bytearray] = {}  # the host's id for each recorded one

    def as_recorded(self, data: bytes) -> bytes:
        """The host's next bytes, with recorded ids in place of its own."""
        changed = bytearray(data)
        for at, found in enumerate(islice(self._asked, len(data))):
            if found:
                recorded, place = found
                own = self._own.setdefault(recorded, bytearray(recorded))
                own[place], changed[at] = data[at], recorded[place]
        return bytes(changed)

    def as_asked(self, data: bytes) -> bytes:
        """The next recorded bytes for the host, with its own ids in place of the recorded ones."""
        changed = bytearray(data)
        for at, found in enumerate(islice(self._came, len(data))):
            if found:
                changed[at] = self._own.get(found[0], found[0])[found[1]]
        return bytes(changed)


def _ids(stream: bytes) -> Iterator[tuple[bytes, int] | None]:
    """For each byte of one direction: of which id, and which byte of it; None for all others."""
    start = 0
    while start + HEADER.size <= len(stream):
        _, protocol, length = HEADER.unpack_from(stream, start)
        if protocol != 0 or not 2 <= length <= LONGEST:
            return
        yield from ((stream[start : start + ID_BYTES], place) for place in range(ID_BYTES))
        yield from repeat(None, HEADER.size - ID_BYTES + length)
        start += HEADER.size + length


@dataclass(frozen=True, slots=True)
class Mismatch:
    """The host sent ``got`` for ``expected`` at ``line`` of the capture; ``what`` says it."""

    link: str
    line: int
    what: str
    expected: bytes = b""
    got: bytes = b""

    @property
    def sentence(self) -> str:
        """What it was, and with which bytes."""
        if not (self.expected or self.got):
            return self.what
        return f"{self.what} (expected {_shown(self.expected)}, got {_shown(self.got)})"

    def __str__(self) -> str:
        return f"{self.link}: line {self.line}: {self.sentence}"


class Player:
    """The far end of connection ``number`` (from 0) of ``end``."""

    def __init__(self, end: ReplayedLink, number: int, connection: Connection) -> None:
        self.number = number
        self._end = end
        self._script = end.conversations[number]
        self._exchanges = self._script.exchanges
        self._connection = connection
        modbus_tcp = self._script.url.startswith(MODBUS_TCP) and not speaks_lines(self._script)
        self._ids = TransactionIds(self._script) if modbus_tcp else None
        self._turn = 0  # the exchange whose request was seen last
        self._asked_s = end.clock.now()  # when it was seen
        self._said = 0  # of what came of it
        self._heard = b""  # of the next request
        self._lost = False

    @property
    def left(self) -> str:
        """What has not been played; empty when all has."""
        of = f"{self._turn} of {len(self._exchanges) - 1} requests"
        if self._lost:
            return f"{of} as recorded, then a mismatch"
        return f"the host left after {of}" if self._turn + 1 < len(self._exchanges) else ""

    def take(self, data: bytes) -> None:
        """Bytes of the host: compare, and answer each request that they complete."""
        if self._ids:
            data = self._ids.as_recorded(data)
        while data and not self._lost:
            if self._turn + 1 == len(self._exchanges):
                # silence; but where the recording ends because the host closed, it should have
                self._lost = self._script.closed_s is not None and not self._script.broke
                if self._lost:
                    what = "the host sends more than was recorded on this connection"
                    self._end.report(self._exchanges[-1].line, what, b"", data[:SHOWN])
                return
            asked = self._exchanges[self._turn + 1].asked
            missing = len(asked) - len(self._heard)
            self._heard, data = self._heard + data[:missing], data[missing:]
            if not asked.startswith(self._heard):
                self._differs(self._exchanges[self._turn + 1], self._heard + data)
            elif len(self._heard) == len(asked):
                while self._said < len(self._exchanges[self._turn].came):
                    self._say()
                self._turn += 1
                self._said, self._heard, self._asked_s = 0, b"", self._end.clock.now()
                self.answer(self._turn)

    def _differs(self, exchange: Exchange, got: bytes) -> None:
        self._lost = True
        pairs = enumerate(zip(exchange.asked, got, strict=False))
        same = next(at for at, (one, other) in pairs if one != other)
        shown = slice(max(0, same - SHOWN // 2), max(0, same - SHOWN // 2) + SHOWN)
        what = (
            f"connection {self.number + 1}, request {self._turn + 1}: byte {same} of it is another"
            " than recorded"
        )
        self._end.report(exchange.line, what, bytes(exchange.asked[shown]), got[shown])

    def answer(self, turn: int) -> None:
        """Say what is due of what came of request ``turn``, and come back for the rest."""
        if turn != self._turn or self._lost:
            return
        came = self._exchanges[turn].came
        while self._said < len(came):
            wait_s = self._wait_s(came[self._said].t_s)
            if wait_s > 0:
                self._connection.after(wait_s, partial(self.answer, turn))
                return
            self._say()
        closed_s = self._script.closed_s
        if self._script.broke and closed_s is not None and turn + 1 == len(self._exchanges):
            wait_s = self._wait_s(closed_s)
            if wait_s > 0:
                self._connection.after(wait_s, self._connection.hang_up)
            else:
                self._connection.hang_up()

    def _wait_s(self, recorded_s: float) -> float:
        if self._end.fast:
            return 0.0
        clock = self._end.clock
        lead_s = LEAD_VIRTUAL_S if isinstance(clock, VirtualClock) else LEAD_REAL_S
        after_s = recorded_s - self._exchanges[self._turn].asked_s - lead_s
        return self._asked_s + after_s - clock.now()

    def _say(self) -> None:
        data = self._exchanges[self._turn].came[self._said].data
        self._said += 1
        self._connection.send(self._ids.as_asked(data) if self._ids else data)


class Replay:
    """A listener for each of ``links`` of ``capture``. ``fast`` answers at once; ``again`` starts
    over after the last connection. Raises OSError.
    """

    def __init__(
        self,
        capture: Capture,
        clock: Clock,
        *,
        links: Collection[str] | None = None,
        fast: bool = False,
        again: bool = False,
        host: str = "127.0.0.1",
    ) -> None:
        lock, self.capture = threading.RLock(), capture
        self._listeners: list[Listener] = []
        self.mismatches: list[Mismatch] = []
        self.ends: dict[str, ReplayedLink] = {}
        self.urls: dict[str, str] = {}
        try:
            for link, conversations in capture.links.items():
                if links is None or link in links:
                    end = ReplayedLink(
                        link, conversations, clock, self.mismatches, fast=fast, again=again
                    )
                    listener = Listener(end, clock, lock=lock, name=f"replayed {link}", host=host)
                    self._listeners.append(listener)
                    self.ends[link] = end
                    self.urls[link] = _like(link, conversations[0], listener.url)
        except OSError:
            self.close()
            raise

    @property
    def finished(self) -> bool:
        """Whether every recorded connection has been made and is over."""
        return all(end.finished for end in self.ends.values())

    @property
    def unplayed(self) -> list[str]:
        """A sentence for each link of which something has not been played, in the last turn."""
        return [f"{name}: {what}" for name, end in self.ends.items() if (what := end.unplayed)]

    def close(self) -> None:
        for listener in self._listeners:
            listener.close()

    def __enter__(self) -> Replay:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def replay_wire(
    file: Path | str,
    links: Collection[str] = (),
    *,
    host: str = "127.0.0.1",
    fast: bool = False,
    again: bool = True,
) -> Iterator[Replay]:
    """Play the instruments' part of a capture in real time at ports of ``host``, of all ``links``
    for none: ``fast`` without its pauses, ``again`` from its start behind its end. Its ``urls`` are
    by link, ``mismatches`` what was asked otherwise. Raises CaptureError.
    """
    capture = read_capture(Path(file))
    there, wrong = ", ".join(capture.links), [one for one in links if one not in capture.links]
    if not capture.links:
        why = "no link was opened in it, so there is nothing to play"
        raise CaptureError(capture.path, [(0, why)])
    if wrong:
        near = did_you_mean(wrong[0], capture.links) or "."
        what = f'no link "{wrong[0]}"{near} It has: {there}.'
        raise CaptureError(capture.path, [(0, what)])
    with closing(RealClock()) as clock:
        try:
            replay = Replay(capture, clock, links=links or None, fast=fast, again=again, host=host)
        except OSError as error:
            what = f"can't listen on {host}: {error.strerror or error}"
            raise CaptureError(capture.path, [(0, what)]) from error
        with replay:
            yield replay


class ReplayedLink:
    """The far end of one link: each connection plays the next that was recorded."""

    def __init__(
        self,
        link: str,
        conversations: Sequence[Conversation],
        clock: Clock,
        mismatches: list[Mismatch],
        *,
        fast: bool,
        again: bool,
    ) -> None:
        self.conversations = conversations
        self.clock = clock
        self.fast = fast
        self._link = link
        self._mismatches = mismatches
        self._again = again
        self._next = 0
        self._players: dict[Connection, Player] = {}
        self._left: dict[int, str] = {}

    @property
    def finished(self) -> bool:
        """Whether the last recorded connection has been made, and none is open."""
        return self._next == len(self.conversations) and not self._players

    @property
    def unplayed(self) -> str:
        """What has not been played in this turn; empty when all has."""
        playing = {player.number: player.left for player in list(self._players.values())}
        left = [
            f"connection {number + 1}: {what}"
            for number, what in sorted({**self._left, **playing}.items())
            if what
        ]
        if missing := len(self.conversations) - self._next:
            left.append(f"{missing} of {len(self.conversations)} connections were never made")
        return "; ".join(left)

    def connect(self, connection: Connection) -> None:
        """A host connects: what came unasked then comes again."""
        if self._again and self.finished:
            self._next = 0
            self._left.clear()
        if self._next == len(self.conversations):
            line = self.conversations[-1].exchanges[-1].line
            self.report(line, f"connected once more than the {self._next} times that were recorded")
            return
        player = self._players[connection] = Player(self, self._next, connection)
        # last, as below: another thread may be waiting for ``finished``
        self._next += 1
        player.answer(0)

    def receive(self, connection: Connection, data: bytes) -> None:
        """Bytes of the host, cut anywhere."""
        if player := self._players.get(connection):
            player.take(data)

    def disconnect(self, connection: Connection) -> None:
        if player := self._players.get(connection):
            self._left[player.number] = player.left
            del self._players[connection]

    def report(self, line: int, what: str, expected: bytes = b"", got: bytes = b"") -> None:
        """Note a mismatch at ``line`` of the capture."""
        self._mismatches.append(Mismatch(self._link, line, what, expected, got))


def _shown(data: bytes) -> str:
    """As text where it is a line of text, else as hex."""
    text = data.decode("latin-1")
    return (
        ascii(text) if data and text.isascii() and text.strip().isprintable() else hex_bytes(data)
    )


def speaks_lines(talk: Conversation) -> bool:
    """Whether the host sent lines of ASCII."""
    asked = b"".join(bytes(exchange.asked) for exchange in talk.exchanges)
    return asked.isascii() and asked.endswith((b"\r", b"\n")) and b"\0" not in asked


def _like(link: str, talk: Conversation, url: str) -> str:
    """``url`` in the recorded driver's form: a bath's has the framing, and the unit if not 1."""
    if link == "bath" and speaks_lines(talk):
        return url.replace("socket", "tcp", 1)
    if talk.url.startswith(MODBUS_TCP):
        scheme, place = "tcp", 6
    # on a serial port it is RTU
    elif talk.url.startswith("rtu+tcp://") or (link == "bath" and "://" not in talk.url):
        scheme, place = "rtu+tcp", 0
    else:
        return url
    unit = talk.exchanges[1].asked[place : place + 1] if len(talk.exchanges) > 1 else b""
    return url.replace("socket", scheme, 1) + (
        f"?unit={unit[0]}" if unit not in (b"", b"\1") else ""
    )

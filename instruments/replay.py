"""Plays the far ends of a capture back: to a driver they are the instruments that were recorded.

A listener for each link, at which each connection plays the next that was recorded (`replay_player`). What the hosts do
otherwise than recorded is kept, as `Mismatch`. It may not know what bytes mean.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from types import TracebackType

from instruments.capture_reader import Capture, Conversation
from instruments.clock import Clock
from instruments.errors import hex_bytes
from instruments.listener import Connection, Listener
from instruments.replay_player import Player
from instruments.transaction_ids import is_modbus_tcp


@dataclass(frozen=True, slots=True)
class Mismatch:
    """The host sent ``got`` where ``expected`` was recorded, at ``line`` of the capture; ``what`` is the sentence."""

    link: str
    line: int
    what: str
    expected: bytes = b""
    got: bytes = b""

    @property
    def sentence(self) -> str:
        """What it was, and with which bytes."""
        told = f" (expected {_shown(self.expected)}, got {_shown(self.got)})" if self.expected or self.got else ""
        return f"{self.what}{told}"

    def __str__(self) -> str:
        return f"{self.link}: line {self.line}: {self.sentence}"


class Replay:
    """A listener for each link of ``capture`` (or of ``links``), at ``urls``. To be closed, or used with ``with``.

    ``mismatches`` are what the hosts did otherwise than recorded, in the order in which they did it.
    ``fast`` answers at once. ``again`` starts from the first connection once the last has been played; without it
    a connection more than recorded is a mismatch. Raises OSError when ``host`` can't be listened on.
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
        lock = threading.RLock()
        self._listeners: list[Listener] = []
        self.mismatches: list[Mismatch] = []
        self.ends: dict[str, FarEnd] = {}
        self.urls: dict[str, str] = {}
        try:
            for link, conversations in capture.links.items():
                if links is None or link in links:
                    end = FarEnd(link, conversations, clock, self.mismatches.append, fast=fast, again=again)
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
        """Stop listening and hang up."""
        for listener in self._listeners:
            listener.close()

    def __enter__(self) -> Replay:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


class FarEnd:
    """The far end of one link, as a device behind a listener: each connection plays the next that was recorded."""

    def __init__(
        self,
        link: str,
        conversations: Sequence[Conversation],
        clock: Clock,
        tell: Callable[[Mismatch], None],
        *,
        fast: bool = False,
        again: bool = False,
    ) -> None:
        self.link = link
        self._conversations = conversations
        self._clock = clock
        self._tell_mismatch = tell
        self._fast = fast
        self._again = again
        self._next = 0
        self._players: dict[Connection, Player] = {}
        self._left: dict[int, str] = {}

    @property
    def finished(self) -> bool:
        """Whether the last recorded connection has been made, and none is open."""
        return self._next == len(self._conversations) and not self._players

    @property
    def unplayed(self) -> str:
        """What has not been played in this turn; empty when all has."""
        playing = {player.number: player.left for player in list(self._players.values()) if player.left}
        left = [f"connection {number + 1}: {what}" for number, what in sorted({**self._left, **playing}.items())]
        if missing := len(self._conversations) - self._next:
            left.append(f"{missing} of {len(self._conversations)} connections were never made")
        return "; ".join(left)

    def connect(self, connection: Connection) -> None:
        """Somebody plugs in: what came unasked then comes again."""
        if self._again and self.finished:
            self._next = 0
            self._left.clear()
        if self._next == len(self._conversations):
            line = self._conversations[-1].exchanges[-1].line
            self._tell(line, f"connected once more than the {self._next} times that were recorded")
            return
        player = Player(self._conversations[self._next], self._next, connection, self._clock, fast=self._fast, tell=self._tell)
        self._players[connection] = player
        self._next += 1  # last, as below: somebody may be waiting on another thread for ``finished``
        player.start()

    def receive(self, connection: Connection, data: bytes) -> None:
        """Bytes of the host, cut anywhere."""
        if player := self._players.get(connection):
            player.take(data)

    def disconnect(self, connection: Connection) -> None:
        """The connection is over, by whichever end."""
        player = self._players.get(connection)
        if player and player.left:
            self._left[player.number] = player.left
        self._players.pop(connection, None)

    def _tell(self, line: int, what: str, expected: bytes = b"", got: bytes = b"") -> None:
        self._tell_mismatch(Mismatch(self.link, line, what, expected, got))


def _shown(data: bytes) -> str:
    """As text where it is a line of text, else as hex."""
    text = data.decode("latin-1")
    return ascii(text) if data and text.isascii() and text.strip().isprintable() else hex_bytes(data)


def _like(link: str, talk: Conversation, url: str) -> str:
    """``url`` in the form that the driver takes which was recorded: a bath's says how Modbus is framed, and which unit if not 1."""
    if is_modbus_tcp(talk.url):
        scheme, place = "tcp", 6
    elif talk.url.startswith("rtu+tcp://") or (link == "bath" and "://" not in talk.url):  # on a serial port it is RTU
        scheme, place = "rtu+tcp", 0
    else:
        return url
    unit = talk.exchanges[1].asked[place : place + 1] if len(talk.exchanges) > 1 else b""
    return url.replace("socket", scheme, 1) + (f"?unit={unit[0]}" if unit not in (b"", b"\1") else "")

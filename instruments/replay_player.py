"""Plays one recorded connection to the host that has made it: compares what it sends, and says what came of that.

What came of a request comes again once the whole request has been seen, however TCP cuts it, and after the recorded
while. The order of bytes is always the recorded one: when the host is faster than it was, what it had read before a
request leaves before that request's answer. A host that asks otherwise is told on and hears nothing more. It may not
know what bytes mean, but for the ids in `transaction_ids`.
"""

from __future__ import annotations

from functools import partial
from typing import Protocol

from instruments.capture_reader import Conversation, Exchange
from instruments.clock import Clock, VirtualClock
from instruments.listener import Connection
from instruments.transaction_ids import TransactionIds, is_modbus_tcp

# A recorded time is when the host had read the bytes. To be read at that time again they leave earlier: by the
# rounding of the file under virtual time, by what loopback and a thread take under real time.
LEAD_VIRTUAL_S = 2e-6
LEAD_REAL_S = 2e-3
SHOWN = 24  # bytes of a mismatch


class Tell(Protocol):
    """Who is told of a mismatch: the line of the capture, the sentence, and the bytes."""

    def __call__(self, line: int, what: str, expected: bytes, got: bytes, /) -> None: ...


class Player:
    """The far end of connection ``number`` (from 0), to be told of the host's bytes; answers at once when ``fast``."""

    def __init__(
        self,
        script: Conversation,
        number: int,
        connection: Connection,
        clock: Clock,
        *,
        fast: bool,
        tell: Tell,
    ) -> None:
        self.number = number
        self._script = script
        self._connection = connection
        self._clock = clock
        self._fast = fast
        self._lead_s = LEAD_VIRTUAL_S if isinstance(clock, VirtualClock) else LEAD_REAL_S
        self._tell = tell
        self._ids = TransactionIds(script) if is_modbus_tcp(script.url) else None
        self._turn = 0  # the exchange whose request was seen last
        self._asked_s = clock.now()  # when it was seen
        self._said = 0  # of what came of it
        self._heard = b""  # of the next request
        self._lost = False

    @property
    def left(self) -> str:
        """What has not been played; empty when all has."""
        requests = len(self._script.exchanges) - 1
        if self._lost:
            return f"{self._turn} of {requests} requests as recorded, then a mismatch"
        return f"the host left after {self._turn} of {requests} requests" if self._turn < requests else ""

    def start(self) -> None:
        """Say what came unasked."""
        self._answer()

    def take(self, data: bytes) -> None:
        """Bytes of the host: compare, and answer each request that they complete."""
        if self._ids:
            data = self._ids.as_recorded(data)
        while data and not self._lost:
            if self._turn + 1 == len(self._script.exchanges):
                self._after_the_end(data)
                return
            asked = self._script.exchanges[self._turn + 1].asked
            new, data = data[: len(asked) - len(self._heard)], data[len(asked) - len(self._heard) :]
            self._heard += new
            if not asked.startswith(self._heard):
                self._differs(self._script.exchanges[self._turn + 1], self._heard + data)
            elif len(self._heard) == len(asked):
                self._say_all()
                self._turn, self._said, self._heard, self._asked_s = self._turn + 1, 0, b"", self._clock.now()
                self._answer()

    def _after_the_end(self, data: bytes) -> None:
        """Silence; and where the recording ends because the host closed, that it didn't is told."""
        self._lost = self._script.closed_s is not None and not self._script.broke
        if self._lost:
            self._tell(self._script.exchanges[-1].line, "the host sends more than was recorded on this connection", b"", data[:SHOWN])

    def _differs(self, exchange: Exchange, got: bytes) -> None:
        self._lost = True
        same = next(at for at, (one, other) in enumerate(zip(exchange.asked, got, strict=False)) if one != other)
        start = max(0, same - SHOWN // 2)
        what = f"connection {self.number + 1}, request {self._turn + 1}: byte {same} of it is another than recorded"
        self._tell(exchange.line, what, exchange.asked[start : start + SHOWN], got[start : start + SHOWN])

    def _answer(self) -> None:
        """Say what is due of what came of the request, and come back for the rest."""
        exchange = self._script.exchanges[self._turn]
        while self._said < len(exchange.came):
            wait_s = self._wait_s(exchange.came[self._said].t_s)
            if wait_s > 0:
                self._connection.after(wait_s, partial(self._go_on, self._turn))
                return
            self._say(exchange)
        if self._script.broke and self._script.closed_s is not None and self._turn + 1 == len(self._script.exchanges):
            self._hang_up_at(self._script.closed_s)

    def _hang_up_at(self, recorded_s: float) -> None:
        wait_s = self._wait_s(recorded_s)
        if wait_s > 0:
            self._connection.after(wait_s, self._connection.hang_up)
        else:
            self._connection.hang_up()

    def _go_on(self, turn: int) -> None:
        if turn == self._turn and not self._lost:
            self._answer()

    def _wait_s(self, recorded_s: float) -> float:
        if self._fast:
            return 0.0
        after_s = recorded_s - self._script.exchanges[self._turn].asked_s - self._lead_s
        return self._asked_s + after_s - self._clock.now()

    def _say(self, exchange: Exchange) -> None:
        data = exchange.came[self._said].data
        self._said += 1
        self._connection.send(self._ids.as_asked(data) if self._ids else data)

    def _say_all(self) -> None:
        exchange = self._script.exchanges[self._turn]
        while self._said < len(exchange.came):
            self._say(exchange)

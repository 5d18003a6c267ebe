"""Questions and answers on the arm's link, one at a time, and the way out for every byte.

All bytes leave through ``send``, which knows the session's state and what is never sent
(../shared/instruments/microscribe.md). Where a reply ends is known to ``configuration``. It may not know which
questions make a sign-on, nor what a packet means.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from instruments.clock import Clock
from instruments.errors import LimitError, ProtocolError
from instruments.link import Link
from instruments.microscribe import configuration as conf
from instruments.microscribe import protocol as wire
from instruments.microscribe.protocol import Event, State, WireError
from instruments.microscribe.refusals import NoSessionError, ParameterLengthError, SilentArmError

ANSWER_S = 0.12  # 0.1 s, and the latency of an adapter whose timer nobody has set
SILENCE_S = 0.1

ON_HINT = "Is the arm switched on, plugged in, and on this port? Close other programs that use it"
_DAMAGE_HINT = "Check cable, plugs and baud rate, then sign on again"
_T = TypeVar("_T")


class Conversation:
    """One link and the state of the session on it, as far as this end knows; ``answer_s`` is how long an answer is waited for."""

    def __init__(self, link: Link, clock: Clock, answer_s: float = ANSWER_S) -> None:
        self.who = link.who
        self.link = link
        self.clock = clock
        self.answer_s = answer_s
        self.state = State.FINDING_BAUD
        self.untidy = False

    def lose(self) -> None:
        """The session is gone, whatever the arm believes; what still comes belongs to no later question."""
        self.state = State.FINDING_BAUD
        self.untidy = True

    def tidy(self) -> None:
        """Let late bytes of a damaged answer pass, so that none is taken for the next answer."""
        if self.untidy:
            self.link.drain(SILENCE_S * self.answer_s / ANSWER_S)
            self.untidy = False

    def send(self, data: bytes, event: Event) -> None:
        """Send bytes that are the event.

        Raises LimitError for what is never sent, NoSessionError for what the state doesn't allow, LinkError when the link
        is broken.
        """
        try:
            wire.refuse_forbidden(data, self.state)
        except WireError as error:
            raise LimitError(self.who, f"{error}", asked=data) from error
        try:
            state = wire.next_state(self.state, event)
        except WireError as error:
            raise NoSessionError(self.who, f"{error}", asked=data, hint="Sign on first") from error
        self.link.write(data)
        self.state = state

    def ask(self, asked: bytes, decode: Callable[[bytes], _T], *, timeout_s: float = 0.0, event: Event = Event.CONFIGURE) -> _T:
        """Send a configuration command and decode its reply, which has ``timeout_s``, and ``answer_s`` at least.

        Raises SilentArmError when nothing comes, ParameterLengthError for a block of an unknown length, ProtocolError for a
        damaged reply, NoSessionError, and LinkError when the link is broken.
        """
        self.tidy()
        start = self.clock.now()
        self.send(asked, event)
        reply, surplus = self._reply(asked[0], start + max(timeout_s, self.answer_s))
        seconds = self.clock.now() - start
        self.untidy = bool(surplus)
        if not reply:
            self.untidy = True
            raise SilentArmError(self.who, "the arm does not answer", asked=asked, seen=b"", seconds=seconds, hint=ON_HINT)
        try:
            return decode(reply)
        except WireError as error:
            self.untidy = True
            kind = ParameterLengthError if isinstance(error, conf.BlockLengthError) else ProtocolError
            raise kind(self.who, f"{error}", asked=asked, seen=reply, seconds=seconds, hint=_DAMAGE_HINT) from error

    def _reply(self, code: int, deadline: float) -> tuple[bytes, bytes]:
        """The reply, whole or as much of it as came, and what came behind it."""
        data = b""
        while (end := conf.reply_length(code, data)) is None:
            more = self.link.receive(max(0.0, deadline - self.clock.now()))
            if not more:
                return data, b""
            data += more
        return data[:end], data[end:]

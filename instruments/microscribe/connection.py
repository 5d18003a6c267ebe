"""One arm on one link: questions and answers, packets, streams, and the end of a session.

All bytes leave through `ArmConnection.send`, which refuses what is never sent. A session is opened
by ``session``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from instruments.clock import Clock
from instruments.errors import InstrumentError, LimitError, ProtocolError
from instruments.link import Link
from instruments.microscribe import configuration as conf
from instruments.microscribe import protocol as wire
from instruments.microscribe.errors import NoSessionError, SilentArmError, UnusableArmError
from instruments.microscribe.protocol import Code, Event, Packet, PacketDecoder, State, WireError

ANSWER_S = 0.12  # 0.1 s, and the latency of an adapter whose timer nobody has set
SILENCE_S = 0.1
PAUSE_S = 0.015
STREAM_END_S = 0.05  # what the maker's host waits after it ended a stream
ATTEMPTS = 3
ON_HINT = "Is the arm switched on, plugged in, and on this port? Close other programs that use it"
CABLE_HINT = "Check cable, plugs and baud rate"
_NOTHING = 0x00  # asks for a packet of buttons alone: how a stream is ended
_T = TypeVar("_T")


class ArmConnection:
    """The session on one link, as this end knows it: ``live`` while it can be asked for packets.

    ``answer_s`` is the least time for an answer. ``untidy``: bytes of an earlier answer may come.
    """

    def __init__(self, link: Link, clock: Clock, answer_s: float) -> None:
        self.who = link.who
        self.link = link
        self.clock = clock
        self.answer_s = answer_s
        self.state = State.FINDING_BAUD
        self.untidy = False
        self._decoder = PacketDecoder(wire.POLL)
        self._decoder_of = wire.POLL
        self._damaged = 0

    @property
    def live(self) -> bool:
        """Whether a session is open, as far as this end knows."""
        return self.state in wire.LIVE

    @property
    def streaming(self) -> bool:
        """Whether a stream runs, as far as this end knows."""
        return self.state is State.STREAMING

    @property
    def damaged(self) -> int:
        """Packets that came damaged."""
        return self._damaged + self._decoder.damaged

    def end(self) -> None:
        """End the session, if any. Raises LinkError when the link is broken: ended too, then."""
        if self.state is State.FINDING_BAUD:
            return
        try:
            self.send(bytes([Code.END]), Event.END)
            # silence is as good: an arm without power has no session
            self.link.read_until(bytes([Code.END]), self.answer_s)
            self.clock.sleep(PAUSE_S)
        finally:
            self.lose()

    def lose(self) -> None:
        """The session is gone; what still comes belongs to no later question."""
        self.state = State.FINDING_BAUD
        self.untidy = True
        self._decoder.reset()

    def tidy(self) -> None:
        """Let late bytes of a damaged answer pass, so that none is taken for the next answer."""
        if self.untidy:
            self.link.drain(min(1.0, SILENCE_S * self.answer_s / ANSWER_S))
            self.untidy = False

    def send(self, data: bytes, event: Event) -> None:
        """Send bytes that are the event. Raises LimitError for what is never sent, NoSessionError
        for what the state doesn't allow, LinkError when the link is broken.
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

    def ask(self, code: Code, decode: Callable[[bytes], _T], *, timeout_s: float = 0.0) -> _T:
        """Send a configuration command and decode its reply, which has ``timeout_s`` or
        ``answer_s``.

        Raises SilentArmError, UnusableArmError for a block of an unknown length, ProtocolError for
        a damaged reply, NoSessionError, and LinkError when the link is broken.
        """
        self.tidy()
        asked, start = bytes([code]), self.clock.now()
        self.send(asked, Event.CONFIGURE)
        deadline, reply = start + max(timeout_s, self.answer_s), b""
        while (end := conf.reply_length(code, reply)) is None:
            more = self.link.receive(max(0.0, deadline - self.clock.now()))
            if not more:
                break
            reply += more
        seconds = self.clock.now() - start
        self.untidy = not reply or len(reply) > len(reply[:end])
        reply = reply[:end]
        kind: type[InstrumentError] = SilentArmError
        what, hint = "the arm does not answer", ON_HINT
        try:
            if reply:
                return decode(reply)
        except WireError as error:
            self.untidy = True
            unusable = isinstance(error, conf.BlockLengthError)
            kind = UnusableArmError if unusable else ProtocolError
            what, hint = f"{error}", f"{CABLE_HINT}, then sign on again"
        raise kind(self.who, what, asked=asked, seen=reply, seconds=seconds, hint=hint)

    def ask_packet(self) -> tuple[Packet | None, bytes]:
        """Poll once: the packet (None where damaged or missing) and the bytes. Raises
        NoSessionError, LinkError when the link is broken.
        """
        self._expect(wire.POLL)
        self.send(bytes([wire.POLL]), Event.POLL)
        seen = b""
        deadline = self.clock.now() + self.answer_s
        while data := self.link.receive(max(0.0, deadline - self.clock.now())):
            seen += data
            if packets := self._decoder.feed(data):
                withdrawn, behind = self._decoder.withdrawn, self.link.receive(0.0)
                self._decoder.feed(behind)
                self.untidy = len(packets) > 1 or bool(behind) or self._decoder.pending > 0
                return None if self._decoder.withdrawn > withdrawn else packets[-1], seen + behind
        self.untidy = True
        return None, seen

    def start_stream(self, command: int) -> bytes | None:
        """Start the fastest stream of ``command`` once: None when echoed, else what came. Raises
        NoSessionError or LinkError.
        """
        self._expect(command)
        self.send(conf.encode_stream(conf.StreamRequest(0, command)), Event.STREAM)
        echo = bytes([Code.STREAM])
        seen = self.link.read_until(echo, self.answer_s)
        if seen.endswith(echo):
            return None
        self.stop_stream()
        return seen

    def stream_packets(self) -> list[Packet]:
        """The packets since the last call; none after ``answer_s``. Raises LinkError."""
        deadline = self.clock.now() + self.answer_s
        while data := self.link.receive(max(0.0, deadline - self.clock.now())):
            if packets := self._decoder.feed(data):
                return packets
        return []

    def stop_stream(self) -> None:
        """End a stream as the maker's host does: 00, 50 ms, flush; repeated while its answer is
        missing. Earlier packets are dropped. Raises LinkError.
        """
        if not self.streaming:
            return
        self.untidy = True
        for _ in range(ATTEMPTS):
            self.send(bytes([_NOTHING]), Event.POLL)
            self.clock.sleep(STREAM_END_S)
            rest = PacketDecoder().feed(self.link.drain(0.0))
            if rest and rest[-1].command == _NOTHING:
                self.untidy = False
                break
        self._decode(self._decoder_of)

    def _expect(self, command: int) -> None:
        """Drop what is left of an earlier answer, and accept packets of ``command`` only."""
        if self.untidy:
            self.tidy()
            self._decoder.reset()
        if command != self._decoder_of:
            self._decode(command)

    def _decode(self, command: int) -> None:
        """From now on packets of ``command``, and nothing of one that had begun."""
        self._damaged += self._decoder.damaged
        self._decoder, self._decoder_of = PacketDecoder(command), command

"""The driver's lower half: one session with an arm, from sign-on to end, and the questions within it.

Timing and order are those of ../shared/instruments/microscribe.md. It may not know what a position is, nor of homing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

from instruments.clock import Clock
from instruments.errors import InstrumentError, LimitError, LinkError
from instruments.link import Link
from instruments.microscribe import commands, signon
from instruments.microscribe import configuration as conf
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import StreamRequest
from instruments.microscribe.conversation import ANSWER_S, Conversation
from instruments.microscribe.portrait import Portrait
from instruments.microscribe.protocol import Code, Event, Packet, PacketDecoder, State, WireError

STREAM_END_S = 0.05  # what the maker's host waits after it ended a stream
ATTEMPTS = 3
_NOTHING = 0x00  # asks for a packet of buttons alone: how a stream is ended


class Session:
    """The conversation on one link. ``live`` while it can be asked for packets."""

    def __init__(self, link: Link, clock: Clock, answer_s: float = ANSWER_S) -> None:
        self._talk = Conversation(link, clock, answer_s)
        self.answer_s = answer_s
        self._clock = clock
        self._decoder = PacketDecoder(wire.POLL)
        self._decoder_of = wire.POLL
        self._damaged = 0

    @property
    def live(self) -> bool:
        """Whether a session is open, as far as this end knows."""
        return self._talk.state in wire.LIVE

    @property
    def streaming(self) -> bool:
        """Whether a stream runs, as far as this end knows."""
        return self._talk.state is State.STREAMING

    @property
    def damaged(self) -> int:
        """Packets that came damaged."""
        return self._damaged + self._decoder.damaged

    def open(self, rates: Sequence[int], *, patience_s: float = signon.SIGN_ON_S) -> tuple[Portrait, int]:
        """Find the arm, begin, and read who it is; a session that was begun is ended again when that fails.

        ``rates`` are tried in their order; the one that worked is given back. Raises as ``signon.find``, ``begin`` and
        ``read_portrait`` do.
        """
        self.lose()
        baud = signon.find(self._talk, rates, patience_s)
        try:
            signon.begin(self._talk)
            return signon.read_portrait(self._talk), baud
        except InstrumentError:
            with contextlib.suppress(LinkError):  # the first error tells more than a second one about the same link
                self.end()
            raise

    def end(self) -> None:
        """End the session; nothing happens without one. Raises LinkError when the link is broken: ended too, then."""
        if self._talk.state is State.FINDING_BAUD:
            return
        try:
            self._talk.send(bytes([Code.END]), Event.END)
            self._talk.link.read_until(bytes([Code.END]), self.answer_s)  # silence is as good: an arm without power has no session
            self._clock.sleep(signon.PAUSE_S)
        finally:
            self.lose()

    def lose(self) -> None:
        """The session is gone, whatever the arm believes; what still comes belongs to no later question."""
        self._talk.lose()
        self._decoder.reset()

    def ask_packet(self, command: int = wire.POLL) -> tuple[Packet | None, bytes]:
        """Poll once: the packet, or None where it came damaged or not at all; and the bytes that came.

        Raises LimitError without a session, LinkError when the link is broken.
        """
        talk = self._talk
        self._tidy(command)
        talk.send(bytes([command]), Event.POLL)
        seen = b""
        deadline = self._clock.now() + self.answer_s
        while data := talk.link.receive(max(0.0, deadline - self._clock.now())):
            seen += data
            if packets := self._decoder.feed(data):
                withdrawn, behind = self._decoder.withdrawn, talk.link.receive(0.0)
                self._decoder.feed(behind)
                talk.untidy = len(packets) > 1 or bool(behind) or self._decoder.pending > 0
                return None if self._decoder.withdrawn > withdrawn else packets[-1], seen + behind
        talk.untidy = True
        return None, seen

    def ask_home(self) -> None:
        """Have the arm load its home counts. Raises LimitError, LinkError or ProtocolError where it doesn't confirm."""
        self._talk.ask(bytes([Code.HOME]), lambda reply: conf.expect_echo(Code.HOME, reply))

    def ask_baud(self, baud: int) -> None:
        """Have the arm speak at another rate, and speak at it. Raises as ``ask_home``; LimitError for a rate that no arm has."""
        try:
            asked = commands.encode_set_baud(baud)
        except WireError as error:
            raise LimitError(self._talk.who, f"{error}", asked="another rate") from error
        self._talk.ask(asked, lambda reply: conf.expect_echo(Code.SET_BAUD, reply))
        self._clock.sleep(signon.PAUSE_S)  # the echo comes at the old rate: the arm has to have changed before it is asked again
        self._talk.link.set_baud(baud)

    # Streams

    def start_stream(self, request: StreamRequest) -> bytes | None:
        """Start a stream once: None when the arm echoed, else the bytes that came. Raises LimitError or LinkError."""
        talk = self._talk
        self._tidy(request.command)
        talk.send(conf.encode_stream(request), Event.STREAM)
        echo = bytes([Code.STREAM])
        seen = talk.link.read_until(echo, self.answer_s)
        if seen.endswith(echo):
            return None
        self.stop_stream()
        return seen

    def stream_packets(self, timeout_s: float) -> list[Packet]:
        """What came since the last call, waiting ``timeout_s`` at most for a whole packet; none: the stream fell silent.

        Raises LinkError when the link is broken.
        """
        deadline = self._clock.now() + timeout_s
        while data := self._talk.link.receive(max(0.0, deadline - self._clock.now())):
            if packets := self._decoder.feed(data):
                return packets
        return []

    def stop_stream(self) -> None:
        """End a stream as the maker's host does: 00, 50 ms, flush; again while its answer is missing. Nothing without a stream.

        What came before the end is dropped. An arm that doesn't answer is left to the next question. Raises LinkError.
        """
        if not self.streaming:
            return
        self._talk.untidy = True
        for _ in range(ATTEMPTS):
            self._talk.send(bytes([_NOTHING]), Event.POLL)
            self._clock.sleep(STREAM_END_S)
            rest = PacketDecoder().feed(self._talk.link.drain(0.0))
            if rest and rest[-1].command == _NOTHING:
                self._talk.untidy = False
                break
        self._listen_for(self._decoder_of)

    def _tidy(self, command: int) -> None:
        """Ready for an answer to ``command``: nothing of an earlier one is left, and only its packets count."""
        if self._talk.untidy:
            self._talk.tidy()
            self._decoder.reset()
        if command != self._decoder_of:
            self._listen_for(command)

    def _listen_for(self, command: int) -> None:
        """From now on packets of ``command``, and nothing of one that had begun."""
        self._damaged += self._decoder.damaged
        self._decoder, self._decoder_of = PacketDecoder(command), command

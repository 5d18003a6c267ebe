"""Questions and answers on the arm's link, one at a time, and the way out for every byte.

All bytes leave through ``send``, which knows the session's state and what is never sent
(../shared/instruments/microscribe.md). Where a reply ends is known to ``configuration``. It may not
know which questions make a sign-on, nor what a packet means.

Sign-on, step by step: find the arm at whatever rate, begin a session, read who it is.

Order and timing are those of ../shared/instruments/microscribe.md. IMMC never goes out without C5
before it, since in a session that somebody left alive its letters are commands; BEGIN only once,
after the echo. It may not know what a session is for.

The driver's lower half: one session with an arm, from sign-on to end, and the questions within it.

Timing and order are those of ../shared/instruments/microscribe.md. It may not know what a position
is, nor of homing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import TypeVar

from instruments.clock import Clock
from instruments.errors import InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.microscribe import configuration as conf
from instruments.microscribe import errors, protocol
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import DeviceInfo, Identity, StreamRequest
from instruments.microscribe.errors import (
    InterfaceBoxError,
    NoMicroScribeError,
    NoSessionError,
    ParameterLengthError,
    SilentArmError,
    UnknownFormatError,
    UnstableUnitError,
)
from instruments.microscribe.protocol import Code, Event, Packet, PacketDecoder, State, WireError

ANSWER_S = 0.12  # 0.1 s, and the latency of an adapter whose timer nobody has set
SILENCE_S = 0.1

ON_HINT = "Is the arm switched on, plugged in, and on this port? Close other programs that use it"
_DAMAGE_HINT = "Check cable, plugs and baud rate, then sign on again"
_T = TypeVar("_T")


class Conversation:
    """One link and the state of the session on it, as far as this end knows; ``answer_s`` is how
    long an answer is waited for.
    """

    def __init__(self, link: Link, clock: Clock, answer_s: float = ANSWER_S) -> None:
        self.who = link.who
        self.link = link
        self.clock = clock
        self.answer_s = answer_s
        self.state = State.FINDING_BAUD
        self.untidy = False

    def lose(self) -> None:
        """The session is gone, whatever the arm believes; what still comes belongs to no later
        question.
        """
        self.state = State.FINDING_BAUD
        self.untidy = True

    def tidy(self) -> None:
        """Let late bytes of a damaged answer pass, so that none is taken for the next answer."""
        if self.untidy:
            self.link.drain(SILENCE_S * self.answer_s / ANSWER_S)
            self.untidy = False

    def send(self, data: bytes, event: Event) -> None:
        """Send bytes that are the event.

        Raises LimitError for what is never sent, NoSessionError for what the state doesn't allow,
        LinkError when the link is broken.
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

    def ask(
        self,
        asked: bytes,
        decode: Callable[[bytes], _T],
        *,
        timeout_s: float = 0.0,
        event: Event = Event.CONFIGURE,
    ) -> _T:
        """Send a configuration command and decode its reply, which has ``timeout_s``, and
        ``answer_s`` at least.

        Raises SilentArmError when nothing comes, ParameterLengthError for a block of an unknown
        length, ProtocolError for a damaged reply, NoSessionError, and LinkError when the link is
        broken.
        """
        self.tidy()
        start = self.clock.now()
        self.send(asked, event)
        reply, surplus = self._reply(asked[0], start + max(timeout_s, self.answer_s))
        seconds = self.clock.now() - start
        self.untidy = bool(surplus)
        if not reply:
            self.untidy = True
            raise SilentArmError(
                self.who,
                "the arm does not answer",
                asked=asked,
                seen=b"",
                seconds=seconds,
                hint=ON_HINT,
            )
        try:
            return decode(reply)
        except WireError as error:
            self.untidy = True
            kind = (
                ParameterLengthError if isinstance(error, conf.BlockLengthError) else ProtocolError
            )
            raise kind(
                self.who, f"{error}", asked=asked, seen=reply, seconds=seconds, hint=_DAMAGE_HINT
            ) from error

    def _reply(self, code: int, deadline: float) -> tuple[bytes, bytes]:
        """The reply, whole or as much of it as came, and what came behind it."""
        data = b""
        while (end := conf.reply_length(code, data)) is None:
            more = self.link.receive(max(0.0, deadline - self.clock.now()))
            if not more:
                return data, b""
            data += more
        return data[:end], data[end:]


SIGN_ON_S = 3.0
# an arm in a session at another rate ends it at the first C5 that it understands
OTHER_RATE_S = 0.5
PAUSE_S = 0.015
READINGS = 3  # of what the arm says of itself; two have to agree
_KNOCK = bytes([Code.END]) + wire.SYNC
_KEPT = 256


def find(talk: Conversation, rates: Sequence[int], patience_s: float) -> int:
    """Knock until the arm echoes; gives back the rate that worked. The first of ``rates`` gets
    ``patience_s``, the others less.

    Raises SilentArmError when nothing answers, NoMicroScribeError when something else does,
    LinkError when the link is broken. The link is at the first rate again then.
    """
    start, seen, tried = talk.clock.now(), b"", []
    for baud in rates:
        if not _speak_at(talk, baud):
            continue
        tried.append(baud)
        found, noise = _knock(talk, patience_s if baud == rates[0] else OTHER_RATE_S)
        if found:
            return baud
        seen = (seen + noise)[-_KEPT:]
        if errors.known(noise):
            break
    _speak_at(talk, rates[0])
    raise _nobody(talk, seen, tried, talk.clock.now() - start)


def _speak_at(talk: Conversation, baud: int) -> bool:
    """Whether the port can do that rate; few can do 14400 and 28800."""
    if talk.link.baud == baud:
        return True
    try:
        talk.link.set_baud(baud)
    except LinkError:
        return False
    return True


def _knock(talk: Conversation, patience_s: float) -> tuple[bool, bytes]:
    """Whether the echo came, and all else that came but the end of an old session.

    The end goes out once by itself first: were it lost before the first IMMC, the letters would be
    commands.
    """
    deadline = talk.clock.now() + patience_s
    talk.send(bytes([Code.END]), Event.END)
    seen = talk.link.read_until(bytes([Code.END]), PAUSE_S)
    while talk.clock.now() < deadline:
        talk.send(_KNOCK, Event.END)
        seen = (seen + talk.link.read_until(wire.SYNC, PAUSE_S))[-_KEPT:]
        if wire.SYNC in seen:
            talk.untidy = True
            # surplus echoes; and nothing from before the session counts as from within it
            talk.tidy()
            talk.state = wire.next_state(talk.state, Event.SYNC)
            return True, b""
    return False, seen.strip(bytes([Code.END]))


def _nobody(
    talk: Conversation, seen: bytes, tried: Sequence[int], seconds: float
) -> LinkError | ProtocolError:
    at = f" at {' or '.join(map(str, tried))} baud" if len(tried) > 1 else ""
    if seen:
        what = f"something answers, but not as a MicroScribe{at}"
        return NoMicroScribeError(
            talk.who,
            what,
            asked=_KNOCK,
            seen=seen[-64:],
            seconds=seconds,
            hint=errors.what_to_try(seen),
        )
    return SilentArmError(
        talk.who,
        f"nothing answers the sign-on{at}",
        asked=_KNOCK,
        seen=b"",
        seconds=seconds,
        hint=ON_HINT,
    )


def begin(talk: Conversation) -> None:
    """Begin the session. Raises InterfaceBoxError, NoMicroScribeError, SilentArmError, or LinkError
    when the link is broken.
    """
    talk.send(wire.BEGIN, Event.BEGIN)
    seconds = max(SIGN_ON_S, talk.answer_s)
    answer = talk.link.read_until(b"\0", seconds)
    if answer.rstrip(b"\0").endswith(wire.PRODUCT_ID):
        return
    if not answer:
        what = "the arm echoed, then fell silent"
        raise SilentArmError(
            talk.who, what, asked=wire.BEGIN, seen=b"", seconds=seconds, hint=ON_HINT
        )
    if wire.INTERFACE_BOX in answer:
        what = (
            "this is an Immersion Interface Box, not an arm: its encoder bits mean something else"
        )
        raise InterfaceBoxError(
            talk.who, what, asked=wire.BEGIN, seen=answer, hint="Connect the MicroScribe's own port"
        )
    what = "the answer is not that of a MicroScribe"
    raise NoMicroScribeError(
        talk.who, what, asked=wire.BEGIN, seen=answer, hint=errors.what_to_try(answer)
    )


def read_portrait(talk: Conversation) -> DeviceInfo:
    """Who the arm is, in the maker's order of asking, again and again until two readings agree:
    replies have no checksum.

    Raises UnknownFormatError, ParameterLengthError, UnstableUnitError, ProtocolError for damage,
    SilentArmError, LinkError.
    """
    seen: list[DeviceInfo] = []
    last: ProtocolError | None = None
    for _ in range(READINGS):
        try:
            portrait = _read_once(talk)
        except ProtocolError as error:
            last = error
            continue
        if portrait in seen:
            return portrait
        seen.append(portrait)
    what = f"what the arm says of itself came differently each of {READINGS} times"
    raise last or UnstableUnitError(
        talk.who,
        what,
        asked="names, maxima, parameters",
        hint="Check cable and plugs, then sign on again",
    )


def _read_once(talk: Conversation) -> DeviceInfo:
    identity = Identity(*(_name(talk, code) for code in conf.NAMES))
    maxima = talk.ask(bytes([Code.MAXIMA]), conf.decode_maxima, timeout_s=SIGN_ON_S)
    if identity.format != conf.FORMAT:
        what = (
            f"its parameters are in a format that is not understood: {identity.format!r}, not"
            f" {conf.FORMAT!r}"
        )
        raise UnknownFormatError(
            talk.who, what, hint="Positions of this arm can't be computed; use another arm"
        )
    parameters = talk.ask(bytes([Code.PARAMETERS]), conf.decode_parameters, timeout_s=SIGN_ON_S)
    beta = (
        talk.ask(bytes([Code.EXTENDED]), conf.decode_extended, timeout_s=SIGN_ON_S)
        if identity.has_beta
        else 0
    )
    return DeviceInfo(identity, maxima, parameters, beta)


def _name(talk: Conversation, code: Code) -> str:
    return talk.ask(bytes([code]), lambda reply: conf.decode_name(code, reply), timeout_s=SIGN_ON_S)


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

    def open(
        self, rates: Sequence[int], *, patience_s: float = SIGN_ON_S
    ) -> tuple[DeviceInfo, int]:
        """Find the arm, begin, and read who it is; a session that was begun is ended again when
        that fails.

        ``rates`` are tried in their order; the one that worked is given back. Raises as
        ``signon.find``, ``begin`` and ``read_portrait`` do.
        """
        self.lose()
        baud = find(self._talk, rates, patience_s)
        try:
            begin(self._talk)
            return read_portrait(self._talk), baud
        except InstrumentError:
            # the first error tells more than a second one about the same link
            with contextlib.suppress(LinkError):
                self.end()
            raise

    def end(self) -> None:
        """End the session; nothing happens without one. Raises LinkError when the link is broken:
        ended too, then.
        """
        if self._talk.state is State.FINDING_BAUD:
            return
        try:
            self._talk.send(bytes([Code.END]), Event.END)
            # silence is as good: an arm without power has no session
            self._talk.link.read_until(bytes([Code.END]), self.answer_s)
            self._clock.sleep(PAUSE_S)
        finally:
            self.lose()

    def lose(self) -> None:
        """The session is gone, whatever the arm believes; what still comes belongs to no later
        question.
        """
        self._talk.lose()
        self._decoder.reset()

    def ask_packet(self, command: int = wire.POLL) -> tuple[Packet | None, bytes]:
        """Poll once: the packet, or None where it came damaged or not at all; and the bytes that
        came.

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
        """Have the arm load its home counts. Raises LimitError, LinkError or ProtocolError where it
        doesn't confirm.
        """
        self._talk.ask(bytes([Code.HOME]), lambda reply: conf.expect_echo(Code.HOME, reply))

    def ask_baud(self, baud: int) -> None:
        """Have the arm speak at another rate, and speak at it. Raises as ``ask_home``; LimitError
        for a rate that no arm has.
        """
        try:
            asked = protocol.encode_set_baud(baud)
        except WireError as error:
            raise LimitError(self._talk.who, f"{error}", asked="another rate") from error
        self._talk.ask(asked, lambda reply: conf.expect_echo(Code.SET_BAUD, reply))
        # the echo comes at the old rate: the arm has to have changed before it is asked again
        self._clock.sleep(PAUSE_S)
        self._talk.link.set_baud(baud)

    # Streams

    def start_stream(self, request: StreamRequest) -> bytes | None:
        """Start a stream once: None when the arm echoed, else the bytes that came. Raises
        LimitError or LinkError.
        """
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
        """What came since the last call, waiting ``timeout_s`` at most for a whole packet; none:
        the stream fell silent.

        Raises LinkError when the link is broken.
        """
        deadline = self._clock.now() + timeout_s
        while data := self._talk.link.receive(max(0.0, deadline - self._clock.now())):
            if packets := self._decoder.feed(data):
                return packets
        return []

    def stop_stream(self) -> None:
        """End a stream as the maker's host does: 00, 50 ms, flush; again while its answer is
        missing. Nothing without a stream.

        What came before the end is dropped. An arm that doesn't answer is left to the next
        question. Raises LinkError.
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
        """Ready for an answer to ``command``: nothing of an earlier one is left, and only its
        packets count.
        """
        if self._talk.untidy:
            self._talk.tidy()
            self._decoder.reset()
        if command != self._decoder_of:
            self._listen_for(command)

    def _listen_for(self, command: int) -> None:
        """From now on packets of ``command``, and nothing of one that had begun."""
        self._damaged += self._decoder.damaged
        self._decoder, self._decoder_of = PacketDecoder(command), command

"""One session with an arm: sign-on, questions and answers, streams, the end.

All bytes leave through `Session.send`, which refuses what is never sent. IMMC only goes out
behind C5, since its letters are commands in a session that was left open; BEGIN goes out once,
after the echo.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import TypeVar

from instruments.clock import Clock
from instruments.errors import InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.microscribe import configuration as conf
from instruments.microscribe import errors
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

SIGN_ON_S = 3.0
# an arm in a session at another rate ends it at the first C5 that it understands
OTHER_RATE_S = 0.5
PAUSE_S = 0.015
READINGS = 3  # of what the arm says of itself; two have to agree
_KNOCK = bytes([Code.END]) + wire.SYNC
_KEPT = 256

STREAM_END_S = 0.05  # what the maker's host waits after it ended a stream
ATTEMPTS = 3
_NOTHING = 0x00  # asks for a packet of buttons alone: how a stream is ended


class Session:
    """The session on one link, as this end knows it. ``live`` while it can be asked for packets;
    ``answer_s`` is the least time for an answer.
    """

    def __init__(self, link: Link, clock: Clock, answer_s: float = ANSWER_S) -> None:
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

    def open(
        self, rates: Sequence[int], *, patience_s: float = SIGN_ON_S
    ) -> tuple[DeviceInfo, int]:
        """Find the arm at one of ``rates``, begin, and read who it is; also gives the rate.

        A session that was begun is ended when that fails. Raises as ``find``, ``begin`` and
        ``read_device_info``.
        """
        self.lose()
        baud = find(self, rates, patience_s)
        try:
            begin(self)
            return read_device_info(self), baud
        except InstrumentError:
            # the first error tells more than a second one about the same link
            with contextlib.suppress(LinkError):
                self.end()
            raise

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

    def ask(
        self,
        asked: bytes,
        decode: Callable[[bytes], _T],
        *,
        timeout_s: float = 0.0,
        event: Event = Event.CONFIGURE,
    ) -> _T:
        """Send a configuration command and decode its reply, which has ``timeout_s`` or
        ``answer_s``.

        Raises SilentArmError, ParameterLengthError, ProtocolError for a damaged reply,
        NoSessionError, and LinkError when the link is broken.
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

    def ask_packet(self, command: int = wire.POLL) -> tuple[Packet | None, bytes]:
        """Poll once: the packet (None where damaged or missing) and the bytes. Raises LimitError
        without a session, LinkError when the link is broken.
        """
        self._tidy(command)
        self.send(bytes([command]), Event.POLL)
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

    def ask_home(self) -> None:
        """Make the arm load its home counts. Raises LimitError, LinkError or ProtocolError."""
        self.ask(bytes([Code.HOME]), lambda reply: conf.expect_echo(Code.HOME, reply))

    def ask_baud(self, baud: int) -> None:
        """Change the arm's and the link's rate. Raises as ``ask_home``; LimitError for an unknown
        rate.
        """
        try:
            asked = wire.encode_set_baud(baud)
        except WireError as error:
            raise LimitError(self.who, f"{error}", asked="another rate") from error
        self.ask(asked, lambda reply: conf.expect_echo(Code.SET_BAUD, reply))
        # the echo comes at the old rate: the arm has to have changed before it is asked again
        self.clock.sleep(PAUSE_S)
        self.link.set_baud(baud)

    # Streams

    def start_stream(self, request: StreamRequest) -> bytes | None:
        """Start a stream once: None when echoed, else what came. Raises LimitError or LinkError."""
        self._tidy(request.command)
        self.send(conf.encode_stream(request), Event.STREAM)
        echo = bytes([Code.STREAM])
        seen = self.link.read_until(echo, self.answer_s)
        if seen.endswith(echo):
            return None
        self.stop_stream()
        return seen

    def stream_packets(self, timeout_s: float) -> list[Packet]:
        """The packets since the last call; none after ``timeout_s``. Raises LinkError."""
        deadline = self.clock.now() + timeout_s
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
        self._listen_for(self._decoder_of)

    def _tidy(self, command: int) -> None:
        """Drop what is left of an earlier answer, and accept packets of ``command`` only."""
        if self.untidy:
            self.tidy()
            self._decoder.reset()
        if command != self._decoder_of:
            self._listen_for(command)

    def _listen_for(self, command: int) -> None:
        """From now on packets of ``command``, and nothing of one that had begun."""
        self._damaged += self._decoder.damaged
        self._decoder, self._decoder_of = PacketDecoder(command), command


# Sign-on


def find(talk: Session, rates: Sequence[int], patience_s: float) -> int:
    """Send IMMC until the arm echoes it; the rate that worked. The first rate gets ``patience_s``.

    Raises SilentArmError, NoMicroScribeError for another device, LinkError; the link is then at the
    first rate again.
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


def _speak_at(talk: Session, baud: int) -> bool:
    """Whether the port can do that rate; few can do 14400 and 28800."""
    if talk.link.baud == baud:
        return True
    try:
        talk.link.set_baud(baud)
    except LinkError:
        return False
    return True


def _knock(talk: Session, patience_s: float) -> tuple[bool, bytes]:
    """Whether the echo came, and all else that came but the end of an old session. The end is sent
    alone first: were it lost before the first IMMC, the letters would be commands.
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
    talk: Session, seen: bytes, tried: Sequence[int], seconds: float
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


def begin(talk: Session) -> None:
    """Begin the session. Raises InterfaceBoxError, NoMicroScribeError, or LinkError."""
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


def read_device_info(talk: Session) -> DeviceInfo:
    """The arm's data in the maker's order, read until two readings agree.

    Raises UnknownFormatError, ParameterLengthError, UnstableUnitError, ProtocolError for damage,
    LinkError.
    """
    seen: list[DeviceInfo] = []
    last: ProtocolError | None = None
    for _ in range(READINGS):
        try:
            info = _read_once(talk)
        except ProtocolError as error:
            last = error
            continue
        if info in seen:
            return info
        seen.append(info)
    what = f"what the arm says of itself came differently each of {READINGS} times"
    raise last or UnstableUnitError(
        talk.who,
        what,
        asked="names, maxima, parameters",
        hint="Check cable and plugs, then sign on again",
    )


def _read_once(talk: Session) -> DeviceInfo:
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


def _name(talk: Session, code: Code) -> str:
    return talk.ask(bytes([code]), lambda reply: conf.decode_name(code, reply), timeout_s=SIGN_ON_S)

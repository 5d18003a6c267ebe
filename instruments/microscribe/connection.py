"""One arm on one link: its session, questions and answers, packets, and streams.

All bytes leave through `ArmConnection.send`, which refuses what is never sent. IMMC only goes out
behind C5, since its letters are commands in a session that was left open; BEGIN goes out once.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import astuple
from functools import partial
from typing import TypeVar

from instruments.clock import Clock
from instruments.errors import InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.microscribe import configuration as conf
from instruments.microscribe import errors
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import DeviceInfo, Identity
from instruments.microscribe.errors import (
    NoMicroScribeError,
    NoSessionError,
    SilentArmError,
    UnusableArmError,
)
from instruments.microscribe.protocol import Code, Event, Packet, PacketDecoder, State, WireError

ANSWER_S = 0.12  # 0.1 s, and the latency of an adapter whose timer has its default
SILENCE_S = 0.1
PAUSE_S = 0.015
STREAM_END_S = 0.05  # what the maker's host waits after it ended a stream
SIGN_ON_S = 3.0
# an arm in a session at another rate ends it at the first C5 that it understands
OTHER_RATE_S = 0.5
ATTEMPTS = 3
READINGS = 3  # of the arm's data at sign-on; two have to agree
ON_HINT = "Is the arm switched on, plugged in, and on this port? Close other programs that use it"
CABLE_HINT = "Check cable, plugs and baud rate"
_NOTHING = 0x00  # asks for a packet of buttons alone: how a stream is ended
_END = bytes([Code.END])
_KEPT = 256
_T = TypeVar("_T")


class ArmConnection:
    """One arm's session; ``live`` while it is open, as far as this end can tell.

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
        """Whether a session is open."""
        return self.state in wire.LIVE

    @property
    def streaming(self) -> bool:
        """Whether a stream runs."""
        return self.state is State.STREAMING

    @property
    def damaged(self) -> int:
        """Packets that came damaged."""
        return self._damaged + self._decoder.damaged

    # Sessions

    def open(self, rates: Sequence[int], patience_s: float) -> tuple[DeviceInfo, int]:
        """Find the arm at one of ``rates``, begin, and read its data; also gives the rate. The
        first rate gets ``patience_s``. A session that was begun is ended when that fails.

        Raises SilentArmError, NoMicroScribeError for another device, UnusableArmError,
        ProtocolError for damage or data that never came alike twice, LinkError.
        """
        self.lose()
        baud = self._find(rates, patience_s)
        try:
            self._begin()
            return self._read_device_info(), baud
        except InstrumentError:
            # the first error says more than a second one about the same link
            with contextlib.suppress(LinkError):
                self.end()
            raise

    def _find(self, rates: Sequence[int], patience_s: float) -> int:
        """Send IMMC until it is echoed; the rate that worked, else the link is at the first."""
        start, seen, tried = self.clock.now(), b"", []
        for baud in rates:
            if not self._set_rate(baud):
                continue
            tried.append(baud)
            noise = self._synchronise(patience_s if baud == rates[0] else OTHER_RATE_S)
            if noise is None:
                return baud
            seen = (seen + noise)[-_KEPT:]
            if errors.guess(noise):
                break
        self._set_rate(rates[0])
        at = f" at {' or '.join(map(str, tried))} baud" if len(tried) > 1 else ""
        kind: type[InstrumentError] = SilentArmError
        what, hint = f"nothing answers the sign-on{at}", ON_HINT
        if seen:
            kind, hint = NoMicroScribeError, errors.guess(seen) or errors.NOISE_HINT
            what = f"something answers, but not as a MicroScribe{at}"
        seconds, asked = self.clock.now() - start, _END + wire.SYNC
        raise kind(self.who, what, asked=asked, seen=seen[-64:], seconds=seconds, hint=hint)

    def _set_rate(self, baud: int) -> bool:
        """Whether the port can do that rate; few can do 14400 and 28800."""
        with contextlib.suppress(LinkError):
            if self.link.baud != baud:
                self.link.set_baud(baud)
        return self.link.baud == baud

    def _synchronise(self, patience_s: float) -> bytes | None:
        """None once the echo came, else all that came but the end of an old session. The end is
        sent alone first: were it lost before the first IMMC, the letters would be commands.
        """
        deadline = self.clock.now() + patience_s
        self.send(_END, Event.END)
        seen = self.link.read_until(_END, PAUSE_S)
        while self.clock.now() < deadline:
            self.send(_END + wire.SYNC, Event.END)
            seen = (seen + self.link.read_until(wire.SYNC, PAUSE_S))[-_KEPT:]
            if wire.SYNC in seen:
                self.untidy = True
                # surplus echoes; and nothing from before the session counts as from within it
                self.tidy()
                self.state = wire.next_state(self.state, Event.SYNC)
                return None
        return seen.strip(_END)

    def _begin(self) -> None:
        self.send(wire.BEGIN, Event.BEGIN)
        seconds = max(SIGN_ON_S, self.answer_s)
        answer = self.link.read_until(b"\0", seconds)
        if answer.rstrip(b"\0").endswith(wire.PRODUCT_ID):
            return
        kind: type[InstrumentError] = NoMicroScribeError
        what = "the answer is not that of a MicroScribe"
        hint = errors.guess(answer) or errors.NOISE_HINT
        if not answer:
            kind, what, hint = SilentArmError, "the arm echoed, then fell silent", ON_HINT
        elif wire.INTERFACE_BOX in answer:
            kind, hint = UnusableArmError, "Connect the MicroScribe's own port"
            what = "this is an Immersion Interface Box, not an arm: its encoder bits differ"
        waited_s = None if answer else seconds
        raise kind(self.who, what, asked=wire.BEGIN, seen=answer, seconds=waited_s, hint=hint)

    def _read_device_info(self) -> DeviceInfo:
        """The arm's data, read until two readings agree."""
        seen: list[DeviceInfo] = []
        last: ProtocolError | None = None
        for _ in range(READINGS):
            try:
                info = self._read_once()
            except ProtocolError as error:
                last = error
                continue
            if info in seen:
                return info
            seen.append(info)
        what = f"the arm's data came differently each of {READINGS} times"
        asked, hint = "names, maxima, parameters", "Check cable and plugs, then sign on again"
        raise last or ProtocolError(self.who, what, asked=asked, hint=hint)

    def _read_once(self) -> DeviceInfo:
        ask = partial(self.ask, timeout_s=SIGN_ON_S)
        names = Identity(*(ask(code, partial(conf.decode_name, code)) for code in conf.NAMES))
        maxima = ask(Code.MAXIMA, conf.decode_maxima)
        if names.format != conf.FORMAT:
            found = f"{names.format!r}, not {conf.FORMAT!r}"
            what = f"its parameters are in a format that is not understood: {found}"
            hint = "Positions of this arm can't be computed; use another arm"
            raise UnusableArmError(self.who, what, hint=hint)
        parameters = ask(Code.PARAMETERS, conf.decode_parameters)
        decode_beta = partial(conf.decode, Code.EXTENDED)
        beta = ask(Code.EXTENDED, decode_beta)[0] if names.has_beta else 0
        return DeviceInfo(names, maxima, parameters, beta)

    def end(self) -> None:
        """End the session, if any. Raises LinkError when the link is broken: ended too, then."""
        if self.state is State.FINDING_BAUD:
            return
        try:
            self.send(_END, Event.END)
            # silence is as good: an arm without power has no session
            self.link.read_until(_END, self.answer_s)
            self.clock.sleep(PAUSE_S)
        finally:
            self.lose()

    def lose(self) -> None:
        """The session is gone; what still comes belongs to no later question."""
        self.state = State.FINDING_BAUD
        self.untidy = True
        self._decoder.reset()

    # Questions and answers

    def tidy(self) -> None:
        """Wait for late bytes of an earlier answer, and drop them."""
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
        """Send a configuration command and decode its reply, within the longer of ``timeout_s`` and
        ``answer_s``. Raises SilentArmError, UnusableArmError for a block of an unknown length,
        ProtocolError for a damaged reply, NoSessionError, LinkError.
        """
        self.tidy()
        asked, start = bytes([code]), self.clock.now()
        self.send(asked, Event.CONFIGURE)
        deadline, reply = start + max(timeout_s, self.answer_s), b""
        while (end := conf.reply_length(code, reply)) is None:
            more = self._received(deadline)
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
        while data := self._received(deadline):
            seen += data
            if packets := self._decoder.feed(data):
                withdrawn, behind = self._decoder.withdrawn, self.link.receive(0.0)
                self._decoder.feed(behind)
                self.untidy = len(packets) > 1 or bool(behind) or self._decoder.pending > 0
                return None if self._decoder.withdrawn > withdrawn else packets[-1], seen + behind
        self.untidy = True
        return None, seen

    # Streams

    def start_stream(self, command: int) -> bytes | None:
        """Start the fastest stream of ``command`` once: None when echoed, else what came. Raises
        NoSessionError or LinkError.
        """
        self._expect(command)
        request = astuple(conf.StreamRequest(0, command))
        self.send(conf.encode(Code.STREAM, *request), Event.STREAM)
        echo = bytes([Code.STREAM])
        seen = self.link.read_until(echo, self.answer_s)
        if seen.endswith(echo):
            return None
        self.stop_stream()
        return seen

    def stream_packets(self) -> list[Packet]:
        """The packets since the last call; none after ``answer_s``. Raises LinkError."""
        deadline = self.clock.now() + self.answer_s
        while data := self._received(deadline):
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

    def _received(self, deadline_s: float) -> bytes:
        return self.link.receive(max(0.0, deadline_s - self.clock.now()))

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

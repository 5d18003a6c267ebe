"""The driver's lower half: one session with an arm, from sign-on to end, and the questions within it.

Timing and order are those of ../shared/instruments/microscribe.md. All bytes leave through one place, which knows
the session's state and what is never sent. It may not know what a position is, nor of homing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from instruments.clock import Clock
from instruments.errors import InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Link
from instruments.microscribe import configuration as conf
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import Identity, Maxima, Parameters
from instruments.microscribe.protocol import Code, Event, Packet, State, WireError

SIGN_ON_S = 3.0
ANSWER_S = 0.12  # 0.1 s, and the latency of an adapter whose timer nobody has set
PAUSE_S = 0.015
SILENCE_S = 0.1

_ON_HINT = "Is the arm switched on, plugged in, and on this port? Close other programs that use it"
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Unit:
    """All that an arm says of itself at sign-on; beta is 0 where it has none."""

    identity: Identity
    maxima: Maxima
    parameters: Parameters
    beta: int


class Session:
    """The conversation on one link. ``live`` while it can be asked for packets."""

    def __init__(self, link: Link, clock: Clock) -> None:
        self.who = link.who
        self._link = link
        self._clock = clock
        self._state = State.FINDING_BAUD
        self._untidy = False
        self._decoder = wire.PacketDecoder(wire.POLL)

    @property
    def live(self) -> bool:
        """Whether a session is open, as far as this end knows."""
        return self._state is State.SESSION

    @property
    def damaged(self) -> int:
        """Packets that came damaged."""
        return self._decoder.damaged

    def open(self) -> Unit:
        """Find the arm, begin, and read who it is; a session that was begun is ended again when that fails.

        Raises LinkError when nothing answers, ProtocolError when what answers is no arm that we understand.
        """
        self.lose()
        self._find()
        try:
            self._begin()
            return self._read_unit()
        except InstrumentError:
            with contextlib.suppress(LinkError):  # the first error tells more than a second one about the same link
                self.end()
            raise

    def end(self) -> None:
        """End the session; nothing happens without one. Raises LinkError when the link is broken: ended too, then."""
        if self._state is State.FINDING_BAUD:
            return
        try:
            self._send(bytes([Code.END]), Event.END)
            self._link.read_until(bytes([Code.END]), ANSWER_S)  # silence is as good: an arm without power has no session
            self._clock.sleep(PAUSE_S)
        finally:
            self.lose()

    def lose(self) -> None:
        """The session is gone, whatever the arm believes; what still comes belongs to no later question."""
        self._state = State.FINDING_BAUD
        self._untidy = True

    def ask_packet(self) -> tuple[Packet | None, bytes]:
        """Poll once: the packet, or None where it came damaged or not at all; and the bytes that came.

        Raises LimitError without a session, LinkError when the link is broken.
        """
        self._tidy()
        self._send(bytes([wire.POLL]), Event.POLL)
        seen = b""
        deadline = self._clock.now() + ANSWER_S
        while data := self._link.receive(max(0.0, deadline - self._clock.now())):
            seen += data
            if packets := self._decoder.feed(data):
                self._untidy = len(packets) > 1 or self._decoder.pending > 0
                return packets[-1], seen
        self._untidy = True
        return None, seen

    def ask_home(self) -> None:
        """Have the arm load its home counts. Raises LimitError, LinkError or ProtocolError where it doesn't confirm."""
        self._tidy()
        asked = bytes([Code.HOME])
        self._exchange(asked, lambda: self._link.read(1, ANSWER_S), lambda reply: conf.expect_echo(Code.HOME, reply))

    # Sign-on, step by step

    def _find(self) -> None:
        asked = bytes([Code.END]) + wire.SYNC  # never IMMC alone: in an old session its letters are commands
        seen = b""
        deadline = self._clock.now() + SIGN_ON_S
        while self._clock.now() < deadline:
            self._send(asked, Event.END)
            seen += self._link.read_until(wire.SYNC, PAUSE_S)
            if wire.SYNC in seen:
                self._untidy = True
                self._tidy()  # surplus echoes; and nothing from before the session counts as from within it
                self._state = wire.next_state(self._state, Event.SYNC)
                return
        if seen.strip(bytes([Code.END])):
            what = "something answers, but not as a MicroScribe"
            raise ProtocolError(self.who, what, asked=asked, seen=seen[-64:], seconds=SIGN_ON_S, hint="Is this the arm's port?")
        raise LinkError(self.who, "nothing answers the sign-on", asked=asked, seen=seen[-64:], seconds=SIGN_ON_S, hint=_ON_HINT)

    def _begin(self) -> None:
        self._send(wire.BEGIN, Event.BEGIN)
        answer = self._link.read_until(b"\0", SIGN_ON_S)
        if answer.rstrip(b"\0").endswith(wire.PRODUCT_ID):
            return
        if wire.INTERFACE_BOX in answer:
            what = "this is an Immersion Interface Box, not an arm: its encoder bits mean something else"
            raise ProtocolError(self.who, what, asked=wire.BEGIN, seen=answer, hint="Connect the MicroScribe's own port")
        if not answer:
            raise LinkError(self.who, "the arm echoed, then fell silent", asked=wire.BEGIN, seen=b"", seconds=SIGN_ON_S, hint=_ON_HINT)
        hint = "Is a loop-back plug or a modem on this port? Else switch the arm off and on, and sign on again"
        raise ProtocolError(self.who, "the answer is not that of a MicroScribe", asked=wire.BEGIN, seen=answer, hint=hint)

    def _read_unit(self) -> Unit:
        identity = Identity(*(self._name(code) for code in conf.NAMES))
        ask_maxima = bytes([Code.MAXIMA])
        maxima = self._exchange(ask_maxima, lambda: self._link.read(conf.MAXIMA_BYTES, SIGN_ON_S), conf.decode_maxima)
        if identity.format != conf.FORMAT:
            what = f"its parameters are in a format that is not understood: {identity.format!r}, not {conf.FORMAT!r}"
            raise ProtocolError(self.who, what, hint="Positions of this arm can't be computed; use another arm")
        parameters = self._exchange(bytes([Code.PARAMETERS]), self._block, conf.decode_parameters)
        beta = self._exchange(bytes([Code.EXTENDED]), self._block, conf.decode_extended) if identity.has_beta else 0
        return Unit(identity, maxima, parameters, beta)

    def _name(self, code: Code) -> str:
        return self._exchange(bytes([code]), lambda: self._link.read_until(b"\0", SIGN_ON_S), lambda reply: conf.decode_name(code, reply))

    def _block(self) -> bytes:
        head = self._link.read(2, SIGN_ON_S)
        return head + (self._link.read(head[1], SIGN_ON_S) if len(head) == 2 else b"")

    # The wire

    def _exchange(self, asked: bytes, receive: Callable[[], bytes], decode: Callable[[bytes], _T]) -> _T:
        start = self._clock.now()
        self._send(asked, Event.CONFIGURE)
        reply = receive()
        seconds = self._clock.now() - start
        if not reply:
            raise LinkError(self.who, "the arm does not answer", asked=asked, seen=b"", seconds=seconds, hint=_ON_HINT)
        try:
            return decode(reply)
        except WireError as error:
            hint = "Check cable, plugs and baud rate, then sign on again"
            raise ProtocolError(self.who, f"{error}", asked=asked, seen=reply, seconds=seconds, hint=hint) from error

    def _tidy(self) -> None:
        """Let late bytes of a damaged answer pass, so that none is taken for the next answer."""
        if self._untidy:
            self._link.drain(SILENCE_S)
            self._decoder.reset()
            self._untidy = False

    def _send(self, data: bytes, event: Event) -> None:
        """The one way out: nothing forbidden, and nothing that the session's state doesn't allow."""
        try:
            wire.refuse_forbidden(data, self._state)
            state = wire.next_state(self._state, event)
        except WireError as error:
            raise LimitError(self.who, f"{error}", asked=data, hint="Sign on first") from error
        self._link.write(data)
        self._state = state

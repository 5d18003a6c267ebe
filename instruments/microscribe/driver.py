"""The host's end of a MicroScribe arm: its session, questions and answers, packets, streams, and
positions.

The protocol has no checksum: damaged packets are asked for again, and several make a reading. There
is no position before homing is confirmed, since an arm that was not homed gives plausible, wrong
ones. A broken link is closed at once, which frees its port's name, and opened by the next sign-on.

All bytes leave through `MicroScribe._send`, which refuses what is never sent. IMMC only goes out
behind C5, since its letters are commands in a session that was left open; BEGIN goes out once.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import partial
from typing import ClassVar, TypeVar

import numpy as np
import numpy.typing as npt

from instruments.clock import Clock
from instruments.errors import InstrumentError, LimitError, LinkError, ProtocolError
from instruments.link import Link, latency_warning
from instruments.microscribe import configuration as conf
from instruments.microscribe import errors
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import DeviceInfo, Identity
from instruments.microscribe.errors import (
    AnotherArmError,
    ArmMovesError,
    NoMicroScribeError,
    NoSessionError,
    NotHomedError,
    SilentArmError,
    UnusableArmError,
)
from instruments.microscribe.pedals import Pedal
from instruments.microscribe.protocol import (
    ArmTime,
    Code,
    Event,
    Packet,
    PacketDecoder,
    State,
    WireError,
)

ANSWER_S = 0.12  # 0.1 s, and the latency of an adapter whose timer has its default
SILENCE_S = 0.1
PAUSE_S = 0.015
STREAM_END_S = 0.05  # what the maker's host waits after it ended a stream
SIGN_ON_S = 3.0
# an arm in a session at another rate ends it at the first C5 that it understands
OTHER_RATE_S = 0.5
ATTEMPTS = 3
READINGS = 3  # of the arm's data at sign-on; two have to agree
RECOVER_S = 30.0
# eight packets of a still arm spread by some 0.35 mm: rounding (0.31 mm a packet) and tremor
MAX_SPREAD_MM = 1.0
INTERVAL_S = 0.01
STREAMED = wire.POLL | wire.TIME_STAMP
_RETRY_S = 0.25
_RETRY_SIGN_ON_S = 1.0  # a port that is back is noticed, and its arm signed on, well within 2 s
_RATES = (115200, 38400, 57600, 19200, 9600, 28800, 14400)  # the likely ones first
_NOTHING = 0x00  # asks for a packet of buttons alone: how a stream is ended
_END = bytes([Code.END])
_KEPT = 256
_T = TypeVar("_T")

ON_HINT = "Is the arm switched on, plugged in, and on this port? Close other programs that use it"
CABLE_HINT = "Check cable, plugs and baud rate"
_CONFIRM_HINT = (
    "Confirm it if the stylus sat on its peg when the arm was last switched on; "
    "else put the stylus on its peg, switch the arm off and on, and confirm"
)
_HOME_HINT = (
    "Put the stylus on its peg and home the arm ('teatbench arm home'), or switch it off and on"
    " there and try again"
)
_BACK_HINT = (
    "Check power and cable, and try again; if it lost its power, switch it on with its stylus"
    " on its peg"
)
_DOUBT = (
    "the arm was in a session at another baud rate, and what was sent at the wrong one may have"
    " re-homed it"
)


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One position in the arm's frame: median ``tip_mm`` (3,) and ``axis`` (3,) up the stylus,
    ``spread_mm`` of ``n`` packets, ``counts`` of the last one; ``written``: as another program or a
    person wrote it.
    """

    tip_mm: npt.NDArray[np.float64]
    spread_mm: float
    axis: npt.NDArray[np.float64] | None
    n: int
    counts: tuple[int, ...] = ()
    written: str = ""

    @property
    def evidence(self) -> str | list[int]:
        """What the record keeps of it: the counts, or what was written."""
        return self.written or [int(count) for count in self.counts]


@dataclass(frozen=True, slots=True, eq=False)
class ArmView:
    """What a watched arm shows: the tip (3,) in the arm's frame, which pedals are down, packets a
    second, and how many were damaged so far. ``t_s`` is by the arm's clock.
    """

    t_s: float
    tip_mm: npt.NDArray[np.float64]
    pedals: Mapping[str, bool]
    packets_per_s: float
    damaged: int


@dataclass(frozen=True, slots=True)
class Sample:
    """One packet; ``t_s`` is by the arm's clock from the session's first stamp."""

    t_s: float
    counts: tuple[int, ...]
    buttons: int


class MicroScribe:
    """One arm on one link, which it owns. ``rates``: tried by sign-on, the first one longest.
    ``answer_s``: time for an answer; three have to be missing before the arm counts as lost.
    """

    moves: ClassVar[bool] = False
    touches: ClassVar[bool] = False
    pedals: ClassVar[bool] = True
    safe_state: ClassVar[str] = "session ended; it has no motor"
    homing: ClassVar[str] = (
        "Put the arm's stylus on its peg, switch the arm on, and leave the stylus there."
    )
    homing_again: ClassVar[str] = (
        "The arm was lost: put its stylus on its peg, see that it is switched on, and leave the"
        " stylus there."
    )

    def __init__(
        self,
        link: Link,
        clock: Clock,
        *,
        rates: Sequence[int] | None = None,
        answer_s: float = ANSWER_S,
    ) -> None:
        self.who = link.who
        self._link = link
        self._clock = clock
        if rates is None:  # a socket's far end keeps its own rate
            others = () if link.url.startswith("socket://") else _RATES
            rates = (link.baud, *(rate for rate in others if rate != link.baud))
        self._rates = tuple(rates)
        self._answer_s = answer_s
        self._state = State.FINDING_BAUD
        self._untidy = False  # bytes of an earlier answer may come
        self._decoder = PacketDecoder(wire.POLL)
        self._arm_time = ArmTime()
        self._info: DeviceInfo | None = None
        self._broken = False
        self._not_homed: str | None = "it has not been confirmed since sign-on"  # why; None: homed
        self._doubt = ""  # why a confirmation is not enough

    @property
    def info(self) -> DeviceInfo:
        """The arm's own data, as read at sign-on. Raises NoSessionError before it."""
        if self._info is None:
            raise NoSessionError(self.who, "it has not been identified yet", hint="Sign on first")
        return self._info

    @property
    def identity(self) -> Identity:
        """The seven names, as read at sign-on. Raises NoSessionError before it."""
        return self.info.names

    @property
    def baud(self) -> int:
        """The rate that the link is at: after sign-on, the one that worked."""
        return self._link.baud

    def record(self) -> dict[str, object]:
        """The arm's own data and how it was read. Raises NoSessionError before sign-on."""
        return {**self.info.record(), "baud": self.baud}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about a slow adapter, another rate, and joints that lose count."""
        found = [latency_warning(self._link.url)]
        if self._info and self.baud != self._rates[0]:
            found.append(f"the arm answers at {self.baud} baud, not at {self._rates[0]}")
        found += self._info.warnings() if self._info else []
        return tuple(warning for warning in found if warning)

    @property
    def homed(self) -> bool:
        """Whether homing has been confirmed in this session."""
        return self._not_homed is None and self.live

    @property
    def live(self) -> bool:
        """Whether a session is open, as far as the host can tell."""
        return self._state in wire.LIVE

    @property
    def damaged(self) -> int:
        """Packets that came damaged since the driver was made."""
        return self._decoder.damaged

    # Sessions

    def sign_on(self) -> Identity:
        """Find the arm and open a session; homing has to be confirmed afterwards. Raises LinkError
        (SilentArmError: no answer), NoMicroScribeError, UnusableArmError, ProtocolError.
        """
        return self._sign_on(self._rates, SIGN_ON_S)

    def recover(self, timeout_s: float = RECOVER_S) -> Identity:
        """Wait for port and arm, and sign on at the rate that worked. Raises what ``sign_on``
        raised last after ``timeout_s``; at once UnusableArmError, AnotherArmError.
        """
        before, deadline = self._info, self._clock.now() + timeout_s
        try:
            while True:
                attempt_s = min(_RETRY_SIGN_ON_S, max(_RETRY_S, deadline - self._clock.now()))
                try:
                    now = self._sign_on((self.baud,), attempt_s)
                    break
                except UnusableArmError:
                    raise
                except (LinkError, ProtocolError):
                    if self._clock.now() + _RETRY_S >= deadline:
                        raise
                self._clock.sleep(_RETRY_S)
            there = now.serial_number
            if before and before.names.serial_number != there:
                self.safe()
                what = f"arm {before.names.serial_number} was lost, and arm {there} answers"
                hint = "Plug the first arm in again, or sign on to the new one"
                raise AnotherArmError(self.who, what, hint=hint)
        except BaseException:
            self._info = before  # still the arm that is waited for
            raise
        return now

    def _sign_on(self, rates: Sequence[int], timeout_s: float) -> Identity:
        self._lose_homing("the session was opened anew")
        self._info = None
        self._arm_time = ArmTime()
        if self._broken:
            self._link.reopen()
            self._broken = False
        self._lose_session()
        with self._link_watched():
            baud = self._find(rates, timeout_s)
            try:
                self._begin()
                self._info = self._read_device_info()
            except InstrumentError:
                # the first error says more than a second one about the same link
                with contextlib.suppress(LinkError):
                    self._end()
                raise
        self._doubt = _DOUBT if baud != rates[0] else ""
        return self._info.names

    def safe(self) -> None:
        """End the session, if any. Raises LinkError when the link is broken."""
        self._lose_homing("the session was ended")
        with self._link_watched():
            self._end()

    def close(self) -> None:
        """End the session and close the link; once more is no error."""
        try:
            with contextlib.suppress(LinkError):  # a broken link has no session to end
                self.safe()
        finally:
            self._link.close()

    @contextlib.contextmanager
    def _link_watched(self) -> Iterator[None]:
        """A link that breaks in here costs the session and the homing."""
        try:
            yield
        except SilentArmError:
            raise  # the link is whole
        except LinkError:
            self._broken = True
            self._lose_homing("the link broke, and the arm may have lost its power")
            self._lose_session()
            self._link.close()
            raise

    def _find(self, rates: Sequence[int], timeout_s: float) -> int:
        """Send IMMC until it is echoed; the rate that worked, else the link is at the first."""
        start, seen, tried = self._clock.now(), b"", []
        for baud in rates:
            if not self._set_rate(baud):
                continue
            tried.append(baud)
            noise = self._synchronise(timeout_s if baud == rates[0] else OTHER_RATE_S)
            if noise is None:
                return baud
            seen = (seen + noise)[-_KEPT:]
            if errors.diagnosis(noise):
                break
        self._set_rate(rates[0])
        at = f" at {' or '.join(map(str, tried))} baud" if len(tried) > 1 else ""
        kind: type[InstrumentError] = SilentArmError
        what, hint = f"nothing answers the sign-on{at}", ON_HINT
        if seen:
            kind, hint = NoMicroScribeError, errors.diagnosis(seen) or errors.NOISE_HINT
            what = f"something answers, but not as a MicroScribe{at}"
        seconds, asked = self._clock.now() - start, _END + wire.SYNC
        raise kind(self.who, what, asked=asked, seen=seen[-64:], seconds=seconds, hint=hint)

    def _set_rate(self, baud: int) -> bool:
        """Whether the port can do that rate; few can do 14400 and 28800."""
        with contextlib.suppress(LinkError):
            if self._link.baud != baud:
                self._link.set_baud(baud)
        return self._link.baud == baud

    def _synchronise(self, timeout_s: float) -> bytes | None:
        """None once the echo came, else all that came. The end is sent alone first: were it lost
        before the first IMMC, the letters would be commands.
        """
        deadline = self._clock.now() + timeout_s
        self._send(_END, Event.END)
        seen = self._link.read_until(_END, PAUSE_S)
        while self._clock.now() < deadline:
            self._send(_END + wire.SYNC, Event.END)
            seen = (seen + self._link.read_until(wire.SYNC, PAUSE_S))[-_KEPT:]
            if wire.SYNC in seen:
                self._untidy = True
                # surplus echoes; and nothing from before the session counts as from within it
                self._tidy()
                self._state = wire.next_state(self._state, Event.SYNC)
                return None
        return seen.strip(_END)

    def _begin(self) -> None:
        self._send(wire.BEGIN, Event.BEGIN)
        seconds = max(SIGN_ON_S, self._answer_s)
        answer = self._link.read_until(b"\0", seconds)
        if answer.rstrip(b"\0").endswith(wire.PRODUCT_ID):
            return
        kind: type[InstrumentError] = NoMicroScribeError
        what = "the answer is not that of a MicroScribe"
        hint = errors.diagnosis(answer) or errors.NOISE_HINT
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
        asked, hint = "names, maxima, parameters", "Check cable and plugs, then try again"
        raise last or ProtocolError(self.who, what, asked=asked, hint=hint)

    def _read_once(self) -> DeviceInfo:
        ask = partial(self._ask, timeout_s=SIGN_ON_S)
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

    def _end(self) -> None:
        """End the session, if any. Raises LinkError when the link is broken: ended too, then."""
        if self._state is State.FINDING_BAUD:
            return
        try:
            self._send(_END, Event.END)
            # silence is as good: an arm without power has no session
            self._link.read_until(_END, self._answer_s)
            self._clock.sleep(PAUSE_S)
        finally:
            self._lose_session()

    def _lose_session(self) -> None:
        """The session is gone; what still comes belongs to no later question."""
        self._state = State.FINDING_BAUD
        self._untidy = True
        self._decoder.reset()

    # Questions and answers

    def _tidy(self) -> None:
        """Wait for late bytes of an earlier answer, and drop them."""
        if self._untidy:
            self._link.drain(min(1.0, SILENCE_S * self._answer_s / ANSWER_S))
            self._untidy = False

    def _send(self, data: bytes, event: Event) -> None:
        """Send bytes that are ``event``. Raises LimitError for what is never sent, NoSessionError
        for what the state doesn't allow, LinkError.
        """
        try:
            wire.refuse_forbidden(data, self._state)
        except WireError as error:
            raise LimitError(self.who, f"{error}", asked=data) from error
        try:
            state = wire.next_state(self._state, event)
        except WireError as error:
            raise NoSessionError(self.who, f"{error}", asked=data, hint="Sign on first") from error
        self._link.write(data)
        self._state = state

    def _ask(self, code: Code, decode: Callable[[bytes], _T], *, timeout_s: float = 0.0) -> _T:
        """Send a configuration command and decode its reply. Raises SilentArmError,
        UnusableArmError, ProtocolError, NoSessionError, LinkError.
        """
        self._tidy()
        asked, start = bytes([code]), self._clock.now()
        self._send(asked, Event.CONFIGURE)
        reply, end = b"", None
        for more in self._incoming(start + max(timeout_s, self._answer_s)):
            reply += more
            if (end := conf.reply_length(code, reply)) is not None:
                break
        seconds = self._clock.now() - start
        self._untidy = not reply or len(reply) > len(reply[:end])
        reply = reply[:end]
        kind: type[InstrumentError] = SilentArmError
        what, hint = "the arm does not answer", ON_HINT
        try:
            if reply:
                return decode(reply)
        except WireError as error:
            self._untidy = True
            unusable = isinstance(error, conf.BlockLengthError)
            kind = UnusableArmError if unusable else ProtocolError
            what, hint = f"{error}", f"{CABLE_HINT}, then try again"
        raise kind(self.who, what, asked=asked, seen=reply, seconds=seconds, hint=hint)

    def _incoming(self, deadline_s: float) -> Iterator[bytes]:
        return self._link.incoming(self._link.reception(deadline_s))

    def _expect(self, command: int) -> None:
        """Drop what is left of an earlier answer, and accept packets of ``command`` only."""
        if self._untidy:
            self._tidy()
            self._decoder.reset()
        if command != self._decoder.command:
            self._decoder.expect(command)

    def _need_session(self, asked: str) -> None:
        """Raise NoSessionError without a session, LimitError within a stream."""
        if not self.live:
            raise NoSessionError(self.who, "there is no session", asked=asked, hint="Sign on first")
        if self._state is State.STREAMING:
            raise LimitError(self.who, "a stream runs", asked=asked, hint="End the stream first")

    # Homing

    def confirm_homed(self) -> None:
        """The operator confirms homing. Raises NoSessionError; NotHomedError after a search for the
        rate, when only homing helps.
        """
        self._need_session("to confirm homing")
        if self._doubt:
            raise NotHomedError(self.who, self._doubt, asked="to confirm homing", hint=_HOME_HINT)
        self._not_homed, self._doubt = None, ""

    def home(self) -> None:
        """Make the arm load its home counts, with the stylus on its peg: anywhere else ruins every
        position. Raises NoSessionError, LinkError, or ProtocolError without confirmation.
        """
        self._need_session("to home")
        self._lose_homing("the arm was asked to home, and did not confirm it")
        with self._link_watched():
            self._ask(Code.HOME, partial(conf.decode, Code.HOME))
        self._not_homed, self._doubt = None, ""

    def _lose_homing(self, why: str) -> None:
        if self._not_homed is None:
            self._not_homed = why

    def _need_homing(self, asked: str) -> None:
        if self._not_homed is not None:
            hint = _HOME_HINT if self._doubt else _CONFIRM_HINT
            what = f"no positions before homing is confirmed: {self._doubt or self._not_homed}"
            what += ". An arm that was not homed gives plausible, wrong ones"
            raise NotHomedError(self.who, what, asked=asked, hint=hint)

    # Packets and positions

    def glance(self) -> Reading | None:
        """One packet, to show; its tip is not-a-number before homing. Raises as ``poll``."""
        packet = self.poll()
        if self._not_homed is not None:
            return Reading(np.full(3, np.nan), 0.0, None, 1, packet.counts)
        return self.position([Sample(self._clock.now(), packet.counts, packet.buttons)])

    def buttons(self) -> int:
        """The pedals that are down now, as bits. Raises as ``poll``."""
        return self.poll().buttons

    def asked_of(self, operator: object) -> None:
        """Does nothing: this arm asks no operator."""

    def touch(self, point_mm: npt.NDArray[np.float64], axis: npt.NDArray[np.float64]) -> None:
        """Raises LimitError: it is moved by hand."""
        raise LimitError(self.who, f"it has no motor to go to {point_mm} along {axis}")

    def poll(self) -> Packet:
        """One packet of six counts, asked for again when damaged. Raises NoSessionError, LimitError
        within a stream, ProtocolError; LinkError, which loses session and homing.
        """
        self._need_session("a packet")
        return self._packet()

    def _packet(self) -> Packet:
        seen, start = b"", self._clock.now()
        for _ in range(ATTEMPTS):
            with self._link_watched():
                packet, came = self._poll_once()
            if packet is not None:
                return packet
            seen = came or seen
        asked, seconds = bytes([wire.POLL]), self._clock.now() - start
        if seen:
            what = f"{ATTEMPTS} packets in a row came damaged"
            raise ProtocolError(self.who, what, asked=asked, seen=seen, hint=CABLE_HINT)
        self._lose_homing("the arm fell silent: it may have lost its power")
        self._lose_session()
        what = "the arm has fallen silent: without power or cable, session and homing are lost"
        hint = _BACK_HINT
        raise SilentArmError(self.who, what, asked=asked, seen=b"", seconds=seconds, hint=hint)

    def _poll_once(self) -> tuple[Packet | None, bytes]:
        """The packet (None: damaged or missing), and the bytes that came. Raises LinkError."""
        self._expect(wire.POLL)
        self._send(bytes([wire.POLL]), Event.POLL)
        seen = b""
        for data in self._incoming(self._clock.now() + self._answer_s):
            seen += data
            if packets := self._decoder.feed(data):
                withdrawn, behind = self._decoder.withdrawn, self._link.receive(0.0)
                self._decoder.feed(behind)
                self._untidy = len(packets) > 1 or bool(behind) or self._decoder.pending > 0
                return None if self._decoder.withdrawn > withdrawn else packets[-1], seen + behind
        self._untidy = True
        return None, seen

    def read(self, n: int = 8, max_spread_mm: float = MAX_SPREAD_MM) -> Reading:
        """One position from ``n`` packets, 10 ms apart. Raises NotHomedError, ArmMovesError for a
        larger spread, ValueError for n below 1, else as ``poll``.
        """
        if n < 1:
            raise ValueError(f"a reading needs one packet at least, not {n}")
        self._need_session("a reading")
        self._need_homing("a reading")
        counts = [self.poll().counts]
        while len(counts) < n:
            self._clock.sleep(INTERVAL_S)
            counts.append(self.poll().counts)
        reading = self._reading(counts)
        if not reading.spread_mm <= max_spread_mm:
            what = f"the arm moves: {n} packets spread by {reading.spread_mm:.2f} mm, more than"
            what, hint = f"{what} {max_spread_mm:g} mm", "Hold the tip still and read again"
            raise ArmMovesError(self.who, what, asked="a reading", hint=hint)
        return reading

    @contextlib.contextmanager
    def stream(self) -> Iterator[Iterator[Sample]]:
        """Samples as fast as the arm sends them; a silent stream is started again if the arm still
        answers. Raises as ``poll``.
        """
        self._need_session("a stream")
        self._start_stream()
        try:
            yield self._samples()
        finally:
            self._stop_stream()

    def watch(self, every_s: float) -> Iterator[ArmView]:
        """A view each ``every_s`` as it streams, without an end. Raises as ``stream``."""
        with self.stream() as stream:
            samples: list[Sample] = []
            for sample in stream:
                samples.append(sample)
                if (span_s := sample.t_s - samples[0].t_s) < every_s:
                    continue
                pedals = {
                    one.name.lower(): bool(sample.buttons & one.value) for one in reversed(Pedal)
                }
                tip_mm, rate = self.position(samples).tip_mm, (len(samples) - 1) / span_s
                yield ArmView(sample.t_s, tip_mm, pedals, rate, self.damaged)
                samples = []

    def _start_stream(self) -> None:
        """Start the fastest stream with time stamps. Raises as ``poll``."""
        start, seen = self._clock.now(), b""
        request = conf.encode(Code.STREAM, *astuple(conf.StreamRequest(0, STREAMED)))
        echo = bytes([Code.STREAM])
        for _ in range(ATTEMPTS):
            with self._link_watched():
                self._expect(STREAMED)
                self._send(request, Event.STREAM)
                came = self._link.read_until(echo, self._answer_s)
            if came.endswith(echo):
                return
            self._stop_stream()
            seen = came or seen
        what = f"{ATTEMPTS} requests for a stream were answered otherwise"
        kind: type[InstrumentError] = ProtocolError
        if not seen:
            self._packet()  # raises where the arm is gone
            kind, what = SilentArmError, "the arm answers polls, but no stream"
        seconds = self._clock.now() - start
        hint = f"{CABLE_HINT}; or poll"
        raise kind(self.who, what, asked=echo, seen=seen[-64:], seconds=seconds, hint=hint)

    def _stop_stream(self) -> None:
        """End a stream as the maker's host does: 00, 50 ms, flush; earlier packets are dropped."""
        if self._state is not State.STREAMING:
            return
        with self._link_watched():
            self._untidy = True
            for _ in range(ATTEMPTS):
                self._send(bytes([_NOTHING]), Event.POLL)
                self._clock.sleep(STREAM_END_S)
                rest = PacketDecoder().feed(self._link.drain(0.0))
                if rest and rest[-1].command == _NOTHING:
                    self._untidy = False
                    break
            self._decoder.expect(STREAMED)

    def _samples(self) -> Iterator[Sample]:
        while True:
            if self._state is not State.STREAMING:
                what, asked = "the stream has ended", "the next sample"
                raise NoSessionError(self.who, what, asked=asked, hint="Start another stream")
            packets: list[Packet] = []
            with self._link_watched():
                for data in self._incoming(self._clock.now() + self._answer_s):
                    if packets := self._decoder.feed(data):
                        break
            if not packets:  # the command may have been lost, or the arm
                self._stop_stream()
                self._packet()
                self._start_stream()
            host_s = self._clock.now()
            for packet in packets:
                t_s = self._arm_time.seconds(packet.ticks or 0, host_s)
                yield Sample(t_s, packet.counts, packet.buttons)

    def position(self, samples: Sequence[Sample]) -> Reading:
        """The reading of samples whatever their spread: to show, not to measure. Raises
        NotHomedError, ValueError for no samples.
        """
        if not samples:
            raise ValueError("a reading needs one sample at least")
        self._need_homing("a position")
        return self._reading([sample.counts for sample in samples])

    def _reading(self, counts: Sequence[tuple[int, ...]]) -> Reading:
        """Of counts (n, 6), n at least 1. One wrong packet moves no median."""
        tips, axes = self.info.geometry().forward(np.array(counts))
        tip, axis = np.median(tips, axis=0), np.median(axes, axis=0)
        spread_mm = float(np.linalg.norm(tips - tip, axis=1).max())
        return Reading(tip, spread_mm, axis / np.linalg.norm(axis), len(counts), counts[-1])

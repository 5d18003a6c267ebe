"""Streams: samples by the arm's own time, pedal events without bounce, and a position out of
several packets.

A silent stream is no proof of a lost arm, as its command may have been lost. So the arm is polled,
and the stream started again where it answers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt

from instruments.clock import Clock
from instruments.errors import ProtocolError
from instruments.microscribe import protocol as wire
from instruments.microscribe.configuration import StreamRequest
from instruments.microscribe.connection import ArmConnection
from instruments.microscribe.errors import NoSessionError, SilentArmError
from instruments.microscribe.kinematics import ArmGeometry
from instruments.microscribe.protocol import (
    LONGEST_DELAY_MS,
    POLL,
    ArmTime,
    Code,
    Packet,
    harmless_delay_ms,
)
from instruments.microscribe.session import ATTEMPTS

DEBOUNCE_S = 0.02


class Pedal(Enum):
    """A pedal, by its bit; a single one is the right one."""

    RIGHT = 0x01
    LEFT = 0x02


@dataclass(frozen=True, slots=True)
class PedalEvent:
    """A press or release at ``t_s``, when its contact changed for good."""

    pedal: Pedal
    pressed: bool
    t_s: float


class Debouncer:
    """A change counts once every packet for ``debounce_s`` has shown it. A pedal that is down in
    the first packet is no event.
    """

    def __init__(self, debounce_s: float = DEBOUNCE_S) -> None:
        """Raises ValueError for a negative time."""
        if not debounce_s >= 0:
            raise ValueError(f"a debounce time is seconds, not less than 0; got {debounce_s}")
        self._debounce_s = debounce_s
        self._settled: int | None = None
        self._since: dict[Pedal, float] = {}

    @property
    def down(self) -> frozenset[Pedal]:
        """The pedals that are down, bounce taken off."""
        return frozenset(pedal for pedal in Pedal if (self._settled or 0) & pedal.value)

    def feed(self, t_s: float, buttons: int) -> tuple[PedalEvent, ...]:
        """The events that this packet settles; ``t_s`` is when it was made."""
        if self._settled is None:
            self._settled = buttons
        return tuple(event for pedal in Pedal if (event := self._event(pedal, t_s, buttons)))

    def _event(self, pedal: Pedal, t_s: float, buttons: int) -> PedalEvent | None:
        if not (buttons ^ (self._settled or 0)) & pedal.value:
            self._since.pop(pedal, None)
            return None
        since = self._since.setdefault(pedal, t_s)
        if t_s - since < self._debounce_s - 1e-9:
            return None
        del self._since[pedal]
        self._settled = (self._settled or 0) ^ pedal.value
        return PedalEvent(pedal, bool(buttons & pedal.value), since)


@dataclass(frozen=True, slots=True, eq=False)
class Reading:
    """One position in the arm's frame. ``tip_mm`` (3,) is the median tip, ``spread_mm`` the largest
    distance of a packet's tip from it, ``axis`` (3,) the unit median direction from the tip up the
    stylus, ``n`` the packets, ``counts`` the last packet's.
    """

    tip_mm: npt.NDArray[np.float64]
    spread_mm: float
    axis: npt.NDArray[np.float64]
    n: int
    counts: tuple[int, ...]


def reading_of(geometry: ArmGeometry, counts: Sequence[tuple[int, ...]]) -> Reading:
    """The reading of counts (n, 6), n at least 1. One wrong packet moves no median."""
    tips, axes = geometry.forward(np.array(counts))
    tip, axis = np.median(tips, axis=0), np.median(axes, axis=0)
    spread_mm = float(np.linalg.norm(tips - tip, axis=1).max())
    return Reading(tip, spread_mm, axis / np.linalg.norm(axis), len(counts), counts[-1])


_ENCODER_BITS = {5: 0x01, 6: 0x03}


@dataclass(frozen=True, slots=True)
class Sample:
    """One packet: raw ``counts`` and ``buttons``, ``events`` without bounce. ``t_s`` is by the
    arm's clock from the session's first stamp; by the host's clock without a stamp.
    """

    t_s: float
    counts: tuple[int, ...]
    buttons: int
    events: tuple[PedalEvent, ...]
    packet: Packet


class Sampler:
    """Makes samples of packets, in their order."""

    def __init__(self, arm_time: ArmTime, debounce_s: float) -> None:
        """Raises ValueError for a negative time."""
        self._arm_time = arm_time
        self._debouncer = Debouncer(debounce_s)

    def sample(self, packet: Packet, host_s: float) -> Sample:
        """One packet, come at ``host_s``."""
        t_s = host_s if packet.ticks is None else self._arm_time.seconds(packet.ticks, host_s)
        return Sample(
            t_s, packet.counts, packet.buttons, self._debouncer.feed(t_s, packet.buttons), packet
        )


def poll_command(encoders: int, stamped: bool) -> int:
    """The command for five or six encoders, time stamp or not. Raises ValueError for others."""
    if encoders not in _ENCODER_BITS:
        raise ValueError(f"an arm has 5 or 6 encoders to ask for, not {encoders}")
    return _ENCODER_BITS[encoders] | (wire.TIME_STAMP if stamped else 0)


def stream_request(rate_hz: float | None, command: int) -> StreamRequest:
    """A stream at a fixed rate, ``rate_hz`` at least; None: the fastest. Periods are whole harmless
    milliseconds, so the next higher rate is taken. Raises ValueError where there is none.
    """
    if rate_hz is None:
        return StreamRequest(0, command)
    slowest_hz = 1000.0 / LONGEST_DELAY_MS
    if not slowest_hz <= rate_hz <= 1000.0:
        raise ValueError(
            f"an arm streams at {slowest_hz:.2g} to 1000 packets a second, not {rate_hz:g}; None is"
            " as fast as it goes"
        )
    return StreamRequest(harmless_delay_ms(1.0 / rate_hz), command)


_ASKED = bytes([Code.STREAM])


class Streaming:
    """One stream of one arm."""

    def __init__(
        self, arm: ArmConnection, clock: Clock, request: StreamRequest, sampler: Sampler
    ) -> None:
        self._arm = arm
        self._clock = clock
        self._request = request
        self._sampler = sampler
        self._patience_s = 2 * request.delay_ms / 1000 + arm.session.answer_s

    def start(self) -> None:
        """Raises ProtocolError or SilentArmError when nothing streams, LinkError."""
        start, seen = self._clock.now(), b""
        for _ in range(ATTEMPTS):
            with self._arm.noticing():
                came = self._arm.session.start_stream(self._request)
            if came is None:
                return
            seen = came or seen
        if seen:
            what = f"{ATTEMPTS} requests for a stream were answered otherwise"
            raise ProtocolError(
                self._arm.who,
                what,
                asked=_ASKED,
                seen=seen[-64:],
                hint="Check cable, plugs and baud rate; or poll",
            )
        # an arm that is still there, but doesn't stream, is told apart from one that is gone
        self._arm.packet(POLL)
        seconds = self._clock.now() - start
        raise SilentArmError(
            self._arm.who,
            "the arm answers polls, but no stream",
            asked=_ASKED,
            seen=b"",
            seconds=seconds,
            hint="Poll",
        )

    def stop(self) -> None:
        """Raises LinkError when the link is broken."""
        with self._arm.noticing():
            self._arm.session.stop_stream()

    def samples(self) -> Iterator[Sample]:
        """Without end. Raises as ``MicroScribe.poll``; NoSessionError after the stream's end."""
        while True:
            packets = self._packets()
            host_s = self._clock.now()
            for packet in packets:
                yield self._sampler.sample(packet, host_s)

    def _packets(self) -> list[Packet]:
        if not self._arm.session.streaming:
            raise NoSessionError(
                self._arm.who,
                "the stream has ended",
                asked="the next sample",
                hint="Start another stream",
            )
        with self._arm.noticing():
            packets = self._arm.session.stream_packets(self._patience_s)
        if not packets:
            self.stop()
            self._arm.packet(POLL)  # whether the arm is still there
            self.start()
        return packets

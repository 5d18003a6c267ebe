"""Packets as a stream gives them: with the arm's own time, and with what the pedals did.

It may not know the session that they come from, nor what position they mean.
"""

from __future__ import annotations

from dataclasses import dataclass

from instruments.microscribe import protocol as wire
from instruments.microscribe.commands import LONGEST_DELAY_MS, harmless_delay_ms
from instruments.microscribe.configuration import StreamRequest
from instruments.microscribe.pedals import Debouncer, PedalEvent
from instruments.microscribe.protocol import Packet
from instruments.microscribe.ticks import ArmTime

_ENCODER_BITS = {5: 0x01, 6: 0x03}


@dataclass(frozen=True, slots=True)
class Sample:
    """One packet: ``counts`` as they came, ``buttons`` as they came, ``events`` with the bounce taken off.

    ``t_s`` is by the arm's own clock, from the first stamped packet of the session; by the host's clock where the packet
    has no stamp.
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
        return Sample(t_s, packet.counts, packet.buttons, self._debouncer.feed(t_s, packet.buttons), packet)


def poll_command(encoders: int, stamped: bool) -> int:
    """The command for five or six encoders, with a time stamp or without. Raises ValueError for another number."""
    if encoders not in _ENCODER_BITS:
        raise ValueError(f"an arm has 5 or 6 encoders to ask for, not {encoders}")
    return _ENCODER_BITS[encoders] | (wire.TIME_STAMP if stamped else 0)


def stream_request(rate_hz: float | None, command: int) -> StreamRequest:
    """A stream at a fixed rate, ``rate_hz`` at least; None: as fast as it goes.

    The arm counts whole milliseconds, and some of them are never asked for (``harmless_delay_ms``), so the rate is the next
    higher one that can be had. Raises ValueError where there is none.
    """
    if rate_hz is None:
        return StreamRequest(0, command)
    slowest_hz = 1000.0 / LONGEST_DELAY_MS
    if not slowest_hz <= rate_hz <= 1000.0:
        raise ValueError(f"an arm streams at {slowest_hz:.2g} to 1000 packets a second, not {rate_hz:g}; None is as fast as it goes")
    return StreamRequest(harmless_delay_ms(1.0 / rate_hz), command)

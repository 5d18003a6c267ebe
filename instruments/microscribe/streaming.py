"""A stream from its start to its end: samples that go on, and a silence that is looked into.

A stream that falls silent is no proof of a lost arm: the command for it may have been lost. So the arm is polled, and
started again where it answers. It may not know what a position is.
"""

from __future__ import annotations

from collections.abc import Iterator

from instruments.clock import Clock
from instruments.errors import ProtocolError
from instruments.microscribe.attachment import Attachment
from instruments.microscribe.configuration import StreamRequest
from instruments.microscribe.protocol import POLL, Code, Packet
from instruments.microscribe.refusals import NoSessionError, SilentArmError
from instruments.microscribe.session import ATTEMPTS
from instruments.microscribe.stream import Sample, Sampler

_ASKED = bytes([Code.STREAM])


class Streaming:
    """One stream of one arm."""

    def __init__(self, arm: Attachment, clock: Clock, request: StreamRequest, sampler: Sampler) -> None:
        self._arm = arm
        self._clock = clock
        self._request = request
        self._sampler = sampler
        self._patience_s = 2 * request.delay_ms / 1000 + arm.session.answer_s

    def start(self) -> None:
        """Raises ProtocolError or SilentArmError when the arm doesn't stream, LinkError when the link is broken."""
        start, seen = self._clock.now(), b""
        for _ in range(ATTEMPTS):
            with self._arm.noticing():
                came = self._arm.session.start_stream(self._request)
            if came is None:
                return
            seen = came or seen
        if seen:
            what = f"{ATTEMPTS} requests for a stream were answered otherwise"
            raise ProtocolError(self._arm.who, what, asked=_ASKED, seen=seen[-64:], hint="Check cable, plugs and baud rate; or poll")
        self._arm.packet(POLL)  # an arm that is still there, but doesn't stream, is told apart from one that is gone
        seconds = self._clock.now() - start
        raise SilentArmError(self._arm.who, "the arm answers polls, but no stream", asked=_ASKED, seen=b"", seconds=seconds, hint="Poll")

    def stop(self) -> None:
        """Raises LinkError when the link is broken."""
        with self._arm.noticing():
            self._arm.session.stop_stream()

    def samples(self) -> Iterator[Sample]:
        """Without end. Raises as ``MicroScribe.poll`` does, and NoSessionError once the stream has ended."""
        while True:
            packets = self._packets()
            host_s = self._clock.now()
            for packet in packets:
                yield self._sampler.sample(packet, host_s)

    def _packets(self) -> list[Packet]:
        if not self._arm.session.streaming:
            raise NoSessionError(self._arm.who, "the stream has ended", asked="the next sample", hint="Start another stream")
        with self._arm.noticing():
            packets = self._arm.session.stream_packets(self._patience_s)
        if not packets:
            self.stop()
            self._arm.packet(POLL)  # whether the arm is still there
            self.start()
        return packets

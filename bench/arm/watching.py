"""What `arm watch` shows: tip, pedals and rate out of a stream, a line some times a second. It may not print, nor know a terminal."""

from __future__ import annotations

from collections.abc import Iterator

from instruments.clock import Clock
from instruments.microscribe.driver import MicroScribe
from instruments.microscribe.pedals import Pedal
from instruments.microscribe.stream import Sample

SHOW_S = 0.2


def watch(arm: MicroScribe, clock: Clock, seconds: float | None) -> Iterator[str]:
    """A line every `SHOW_S` until ``seconds`` have passed (None: without end). Raises as the driver does."""
    start = shown = clock.now()
    samples: list[Sample] = []
    with arm.stream() as stream:
        for sample in stream:
            samples.append(sample)
            now = clock.now()
            if now - shown >= SHOW_S:
                yield line(arm, samples, now - shown)
                samples, shown = [], now
            if seconds is not None and now - start >= seconds:
                return


def line(arm: MicroScribe, samples: list[Sample], over_s: float) -> str:
    """One line for the samples of ``over_s`` seconds."""
    x, y, z = arm.position(samples).tip_mm
    pedals = ", ".join(f"{pedal.name.lower()} {'DOWN' if samples[-1].buttons & pedal.value else 'up'}" for pedal in reversed(Pedal))
    return f"tip {x:8.2f} {y:8.2f} {z:8.2f} mm   pedals: {pedals:<22} {len(samples) / over_s:6.1f} packets/s   damaged: {arm.damaged}"

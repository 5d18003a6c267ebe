"""An emulated stage on a loopback link under virtual time, raw or with its driver; no thread may be left behind."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager

import pytest

from instruments.clock import VirtualClock
from instruments.link import Link
from instruments.listener import Device, Listener
from instruments.stage.driver import Stage
from instruments.stage.emulator import CLASSIC, Dialect, StageEmulator


class Bench:
    """One emulator, and the means to talk to it."""

    def __init__(
        self, settings: Mapping[int, float] | None = None, *, dialect: Dialect = CLASSIC, fresh_eeprom: bool = False, device: Device | None = None
    ) -> None:
        self.clock = VirtualClock()
        self.emulator = StageEmulator(self.clock, settings=settings, dialect=dialect, fresh_eeprom=fresh_eeprom)
        self.listener = Listener(device or self.emulator, self.clock, lock=threading.RLock(), name="stage")
        self.links: list[Link] = []

    def link(self) -> Link:
        link = Link(self.listener.url, self.clock, who="stage")
        self.links.append(link)
        return link

    def stage(self) -> Stage:
        return Stage(self.link(), self.clock)

    def close(self) -> None:
        for link in self.links:
            link.close()
        self.listener.close()


class Talk:
    """Raw bytes out, raw bytes back."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.link = bench.link()
        self.greeting = self.hear(0.0)

    def hear(self, seconds: float) -> bytes:
        """All that comes within ``seconds`` of virtual time, all of which passes."""
        until, got = self.bench.clock.now() + seconds, b""
        while data := self.link.receive(max(0.0, until - self.bench.clock.now())):
            got += data
        return got

    def say(self, data: bytes, seconds: float = 0.0) -> bytes:
        """Send, and hear what comes."""
        self.link.write(data)
        return self.hear(seconds)


@contextmanager
def opened(settings: Mapping[int, float] | None = None, *, dialect: Dialect = CLASSIC, fresh_eeprom: bool = False) -> Iterator[Bench]:
    bench = Bench(settings, dialect=dialect, fresh_eeprom=fresh_eeprom)
    try:
        yield bench
    finally:
        bench.close()


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    before = threading.active_count()
    yield
    assert threading.active_count() == before


@pytest.fixture
def open_bench() -> Iterator[Callable[..., Bench]]:
    """Makes benches, and closes them."""
    benches: list[Bench] = []

    def make(*args: object, **kwargs: object) -> Bench:
        benches.append(Bench(*args, **kwargs))  # type: ignore[arg-type]
        return benches[-1]

    yield make
    for bench in benches:
        bench.close()

"""What real cables need, on both kinds of baths: the least silence between two frames by its key, and
a serial port behind a server that speaks RFC 2217.
"""

from __future__ import annotations

import contextlib
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import pairwise

import pytest
import serial
from serial.rfc2217 import PortManager

from instruments.bath.driver import OwnBath
from instruments.bath.emulator import BathEmulator
from instruments.bath.line_emulator import LineEmulator
from instruments.bath.profile import LineProfile, RegisterProfile, load_profile
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.listener import Connection, Device
from instruments.pty_listener import PtyListener
from tests.instruments.bath.devices import calm_plant, driven

SPOKEN = ["julabo-ascii", "eurotherm-2400"]


def bath_of(name: str, clock: Clock) -> LineEmulator | BathEmulator:
    profile = load_profile(name)
    if isinstance(profile, LineProfile):
        return LineEmulator(calm_plant(), profile, clock)
    assert isinstance(profile, RegisterProfile)
    return BathEmulator(calm_plant(), profile, clock, framing="rtu")


class Timed:
    """When each question reached ``device``."""

    def __init__(self, device: Device, clock: Clock) -> None:
        self.device, self.clock, self.at_s = device, clock, list[float]()
        self.connect, self.disconnect = device.connect, device.disconnect

    def receive(self, connection: Connection, data: bytes) -> None:
        self.at_s.append(self.clock.now())
        self.device.receive(connection, data)


@pytest.mark.parametrize("name", SPOKEN)
def test_the_least_silence_between_two_frames_is_that_of_the_key(name: str) -> None:
    least = {}
    for query in ("", "?gap_ms=80"):
        clock = VirtualClock()
        timed = Timed(bath_of(name, clock), clock)
        with driven(timed, load_profile(name), clock, query=query) as bath:
            bath.read()
            bath.read()
        least[query] = min(later - sooner for sooner, later in pairwise(timed.at_s))
    assert least[""] < 0.05
    assert 0.08 - 1e-9 <= least["?gap_ms=80"] < 0.1


class Port(serial.Serial):
    """A pseudo-terminal has no modem lines."""

    cts = dsr = ri = cd = property(lambda _: False)
    _update_rts_state = _update_dtr_state = lambda _: None


@contextmanager
def port_server(path: str) -> Iterator[tuple[str, serial.Serial]]:
    """A serial server (RFC 2217) by pyserial itself, before the port at ``path``: its address."""
    ends, hosts = threading.Event(), list[socket.socket]()
    with (
        Port(path, timeout=0.02) as port,
        closing(socket.create_server(("127.0.0.1", 0))) as server,
    ):
        server.settimeout(5.0)

        def serve() -> None:
            with contextlib.suppress(OSError), server.accept()[0] as host:
                hosts.append(host)
                host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                manager = PortManager(port, Wire(host))  # type: ignore[arg-type]
                threads = [
                    threading.Thread(target=work)
                    for work in (lambda: to_port(host, manager), lambda: to_host(host, manager))
                ]
                for thread in threads:
                    thread.start()
                for thread in threads:
                    thread.join()

        def to_port(host: socket.socket, manager: PortManager) -> None:
            with contextlib.suppress(OSError):
                while data := host.recv(1024):
                    port.write(b"".join(manager.filter(data)))
            ends.set()

        def to_host(host: socket.socket, manager: PortManager) -> None:
            while not ends.is_set():
                if data := port.read(port.in_waiting or 1):
                    host.sendall(b"".join(manager.escape(data)))

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"rfc2217://127.0.0.1:{server.getsockname()[1]}", port
        finally:
            ends.set()
            for host in hosts:
                with contextlib.suppress(OSError):
                    host.shutdown(socket.SHUT_RDWR)
            server.close()
            thread.join()


class Wire:
    """What a `PortManager` answers through."""

    def __init__(self, host: socket.socket) -> None:
        self.write = host.sendall


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:set(Daemon|Name)", "ignore:isDaemon")  # of pyserial
@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals: POSIX only")
@pytest.mark.parametrize("name", SPOKEN)
def test_a_bath_behind_a_serial_server(name: str) -> None:
    with closing(RealClock()) as clock:
        device = bath_of(name, clock)
        with (
            closing(PtyListener(device, clock, lock=threading.RLock(), name="bath")) as listener,
            port_server(listener.url) as (address, port),
        ):
            # a pseudo-terminal has no parity and no lines
            url = f"{address}?baud=9600&parity=N&bytesize=8&stopbits=2&handshake=none"
            with closing(OwnBath(url, load_profile(name), clock)) as bath:
                assert (port.baudrate, port.stopbits) == (9600, 2), "the server was told"
                assert bath.read().temp_c == pytest.approx(20.0, abs=0.1)

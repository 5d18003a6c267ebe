"""Round trips with an emulator beside those with a peer, each in a process of its own: no end waits
for another's turn in the interpreter. They take short turns, each the first in every other one, and
the median of their ratios is the figure: a busy machine slows both of a pair down, and the best of
each may be of different moments.

The arm's aim is 1.2 of an echo of the package sinstruments, where that is installed. The bare echo
is what Python can do at most on this machine: it does nothing but to receive and to send.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from subprocess import PIPE
from typing import Any

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from tests.benchmarks.figures import figure
from tests.conftest import ROOT

# each then gives its processor time whenever it is asked
SERVE = """
import asyncio, socket, sys, threading, time
import numpy as np
def serve(port):
    print(port, flush=True)
    for _ in sys.stdin:
        print(time.process_time(), flush=True)
def thread(work, *of):
    threading.Thread(target=work, args=of, daemon=True).start()
"""
OURS = """
from instruments.clock import RealClock
from instruments.listener import Listener
clock = RealClock()
def listen(device):
    serve(Listener(device, clock, lock=threading.RLock(), name="emulator").port)
"""
ARM = """
from instruments.microscribe.emulator import ArmEmulator
class Hand:
    held = np.array([-180.0, 240.0, 130.0]), np.array([0.0, 0.0, 1.0])
    arm_target = lambda self: self.held
listen(ArmEmulator(Hand(), clock))
"""
BATH = """
from instruments.bath.emulator import BathEmulator
from instruments.world.plant import Plant
from tests.instruments.bath.devices import load_register_profile
listen(BathEmulator(Plant(1), load_register_profile("julabo-presto"), clock, framing="tcp"))
"""
ECHO = """
server = socket.create_server(("127.0.0.1", 0))
def echo():
    host = server.accept()[0]
    host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    while data := host.recv(65536):
        host.sendall(data)
thread(echo)
serve(server.getsockname()[1])
"""
PYMODBUS = """
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
with socket.create_server(("127.0.0.1", 0)) as free:
    port = free.getsockname()[1]
async def run(ready):
    held = SimData(0, values=[7] * 100, datatype=DataType.REGISTERS)
    server = ModbusTcpServer(SimDevice(1, simdata=[held]), address=("127.0.0.1", port))
    asyncio.get_running_loop().call_later(0.5, ready.set)
    await server.serve_forever()
ready = threading.Event()
thread(lambda: asyncio.run(run(ready)))
ready.wait()
serve(port)
"""
SINSTRUMENTS = """
from sinstruments.simulator import BaseDevice, Server
class Echo(BaseDevice):
    handle_message = lambda self, message: message
with socket.create_server(("127.0.0.1", 0)) as free:
    port = free.getsockname()[1]
def run():
    wire = {"type": "tcp", "url": ["127.0.0.1", port]}
    server = Server(devices=[dict(name="e", package="__main__", transports=[wire], **{"class": "Echo"})])
    server.start()
    server.serve_forever()
thread(run)
while True:  # it listens some time after its start
    try:
        socket.create_connection(("127.0.0.1", port)).close()
        break
    except ConnectionRefusedError:
        time.sleep(0.01)
serve(port)
"""
TURNS = 15
SET_POINT = bytes.fromhex("0001 0000 0006 01 03 0002 0002")  # by Modbus TCP


Turn = Callable[[], tuple[float, float]]  # seconds of a round trip, and those of the server


@contextmanager
def served(code: str, ask: bytes, answer: int, before: tuple[bytes, ...] = ()) -> Iterator[Turn]:
    told = [sys.executable, "-c", SERVE + code]
    with subprocess.Popen(told, cwd=ROOT, stdin=PIPE, stdout=PIPE, text=True, bufsize=1) as child:
        assert child.stdin
        assert child.stdout
        asked, said = child.stdin, child.stdout

        def spent_s() -> float:
            asked.write("\n")
            return float(said.readline())

        def turn(count: int = 700) -> tuple[float, float]:
            before_s, begun_s = spent_s(), time.perf_counter()
            for _ in range(count):
                host.sendall(ask)
                assert len(host.recv(100)) == answer
            return (time.perf_counter() - begun_s) / count, (spent_s() - before_s) / count

        with socket.create_connection(("127.0.0.1", int(said.readline()))) as host:
            host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for word in before:
                host.sendall(word)
                time.sleep(0.2)
                assert host.recv(100)
            yield turn  # the child ends as its standard input does


ROWS: dict[str, tuple[Any, ...]] = {
    "arm": (OURS + ARM, b"\x03", 14, (b"\xc5IMMC", b"BEGIN")),
    "an echo": (ECHO, b"x" * 14, 14),
    "sinstruments": (SINSTRUMENTS, b"x" * 13 + b"\n", 14),
    "bath": (OURS + BATH, SET_POINT, 13),
    "pymodbus's server": (PYMODBUS, SET_POINT, 13),
}


@pytest.mark.parametrize(
    ("name", "peer", "aim"),
    [
        ("arm", "an echo", "at least 0.66, below 1"),
        ("arm", "sinstruments", "at least 1.2"),
        ("bath", "pymodbus's server", "at least 2"),
    ],
)
def test_round_trips(benchmark: BenchmarkFixture, name: str, peer: str, aim: str) -> None:
    if peer == "sinstruments" and not find_spec(peer):
        pytest.skip("sinstruments is not installed")
    with served(*ROWS[name]) as ours, served(*ROWS[peer]) as theirs:
        both = ours, theirs

        def turns() -> list[list[tuple[float, float]]]:
            """Of ours and of theirs, in this order, whichever was asked first."""
            ways = [(1, -1)[number % 2] for number in range(TURNS)]
            return [[turn() for turn in both[::way]][::way] for way in ways]

        pairs = np.array(benchmark.pedantic(turns, rounds=1))  # (TURNS, 2, 2)
    trip_s, _ = np.median(pairs[:, 0], axis=0)
    apart, cpu = np.median(pairs[:, 1] / pairs[:, 0], axis=0)
    figure(benchmark, f"{name}, round trips a second", 1.0 / trip_s, "at least 10 000")
    figure(benchmark, f"{name}, round trips over {peer}", apart, aim)
    figure(benchmark, f"{name}, CPU over {peer}", 1.0 / cpu, "less than 1")

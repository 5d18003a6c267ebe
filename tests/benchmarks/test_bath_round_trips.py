"""A question to the bath through our driver against the same question by pymodbus's own
asynchronous client, on the same link.

Both ends live in this process and share its lock; the emulator's part is the same for both. Medians
of many; the two take turns, so that whatever else the machine does meets both.

Between the frames of a poll Modbus wants 3.5 characters of silence, and 1.75 ms above 19200 baud
(over serial line 1.02, section 2.5.1.1). pymodbus leaves that silence out, so it is added to its
polls.
"""

from __future__ import annotations

import asyncio
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import pytest
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.framer import FramerType
from pytest_benchmark.fixture import BenchmarkFixture

from instruments.bath.driver import OwnBath
from instruments.bath.emulator import BathEmulator
from instruments.bath.profile import RegisterProfile
from instruments.bath.requests import Block, blocks
from instruments.bath.rows import Row
from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.pty_listener import PtyListener
from instruments.world.plant import Plant
from tests.benchmarks.figures import figure
from tests.instruments.bath.devices import load_register_profile

AT_MOST = 1.15
BAUD = 115200
LEAST_GAP_S = 0.00175
Client = AsyncModbusTcpClient | AsyncModbusSerialClient

pty = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals: POSIX only")


@dataclass(frozen=True)
class Served:
    """An emulated bath somewhere, and how pymodbus opens it."""

    url: str
    profile: RegisterProfile
    client: Callable[[], Client]

    @property
    def asked(self) -> Row:
        """One quantity that is a question of its own."""
        return self.profile.row("power")

    @property
    def function(self) -> int:
        """The function that reads it."""
        return self.profile.read_function(self.asked.table)

    @property
    def polled(self) -> tuple[Block, ...]:
        """The questions of a poll."""
        return blocks(self.profile, gaps=True)


@contextmanager
def served(kind: str, family: str) -> Iterator[Served]:
    with ExitStack() as stack:
        clock = RealClock()
        stack.callback(clock.close)
        profile = load_register_profile(family)
        emulator = BathEmulator(Plant(1), profile, clock, framing="tcp" if kind == "tcp" else "rtu")
        lock = threading.RLock()
        if kind == "pty":
            terminal = PtyListener(emulator, clock, lock=lock, name="bath")
            stack.callback(terminal.close)
            url = terminal.url
            yield Served(
                f"{url}?baud={BAUD}",
                profile,
                lambda: AsyncModbusSerialClient(url, baudrate=BAUD),
            )
            return
        listener = Listener(emulator, clock, lock=lock, name="bath")
        stack.callback(listener.close)
        framer = FramerType.SOCKET if kind == "tcp" else FramerType.RTU
        yield Served(
            f"{kind}://127.0.0.1:{listener.port}",
            profile,
            lambda: AsyncModbusTcpClient("127.0.0.1", port=listener.port, framer=framer),
        )


def ours(bath: Served, count: int, pause_s: float) -> tuple[list[float], list[float]]:
    """Seconds that each of ``count`` questions takes after a pause, and each of as many polls."""
    clock = RealClock()
    driver = OwnBath(bath.url, bath.profile, clock)
    questions, polls = [], []
    for _ in range(count):
        time.sleep(pause_s)
        start = time.perf_counter()
        driver.get(bath.asked.name)
        questions.append(time.perf_counter() - start)
    for _ in range(count):
        start = time.perf_counter()
        driver.read()
        polls.append(time.perf_counter() - start)
    driver.close()
    clock.close()
    return questions, polls


async def theirs(bath: Served, count: int, pause_s: float) -> tuple[list[float], list[float]]:
    """The same by pymodbus alone, in a loop that keeps running; no silence between frames."""
    client = bath.client()
    await client.connect()
    ask = {
        2: client.read_discrete_inputs,
        3: client.read_holding_registers,
        4: client.read_input_registers,
    }
    questions, polls = [], []
    for _ in range(count):
        time.sleep(pause_s)
        start = time.perf_counter()
        answer = await ask[bath.function](bath.asked.address, count=bath.asked.words)
        questions.append(time.perf_counter() - start)
        assert not answer.isError()
    for _ in range(count):
        start = time.perf_counter()
        for block in bath.polled:
            await ask[block.function](block.address, count=block.count)
        polls.append(time.perf_counter() - start)
    client.close()
    await asyncio.sleep(0.05)
    return questions, polls


def turns(bath: Served, count: int, rounds: int, pause_s: float) -> dict[str, float]:
    """Medians in seconds, each the median of the rounds'."""
    names = ("question", "poll", "pymodbus question", "pymodbus poll")
    medians: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(rounds):
        for whose, took in (
            ("", ours(bath, count, pause_s)),
            ("pymodbus ", asyncio.run(theirs(bath, count, pause_s))),
        ):
            medians[f"{whose}question"].append(statistics.median(took[0]))
            medians[f"{whose}poll"].append(statistics.median(took[1]))
    return {name: statistics.median(rounded) for name, rounded in medians.items()}


@pytest.mark.parametrize(
    ("kind", "family"),
    [
        ("tcp", "julabo-presto"),
        ("rtu+tcp", "eurotherm-3200"),
        pytest.param("pty", "eurotherm-3200", marks=pty),
    ],
)
def test_a_question_takes_no_longer_than_by_pymodbus_alone(
    benchmark: BenchmarkFixture, kind: str, family: str
) -> None:
    with served(kind, family) as bath:
        took_s = benchmark.pedantic(
            turns, args=(bath, 60, 15, 0.003 if kind == "pty" else 0.0), rounds=1
        )
        silence_s = len(bath.polled) * LEAST_GAP_S if kind == "pty" else 0.0
    link = f"{kind} {family}"
    benchmark.extra_info |= {name: float(f"{seconds:.4g}") for name, seconds in took_s.items()}
    question = took_s["question"] / took_s["pymodbus question"]
    figure(benchmark, f"{link}, question over pymodbus's", question, f"at most {AT_MOST}")
    whose = "pymodbus's and the silence that it leaves out" if silence_s else "pymodbus's"
    poll = took_s["poll"] / (took_s["pymodbus poll"] + silence_s)
    figure(benchmark, f"{link}, poll over {whose}", poll, f"at most {AT_MOST}")

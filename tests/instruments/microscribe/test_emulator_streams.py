"""Streams of the emulated arm: by time, by differences, by pedals; and what nobody knows of them,
either way.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from instruments.clock import RealClock
from instruments.link import Link
from instruments.listener import Listener
from instruments.microscribe.configuration import StreamRequest
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.firmware import Look, Trigger, UnspecifiedBehaviour
from instruments.microscribe.protocol import PacketDecoder, State
from tests.instruments.microscribe.bare_host import AT_REST, POINT, Hand, Host


@pytest.fixture
def host() -> Iterator[Host]:
    host = Host(tremor_mm=0.0)
    host.session()
    yield host
    host.close()


def stream(
    delay_ms: int, *, command: str = "03", mask: int = 0, deltas: tuple[int, ...] = (0,) * 6
) -> str:
    """The stream command, typed field by field as the sheet has it."""
    return (
        f"CF {delay_ms:04X} {command} {mask:02X} "
        + "00 " * 8
        + " ".join(f"{delta:04X}" for delta in deltas)
    )


@pytest.mark.parametrize(
    ("command", "rate_hz"),
    [("03", 822.9), ("01", 960.0), ("23", 720.0), ("00", 5760.0)],
    ids=["six encoders", "five", "time stamps", "buttons alone"],
)
def test_without_delay_a_stream_is_as_fast_as_115200_baud(
    host: Host, command: str, rate_hz: float
) -> None:
    assert len(host.packets(stream(0, command=command), 1.0)) == pytest.approx(rate_hz, abs=1)


def test_differences_send_when_a_joint_has_moved_so_far_and_not_else(host: Host) -> None:
    host.hand.point = POINT
    assert host.ask(stream(0, deltas=(20, 0, 0, 0, 0, 0)), 0.5) == "CF"
    start, counts = host.counts()[0], []
    host.ask(stream(0, deltas=(20, 0, 0, 0, 0, 0)))
    for step in range(60):
        host.hand.point = POINT + np.array([0.0, 0.5 * step, 0.0])
        counts += [packet.counts[0] for packet in host.packets("", 0.002)]
    moved = np.abs(np.diff([start, *counts]))
    assert len(counts) == 6, "the base turns by 3.1 degrees: 142 counts"
    assert (moved >= 20).all()
    assert (moved < 20 + 4).all(), "a step of the hand is 0.5 mm, some 4 counts at most"
    assert host.arm.state is State.STREAMING


def test_differences_respect_the_delay(host: Host) -> None:
    host.hand.point = POINT
    host.ask(stream(100, deltas=(1,) * 6))
    seen = 0
    for step in range(1, 101):
        host.hand.point = POINT + np.array([0.0, 0.5 * step, 0.0])
        seen += len(host.packets("", 0.01))
    assert seen == pytest.approx(10, abs=1)


@pytest.mark.parametrize(("releases", "expected"), [(True, [1, 0, 1, 0]), (False, [1, 1])])
def test_a_pedal_of_the_mask_sends(releases: bool, expected: list[int]) -> None:
    host = Host(habits=UnspecifiedBehaviour(release_triggers=releases))
    host.session()
    assert host.ask(stream(0, mask=0x01)) == "CF"
    seen = []
    for buttons in (1, 1, 0, 2, 3, 2, 0):
        host.arm.buttons = buttons
        seen += [packet.buttons & 1 for packet in host.packets("", 0.01)]
    assert seen == expected
    host.close()


def test_a_slow_drift_and_what_differences_are_measured_from() -> None:
    drift = [Look(0, (count,)) for count in range(16380, 16384)] + [
        Look(0, (count,)) for count in range(30)
    ]
    request = StreamRequest(0, 3, encoder_deltas=(5, 0, 0, 0, 0, 0))
    fired = {}
    for habit in ("last packet", "last look"):
        trigger = Trigger(request, UnspecifiedBehaviour(deltas_from=habit), drift[0])
        fired[habit] = [look.counts[0] for look in drift[1:] if trigger.fires(look)]
    assert fired == {
        "last packet": [1, 6, 11, 16, 21, 26],
        "last look": [],
    }, "counts go round at 16384"


def test_the_marker_comes_back_in_its_place_and_any_command_ends_a_stream(host: Host) -> None:
    host.ask(stream(10), 0.025)
    assert host.ask("D2 55", 0.025) == f"D2 55 {AT_REST} {AT_REST}"
    host.ask("C9", 0.0)
    assert host.arm.state is State.SESSION
    assert host.ask("", 1.0) == ""


def test_a_second_stream_replaces_the_first(host: Host) -> None:
    host.ask(stream(1))
    host.link.drain(0.0)
    assert len(host.packets(stream(100), 1.05)) == 10


def test_a_stream_goes_on_for_the_next_host(host: Host) -> None:
    host.ask(stream(10))
    host.plug_in_again()
    assert host.ask("", 0.105) == " ".join([AT_REST] * 10), (
        "the arm doesn't notice who is plugged in"
    )
    assert host.ask("03") == AT_REST
    assert host.ask("", 0.1) == ""


def test_a_stream_never_outruns_its_line() -> None:
    clock = RealClock()
    arm = ArmEmulator(Hand(), clock)
    listener = Listener(arm, clock, lock=threading.RLock(), name="arm", baud=9600)
    link = Link(listener.url, clock, who="host")
    for sent, length in (("49 4D 4D 43", 4), ("42 45 47 49 4E", 5), (stream(0), 1)):
        link.write(bytes.fromhex(sent))
        assert len(link.read(length, 5.0)) == length
    start = clock.now()
    got = link.read(14 * 20, 5.0)
    made, took_s = arm.packets, clock.now() - start
    assert made <= took_s / (14 * 10 / 9600) + 3, "what doesn't fit on the line isn't made"
    link.write(b"\xc5")
    got += link.read_until(b"\xc5", 5.0)
    assert len(PacketDecoder(0x03).feed(got)) == arm.packets, "and what was made arrives"
    link.close()
    listener.close()
    clock.close()

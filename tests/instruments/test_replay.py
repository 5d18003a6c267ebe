"""The far end of a capture that is typed by hand, played to a link: what it says, when, and what it
tells on.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from instruments.captures.capture import read_capture
from instruments.captures.replay import Replay
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.errors import LinkError
from instruments.link import Link

HEAD = (
    '{"format": "teatbench capture", "version": 1, "wall_time": "w", "teatbench": "0", "command":'
    ' "c", "machine": "m"}\n'
)
SERIAL = "/dev/ttyUSB0"
Line = tuple[float, str, str]
TALK: list[Line] = [
    (10.0, "opened", SERIAL),
    (10.5, "received", "hello"),
    (11.0, "sent", "who?"),
    (11.2, "received", "it is "),
    (11.3, "received", "me"),
    (13.0, "received", "!alarm"),
    (14.0, "sent", "reset"),
    (14.0, "received", "done"),
]


class Bench:
    """The far end of the lines of one link, played; ``more`` stands behind them in the file."""

    def __init__(
        self,
        path: Path,
        *lines: Line,
        name: str = "arm",
        more: str = "",
        clock: Clock | None = None,
        fast: bool = False,
        again: bool = False,
    ) -> None:
        keys = {"opened": "url", "closed": "why"}
        text = HEAD
        for t_s, event, fact in lines:
            fact = fact if event in keys else fact.encode("latin-1").hex()
            key = f', "{keys.get(event, "data")}": "{fact}"' if fact else ""
            text += f'{{"t_s": {t_s}, "link": "{name}", "event": "{event}"{key}}}\n'
        path.write_text(text + more, encoding="utf-8")
        self.clock = clock or VirtualClock()
        self.capture = read_capture(path)
        self.replay = Replay(self.capture, self.clock, fast=fast, again=again)
        self.url = self.replay.urls[name]
        self.links: list[Link] = []

    def link(self) -> Link:
        url = self.url.replace("tcp://", "socket://").split("?")[0]
        self.links.append(Link(url, self.clock, who="host"))
        return self.links[-1]

    @property
    def note(self) -> list[str]:
        return [str(mismatch) for mismatch in self.replay.mismatches]

    def settled(self) -> bool:
        """Whether all is played in time that is ample for a thread to see that a host has gone."""
        clock = RealClock()
        while not self.replay.finished and clock.now() < 5.0:
            clock.sleep(0.005)
        return self.replay.finished

    def close(self) -> None:
        for link in self.links:
            link.close()
        self.replay.close()
        if isinstance(self.clock, RealClock):
            self.clock.close()


Play = Callable[..., Bench]


@pytest.fixture
def play(tmp_path: Path) -> Iterator[Play]:
    with ExitStack() as stack:
        yield lambda *lines, **options: stack.enter_context(
            closing(Bench(tmp_path / "c.jsonl", *lines, **options))
        )


def test_each_answer_comes_after_the_recorded_while(play: Play) -> None:
    bench = play(*TALK)
    link = bench.link()
    came = []
    link.clock.sleep(0.1)
    for request, wait_s in ((b"", 1.0), (b"who?", 3.0), (b"reset", 1.0)):
        start = bench.clock.now()
        if request:
            link.write(request)
        while bench.clock.now() < start + wait_s:
            if data := link.receive(start + wait_s - bench.clock.now()):
                came.append((round(bench.clock.now() - start, 3), data))
    assert came == [
        (0.4, b"hello"),
        (0.2, b"it is "),
        (0.3, b"me"),
        (2.0, b"!alarm"),
        (0.0, b"done"),
    ]
    assert bench.note == []
    link.close()
    assert bench.replay.unplayed == []


def test_what_a_driver_read_at_the_end_of_a_wait_is_there_again(play: Play) -> None:
    link = play((0.0, "opened", SERIAL), (0.1, "sent", "a"), (0.3, "received", "b")).link()
    link.write(b"a")
    assert link.receive(0.0) == b""
    link.clock.sleep(0.2)
    assert link.receive(0.0) == b"b"


@pytest.mark.slow
@given(cuts=st.sets(st.integers(1, 8)))
@settings(
    max_examples=30,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    deadline=None,
)
def test_requests_may_be_cut_anywhere(tmp_path: Path, cuts: set[int]) -> None:
    with closing(Bench(tmp_path / "c", *TALK)) as bench:
        link, stream, places = bench.link(), b"who?reset", [0, *sorted(cuts), 9]
        for start, end in pairwise(places):
            link.write(stream[start:end])
        assert link.drain(5.0) == b"helloit is me!alarmdone"
        assert bench.note == []


def test_a_host_that_is_faster_than_it_was_gets_everything_in_order(play: Play) -> None:
    bench = play(*TALK)
    link = bench.link()
    link.write(b"who?")
    assert link.read(11, 0.25) == b"helloit is "
    link.write(b"reset")
    assert link.read(12, 0.0) == b"me!alarmdone"
    assert link.drain(60.0) == b"", "what was said early is not said twice"
    assert bench.note == []


def test_what_the_host_sends_otherwise_is_reported_and_answered_by_silence(play: Play) -> None:
    bench = play(*TALK)
    link = bench.link()
    link.write(b"who?")
    link.drain(3.0)
    link.write(b"rest")
    assert link.drain(5.0) == b""
    link.write(b"reset")
    assert link.drain(5.0) == b""
    expected = (
        "arm: line 8: connection 1, request 2: byte 3 of it is another than recorded (expected"
        " 'reset', got 'rest')"
    )
    assert bench.note == [expected]
    assert bench.replay.unplayed == [
        "arm: connection 1: 1 of 2 requests as recorded, then a mismatch"
    ]


def test_of_a_long_request_the_place_is_shown(play: Play) -> None:
    bench = play((0.0, "opened", SERIAL), (0.0, "sent", "x" * 1000))
    link = bench.link()
    link.write(b"x" * 500 + b"y" * 500)
    link.drain(1.0)
    (mismatch,) = bench.replay.mismatches
    assert "byte 500" in mismatch.what
    assert mismatch.got == b"x" * 12 + b"y" * 12
    assert len(mismatch.expected) == 24


def test_a_host_that_leaves_early_is_reported(play: Play) -> None:
    bench = play(*TALK, (15.0, "closed", ""))
    link = bench.link()
    assert bench.replay.unplayed == ["arm: connection 1: the host left after 0 of 2 requests"]
    link.write(b"who?")
    link.read(8, 3.0)
    link.close()
    assert bench.settled()
    assert bench.replay.unplayed == ["arm: connection 1: the host left after 1 of 2 requests"]
    assert bench.note == []


def test_a_host_that_goes_on_where_it_had_closed_is_reported(play: Play) -> None:
    bench = play(*TALK, (15.0, "closed", ""))
    link = bench.link()
    link.write(b"who?reset\x03")
    link.drain(5.0)
    assert bench.note == [
        (
            "arm: line 8: the host sends more than was recorded on this connection (expected nothing,"
            " got 03)"
        )
    ]


@pytest.mark.parametrize("more", ["", '{"t_s": 14.5, "li'])
def test_at_the_end_of_a_capture_that_was_killed_there_is_silence(play: Play, more: str) -> None:
    bench = play(*TALK, more=more)
    link = bench.link()
    link.write(b"who?reset")
    link.drain(5.0)
    link.write(b"and now?")
    assert link.drain(60.0) == b""
    assert bench.note == []


def test_a_recorded_hang_up_hangs_up_at_its_time(play: Play) -> None:
    bench = play(*TALK, (14.5, "closed", "the other end hung up"))
    link = bench.link()
    link.write(b"who?")
    link.drain(3.0)
    link.write(b"reset")
    assert link.read(4, 1.0) == b"done"
    start = bench.clock.now()
    with pytest.raises(LinkError, match="hung up"):
        link.receive(60.0)
    assert bench.clock.now() - start == pytest.approx(0.5, abs=1e-5)
    assert bench.settled()
    assert (bench.note, bench.replay.unplayed) == ([], [])


def test_each_connection_plays_the_next_that_was_recorded(play: Play) -> None:
    again: list[Line] = [(20.0, "opened", SERIAL), (20.0, "received", "back"), (21.0, "closed", "")]
    bench = play(*TALK, (15.0, "closed", "unplugged"), *again)
    link = bench.link()
    link.write(b"who?reset")
    assert link.drain(0.5) == b"helloit is me!alarmdone"
    assert bench.replay.unplayed == ["arm: 1 of 2 connections were never made"]
    link.reopen()
    assert link.drain(1.0) == b"back"
    link.reopen()
    assert link.drain(1.0) == b""
    assert bench.note == ["arm: line 11: connected once more than the 2 times that were recorded"]


def test_again_begins_anew_once_all_is_played(play: Play) -> None:
    bench = play(*TALK, (15.0, "closed", ""), again=True)
    for _ in range(3):
        link = bench.link()
        assert link.read(5, 1.0) == b"hello"
        link.write(b"who?")
        link.close()
        assert bench.settled()
    assert bench.note == []


@pytest.mark.parametrize(
    ("link", "recorded", "request_hex", "scheme", "settings"),
    [
        ("arm", "/dev/ttyUSB0", "c5494d4d43", "socket", ""),
        ("stage", "rfc2217://lab:7000", "3f", "socket", ""),
        ("bath", "tcp://192.168.0.40:502", "00010000000601030000", "tcp", ""),
        ("bath", "tcp://192.168.0.40:502", "00010000000607030000", "tcp", "?unit=7"),
        ("bath", "rtu+tcp://lab:7000", "0103005d0001", "rtu+tcp", ""),
        ("bath", "rtu+tcp://lab:7000", "ff03005d0001", "rtu+tcp", "?unit=255"),
        ("bath", "/dev/ttyUSB1", "0203005d0001", "rtu+tcp", "?unit=2"),
        ("bath", "COM7", "0103005d0001", "rtu+tcp", ""),
        ("bath", "tcp://[\x1b?unit=9", "", "tcp", ""),
    ],
)
def test_an_url_has_the_form_that_the_recorded_driver_takes(
    play: Play, link: str, recorded: str, request_hex: str, scheme: str, settings: str
) -> None:
    lines: list[Line] = [(0.0, "opened", recorded.replace("\x1b", "\\u001b"))]
    if request_hex:
        lines.append((0.0, "sent", bytes.fromhex(request_hex).decode("latin-1")))
    url = play(*lines, name=link).url
    assert re.fullmatch(rf"{re.escape(scheme)}://127\.0\.0\.1:\d+{re.escape(settings)}", url)


def test_only_some_links_are_played_if_one_wishes(play: Play) -> None:
    bench = play(
        *TALK, more='{"t_s": 20, "link": "bath", "event": "opened", "url": "tcp://192.168.0.40"}\n'
    )
    assert list(bench.replay.urls) == ["arm", "bath"]
    with Replay(bench.capture, VirtualClock(), links=["bath"]) as replay:
        assert list(replay.urls) == ["bath"]


def test_fast_answers_at_once(play: Play) -> None:
    bench = play(*TALK, fast=True)
    link = bench.link()
    assert link.read(5, 0.0) == b"hello"
    link.write(b"who?")
    assert link.read(14, 0.0) == b"it is me!alarm"
    link.write(b"reset")
    assert link.read(4, 0.0) == b"done"
    assert (bench.clock.now(), bench.note) == (0.0, [])


@pytest.mark.slow
def test_a_stream_of_an_hour_is_planned_piece_by_piece(play: Play) -> None:
    stream: list[Line] = [(n / 100, "received", "p") for n in range(20_000)]
    clock = VirtualClock()
    link = play((0.0, "opened", SERIAL), *stream, clock=clock).link()
    assert len(link.drain(1.0, at_most_s=100.0)) == pytest.approx(10_000, abs=5)
    assert len(clock._planned) == 1


# Modbus: a host counts its transactions as it likes

READ = "\0\x05\0\0\0\x06\x01\x03\0\x5d\0\x01"
ANSWER = "\0\x05\0\0\0\x05\x01\x03\x02\0\x07"
OTHER = READ.replace("\x05", "\x06")
OTHER_ANSWER = ANSWER.replace("\0\x05\0\0\0", "\0\x06\0\0\0")
MODBUS: list[Line] = [
    (0.0, "opened", "tcp://bath:502"),
    (1.0, "sent", READ),
    (1.1, "received", ANSWER[:1]),
    (1.2, "received", ANSWER[1:]),
    (2.0, "sent", OTHER),
    (2.1, "received", OTHER_ANSWER),
]


def as_bytes(text: str) -> bytes:
    return text.encode("latin-1")


@pytest.mark.parametrize("step", [1, 2, 5, 12, 24])
def test_an_answer_carries_the_id_of_its_own_request(play: Play, step: int) -> None:
    bench = play(*MODBUS)
    link = bench.link()
    requests = b"\xab\xcd" + as_bytes(READ)[2:] + b"\xab\xce" + as_bytes(OTHER)[2:]
    for at in range(0, len(requests), step):
        link.write(requests[at : at + step])
    assert (
        link.drain(1.0)
        == b"\xab\xcd" + as_bytes(ANSWER)[2:] + b"\xab\xce" + as_bytes(OTHER_ANSWER)[2:]
    )
    assert bench.note == []


def test_all_else_in_a_frame_has_to_be_as_recorded(play: Play) -> None:
    for place in range(2, 12):
        request = bytearray(as_bytes(READ))
        request[place] ^= 1
        bench = play(*MODBUS)
        link = bench.link()
        link.write(bytes(request))
        link.drain(1.0)
        assert f"byte {place} of it is another than recorded" in bench.note[0]


def test_on_a_link_that_is_no_modbus_no_byte_is_free(play: Play) -> None:
    bench = play((0.0, "opened", SERIAL), *MODBUS[1:])
    link = bench.link()
    link.write(b"\xab\xcd" + as_bytes(READ)[2:])
    link.drain(1.0)
    assert "byte 0 of it" in bench.note[0]


def test_nonsense_on_a_modbus_link_is_played_as_it_came(play: Play) -> None:
    bench = play(*MODBUS[:2], (1.1, "received", "HTTP/1.1 400 Bad"))
    link = bench.link()
    link.write(b"\0\1" + as_bytes(READ)[2:])
    assert link.drain(1.0) == b"HTTP/1.1 400 Bad"
    assert bench.note == []

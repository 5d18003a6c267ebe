"""URLs of Modbus devices; and what clients of Modbus get wrong on a bad wire and about links (fact sheet,
section 2.3, P1 to P10), each reproduced and shown cured."""

from __future__ import annotations

import re
import threading
from contextlib import suppress
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from instruments.bath.connection import Line, LineError, parse_line
from instruments.bath.driver import OwnBath
from instruments.bath.session import BrokenError
from instruments.bath.transactions import FORGET_S, Transactions
from instruments.errors import InstrumentError, LinkError, ProtocolError
from instruments.listener import Listener
from instruments.port_settings import PortSettings
from tests.examples import examples
from tests.instruments.bath.devices import Stand, load_register_profile
from tests.instruments.bath.far_end import MARKERS, FarEnd, linked, right, rtu, virtual

# ---- P1, P5: late answers


def test_p1_silence_costs_little_and_a_slow_answer_is_taken_for_what_it_is() -> None:
    with linked() as (far_end, link):
        start = far_end.clock.now() + 0.5  # the quiet after connecting
        far_end.delays_s = [1.3]
        assert link.read(3, 2, 1) == right(2)
        assert far_end.clock.now() - start == pytest.approx(1.3)
        assert len(far_end.asked) == 1
        far_end.delays_s = [None]
        assert link.read(3, 2, 1) == right(2)
        # time-out and quiet; then the proof, and asked again
        assert far_end.clock.now() - start == pytest.approx(1.3 + 1.5)
        assert [pdu[0] for pdu in far_end.asked] == [3, 3, 4, 3]


def test_a_dead_line_is_reported_in_time_and_works_again_when_it_is_back() -> None:
    with linked() as (far_end, link):
        far_end.delays_s = [None] * 100
        for _ in range(20):
            start = far_end.clock.now()
            with pytest.raises(LinkError, match="no answer"):
                link.read(3, 0, 1)
            assert far_end.clock.now() - start <= 4.0
            far_end.clock.sleep(1.0)
        far_end.delays_s = []
        far_end.clock.sleep(10.0)
        assert link.read(3, 1, 1) == right(1)


Step = tuple[str, int, int, float | None]
steps = st.tuples(
    st.sampled_from(["read", "read", "read", "write"]),
    st.integers(0, 7),
    st.integers(1, 3),
    st.one_of(st.just(0.0), st.none(), st.floats(0.0, 9.9)),
)


@pytest.mark.slow
@given(
    script=st.lists(steps, min_size=2, max_size=12),
    pauses=st.lists(st.floats(0.0, 3.0), min_size=12, max_size=12),
)
@settings(max_examples=examples(25), deadline=None)
def test_p1_whatever_is_late_no_wrong_value_gets_through(
    script: list[Step], pauses: list[float]
) -> None:
    with linked() as (far_end, link):
        now = {address: 100 * (address + 1) for address in range(16)}
        for number, ((kind, address, count, delay_s), pause_s) in enumerate(
            zip(script, pauses, strict=False)
        ):
            far_end.delays_s = [delay_s]
            wanted = 1000 + number
            try:
                if kind == "write":
                    link.write(16, address, [wanted])
                else:
                    assert link.read(3, address, count) == [
                        now[address + at] for at in range(count)
                    ]
            except InstrumentError:
                pass
            now = {known: far_end.memory.get(known, value) for known, value in now.items()}
            far_end.clock.sleep(pause_s)
        far_end.delays_s = []
        far_end.clock.sleep(20.0)
        assert link.read(3, 0, 1) == [now[0]]


# ---- P2: lengths


@pytest.mark.parametrize(
    ("framing", "sent"), [("rtu", 0), ("rtu", 1), ("rtu", 3), ("tcp", 1), ("tcp", 125)]
)
def test_p2_a_wrong_number_of_registers_is_reported(framing: str, sent: int) -> None:
    with linked(framing) as (far_end, link):
        registers = bytes((3, 2 * sent)) + b"\x12\x34" * sent

        def wrong(frame: bytes) -> bytes:
            if framing == "rtu":
                return rtu(f"01 {registers.hex()}")
            return frame[:4] + (len(registers) + 1).to_bytes(2, "big") + frame[6:7] + registers

        far_end.spoils = [wrong]
        with pytest.raises(
            ProtocolError, match=f"{sent} registers were answered where 2 were asked"
        ):
            link.read(3, 4, 2)
        assert link.read(3, 4, 2) == right(4, 2)


@pytest.mark.parametrize(
    ("function", "echo"),
    [
        (6, "01 06 0001 0007"),
        (6, "01 06 0002 0008"),
        (16, "01 10 0002 0002"),
        (16, "01 10 0003 0001"),
        (5, "01 05 0002 0000"),
    ],
)
def test_a_write_that_is_confirmed_wrongly(function: int, echo: str) -> None:
    with linked() as (far_end, link):
        far_end.spoils = [lambda _: rtu(echo)]
        with pytest.raises(ProtocolError, match="confirms another write"):
            link.write(function, 2, [1 if function == 5 else 7])


# ---- P3: interrupted questions


@pytest.mark.parametrize("late_s", [0.6, 1.2, 2.0, 4.0])
@pytest.mark.parametrize("gateway", [False, True])
def test_p3_an_interrupted_question_quarantines_the_line(gateway: bool, late_s: float) -> None:
    with linked(gateway=gateway) as (far_end, link):
        link.read(3, 0, 1)
        far_end.delays_s = [late_s]

        def interrupt() -> None:
            raise KeyboardInterrupt

        far_end.clock.call_at(far_end.clock.now() + 0.5, interrupt)
        with pytest.raises(KeyboardInterrupt):
            link.read(3, 0, 1)
        assert not link.connected
        with pytest.raises(BrokenError):
            link.read(3, 1, 1)
        link.connect()
        for address in (1, 2, 3):
            try:
                assert link.read(3, address, 1) == right(address)
            except LinkError:
                far_end.clock.sleep(2.0)
        assert link.read(3, 5, 1) == right(5)


def test_an_answer_to_somebody_elses_question_is_let_go_by_after_connecting() -> None:
    with virtual(gateway=True) as (far_end, url):
        far_end.memory = {0: 100, 1: 200}
        far_end.clock.call_at(0.3, lambda: far_end.send_all(rtu("01 03 02 0BAD")))
        link = Transactions(parse_line(url), far_end.clock, who="bath", markers=MARKERS)
        link.connect()
        assert link.read(3, 1, 1) == right(1)
        link.close()


def test_an_urgent_write_does_not_wait_for_what_is_owed() -> None:
    with linked() as (far_end, link):
        far_end.delays_s = [3.0, None]
        with pytest.raises(LinkError):
            link.read(3, 0, 1)
        sent_s = far_end.clock.now()
        far_end.delays_s = []
        far_end.clock.call_at(sent_s + 0.001, lambda: None)
        link.write(6, 7, [1], urgent=True)
        assert far_end.memory[7] == 1
        assert len(far_end.asked) == 3
        assert link.read(3, 1, 1) == right(1)


# ---- P4: other numbers over TCP


# ---- P6: garbage


@pytest.mark.slow
@given(
    ahead=st.binary(max_size=40)
    | st.sampled_from(["01", "0103", "01 03 02", "0183", "01 03 FA 00"]).map(bytes.fromhex),
    behind=st.binary(max_size=40),
    address=st.integers(0, 7),
    count=st.integers(1, 4),
)
@settings(max_examples=examples(25), deadline=None)
def test_p6_any_garbage_around_answers_costs_nothing(
    ahead: bytes, behind: bytes, address: int, count: int
) -> None:
    with linked() as (far_end, link):
        link.read(3, 0, 1)
        start = far_end.clock.now()
        far_end.spoils = [lambda frame: ahead + frame + behind] * 3
        for _ in range(3):
            assert link.read(3, address, count) == right(address, count)
        assert far_end.clock.now() == start
        assert len(far_end.asked) == 4


def test_p6_damage_that_stays_is_reported_with_what_came() -> None:
    with linked() as (far_end, link):
        far_end.spoils = [lambda frame: frame[:-1] + bytes((frame[-1] ^ 1,))] * 3
        with pytest.raises(
            ProtocolError, match=r"what came is no answer to this .*got 01 04 02 00 64"
        ):
            link.read(3, 3, 1)


# ---- a cut answer over TCP


PRESTO = {5: 4, 2: 0x4204, 12: 0x41F4, 14: 37, 15: 0x4205, 10: 0x4204, 11: 0x8000, 19: 0x4218}
POLLED_BYTES = (31, 17, 33)  # the answers of a poll: holding 0 to 10 and 90 to 93, input 5 to 16


@pytest.mark.slow
@pytest.mark.parametrize("cut", ["alone", "late", "its rest later", "its rest amid the next"])
def test_a_cut_answer_is_never_completed_by_the_next(cut: str) -> None:
    """At every place: the right reading or an error, and the right one again soon after."""
    with virtual("tcp") as (far_end, url):
        far_end.memory = dict(PRESTO)
        bath = OwnBath(url, load_register_profile("julabo-presto"), far_end.clock)
        whole = replace(bath.read(), t_s=0.0)
        assert (whole.temp_c, whole.external_c, whole.safety_c) == (33.125, 30.5, 33.25)
        assert (whole.power_percent, whole.set_point_c) == (37.0, 33.0)
        for block, length in enumerate(POLLED_BYTES):
            for place in range(1, length):

                def spoil(frame: bytes, place: int = place, length: int = length) -> bytes:
                    assert len(frame) == length
                    rest = frame[place:]
                    if cut.startswith("its rest"):
                        pause_s = 1.2 if cut == "its rest later" else 1.0
                        later_s = far_end.clock.now() + pause_s
                        far_end.clock.call_at(later_s, lambda: far_end.send_all(rest))
                    return frame[:place]

                far_end.spoils = [*[lambda frame: frame] * block, spoil]
                far_end.delays_s = [*[0.0] * block, *([1.2] if cut == "late" else [])]
                for _ in range(2):
                    with suppress(InstrumentError):
                        assert replace(bath.read(), t_s=0.0) == whole, (block, place)
                    far_end.clock.sleep(1.0)
                assert replace(bath.read(), t_s=0.0) == whole, (block, place)
        bath.close()


# ---- few shapes of answers over RTU


def test_where_every_shape_of_an_answer_is_owed_a_call_waits_and_says_so() -> None:
    with Stand(profile=load_register_profile("omega-cn7")) as stand:
        bath = stand.bath()
        stand.emulator.fault("silence")
        said = []
        for _ in range(40):  # asked again at once, as nobody should
            start = stand.clock.now()
            with pytest.raises(LinkError, match="no answer") as raised:
                bath.read()
            assert 1.0 <= stand.clock.now() - start <= 7.0
            said.append(str(raised.value))
        assert any(
            re.search(r"no answer to 3 questions .* Nothing is asked for \d s at most", message)
            for message in said
        )
        stand.emulator.fault("silence", on=False)
        back_s = stand.clock.now()
        while True:
            with suppress(LinkError):
                assert bath.read().temp_c == 20.0
                break
        assert stand.clock.now() - back_s <= FORGET_S


# ---- P7, P8: links that are not there, or go


def test_p7_a_first_connect_that_fails_is_tried_again() -> None:
    with virtual() as (elsewhere, url):
        clock, port = elsewhere.clock, int(url.rpartition(":")[2])
    listeners: list[Listener] = []
    far_end = FarEnd(clock)
    clock.call_at(
        1.0,
        lambda: listeners.append(
            Listener(far_end, clock, lock=threading.RLock(), name="far end", port=port)
        ),
    )
    link = Transactions(parse_line(url), clock, who="bath")
    link.connect()
    assert clock.now() == pytest.approx(1.5)  # 0.1, 0.3, 0.7, 1.5 s: growing pauses
    assert link.read(3, 0, 1) == [0]
    link.close()
    listeners[0].close()


# ---- P9, P10: real time


BY_ID = "/dev/serial/by-id/usb-FTDI"
ODD = PortSettings(parity="E", stopbits=2)


@pytest.mark.parametrize(
    ("url", "line"),
    [
        ("tcp://10.0.0.7", Line("tcp", "10.0.0.7", 502)),
        ("tcp://bath.lab:1502?unit=255", Line("tcp", "bath.lab", 1502, unit_id=255)),
        ("tcp://[::1]:502", Line("tcp", "::1", 502)),
        ("rtu+tcp://moxa:4001?unit=3", Line("rtu+tcp", "moxa", 4001, unit_id=3)),
        ("/dev/ttyUSB0", Line("serial", device="/dev/ttyUSB0")),
        ("COM5", Line("serial", device="COM5")),
        ("COM12?baud=9600", Line("serial", device="COM12", baud=9600)),
        (
            f"{BY_ID}?unit=12&baud=19200&parity=e&stopbits=2",
            Line("serial", device=BY_ID, unit_id=12, baud=19200, serial=ODD),
        ),
    ],
)
def test_what_a_url_says(url: str, line: Line) -> None:
    assert parse_line(url) == line


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("tpc://h:1", 'did you mean "tcp://"?'),
        ("socket://h:1", 'did you mean "rtu+tcp://"?'),
        ("modbus://h:1", 'did you mean "tcp://"?'),
        ("ttyUSB0", 'did you mean "/dev/ttyUSB0"?'),
        ("com5:", 'did you mean "COM5"?'),
        ("10.0.0.7:502", 'did you mean "tcp://10.0.0.7:502"?'),
        (
            "",
            'allowed: "tcp://host:port", "rtu+tcp://host:port", "rfc2217://host:port", "/dev/ttyUSB0"',
        ),
        ("tcp://", 'write "tcp://host:port"'),
        ("tcp://h:1/x", "nothing behind it"),
        ("tcp://me@h:1", "nothing behind it"),
        ("tcp://h:99999", "Port out of range"),
        ("rtu+tcp://h", "the port is missing"),
        ("tcp://h:1?unti=1", 'no setting of tcp://; did you mean "unit"?'),
        ("tcp://h:1?baud=9600", '"baud" is no setting of tcp:// (allowed: unit, gap_ms)'),
        ("/dev/ttyS0?9600", "is no list of settings"),
        ("tcp://h:1?unit=x", "unit=x: a whole number from 1 to 255"),
        ("rtu+tcp://h:1?unit=255", "from 1 to 254"),
        ("COM5?unit=0", "from 1 to 254"),
        ("COM5?parity=odd", "N (none), E (even) and O (odd)"),
        ("COM5?baud=115200000", "from 300 to 921600"),
        ("COM5?stopbits=1.5", "from 1 to 2"),
    ],
)
def test_a_url_that_is_none_is_refused_with_why(url: str, said: str) -> None:
    with pytest.raises(LineError) as caught:
        parse_line(url)
    assert said in str(caught.value)


@pytest.mark.slow
@given(url=st.text(max_size=40))
def test_any_text_is_a_line_or_is_refused(url: str) -> None:
    try:
        line = parse_line(url)
    except LineError:
        return
    assert line.device or (line.host and 0 <= line.port <= 65535)

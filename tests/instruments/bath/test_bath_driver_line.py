"""URLs of Modbus devices: what they say, and what is said to those that are none."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.bath.connection import Line, LineError, parse_line


@pytest.mark.parametrize(
    ("url", "line"),
    [
        ("tcp://10.0.0.7", Line("tcp", "10.0.0.7", 502)),
        ("tcp://bath.lab:1502?unit=255", Line("tcp", "bath.lab", 1502, unit_id=255)),
        ("tcp://[::1]:502", Line("tcp", "::1", 502)),
        ("rtu+tcp://moxa:4001?unit=3", Line("rtu+tcp", "moxa", 4001, unit_id=3)),
        ("/dev/ttyUSB0", Line("serial", device="/dev/ttyUSB0")),
        ("COM5", Line("serial", device="COM5")),
        (
            "/dev/serial/by-id/usb-FTDI?unit=12&baud=19200&parity=e&stopbits=2",
            Line(
                "serial",
                device="/dev/serial/by-id/usb-FTDI",
                unit_id=12,
                baud=19200,
                parity="E",
                stopbits=2,
            ),
        ),
        ("COM12?baud=9600", Line("serial", device="COM12", baud=9600)),
    ],
)
def test_what_a_url_says(url: str, line: Line) -> None:
    assert parse_line(url) == line


@pytest.mark.parametrize(
    ("url", "said"),
    [
        ("tpc://h:1", 'did you mean "tcp://"?'),
        ("socket://h:1", 'did you mean "rtu+tcp://"?'),
        ("rtu://h:1", 'did you mean "rtu+tcp://"?'),
        ("modbus://h:1", 'did you mean "tcp://"?'),
        ("ttyUSB0", 'did you mean "/dev/ttyUSB0"?'),
        ("com5:", 'did you mean "COM5"?'),
        ("10.0.0.7:502", 'did you mean "tcp://10.0.0.7:502"?'),
        ("", 'allowed: "tcp://host:port", "rtu+tcp://host:port", "/dev/ttyUSB0", "COM5"'),
        ("tcp://", 'write "tcp://host:port"'),
        ("tcp://:502", 'write "tcp://host:port"'),
        ("tcp://h:1/x", "nothing behind it"),
        ("tcp://me@h:1", "nothing behind it"),
        ("tcp://h:99999", "Port out of range"),
        ("tcp://h:x", "not a link"),
        ("rtu+tcp://h", "the port is missing"),
        ("tcp://h:1?unti=1", 'no setting of tcp://; did you mean "unit"?'),
        ("tcp://h:1?baud=9600", '"baud" is no setting of tcp:// (allowed: unit)'),
        ("/dev/ttyS0?bauds=9600", 'no setting of a serial port; did you mean "baud"?'),
        ("/dev/ttyS0?9600", "is no list of settings"),
        ("tcp://h:1?unit=x", "unit=x: a whole number from 1 to 255"),
        ("tcp://h:1?unit=", "unit=: a whole number"),
        ("rtu+tcp://h:1?unit=255", "from 1 to 254"),
        ("COM5?unit=0", "from 1 to 254"),
        ("COM5?parity=odd", "N (none), E (even) and O (odd)"),
        ("COM5?baud=115200000", "from 300 to 921600"),
        ("COM5?stopbits=1.5", "from 1 to 2"),
    ],
)
def test_a_url_that_is_none_is_told_why(url: str, said: str) -> None:
    with pytest.raises(LineError) as caught:
        parse_line(url)
    assert said in str(caught.value)


@given(url=st.text(max_size=40))
def test_any_text_is_a_line_or_is_refused(url: str) -> None:
    try:
        line = parse_line(url)
    except LineError:
        return
    assert line.device or (line.host and 0 <= line.port <= 65535)

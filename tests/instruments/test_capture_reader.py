"""A capture when it is read: grouped as it was said, with every fault of the file in its line, and
none for a killed bench.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from instruments.captures.capture import CaptureError, CaptureFile, read_capture
from instruments.clock import VirtualClock
from tests.conftest import ROOT
from tests.examples import examples
from tests.waiting import within

HEAD = (
    '{"format": "teatbench capture", "version": 1, "wall_time": "w", "teatbench": "0", "command":'
    ' "c", "machine": "m"}\n'
)
OPENED = '{"t_s": 0.5, "link": "arm", "event": "opened", "url": "COM5"}\n'
SENT = '{"t_s": 1.0, "link": "arm", "event": "sent", "data": "03"}\n'
RECEIVED = '{"t_s": 1.25, "link": "arm", "event": "received", "data": "83 00"}\n'
CLOSED = '{"t_s": 2, "link": "arm", "event": "closed"}\n'


ONE_FOLDER = settings(
    max_examples=examples(40),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    deadline=None,
)


def sent(old: str, new: str) -> str:
    """A capture of a link that was opened, and of one line that was sent, changed."""
    return HEAD + OPENED + SENT.replace(old, new)


def written(folder: Path, text: str | bytes) -> Path:
    path = folder / "c.jsonl"
    path.write_bytes(text.encode("utf-8") if isinstance(text, str) else text)
    return path


def test_what_was_said_is_grouped_by_what_was_asked(tmp_path: Path) -> None:
    stage = [
        '{"t_s": 2.0, "link": "stage", "event": "opened", "url": "socket://h:1"}\n',
        '{"t_s": 2.1, "link": "stage", "event": "received", "data": "0d0a"}\n',
        '{"t_s": 2.2, "link": "stage", "event": "sent", "data": "24"}\n',
        '{"t_s": 2.3, "link": "stage", "event": "sent", "data": "490a"}\n',
        '{"t_s": 2.4, "link": "stage", "event": "received", "data": "6f"}\n',
        '{"t_s": 2.5, "link": "stage", "event": "received", "data": "6b"}\n',
        '{"t_s": 2.6, "link": "stage", "event": "closed", "why": "unplugged"}\n',
        '{"t_s": 2.7, "link": "stage", "event": "opened", "url": "socket://h:1"}\n',
    ]
    read = read_capture(
        written(tmp_path, HEAD + OPENED + SENT + RECEIVED + CLOSED + "".join(stage))
    )
    assert read.facts == {"wall_time": "w", "teatbench": "0", "command": "c", "machine": "m"}
    assert not read.cut
    (arm,) = read.links["arm"]
    assert (arm.url, arm.closed_s, arm.broke) == ("COM5", 2.0, "")
    assert [(bytes(one.asked), one.asked_s, one.line) for one in arm.exchanges] == [
        (b"", 0.5, 2),
        (b"\x03", 1.0, 3),
    ]
    assert [(piece.t_s, piece.data, piece.line) for piece in arm.exchanges[1].came] == [
        (1.25, b"\x83\x00", 4)
    ]
    first, second = read.links["stage"]
    assert first.broke == "unplugged"
    assert [(bytes(one.asked), one.asked_s, one.line) for one in first.exchanges] == [
        (b"", 2.0, 6),
        (b"$I\n", 2.3, 8),
    ]
    assert [piece.data for piece in first.exchanges[0].came] == [b"\r\n"]
    assert [piece.data for piece in first.exchanges[1].came] == [b"o", b"k"]
    assert (second.exchanges[0].asked_s, second.closed_s, len(second.exchanges)) == (2.7, None, 1)


def test_the_example_of_the_documentation_is_a_capture(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "record.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    (arm,) = read_capture(written(tmp_path, example)).links["arm"]
    assert [one.asked for one in arm.exchanges] == [b"", b"\xc5IMMC"]
    assert arm.broke == "the other end hung up"


def test_what_is_written_into_a_broken_link_never_arrived_and_what_is_read_from_it_did(
    tmp_path: Path,
) -> None:
    broke = CLOSED.replace('"closed"', '"closed", "why": "reset"')
    late = RECEIVED.replace("1.25", "3") + SENT.replace("1.0", "3")
    (arm,) = read_capture(
        written(tmp_path, HEAD + OPENED + SENT + broke + late + CLOSED.replace("2", "4"))
    ).links["arm"]
    assert [one.asked for one in arm.exchanges] == [b"", b"\x03"]
    assert [piece.data for piece in arm.exchanges[1].came] == [b"\x83\x00"]
    assert (arm.closed_s, arm.broke) == (2.0, "reset")


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("", 1, "Invalid JSON"),
        ("[1]\n", 1, "should be an object"),
        ("{}\n", 1, "format: Field required"),
        (
            '{"format": "pcap", "version": 1}\n',
            1,
            "format: Input should be 'teatbench capture'.*pcap",
        ),
        (HEAD.replace("1", "2", 1), 1, r"version: Input should be 1 \(found 2\)"),
        (HEAD.replace('"m"', "7"), 1, "machine: .*valid string.*7"),
        (HEAD + SENT, 2, "arm: sent before it was opened"),
        (HEAD + CLOSED, 2, "arm: closed before it was opened"),
        (HEAD + OPENED + SENT[:30] + "\n" + RECEIVED, 3, "Invalid JSON"),
        (sent("sent", "said"), 3, "'said' .*expected tags: 'opened', 'sent', 'received', 'closed'"),
        (sent("03", "3"), 3, "data: .*hexadecimal.*'3'"),
        (
            sent('"03"', '"03", "\\u001b[2J": 1'),
            3,
            r"^[^\x1b]*\\x1b\[2J: Extra inputs are not permitted",
        ),
        (sent(', "data": "03"', ""), 3, "data: Field required"),
        (sent("1.0", '"1"'), 3, "t_s: .*valid number.*'1'"),
        (sent("1.0", "NaN"), 3, "t_s: .*finite.*nan"),
        (sent("1.0", "-1"), 3, "t_s: .*greater than or equal to 0.*-1"),
        (sent("1.0", "1" + 400 * "0"), 3, "t_s: .{1,110}$"),
        (sent("1.0", "9" * 5000), 3, "Invalid JSON"),
        (sent("1.0", "0.4"), 3, "t_s goes back, from 0.5 to 0.4"),
        (HEAD + OPENED.replace("arm", "\\u001b[2J"), 2, r"link: [^\x1b]*\\x1b\[2J"),
        (HEAD + "[" * 100_000 + "\n", 2, "Invalid JSON"),
        (HEAD + " " * 1_100_000, 2, "the line is longer than 1048576 bytes"),
        (HEAD.encode() + b'{"t_s": 0, "link": "\xff"}\n', 2, "Invalid JSON"),
    ],
)
def test_a_fault_is_reported_in_its_line(
    tmp_path: Path, text: str | bytes, line: int, message: str
) -> None:
    path = written(tmp_path, text)
    with pytest.raises(CaptureError, match=message) as caught:
        read_capture(path)
    assert str(caught.value).startswith(f"{path}:{line}: " if line else f"{path}: ")
    assert caught.value.faults[0][0] == line


def test_all_faults_are_reported_and_of_many_the_first(tmp_path: Path) -> None:
    with pytest.raises(CaptureError) as caught:
        read_capture(
            written(tmp_path, HEAD + OPENED + "x\n" + SENT + "y\n" + RECEIVED.replace("00", "0"))
        )
    assert [line for line, _ in caught.value.faults] == [3, 5, 6]
    with pytest.raises(CaptureError) as caught:
        read_capture(written(tmp_path, HEAD + "x\n" * 100_000))
    assert str(caught.value).count("\n") == 20
    assert str(caught.value).endswith("980 faults more")


def test_a_file_that_cannot_be_read_is_reported(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="can't be read"):
        read_capture(tmp_path / "none")
    with pytest.raises(CaptureError, match="can't be read"):
        read_capture(tmp_path)


def test_a_last_line_cut_anywhere_is_no_fault(tmp_path: Path) -> None:
    for length in range(len(RECEIVED) + 1):
        read = read_capture(written(tmp_path, HEAD + OPENED + SENT + RECEIVED[:length]))
        whole = length >= len(RECEIVED) - 1
        assert read.cut == (length > 0 and not whole)
        assert len(read.links["arm"][0].exchanges[1].came) == whole


def test_a_last_line_that_is_whole_and_wrong_is_a_fault(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="hexadecimal"):
        read_capture(written(tmp_path, sent("03", "0x").rstrip()))


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["arm", "bath"]),
        st.sampled_from(["opened", "sent", "received", "closed"]),
        st.binary(),
    )
)


@pytest.mark.slow
@given(EVENTS)
@settings(ONE_FOLDER, max_examples=examples(25))
def test_whatever_taps_get_is_read_back(
    tmp_path: Path, events: list[tuple[str, str, bytes]]
) -> None:
    path = tmp_path / "c"
    path.unlink(missing_ok=True)
    clock = VirtualClock()
    with CaptureFile(str(path)) as capture:  # as a program may write one, without any facts
        taps = {name: capture.tap(name, clock) for name in ("arm", "bath")}
        for tap in taps.values():
            tap.opened("u")
        for link, event, data in events:
            clock.sleep(0.1)
            tell = {"sent": taps[link].sent, "received": taps[link].received}
            if event in tell:
                tell[event](data)
            elif event == "opened":
                taps[link].opened("again")
            else:
                taps[link].closed()
    read = read_capture(path)
    for link in taps:
        mine = [(event, data) for name, event, data in events if name == link]
        assert len(read.links[link]) == 1 + sum(event == "opened" for event, _ in mine)
        came = b"".join(
            p.data for talk in read.links[link] for one in talk.exchanges for p in one.came
        )
        assert came == b"".join(data for event, data in mine if event == "received")


WRITER = """
import sys
from pathlib import Path
from instruments.captures.capture import CaptureFile
from instruments.clock import RealClock
tap = CaptureFile(Path(sys.argv[1]), {"teatbench": "0", "command": "c", "machine": "m"}).tap("arm", RealClock())
tap.opened("u")
number = 0
while True:
    tap.sent(number.to_bytes(4, "big"))
    tap.received(bytes(number % 60000 + 1))
    number += 1
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs SIGKILL")
def test_kill_9_leaves_all_that_was_captured(tmp_path: Path) -> None:
    path = tmp_path / "c"
    child = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    try:
        within(lambda: path.exists() and path.stat().st_size > 1000, "captured")
        time.sleep(0.11)
    finally:
        child.send_signal(signal.SIGKILL)
        child.wait()
    (conversation,) = read_capture(path).links["arm"]
    exchanges = conversation.exchanges[1:]
    assert len(exchanges) > 10
    assert [int.from_bytes(one.asked, "big") for one in exchanges] == list(range(len(exchanges)))
    assert all(len(one.came) == 1 for one in exchanges[:-1])
    assert conversation.closed_s is None

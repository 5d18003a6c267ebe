"""A capture while it is written: what stands in it, that it is there at once, and that nothing it
meets reaches the link.
"""

from __future__ import annotations

import json
import sys
import threading
import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from instruments.captures.capture import CaptureError, CaptureFile, read_capture
from instruments.clock import RealClock, VirtualClock
from instruments.link import Tap

FACTS = {"teatbench": "1.2.3", "command": "teatbench check 'my rig.toml'", "machine": "Linux"}


def text(path: Path) -> list[dict[str, Any]]:
    """The file's lines behind the header."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()[1:]]


@contextmanager
def opened(path: Path, url: str = "u", **facts: str) -> Iterator[tuple[CaptureFile, Tap]]:
    """A capture in which the arm's link was opened, and its tap."""
    with CaptureFile(path, {**FACTS, **facts}) as capture:
        tap = capture.tap("arm", VirtualClock())
        tap.opened(url)
        yield capture, tap


def test_the_file_is_json_lines_as_documented(tmp_path: Path) -> None:
    path, clock = tmp_path / "bug.jsonl", VirtualClock()
    with CaptureFile(path, FACTS) as capture:
        tap = capture.tap("arm", clock)
        tap.opened("/dev/ttyUSB0")
        clock.sleep(0.1234567)
        tap.sent(b"\xc5IMMC")
        tap.received(b"IMMC")
        clock.sleep(0.5)
        tap.closed()
    head, *lines = path.read_text(encoding="utf-8").splitlines()
    header = json.loads(head)
    assert header.pop("wall_time").endswith("+00:00")
    assert header == {"format": "teatbench capture", "version": 1, **FACTS}
    assert lines == [
        '{"t_s": 0.0, "link": "arm", "event": "opened", "url": "/dev/ttyUSB0"}',
        '{"t_s": 0.123457, "link": "arm", "event": "sent", "data": "c5494d4d43"}',
        '{"t_s": 0.123457, "link": "arm", "event": "received", "data": "494d4d43"}',
        '{"t_s": 0.623457, "link": "arm", "event": "closed"}',
    ]


def test_every_line_is_there_before_the_file_is_closed(tmp_path: Path) -> None:
    with opened(tmp_path / "c") as (_, tap):
        for count in range(1, 20):
            assert len(text(tmp_path / "c")) == count
            tap.sent(b"x")


def test_several_links_from_several_threads_share_a_file(tmp_path: Path) -> None:
    clock = RealClock()
    with CaptureFile(tmp_path / "c", FACTS) as capture:

        def talk(name: str) -> None:
            tap = capture.tap(name, clock)
            tap.opened(name)
            for number in range(500):
                tap.sent(number.to_bytes(2, "big"))
                tap.received(number.to_bytes(2, "little") * (number % 40 + 1))
            tap.closed()

        threads = [threading.Thread(target=talk, args=[f"link-{n}"]) for n in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    read = read_capture(tmp_path / "c")  # which refuses times that go back
    assert len(read.links) == 4
    for conversations in read.links.values():
        assert [int.from_bytes(one.asked, "big") for one in conversations[0].exchanges[1:]] == list(
            range(500)
        )
        assert [len(one.came[0].data) for one in conversations[0].exchanges[1:]] == [
            2 * (n % 40 + 1) for n in range(500)
        ]


def test_long_writes_are_cut_into_lines_that_the_reader_takes(tmp_path: Path) -> None:
    long = bytes(range(256)) * 5000
    with opened(tmp_path / "c") as (_, tap):
        tap.sent(long)
        tap.sent(b"")
    assert max(len(line) for line in (tmp_path / "c").read_bytes().splitlines()) < 140_000
    (conversation,) = read_capture(tmp_path / "c").links["arm"]
    assert conversation.exchanges[1].asked == long


@pytest.mark.slow
def test_nothing_is_kept_in_memory(tmp_path: Path) -> None:
    with opened(tmp_path / "c") as (_, tap):
        tap.received(bytes(1000))
        tracemalloc.start()
        for _ in range(5000):
            tap.received(bytes(1000))
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert (tmp_path / "c").stat().st_size > 10_000_000
    assert peak < 100_000


def test_a_capture_is_never_written_over(tmp_path: Path) -> None:
    (tmp_path / "c").write_text("precious", encoding="utf-8")
    with pytest.raises(CaptureError, match="there already"):
        CaptureFile(tmp_path / "c", FACTS)
    assert (tmp_path / "c").read_text(encoding="utf-8") == "precious"


def test_where_no_file_can_be_is_reported(tmp_path: Path) -> None:
    for path in (tmp_path / "no" / "folder" / "c", tmp_path / ("x" * 300)):
        with pytest.raises(CaptureError, match="can't be written"):
            CaptureFile(path, FACTS)
    with pytest.raises(CaptureError, match="there already"):
        CaptureFile(tmp_path, FACTS)


@pytest.mark.parametrize("name", ["", "two words", "../up", "1", "ä", "x" * 33])
def test_a_link_may_not(tmp_path: Path, name: str) -> None:
    with (
        CaptureFile(tmp_path / "c", FACTS) as capture,
        pytest.raises(ValueError, match="no name for a link"),
    ):
        capture.tap(name, VirtualClock())


def test_hostile_texts_stay_within_their_line(tmp_path: Path) -> None:
    url = '/dev/"\n{"t_s": 0}\u2028\x00\ud800\\'
    with opened(tmp_path / "c", url, command=url) as (_, tap):
        tap.closed(url)
    read = read_capture(tmp_path / "c")
    kept = url.replace("\ud800", "?")  # no file of UTF-8 can hold it
    assert read.facts["command"] == read.links["arm"][0].url == read.links["arm"][0].broke == kept


def test_a_capture_without_an_event_leaves_no_file(tmp_path: Path) -> None:
    with CaptureFile(tmp_path / "c", FACTS):
        assert (tmp_path / "c").exists()
    assert not (tmp_path / "c").exists()


def test_what_comes_after_the_end_is_dropped(tmp_path: Path) -> None:
    with opened(tmp_path / "c") as (capture, tap):
        pass
    tap.sent(b"late")
    tap.closed()
    capture.close()
    assert len(text(tmp_path / "c")) == 1


@pytest.mark.skipif(sys.platform == "win32", reason="limits a file's size as POSIX does")
def test_a_full_disk_ends_the_capture_and_not_the_run(tmp_path: Path) -> None:
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with opened(tmp_path / "c") as (capture, tap):
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
        try:
            for _ in range(100):
                tap.sent(b"0123456789")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        tap.sent(b"room again, and out of step")
    assert (tmp_path / "c").stat().st_size == 2000
    read = read_capture(tmp_path / "c")
    assert read.cut
    whole = len(read.links["arm"][0].exchanges[1].asked) // 10 + 1
    assert f"ends early, after {whole} events: File too large" in capture.fault

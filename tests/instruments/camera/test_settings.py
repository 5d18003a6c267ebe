"""What did not take is an error that names all of it, unless it was a try; and device time on the
bench's clock.
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.camera.genicam import DRIFT, DeviceTime
from instruments.camera.settings import ReadBack, same
from instruments.errors import DeviceError


@pytest.mark.parametrize(
    ("asked", "seen", "alike"),
    [
        (8000.0, 8010.5, True),
        (8000.0, 9000.0, False),
        (0.0, 0.0, True),
        (10.0, "10", True),
        (10.0, "fast", False),
        (True, "true", True),
        (True, "1", True),
        (False, "0", True),
        (True, "false", False),
        ("Mono8", "Mono8", True),
        ("Mono8", "mono8 ", True),
        ("Mono8", "Mono16", False),
        ((640, 480), (640, 480), True),
        ((640, 480), (640, 512), False),
        (3, 3.0, True),
    ],
)
def test_what_counts_as_taken(asked: object, seen: object, alike: bool) -> None:
    assert same(asked, seen) is alike


def test_all_that_did_not_take_comes_at_once() -> None:
    back = ReadBack("left camera", frozenset({"gain"}))
    back.compare("exposure", 8000.0, 100.0)
    back.compare("resolution", (1360, 1024), (640, 480))
    back.compare("gain", 3.0, 0.0)
    back.compare("fps", 10.0, 10.0)
    with pytest.raises(
        DeviceError,
        match=r"exposure asked 8000, is 100; resolution asked 1360 x 1024, is 640 x 480\. Ask",
    ):
        back.finish()
    assert back.notes == ["gain asked 3, is 0"]
    back = ReadBack("left camera", frozenset({"all"}))
    back.compare("gain", 3.0, 0.0)
    back.refused("fps", "fps was refused")
    assert back.finish() == ("gain asked 3, is 0", "fps was refused")


def test_the_least_delay_is_the_offset() -> None:
    time = DeviceTime()
    # the first: nothing better is known than its arrival
    assert time.bench_s(1000.0, 10.5) == pytest.approx(10.5)
    # came faster: 0.3 s of the first were delay
    assert time.bench_s(1001.0, 11.2) == pytest.approx(11.2)
    # came late, was exposed in time
    assert time.bench_s(1002.0, 13.0) == pytest.approx(12.2, abs=1e-3)


def test_a_camera_without_stamps_or_started_anew() -> None:
    time = DeviceTime()
    assert time.bench_s(0.0, 5.0) == 5.0
    time.bench_s(1000.0, 6.0)
    assert time.bench_s(3.0, 9.0) == 9.0, "its clock began again: the old offset must not be used"
    assert time.bench_s(4.0, 11.0) == pytest.approx(10.0, abs=1e-3)


@given(
    st.lists(st.tuples(st.floats(0.1, 300.0), st.floats(0.0, 0.5)), min_size=1, max_size=30),
    st.floats(-5e-5, 5e-5),
)
def test_never_after_its_arrival_and_never_worse_than_the_delays(
    frames: list[tuple[float, float]], drift: float
) -> None:
    time, true_s = DeviceTime(), 100.0
    for i, (apart_s, delay_s) in enumerate(frames):
        true_s += apart_s
        told_s = time.bench_s(5000.0 + true_s * (1.0 + drift), true_s + delay_s)
        assert told_s <= true_s + delay_s
        assert told_s >= true_s - 2.0 * DRIFT * 900.0 - 1e-6, i

"""The emulated cameras as MJPEG streams on loopback, met by the OpenCV driver as any network
camera.
"""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np
import pytest

from instruments.camera.cameras import CameraSet
from instruments.camera.frame import FrameError, FrameFault, FrameSet
from instruments.camera.opencv import OpenCvCamera
from instruments.camera.stream import StreamServer
from instruments.clock import RealClock, VirtualClock
from instruments.errors import LinkError
from tests.waiting import PATIENCE_S

SIZES = {"left": (96, 128), "right": (96, 128), "thermal": (48, 64)}


@dataclass
class Counting:
    """Cameras whose pictures tell their number: 40 + 10 x n bright, from 0 again after 20."""

    clock: RealClock
    taken: int = 0
    dropped: set[int] = field(default_factory=set)
    sizes: dict[str, tuple[int, int]] = field(default_factory=lambda: dict(SIZES))

    def capture(self) -> FrameSet:
        self.taken += 1
        if self.taken in self.dropped:
            raise FrameError(FrameFault.DROPPED, "left", "left camera", "no frame came")
        level, exposed_s = 40 + 10 * (self.taken % 20), dict.fromkeys(SIZES, self.clock.now())
        left, right, thermal = (np.full(size, level, np.uint8) for size in self.sizes.values())
        return FrameSet(left, right, thermal, exposed_s=exposed_s)


@pytest.fixture
def served(clock: RealClock) -> Iterator[StreamServer]:
    with closing(StreamServer(Counting(clock), clock, fps=20.0)) as server:
        yield server


def cameras_of(server: StreamServer, clock: RealClock) -> CameraSet:
    openers = {name: partial(OpenCvCamera, name, server.urls[name], clock) for name in SIZES}
    return CameraSet(openers, {})


@pytest.mark.slow
def test_the_driver_gets_fresh_frames_of_the_same_moment(
    served: StreamServer, clock: RealClock
) -> None:
    with closing(cameras_of(served, clock)) as cameras:
        assert "128 x 96" in cameras.identity["left"]
        assert "64 x 48" in cameras.identity["thermal"]
        # two may fall on the two sides of a tick; its skew tells, and the bench takes it again
        for _ in range(20):
            frames = cameras.capture()
            if max(frames.exposed_s.values()) - min(frames.exposed_s.values()) < 0.02:
                break
        assert frames.thermal is not None
        assert frames.left.mean() == pytest.approx(frames.right.mean(), abs=1.5)
        assert frames.left.mean() == pytest.approx(frames.thermal.mean(), abs=1.5)
        clock.sleep(0.6)  # a dozen frames go by
        asked_s = clock.now()
        assert min(cameras.capture().exposed_s.values()) > asked_s, "fresh"


@pytest.mark.slow
def test_a_camera_that_falls_silent(clock: RealClock) -> None:
    source = Counting(clock)
    with closing(StreamServer(source, clock, fps=20.0)) as server:
        camera = OpenCvCamera("left", server.urls["left"], clock, timeout_s=0.3)
        camera.begin()
        camera.take()
        source.dropped = set(range(source.taken + 1, source.taken + 10000))
        clock.sleep(0.2)
        camera.begin()
        with pytest.raises(FrameError, match="no frame came") as silent:
            camera.take()
        assert silent.value.fault is FrameFault.DROPPED
        source.dropped = set()
        shapes: list[tuple[int, ...]] = []
        while not shapes:  # on a busy machine the silence may have ended the stream: it reopens
            with suppress(FrameError):
                camera.begin()
                shapes.append(camera.take().pixels.shape)
        assert shapes == [(96, 128, 3)]
        camera.close()


@pytest.mark.slow
def test_a_stream_that_breaks_off_is_known_without_a_frame(
    served: StreamServer, clock: RealClock
) -> None:
    with closing(cameras_of(served, clock)) as cameras:
        cameras.glance()
        served.pulled.add("right")
        said = ""
        while not said:  # until the library has read what was under way
            clock.sleep(0.05)
            try:
                cameras.glance()
            except LinkError as error:
                said = str(error)
        assert said.startswith("right camera at http")
        assert "the stream broke off" in said
        served.pulled.clear()
        cameras.reopen()
        cameras.glance()


@pytest.mark.slow
def test_a_size_that_changes_within_a_stream_is_reported_until_it_is_the_old_one(
    clock: RealClock,
) -> None:
    source = Counting(clock)

    def outcomes_until(wanted: str) -> set[str]:
        seen: list[str] = []
        while wanted not in seen and len(seen) < 100:
            camera.begin()
            try:
                seen.append(str(camera.take().pixels.shape))
            except FrameError as error:
                seen.append(f"{error.fault}: {error.what}")
        assert wanted in seen, seen
        return set(seen)

    with (
        closing(StreamServer(source, clock, fps=20.0)) as server,
        closing(OpenCvCamera("left", server.urls["left"], clock, timeout_s=60.0)) as camera,
    ):
        assert outcomes_until("(96, 128, 3)") == {"(96, 128, 3)"}
        source.sizes["left"] = (60, 80)
        text = "wrong size: a frame of 80 x 60 came; it was opened with 128 x 96"
        assert outcomes_until(text) <= {"(96, 128, 3)", text}
        source.sizes["left"] = SIZES["left"]
        assert outcomes_until("(96, 128, 3)") <= {"(96, 128, 3)", text}


def test_what_is_sent(served: StreamServer) -> None:
    host, port = served.urls["left"].removeprefix("http://").split("/")[0].split(":")
    connection = http.client.HTTPConnection(host, int(port), timeout=PATIENCE_S)
    connection.request("GET", "/right.mjpg")
    answer = connection.getresponse()
    assert answer.getheader("Content-Type") == "multipart/x-mixed-replace; boundary=frame"
    assert answer.readline() == b"--frame\r\n"
    head = dict(line.decode().strip().split(": ") for line in iter(answer.readline, b"\r\n"))
    jpeg = answer.read(int(head["Content-Length"]))
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    assert image.shape == (96, 128)
    assert float(head["X-Exposed-Seconds"]) > 0.0
    connection.close()
    connection.request("GET", "/middle.mjpg")
    assert connection.getresponse().status == 404
    connection.close()


def test_a_taken_port_is_refused(clock: RealClock) -> None:
    """On Windows too, where two servers that reuse addresses may share one."""
    source = Counting(clock)
    with closing(StreamServer(source, clock)) as served:
        taken = int(served.page_url.rstrip("/").rpartition(":")[2])
        with pytest.raises(OSError, match=r"in use|denied|10013|10048"):
            StreamServer(source, clock, port=taken)


def test_no_stream_under_virtual_time() -> None:
    with pytest.raises(ValueError, match="in real time"):
        StreamServer(Counting(RealClock()), VirtualClock())

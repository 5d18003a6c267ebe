"""Camera drivers: emulated ones on a small world, OpenCV's on a video file that the test writes."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.camera.cameras import Camera, CameraSet
from instruments.camera.closing import close_within
from instruments.camera.frame import Conversion, FrameError, FrameFault, Radiometry, RawFrame
from instruments.camera.genicam import DRIFT, DeviceTime
from instruments.camera.opencv import LONGEST_WAIT_S, LiveReader, OpenCvCamera, fourcc_name, is_live
from instruments.camera.settings import Settings, apply, same
from instruments.clock import RealClock, VirtualClock
from instruments.errors import DeviceError, LinkError, ProtocolError
from tests.waiting import PATIENCE_S


def video(path: Path, level: int, frames: int = 3, codec: str = "MJPG") -> str:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10.0, (64, 48))
    assert writer.isOpened()
    for i in range(frames):
        writer.write(np.full((48, 64, 3), level + 10 * i, dtype=np.uint8))
    writer.release()
    return str(path)


def pair(left: str, right: str, clock: VirtualClock) -> CameraSet:
    paths = {"left": left, "right": right}
    return CameraSet(
        {name: partial(OpenCvCamera, name, at, clock) for name, at in paths.items()}, {}
    )


def test_opencv_plays_a_recorded_video_to_its_end(tmp_path: Path) -> None:
    clock = VirtualClock()
    clock.sleep(3.0)
    cameras = pair(video(tmp_path / "left.avi", 40), video(tmp_path / "right.avi", 120), clock)
    assert "64 x 48" in cameras.identity["left"]
    for i in range(3):
        frames = cameras.capture()
        assert frames.left.shape == (48, 64)
        assert frames.left.mean() == pytest.approx(40 + 10 * i, abs=3)
        assert frames.right.mean() == pytest.approx(120 + 10 * i, abs=3)
        assert frames.thermal is None
        assert frames.exposed_s == {"left": 3.0, "right": 3.0}
    with pytest.raises(LinkError, match=r"left camera at .*left\.avi: gave no frame"):
        cameras.capture()
    cameras.close()
    cameras.close()


@pytest.mark.parametrize("codec", ["MPG1 mpg", "VP80 webm"])
def test_a_picture_size_that_changes_in_a_file_of_another_codec_is_a_fault_too(
    tmp_path: Path, codec: str
) -> None:
    name, ending = codec.split()
    path = tmp_path / f"left.{ending}"
    for by in (1, 2):  # files of these kinds may be put one behind the other
        part = tmp_path / f"{by}.{ending}"
        size, fourcc = (64 * by, 48 * by), cv2.VideoWriter.fourcc(*name)
        writer = cv2.VideoWriter(str(part), cv2.CAP_FFMPEG, fourcc, 25.0, size)
        assert writer.isOpened()
        for level in range(8):
            writer.write(np.full((*size[::-1], 3), 20 * level, np.uint8))
        writer.release()
        with path.open("ab") as whole:
            whole.write(part.read_bytes())
    shapes = []
    rescaled = cv2.VideoCapture(str(path))
    while rescaled.grab():
        shapes.append(rescaled.retrieve()[1].shape)
    assert set(shapes[2:]) == {(48, 64, 3)}, "by OpenCV it goes unnoticed"
    outcomes: list[str] = []
    with closing(OpenCvCamera("left", str(path), VirtualClock())) as camera:
        for _ in range(30):
            try:
                camera.begin()
                outcomes.append(str(camera.take().pixels.shape))
            except FrameError as error:
                outcomes.append(error.what)
            except LinkError:  # its end
                break
    changed = "a frame of 128 x 96 came; it was opened with 64 x 48"
    assert outcomes.index(changed) == outcomes.count("(48, 64, 3)") >= 7
    assert outcomes.count(changed) >= 7


def test_a_video_file_that_is_cut_or_none_is_a_named_fault(tmp_path: Path) -> None:
    whole = Path(video(tmp_path / "whole.avi", 40, codec="XVID")).read_bytes()
    cut = tmp_path / "cut.avi"
    for share in (0.2, 0.9, 0.97):
        cut.write_bytes(whole[: int(share * len(whole))])
        with suppress(LinkError), closing(OpenCvCamera("left", str(cut), VirtualClock())) as camera:
            for _ in range(10):
                with suppress(FrameError):
                    camera.begin()
                    assert camera.take().pixels.shape == (48, 64, 3)


class Paced:
    """A capture that grabs one frame for each time that is put."""

    def __init__(self) -> None:
        self.times: queue.Queue[float | None] = queue.Queue()
        self.now_s = 0.0
        self.released = threading.Event()

    def now(self) -> float:
        return self.now_s

    def grab(self) -> bool:
        if (at_s := self.times.get()) is None:
            return False
        self.now_s = at_s
        return True

    def release(self) -> None:
        self.released.set()


def test_a_source_is_waited_for_by_the_interval_that_it_shows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    source: Any = Paced()
    reader = LiveReader(source, source, "left")
    assert reader.wait_s(2.0) == LONGEST_WAIT_S, "nothing is known of it"
    for at_s in (1.0, 2.0, 3.0):
        source.times.put(at_s)
    while reader.wait_s(2.0) != 3.0:
        time.sleep(0.001)
    # a dead source doesn't answer: it is not waited for without end
    monkeypatch.setattr("instruments.camera.opencv.CLOSE_S", 0.05)
    reader.close()
    assert not source.released.is_set()
    source.times.put(None)
    assert source.released.wait(PATIENCE_S)


def test_frames_of_a_stream_that_can_not_be_decoded_are_passed_over(tmp_path: Path) -> None:
    clock = VirtualClock()
    camera = OpenCvCamera("left", video(tmp_path / "left.avi", 40), clock)
    whole = np.frombuffer(cv2.imencode(".jpg", np.full((48, 64, 3), 9, np.uint8))[1], np.uint8)

    class Live:
        """A reader that gives these, one at each question."""

        broken = False

        def __init__(self, *came: Any) -> None:
            self.came = [*came]

        def ask(self) -> None: ...

        def wait_s(self, least_s: float) -> float:
            return least_s

        def answer(self, timeout_s: float) -> Any:
            return (self.came.pop(0), 1.0) if self.came else None

    camera._live = cast(Any, Live(whole[:30], None, whole))
    assert camera.take().passed_over == 2
    camera._live = cast(Any, Live(None, None))
    with pytest.raises(FrameError, match="no whole frame came, 2 that can't be decoded") as half:
        camera.take()
    assert half.value.fault is FrameFault.HALF
    camera._live = None
    camera.close()


def test_cameras_are_closed_side_by_side_and_errors_are_told() -> None:
    both = threading.Barrier(2)

    class Waiting(Still):
        def close(self) -> None:
            both.wait(PATIENCE_S)

    CameraSet(of(left=Waiting(), right=Waiting()), {}).close()

    def fails() -> None:
        raise LinkError("left camera", "is gone")

    with pytest.raises(LinkError, match="is gone"):
        close_within([fails], 60.0)


def test_damaged_frames_that_were_passed_over_are_told_by_camera() -> None:
    left = Still()
    left.frame = replace(left.frame, passed_over=2)
    assert CameraSet(of(left=left, right=Still()), {}).capture().passed_over == {"left": 2}


def test_a_stream_whose_picture_size_may_change_unnoticed_is_refused_unless_allowed(
    tmp_path: Path,
) -> None:
    fourcc, picture = cv2.VideoWriter.fourcc(*"MPG1"), np.full((48, 64, 3), 40, np.uint8)
    writer = cv2.VideoWriter(str(tmp_path / "s.mpg"), cv2.CAP_FFMPEG, fourcc, 25.0, (64, 48))
    for _ in range(20):
        writer.write(picture)
    writer.release()

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None: ...

    allowed = Settings(tries=frozenset({"resolution"}))
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=tmp_path)) as server:
        serving = threading.Thread(target=server.serve_forever, args=(0.01,))
        serving.start()
        url, clock = f"http://127.0.0.1:{server.server_port}/s.mpg", RealClock()
        try:
            with pytest.raises(DeviceError, match=r"size goes unnoticed.*frames of mpg1.*MJPEG"):
                OpenCvCamera("left", url, clock)
            with closing(OpenCvCamera("left", url, clock, allowed)) as camera:
                assert "picture size goes unnoticed" in camera.identity
        finally:
            server.shutdown()
            serving.join()
            clock.close()


def test_opencv_says_which_camera_does_not_open_and_lets_the_others_go(tmp_path: Path) -> None:
    closed: list[str] = []

    class Seen(Still):
        def close(self) -> None:
            closed.append("left")

    openers: Mapping[str, Any] = {
        "left": Seen,
        "right": lambda: OpenCvCamera("right", str(tmp_path / "nothing.avi"), VirtualClock()),
    }
    with pytest.raises(LinkError, match=r"right camera at .*nothing\.avi: can't be opened"):
        CameraSet(openers, {})
    assert closed == ["left"]


def test_what_a_file_cannot_be_set_to_is_an_error_unless_tried(tmp_path: Path) -> None:
    path = video(tmp_path / "left.avi", 40)
    asked = Settings(resolution=(640, 480), exposure=100.0, gain=2.0, pixel_format="YUYV")
    size = "resolution asked 640 x 480, is 64 x 48"
    wrong = rf"pixel_format asked YUYV, is MJPG; {size}; exposure asked 100, is -?\d; gain"
    with pytest.raises(DeviceError, match=wrong):
        OpenCvCamera("left", path, VirtualClock(), asked)
    tried, usual = replace(asked, tries=frozenset({"all"})), Settings((64, 48), "MJPG", fps=10.0)
    for settings, said in ((tried, size), (usual, "(FFMPEG, 64 x 48)")):
        with closing(OpenCvCamera("left", path, VirtualClock(), settings)) as camera:
            assert said in camera.identity
            assert ("asked" in camera.identity) == (settings is tried)


def test_which_sources_are_live_and_names_of_pixel_formats() -> None:
    live: set[int | str] = {0, "/dev/video0", "http://h/a.mjpg", "rtsp://h/a", "C:\\a.avi", "a.avi"}
    assert {source for source in live if not is_live(source)} == {"C:\\a.avi", "a.avi"}
    assert fourcc_name(float(cv2.VideoWriter.fourcc(*"MJPG"))) == "MJPG"
    assert fourcc_name(0.0) == fourcc_name(-1.0) == "none"


class Still:
    """A camera that always gives the same frame."""

    def __init__(self, pixels: Any = None, bits: int = 8) -> None:
        self.frame = RawFrame(np.full((4, 6), 7, np.uint8) if pixels is None else pixels, 1.0, bits)
        self.identity = "still"

    def prepare(self) -> None:
        pass

    def begin(self) -> None:
        pass

    def take(self) -> RawFrame:
        return self.frame

    def close(self) -> None:
        pass


def of(**cameras: Camera) -> dict[str, Any]:
    return {name: lambda camera=camera: camera for name, camera in cameras.items()}


def radiometric(counts: int) -> CameraSet:
    thermal = Still(np.full((3, 4), counts, np.uint16), 16)
    declared = {"thermal": Conversion(radiometry=Radiometry(0.04))}
    return CameraSet(of(left=Still(), right=Still(), thermal=thermal), declared)


def test_a_radiometric_camera_gives_temperatures_and_no_picture() -> None:
    frames = radiometric(7600).capture()
    assert frames.thermal is None
    assert np.asarray(frames.thermal_k) == pytest.approx(np.full((3, 4), 304.0))
    assert frames.exposed_s == {"left": 1.0, "right": 1.0, "thermal": 1.0}
    with pytest.raises(ProtocolError, match="kelvin_per_count or kelvin_at_zero is wrong"):
        radiometric(60000).capture()
    with pytest.raises(ValueError, match="left, right, perhaps thermal and depth, got left"):
        CameraSet(of(left=Still()), {})


# Settings that did not take, and device time on the bench's clock


TAKEN: list[tuple[object, object]] = [(8000.0, 8010.5), (0.0, 0.0), (10.0, "10"), (3, 3.0)]
TAKEN += [(True, "true"), (True, "1"), (False, "0"), ("Mono8", "mono8 "), ((640, 480), (640, 480))]
OTHER: list[tuple[object, object]] = [(8000.0, 9000.0), (10.0, "fast"), (True, "false")]
OTHER += [("Mono8", "Mono16"), ((640, 480), (640, 512))]


def test_what_counts_as_taken() -> None:
    assert [pair for pair in TAKEN if not same(*pair)] == []
    assert [pair for pair in OTHER if same(*pair)] == []


def camera(**seen: object) -> dict[str, Any]:
    """A camera that takes no setting: it has these."""
    return {name: (lambda _: None, lambda value=value: value) for name, value in seen.items()}


ASKED: dict[str, Any] = {"exposure": 8000.0, "resolution": (1360, 1024), "gain": 3.0, "fps": 10.0}


def test_all_that_did_not_take_comes_at_once_but_for_tries() -> None:
    has = camera(exposure=100.0, resolution=(640, 480), gain=0.0, fps=10.0)
    wrong = r"exposure asked 8000, is 100; resolution asked 1360 x 1024, is 640 x 480\. Ask"
    with pytest.raises(DeviceError, match=wrong):
        apply("left camera", Settings(**ASKED, tries=frozenset({"gain"})), has)
    notes = apply("left camera", Settings(**ASKED, tries=frozenset({"all"})), has)
    assert notes[2] == "gain asked 3, is 0"


def test_what_a_camera_refuses_to_take_or_to_tell_is_a_fault_too() -> None:
    def refuse(_: object = None) -> None:
        raise DeviceError("left camera", "not writable")

    ways: dict[str, Any] = {"gain": (refuse, refuse), "fps": (lambda _: None, refuse)}
    asked = Settings(gain=3.0, fps=10.0, tries=frozenset({"gain", "fps"}))
    notes = apply("left camera", asked, ways, (DeviceError,))
    assert notes == ("gain was refused: not writable", "fps can't be read back: not writable")


def test_the_least_delay_is_the_offset_until_the_clock_begins_anew() -> None:
    time = DeviceTime()
    for stamp_s, arrived_s, exposed_s in (
        (0.0, 5.0, 5.0),  # without a stamp
        (1000.0, 10.5, 10.5),  # the first: nothing better is known than its arrival
        (1001.0, 11.2, 11.2),  # came faster: 0.3 s of the first were delay
        (1002.0, 13.0, 12.2),  # came late, was exposed in time
        (3.0, 19.0, 19.0),  # its clock began again: the old offset must not be used
        (4.0, 21.0, 20.0),
    ):
        assert time.bench_s(stamp_s, arrived_s) == pytest.approx(exposed_s, abs=1e-3)


@pytest.mark.slow
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

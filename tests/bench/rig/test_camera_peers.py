"""Cameras of a rig file over real wires: streams and a radiometric GenICam camera together; a GigE
Vision camera that loses packets.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from bench.rig.frame_capture import FrameTaker
from bench.rig.model import Cameras as CamerasTable
from bench.rig.model import Checks
from bench.rig.opening import open_instruments
from instruments.camera.cameras import CameraSet
from instruments.camera.emulator import EmulatedCameras
from instruments.camera.genicam import GenicamCamera
from instruments.camera.settings import Settings
from instruments.camera.stream import StreamServer
from instruments.clock import RealClock
from tests.bench.rig.test_camera_tables import rig_of
from tests.instruments.camera.peers import ADDRESS, gige_camera, need_aravis
from tests.instruments.camera.small_world import GalleryWorld

RIG = """
[cameras]
max_skew_s = 0.5

[cameras.left]
url = "opencv:{left}"
resolution = [1360, 1024]

[cameras.right]
url = "opencv:{right}"
exposure = 100.0
try = ["exposure"]

[cameras.thermal]
url = "genicam:Fake_1"
pixel_format = "Mono16"
resolution = [160, 120]
trigger = "software"
radiometric = {{ kelvin_per_count = 0.002, kelvin_at_zero = 250.0 }}
"""


@pytest.fixture
def clock() -> Iterator[RealClock]:
    with closing(RealClock()) as real:
        yield real


def test_streams_and_a_radiometric_camera_of_one_rig_file(tmp_path: Path, clock: RealClock) -> None:
    need_aravis()
    with closing(StreamServer(EmulatedCameras(GalleryWorld(clock=clock)), clock)) as server:
        rig = rig_of(tmp_path, RIG.format(**server.urls))
        events: list[str] = []
        with open_instruments(rig, ("cameras",), clock) as devices:
            cameras = devices.cameras
            assert "exposure asked 100, is " in cameras.identity["right"]
            taker = FrameTaker(
                cameras,
                rig.rig.cameras,
                rig.calibration,
                clock.sleep,
                lambda _, text: events.append(text),
            )
            frames = taker.take()
    assert frames.left.shape == frames.right.shape == (1024, 1360)
    assert frames.thermal is None, "temperatures are all that it gives"
    assert frames.thermal_k is not None
    assert frames.thermal_k.shape == (120, 160)
    assert (
        250.0
        <= float(np.min(frames.thermal_k))
        < float(np.max(frames.thermal_k))
        <= 250.0 + 0.002 * 65535
    )


def test_lost_packets_are_taken_again_and_counted(clock: RealClock) -> None:
    """About one frame in six of the left camera comes with holes; every set that is given out is
    whole.
    """
    table = CamerasTable(
        url="emulator:",
        max_skew_s=10.0,
        retries=20,
        retry_s=0.0,
        checks=Checks(swapped=False, frozen=False),
    )
    events: list[str] = []
    with gige_camera("-r", "1"):
        openers = {
            "left": lambda: GenicamCamera("left", ADDRESS, clock, Settings(fps=100.0)),
            "right": lambda: GenicamCamera("right", "Fake_1", clock, Settings(fps=100.0)),
        }
        with closing(CameraSet(openers, {})) as cameras:
            taker = FrameTaker(
                cameras, table, None, clock.sleep, lambda _, text: events.append(text)
            )
            for _ in range(200):
                frames = taker.take()
                assert frames.left.shape == (512, 512)
                if taker.counts["left: lost packets"] >= 2:
                    break
    assert taker.counts["left: lost packets"] >= 2
    assert sum(taker.counts.values()) >= len(events) > 0
    assert (
        "left camera: lost packets: left camera genicam:127.0.0.1: a frame's buffer came with"
        " status MISSING_PACKETS" in "".join(events)
    )

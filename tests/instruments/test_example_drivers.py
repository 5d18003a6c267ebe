"""The drivers in docs/examples, each with a stand-in of the package that it is over."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from dataclasses import replace
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bench.calibrate.exchange import read_maker
from bench.config import ConfigError
from bench.testing.conformance import CHECKS, conform
from bench.testing.plugins import PluginSubject
from instruments.camera.cameras import CameraSet
from instruments.camera.frame import Conversion, FrameError, FrameFault
from instruments.clock import VirtualClock
from instruments.drivers.arm import PluggedArm
from instruments.drivers.camera import PluggedCamera, PluggedGroup
from instruments.drivers.entry_points import Kind, Plugin
from instruments.errors import DeviceError, LimitError, LinkError
from tests.conftest import ROOT

Drivers = Callable[..., Plugin]


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Drivers:
    """The class in an example, its package being a stand-in."""

    def made(file: str, name: str, modules: dict[str, Any], **keys: str) -> Plugin:
        for module, members in modules.items():
            found = ModuleType(module)
            vars(found).update(members)
            monkeypatch.setitem(sys.modules, module, found)
        return Plugin(
            name, file, runpy.run_path(str(ROOT / "docs" / "examples" / file))[name], keys
        )

    return made


def passes(kind: Kind, plugged: Plugin) -> None:
    """What the suite can ask of a stand-in: no link that can be cut, no late answer."""
    clock = VirtualClock()
    found = list(conform(lambda: PluginSubject(kind, plugged, clock, works=True), CHECKS))
    passed = {"says who", "safe twice", "closes twice"}
    for one in found:
        beginning = " ".join(one.check.split()[:2])
        assert one.outcome == ("passed" if beginning in passed else "not checked"), one


class MissingError(Exception):
    """The stand-ins' time-out."""


class Acquirer:
    """A camera of 12 bits; ``lost``: its cable is out."""

    lost = silent = False
    stale = fetched = 0

    def __init__(self) -> None:
        self.asked: list[str] = []
        names = "DeviceVendorName DeviceModelName PixelFormat ExposureTime Gain ExposureAuto"
        names += " TriggerSelector TriggerMode TriggerSource"
        nodes = SimpleNamespace(**{name: SimpleNamespace(value=name) for name in names.split()})
        nodes.TriggerSoftware = SimpleNamespace(execute=lambda: self.asked.append("exposed"))
        self.remote_device = SimpleNamespace(node_map=nodes)

    def start(self) -> None: ...
    def stop(self) -> None: ...
    def destroy(self) -> None: ...

    def try_fetch(self, timeout: float) -> Any:
        if not self.stale:
            return None
        self.stale -= 1
        return SimpleNamespace(queue=lambda: self.asked.append("dropped"))

    def fetch(self, timeout: float) -> Any:
        if self.silent:
            raise MissingError
        if self.lost:
            raise sys.modules["genicam.gentl"].GenericException("device lost")
        self.fetched += 1
        image = np.arange(6, dtype=np.uint16) * 800
        image[-1] += self.fetched % 2  # noise
        part = SimpleNamespace(data_format="Mono12", height=2, width=3, data=image)
        buffer = SimpleNamespace(payload=SimpleNamespace(components=[part]))
        return _Fetched(buffer)


class _Fetched:
    def __init__(self, buffer: Any) -> None:
        self.buffer = buffer

    def __enter__(self) -> Any:
        return self.buffer

    def __exit__(self, *_: object) -> None: ...


def test_a_camera_over_harvesters(driver: Drivers) -> None:
    device = Acquirer()
    harvester = SimpleNamespace(
        add_file=lambda cti: None,
        update=lambda: None,
        create=lambda key: device,
        reset=lambda: None,
    )
    generic = type("GenericException", (Exception,), {})
    modules = {
        "genicam": {},
        "genicam.gentl": {"GenericException": generic, "TimeoutException": MissingError},
        "harvesters": {},
        "harvesters.core": {"Harvester": lambda: harvester},
    }
    keys = {"cti": "a.cti", "serial": "7", "pixel_format": "Mono12", "exposure_us": "900"}
    plugged = driver("harvesters_camera.py", "HarvestersCamera", modules, **keys)
    passes("camera", plugged)
    camera = PluggedCamera(plugged, "left", VirtualClock())
    device.asked.clear()
    device.stale = 2
    camera.prepare()
    camera.begin()
    frame = camera.take()
    assert device.asked == ["dropped", "dropped", "exposed"]
    assert frame.bits == 12
    assert Conversion().picture(frame).tolist() == [[0, 50, 100], [149, 199, 249]]
    assert device.remote_device.node_map.ExposureTime.value == 900.0
    device.silent = True
    with pytest.raises(FrameError) as none:
        camera.take()
    assert none.value.fault is FrameFault.DROPPED
    device.silent, device.lost = False, True
    with pytest.raises(LinkError, match="device lost"):
        camera.take()


class Pipeline:
    """Three pictures of one device; ``late_ms``: of its depth picture."""

    there, late_ms, waiting, seen = True, 0.0, 3, 0

    columns = 6

    def start(self, _: object) -> Any:
        return SimpleNamespace(get_device=lambda: self, get_stream=self.stream)

    def stream(self, *which: object) -> Any:
        """Rectified: the right imager stands 50 mm to the right of the left one."""
        lens = SimpleNamespace(width=self.columns, height=4, fx=5.0, fy=5.0, ppx=2.5, ppy=1.5)
        lens.coeffs = [0.0] * 5
        way = SimpleNamespace(rotation=np.eye(3).ravel(), translation=[-0.05, 0.0, 0.0])
        none = SimpleNamespace(rotation=np.eye(3).ravel(), translation=[0.0] * 3)
        return SimpleNamespace(
            as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: lens),
            get_extrinsics_to=lambda other: way if other.which[1:] == (2,) else none,
            which=which,
        )

    def first_depth_sensor(self) -> Any:
        return SimpleNamespace(set_option=lambda *_: None, get_depth_scale=lambda: 0.001)

    def get_info(self, key: str) -> str:
        return {"serial": "0123"}.get(key, key)

    def poll_for_frames(self) -> bool:
        self.waiting -= 1
        return self.waiting > 0

    def wait_for_frames(self, _: int) -> Any:
        if not self.there:
            raise RuntimeError("Frame didn't arrive within 2000")
        return self

    def frame(self, pixels: Any, late_ms: float = 0.0) -> Any:
        self.seen += 1
        pixels[-1, -1] += self.seen % 2  # noise
        return SimpleNamespace(get_data=lambda: pixels, get_timestamp=lambda: 100.0 + late_ms)

    def get_infrared_frame(self, number: int) -> Any:
        return self.frame(np.full((4, 6), 10 * number, np.uint8))

    def get_depth_frame(self) -> Any:
        return self.frame(np.full((4, 6), 650, np.uint16), self.late_ms)

    def stop(self) -> None: ...


def test_a_group_of_a_realsense(driver: Drivers) -> None:
    device, devices = Pipeline(), [Pipeline()]
    names = "infrared depth y8 z16 emitter_enabled enable_auto_exposure exposure name"
    names += " firmware_version"
    words = SimpleNamespace(serial_number="serial", **{name: name for name in names.split()})
    config = SimpleNamespace(enable_device=lambda _: None, enable_stream=lambda *_: None)
    rs = {
        **dict.fromkeys(("stream", "format", "option", "camera_info"), words),
        "config": lambda: config,
        "pipeline": lambda: device,
        "context": lambda: SimpleNamespace(query_devices=lambda: devices),
    }
    plugged = driver("realsense_group.py", "RealSense", {"pyrealsense2": rs}, serial="0123")
    passes("camera", plugged)
    clock = VirtualClock()
    cameras = CameraSet({}, {}, lambda: PluggedGroup(plugged, clock))
    frames = cameras.capture()
    assert frames.left[0, 0] == 10
    assert frames.right[0, 0] == 20
    assert frames.depth_mm is not None
    assert frames.depth_mm[0, 0] == 650.0
    assert "0123" in cameras.identity["depth"]
    stated = cameras.makers_calibration()
    assert stated is not None
    sizes = dict.fromkeys(("left", "right", "depth"), (6, 4))
    part = read_maker(stated, sizes, "RealSense")
    assert part.left is not None
    assert part.left.fc == (5.0, 5.0)
    assert part.right_from_left is not None
    assert part.right_from_left.T.tolist() == [-50.0, 0.0, 0.0]
    assert part.depth_from_left is not None
    assert part.depth_from_left.T.tolist() == [0.0, 0.0, 0.0]
    assert part.covariance is None
    with_sd = replace(stated, sd={"left fx": 0.5, "stereo T1": 0.02})
    covariance = read_maker(with_sd, sizes, "RealSense").covariance
    assert covariance is not None
    assert covariance.sd("stereo", "T1") == 0.02
    with pytest.raises(ConfigError, match="sd can't be: no such parameter: left f"):
        read_maker(replace(stated, sd={"left f": 0.5}), sizes, "RealSense")
    device.columns = 7
    failed = next(conform(lambda: PluginSubject("camera", plugged, clock, works=True)))
    assert failed.outcome == "failed"
    assert "its maker's lenses are of {'left': (7, 4)" in failed.why
    device.columns = 6
    device.late_ms = 30.0
    with pytest.raises(FrameError, match="beside the left picture"):
        cameras.capture()
    device.there = False
    with pytest.raises(FrameError, match="no frame came"):
        cameras.capture()
    devices.clear()
    with pytest.raises(LinkError):
        cameras.capture()
    with pytest.raises(LinkError, match="0123 is not connected"):
        PluggedGroup(plugged, clock)


class Robot:
    """A UR before a plane at ``contact_mm``, which it touches from above."""

    def __init__(self) -> None:
        self.pose, self.speed = np.array([0.1, 0.2, 0.3, np.pi, 0.0, 0.0]), np.zeros(6)
        self.mode = 1
        self.contact_mm, self.linked, self.stopped = 120.0, True, 0

    def getActualTCPPose(self) -> list[float]:  # noqa: N802 - RTDE's names
        return list(self.pose.tolist())

    def getActualTCPSpeed(self) -> list[float]:  # noqa: N802
        return list(self.speed.tolist())

    def getSafetyMode(self) -> int:  # noqa: N802
        return self.mode

    def isConnected(self) -> bool:  # noqa: N802
        return self.linked

    def isPoseWithinSafetyLimits(self, pose: list[float]) -> bool:  # noqa: N802
        return bool(np.linalg.norm(pose[:3]) < 0.9)

    def moveL(self, pose: list[float], _speed: float, _acceleration: float) -> bool:  # noqa: N802
        self.pose = np.array(pose)
        return True

    def moveUntilContact(self, velocity: list[float]) -> bool:  # noqa: N802
        assert velocity[2] < 0.0
        self.pose[2] = self.contact_mm / 1000.0
        return True

    def stopL(self, _: float) -> None:  # noqa: N802
        self.stopped += 1

    def stopScript(self) -> None: ...  # noqa: N802
    def disconnect(self) -> None: ...


def test_an_arm_that_touches_by_itself_over_rtde(driver: Drivers) -> None:
    robot = Robot()
    modules = {
        "rtde_control": {"RTDEControlInterface": lambda _: robot},
        "rtde_receive": {"RTDEReceiveInterface": lambda _: robot},
    }
    plugged = driver("ur_rtde_arm.py", "UrArm", modules, host="robot")
    passes("arm", plugged)
    arm = PluggedArm(plugged, VirtualClock())
    arm.sign_on()
    up = np.array([0.0, 0.0, 1.0])
    with pytest.raises(LimitError, match="before homing"):
        arm.touch(np.array([50.0, 60.0, 118.0]), up)
    arm.confirm_homed()
    arm.touch(np.array([50.0, 60.0, 118.0]), up)
    reading = arm.read(4)
    assert reading.tip_mm == pytest.approx([50.0, 60.0, 120.0])
    assert reading.axis == pytest.approx(up)
    assert not arm.moves
    with pytest.raises(DeviceError, match="touched nothing"):
        arm.touch(np.array([50.0, 60.0, 140.0]), up)
    assert robot.stopped
    with pytest.raises(LimitError, match="safety limits"):
        arm.touch(np.array([900.0, 600.0, 118.0]), up)
    robot.mode = 3
    with pytest.raises(DeviceError, match="safety mode 3"):
        arm.touch(np.array([50.0, 60.0, 118.0]), up)
    robot.speed[0] = 0.1
    with pytest.raises(DeviceError, match="does not stand"):
        arm.safe()
    arm.confirm_homed()  # of the link that the second try has opened
    robot.linked = False
    with pytest.raises(LinkError, match="the link is lost"):
        arm.read()

"""GenICam cameras: the driver against two cameras that share no code with it, one over GigE Vision,
one in this process.
"""

from __future__ import annotations

import importlib
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import astuple, replace
from functools import wraps
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from instruments.camera.closing import close_within
from instruments.camera.frame import Conversion, FrameError, FrameFault, Radiometry, RawFrame
from instruments.camera.genicam import (
    AUTOMATIC,
    PTP,
    DeviceTime,
    GenicamCamera,
    _of_parts,
    load_aravis,
)
from instruments.camera.pixel_formats import FORMATS
from instruments.camera.radiometric import PROFILES
from instruments.camera.settings import Settings, Trigger
from instruments.clock import RealClock
from instruments.errors import DeviceError, InstrumentError, LinkError
from tests.instruments.camera.peers import ADDRESS, gige_camera, need_aravis
from tests.waiting import PATIENCE_S

IN_PROCESS = "Fake_1"


@pytest.fixture
def aravis() -> Any:
    need_aravis()
    return load_aravis()


def opened(device: str, clock: RealClock, **asked: Any) -> closing[GenicamCamera]:
    return closing(GenicamCamera("left", device, clock, Settings(**asked)))


def whole(camera: GenicamCamera) -> RawFrame:
    """The next frame that comes whole. A busy machine loses packets on its own loopback too, and
    the camera's answers come too late.
    """
    for _ in range(40):
        try:
            camera.begin()
            return camera.take()
        except InstrumentError as error:
            late = isinstance(error, FrameError | LinkError) or "timeout" in str(error).lower()
            if not late:
                raise
    raise StarvedError("none of 40 frames came whole")


class StarvedError(Exception):
    """A camera that lost sight of us, or we of it, since neither got the processor for seconds."""


def again_where_starved(test: Callable[..., None]) -> Callable[..., None]:
    """The whole test once more, up to twice, with cameras opened anew."""

    @wraps(test)
    def tried(*given: Any, **named: Any) -> None:
        for _ in range(2):
            with suppress(StarvedError):
                return test(*given, **named)
        return test(*given, **named)

    return tried


@pytest.mark.slow
@again_where_starved
def test_over_gige_vision_everything_that_is_asked_for_is_read_back(clock: RealClock) -> None:
    asked: dict[str, Any] = {"pixel_format": "Mono16", "resolution": (256, 128)}
    asked |= {"exposure": 5000.0, "gain": 3.0, "fps": 50.0}
    features = {"TriggerSelector": "FrameStart", "GevSCPSPacketSize": 1400}
    with (
        gige_camera() as serial,
        opened(ADDRESS, clock, **asked, features=features, trigger="software") as camera,
    ):
        assert camera.identity == f"Aravis Fake {serial} (256 x 128, Mono16)"
        times = []
        for _ in range(4):
            frame = whole(camera)
            assert (frame.pixels.shape, frame.bits) == ((128, 256), 16)
            assert frame.pixels.dtype == "uint16"
            times.append(frame.exposed_s)
            assert frame.exposed_s <= clock.now()
        assert times == sorted(set(times)), "the camera's own stamps go on"


@pytest.mark.slow
@again_where_starved
def test_one_of_this_machine_by_name_open_already_and_without_its_trigger(clock: RealClock) -> None:
    with gige_camera() as serial:
        with opened(f"Aravis-Fake-{serial}", clock) as camera:
            already = r"right camera .*: it is open already, here or .* Is it twice"
            with pytest.raises(LinkError, match=already):
                GenicamCamera("right", ADDRESS, clock)
            assert whole(camera).pixels.shape == (512, 512), "the first one goes on"
        asked = Settings(trigger="hardware", trigger_source="Line0")
        camera = GenicamCamera("thermal", ADDRESS, clock, asked, timeout_s=0.3)
        camera.begin()
        never = r"no frame came .*after 0\.3 s\)\. Did its trigger come\?"
        with pytest.raises(FrameError, match=never) as error:
            camera.take()
        assert (error.value.fault, error.value.camera) == (FrameFault.DROPPED, "thermal")
        camera.close()
        camera.close()
        with pytest.raises(LinkError, match="is closed"):
            camera.begin()


class Buffers:
    """A stream whose buffers come with these statuses, and then none."""

    def __init__(self, camera: GenicamCamera, *statuses: str) -> None:
        self.stream, self.left = camera._stream, list(statuses)

    def timeout_pop_buffer(self, timeout_us: int) -> Any:
        if not self.left:
            return None
        status = SimpleNamespace(value_nick=self.left.pop(0))
        buffer = None
        while buffer is None or buffer.get_status().value_nick != "success":
            buffer = self.stream.timeout_pop_buffer(10_000_000)
        return buffer if status.value_nick == "success" else Damaged(buffer, status)

    def push_buffer(self, buffer: Any) -> None:
        self.stream.push_buffer(getattr(buffer, "real", buffer))

    def try_pop_buffer(self) -> None: ...


class Damaged:
    def __init__(self, real: Any, status: Any) -> None:
        self.real, self.get_status = real, lambda: status


@pytest.mark.slow
def test_what_damaged_frames_are_called_and_when_the_hint_is_given(
    aravis: Any, clock: RealClock
) -> None:
    with closing(GenicamCamera("left", IN_PROCESS, clock, timeout_s=60.0)) as camera:
        real = camera._stream
        unfilled = ("cleared", "aborted", "filling", "unknown")
        camera._stream = Buffers(camera, "missing-packets", *unfilled, "timeout", "success")
        camera.begin()
        assert camera.take().passed_over == 2
        lost = r"no whole frame came, 2 with damage, the last .*Raise the socket's buffer"
        for statuses, fault, said in (
            (("timeout", "missing-packets"), FrameFault.LOST_PACKETS, lost),
            (("missing-packets", "timeout", "aborted"), FrameFault.LOST_PACKETS, lost),
            (unfilled, FrameFault.DROPPED, r"no frame came .*Check cable, power"),
        ):
            camera._stream = Buffers(camera, *statuses)
            camera._stream.stream = real
            camera.begin()
            with pytest.raises(FrameError, match=said) as caught:
                camera.take()
            assert caught.value.fault is fault
        camera._stream = real


def test_a_slow_camera_is_waited_for(aravis: Any, clock: RealClock) -> None:
    for fps, wait_s in ((1.0, 3.0), (25.0, 2.0)):
        with opened(IN_PROCESS, clock, fps=fps) as camera:
            assert camera._wait_s == pytest.approx(wait_s)


@pytest.mark.slow
@pytest.mark.parametrize("gige", [False, True])
@again_where_starved
def test_regions_and_pixel_formats_set_behind_its_back_are_noticed_and_opened_anew(
    aravis: Any, clock: RealClock, gige: bool
) -> None:
    """Larger frames than the buffers come as damaged, or over GigE Vision not at all."""
    with ExitStack() as stack:
        device = IN_PROCESS
        if gige:
            stack.enter_context(gige_camera())
            device = ADDRESS

        def deepen(camera: GenicamCamera) -> None:
            camera._camera.set_pixel_format_from_string("Mono16")

        with closing(GenicamCamera("left", device, clock)) as camera:
            for region in ((16, 8, 512, 512), (0, 0, 1024, 1024), (0, 0, 64, 48)):
                camera._camera.set_region(*region)
                until(camera, "wrong size", "half a frame")
                assert whole(camera).pixels.shape == (512, 512), "as it was opened first"
                assert camera._camera.get_region().x == 0
            deepen(camera)
            until(camera, "wrong size", "half a frame")
            now = whole(camera).pixels.dtype
            assert camera.identity.endswith("Mono16)" if now == "uint16" else "Mono8)")
            assert not gige or now == "uint16", "nothing is asked for, so it is as it was set"
        with opened(device, clock, pixel_format="Mono8") as camera:
            deepen(camera)
            until(camera, "wrong size", "half a frame")
            assert whole(camera).pixels.dtype == "uint8", "as the rig file asks"


def until(camera: GenicamCamera, *faults: str) -> str:
    """The outcome that begins so. Before, a frame that was under way may come, or packets be lost."""
    for _ in range(40):
        if (said := outcome(camera)).startswith(faults):
            return said
    pytest.fail(f"none of 40 frames was {faults}")


def test_a_dead_camera_is_let_go_in_bounded_time(
    aravis: Any, clock: RealClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers, gone = threading.Event(), threading.Event()
    camera = GenicamCamera("left", IN_PROCESS, clock)
    real = camera._camera

    class Dead:
        def stop_acquisition(self) -> None:
            answers.wait()
            real.stop_acquisition()
            gone.set()

    camera._camera = Dead()
    monkeypatch.setattr(close_within, "__defaults__", (0.05,))
    camera.close()  # comes back though the camera has not answered
    camera.close()
    with pytest.raises(LinkError, match="is closed"):
        camera.begin()
    answers.set()
    assert gone.wait(PATIENCE_S)


@pytest.mark.slow
@pytest.mark.parametrize("trigger", ["free", "software"])
@again_where_starved
def test_one_that_lost_control_says_so_and_is_opened_again(
    clock: RealClock, trigger: Trigger
) -> None:
    with gige_camera():
        # a frame fits into the socket's buffer, however long the reader waits for the processor
        small = Settings(trigger=trigger, resolution=(256, 128), pixel_format="Mono8")
        camera = GenicamCamera("left", ADDRESS, clock, small, timeout_s=0.5)
        whole(camera)
        camera.glance()
    with gige_camera():  # as after its power was off: it knows nobody any more
        while "no longer under this program's control" not in (said := outcome(camera)):
            pass
        assert "opened again" in said
        assert whole(camera).pixels.shape == (128, 256)
        camera.close()


def outcome(camera: GenicamCamera) -> str:
    """What became of the next frame."""
    try:
        camera.begin()
        camera.take()
    except FrameError as error:
        return f"{error.fault}: {error}"
    except LinkError as error:
        return str(error)
    return "whole"


def test_settings_that_do_not_take(aravis: Any, clock: RealClock) -> None:
    refused = (
        r"not take: pixel_format was refused: .*Mono12p.*; TrigerMode was refused: .*did you mean"
    )
    with pytest.raises(DeviceError, match=refused):
        opened(IN_PROCESS, clock, pixel_format="Mono12p", features={"TrigerMode": "On"})
    features = {"ExposureTimeAbs": 20000.0, "Nonsense": 3}
    at_odds: dict[str, Any] = {"exposure": 5000.0, "features": features}
    # one setting undid another
    with pytest.raises(DeviceError, match=r"Nonsense was refused.*exposure asked 5000, is 20000"):
        opened(IN_PROCESS, clock, **at_odds)
    with opened(IN_PROCESS, clock, **at_odds, tries=frozenset({"exposure", "Nonsense"})) as camera:
        assert "exposure asked 5000, is 20000" in camera.identity


@pytest.mark.slow
def test_a_camera_that_is_not_there(aravis: Any, clock: RealClock) -> None:
    said = r"left camera genicam:nobody: can't be opened: .*Cameras that answer: "
    with pytest.raises(LinkError, match=said):
        GenicamCamera("left", "nobody", clock)


def test_without_the_library_it_is_said_what_to_install(
    monkeypatch: pytest.MonkeyPatch, clock: RealClock
) -> None:
    real: Any = importlib.import_module

    def without(name: str, package: str | None = None) -> Any:
        if name == "gi":
            raise ImportError("No module named 'gi'")
        return real(name, package)

    monkeypatch.setattr(importlib, "import_module", without)
    said = r"No module named 'gi'\. Install Aravis .*apt install gir1\.2-aravis-0\.8.*teatbench\[genicam\]"
    with pytest.raises(DeviceError, match=said):
        GenicamCamera("left", IN_PROCESS, clock)


def test_a_camera_that_refuses_when_it_is_opened_again_is_tried_once_more(
    aravis: Any, clock: RealClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> tuple[str, ...]:
        raise DeviceError("left", "it refused: timeout")

    with closing(GenicamCamera("left", IN_PROCESS, clock)) as camera:
        camera._wait_s = 0.0
        with monkeypatch.context() as another_program:
            another_program.setattr("instruments.camera.genicam._controls", lambda _: False)
            with pytest.raises(LinkError, match="no longer under this program's control"):
                camera.glance()
            assert "no longer under this program's control" in outcome(camera)
        with monkeypatch.context() as busy:
            busy.setattr("instruments.camera.genicam.apply", refuse)
            with pytest.raises(DeviceError, match="it refused"):
                camera.begin()
        camera.begin()
        assert "Fake" in camera.identity


# A camera with automatic functions, temperatures and a shutter: the library's, described otherwise

REGISTER_XML = """
<IntReg Name="{name}Register" NameSpace="Custom">
  <Address>{address}</Address><Length>4</Length><AccessMode>RW</AccessMode>
  <pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess>
</IntReg>"""
SWITCH_XML = """
<Enumeration Name="{name}" NameSpace="Standard">
  <EnumEntry Name="{on}" NameSpace="Standard"><Value>0</Value></EnumEntry>
  <EnumEntry Name="{off}" NameSpace="Standard"><Value>1</Value></EnumEntry>
  <pValue>{name}{by}</pValue>
</Enumeration>
<IntSwissKnife Name="{name}Fixed" NameSpace="Custom"><Formula>0</Formula></IntSwissKnife>"""
NUC = 0x2F00
COMMAND_XML = """
<Command Name="NUCAction" NameSpace="Custom">
  <pValue>NUCRegister</pValue><CommandValue>7</CommandValue>
</Command>""" + REGISTER_XML.format(name="NUC", address=hex(NUC))


def switch(name: str, on: str, off: str, *, address: int = 0x2000, by: str = "Register") -> str:
    """A feature of two words that is ``on``."""
    register = REGISTER_XML.format(name=name, address=hex(address))
    return SWITCH_XML.format(name=name, on=on, off=off, by=by) + register


Describe = Callable[..., None]


@pytest.fixture
def describe(aravis: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Describe]:
    """What gives the camera in this process further features, from then on: its own description is
    put back at the end. ``renamed``: what is replaced in it. The library reads the last file again.
    """
    folder = tmp_path_factory.mktemp("described")
    aravis.enable_interface("Fake")
    plain = str(aravis.Camera.new(IN_PROCESS).get_device().get_genicam_xml()[0])
    numbers = count()

    def described(features: str = "", renamed: tuple[str, str] = ("", "")) -> None:
        text = re.sub(*renamed, plain, flags=re.DOTALL) if renamed[0] else plain
        path = folder / f"{next(numbers)}.xml"
        path.write_text(text.replace("<StringReg", f"{features}<StringReg", 1), encoding="utf-8")
        aravis.set_fake_camera_genicam_filename(str(path))

    yield described
    described()


# the library's camera has one of its own, which is off
OWN_GAIN_AUTO = r'<Enumeration Name="GainAuto".*?</Enumeration>.*?</IntReg>', ""


@pytest.mark.parametrize("name", AUTOMATIC)
def test_each_automatic_function_is_switched_off_or_told(
    describe: Describe, clock: RealClock, name: str
) -> None:
    instead = OWN_GAIN_AUTO if name == "GainAuto" else ("", "")
    describe(switch(name, "Continuous", "Off"), instead)
    with opened(IN_PROCESS, clock, auto=True) as camera:
        assert f"automatic functions are on: {name} Continuous" in camera.identity
    with opened(IN_PROCESS, clock) as camera:
        assert "automatic" not in camera.identity
        node = camera._camera.get_device().get_feature(name)
        assert node.get_value_as_string() == "Off"
    describe(switch(name, "Continuous", "Off", by="Fixed"), instead)
    with pytest.raises(DeviceError, match=f"be switched off: {name} Continuous.*auto = true"):
        opened(IN_PROCESS, clock)


FLIR = [name for name in PROFILES if name.startswith("flir-")]


@pytest.mark.parametrize("name", FLIR)
@again_where_starved
def test_temperatures_and_shutter_of_a_flir(
    describe: Describe, clock: RealClock, name: str
) -> None:
    profile = PROFILES[name]
    features = [
        switch(one, "No", str(value), address=0x2000 + 4 * i)
        for i, (one, value) in enumerate(profile.features.items())
    ]
    describe("".join(features) + COMMAND_XML)
    asked: dict[str, Any] = {
        "pixel_format": "Mono16",  # the library's camera has no Mono14
        "features": profile.features,
        "shutter": profile.shutter,
        "shutter_s": 0.0,
        "counts": True,
    }
    with opened(IN_PROCESS, clock, **asked) as camera:
        device = camera._camera.get_device()
        for one, value in profile.features.items():
            assert device.get_feature(one).get_value_as_string() == value
        device.write_register(NUC, 0)
        camera.prepare()
        assert device.read_register(NUC) == 7, "the shutter was told to close"
        frame = whole(camera)
        declared = Conversion(radiometry=Radiometry(profile.kelvin_per_count))
        assert frame.bits == 16
        warm = np.full_like(frame.pixels, round(300.0 / profile.kelvin_per_count))
        assert declared.temperatures(replace(frame, pixels=warm)).dtype == "uint16"
    with (
        opened(IN_PROCESS, clock, shutter="NoSuchCommand") as camera,
        pytest.raises(LinkError, match=r"did not close its shutter.*Correct shutter"),
    ):
        camera.prepare()


NUMBER_XML = '<Float Name="{0}" NameSpace="Standard"><Value>{1}</Value></Float>'
WORD_XML = """<Enumeration Name="{0}" NameSpace="Standard">
  <EnumEntry Name="{1}" NameSpace="Standard"><Value>1</Value></EnumEntry><Value>1</Value>
</Enumeration>"""
FLAG_XML = '<Boolean Name="{0}"><Value>{1}</Value></Boolean>'
SCAN3D = {
    "Scan3dCoordinateSelector": (WORD_XML, "CoordinateC"),
    "Scan3dOutputMode": (WORD_XML, "CalibratedC"),
    "Scan3dDistanceUnit": (WORD_XML, "Inch"),
    "Scan3dCoordinateScale": (NUMBER_XML, 0.01),
    "Scan3dCoordinateOffset": (NUMBER_XML, 2.0),
    "Scan3dInvalidDataFlag": (FLAG_XML, 1),
    "Scan3dInvalidDataValue": (NUMBER_XML, 7.0),
}


def scans(**changed: str) -> str:
    said = {name: (WORD_XML, word) for name, word in changed.items()}
    return "".join(xml.format(name, value) for name, (xml, value) in (SCAN3D | said).items())


# the camera sends Coord3D_C16, but its payload bears the code of Mono16, the same bytes: it fills no
# other of 16 bits
DEEP = 'Name="Mono16"', 'Name="Coord3D_C16"'


@again_where_starved
def test_a_depth_camera_says_what_its_counts_are(describe: Describe, clock: RealClock) -> None:
    describe(scans(), DEEP)
    asked: dict[str, Any] = {"pixel_format": "Coord3D_C16", "resolution": (64, 48), "depth": True}
    with opened(IN_PROCESS, clock, **asked) as camera:
        assert "(64 x 48, Coord3D_C16)" in camera.identity
        frame = whole(camera)
    assert (frame.pixels.shape, frame.bits) == ((48, 64), 16)
    assert frame.ranging is not None
    assert astuple(frame.ranging) == pytest.approx((0.254, 50.8, 7.0))
    tenths, _ = Conversion().depth(frame)
    expected = np.rint(508.0 + 2.54 * frame.pixels)
    kept = (frame.pixels != 7) & (expected <= 65535)
    assert np.array_equal(tenths, np.where(kept, expected, 0))
    for name, word in (
        ("Scan3dOutputMode", "DisparityC"),
        ("Scan3dCoordinateSystem", "Spherical"),
        ("Scan3dDistanceUnit", "Pixel"),
    ):
        describe(scans(**{name: word}), DEEP)
        with pytest.raises(DeviceError, match=f"no depth along its axis: {name} is {word}"):
            opened(IN_PROCESS, clock, **asked)
    describe()  # one that says nothing leaves it to the rig file
    with opened(IN_PROCESS, clock, depth=True) as camera:
        assert whole(camera).ranging is None


class Parts:
    """A payload of several parts as the library hands it over; no camera was there to send one."""

    def __init__(self, *parts: tuple[str, Any]) -> None:
        self.sent = [(next(f.code for f in FORMATS if f.name == name), a) for name, a in parts]

    def __getattr__(self, name: str) -> Any:
        which = name.removeprefix("get_part_")
        return lambda part=0: {
            "get_n_parts": len(self.sent),
            "pixel_format": self.sent[part][0],
            "width": self.sent[part][1].shape[1],
            "height": self.sent[part][1].shape[0],
            "padding": SimpleNamespace(x_padding=0),
            "data": self.sent[part][1].tobytes(),
        }[which]


def test_of_several_parts_distances_and_amplitude_are_taken() -> None:
    deep = np.arange(6, dtype=np.float32).reshape(2, 3)
    small, strength = np.zeros((1, 2), np.uint8), np.full((2, 3), 9, np.uint16)
    sent = ("Mono8", small), ("Coord3D_C32f", deep), ("Mono16", strength), ("Confidence8", small)
    (pixels, bits), amplitude = _of_parts(Parts(*sent))
    assert (pixels.tolist(), bits) == (deep.tolist(), 32)
    assert np.array_equal(np.asarray(amplitude), strength)
    assert _of_parts(Parts(*sent[:2]))[1] is None
    with pytest.raises(ValueError, match=r"no part is a distance .*: it sent Mono8, Mono16"):
        _of_parts(Parts(sent[0], sent[2]))


@pytest.mark.parametrize(("enable", "status"), PTP)
def test_clocks_that_ptp_keeps_in_step_are_waited_for_and_told(
    describe: Describe, clock: RealClock, enable: str, status: str
) -> None:
    with pytest.raises(DeviceError, match=r"offers no PTP.*Leave ptp out"):
        opened(IN_PROCESS, clock, ptp=True)
    # written with 1, its status becomes the second word
    describe(f"""<Boolean Name="{enable}"><pValue>{status}Register</pValue><OnValue>1</OnValue>
        <OffValue>0</OffValue></Boolean>{switch(status, "Listening", "Slave")}""")
    with opened(IN_PROCESS, clock, ptp=True) as camera:
        assert camera.identity.endswith("; PTP Slave")


def test_clocks_in_step_tell_the_skew_by_their_stamps() -> None:
    """Two cameras that expose 3 ms apart, and whose frames come 80 ms apart, the later one first."""
    time = DeviceTime()
    assert time.bench_s(1000.003, 10.010) - time.bench_s(1000.0, 10.090) == pytest.approx(
        0.003, abs=1e-4
    )

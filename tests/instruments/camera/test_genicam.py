"""GenICam cameras: the driver against two cameras that share no code with it, one over GigE Vision,
one in this process.
"""

from __future__ import annotations

import importlib
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

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

IN_PROCESS = "Fake_1"


@pytest.fixture
def clock() -> Iterator[RealClock]:
    with closing(RealClock()) as real:
        yield real


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
    tries = 40
    while True:
        tries -= 1
        try:
            camera.begin()
            return camera.take()
        except InstrumentError as error:
            late = isinstance(error, FrameError | LinkError) or "timeout" in str(error).lower()
            if not tries or not late:
                raise


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pixel_format", "kind", "bits", "dimensions"),
    [
        ("Mono8", "uint8", 8, 2),
        ("Mono16", "uint16", 16, 2),
        ("RGB8", "uint8", 8, 3),
        ("BayerRG8", "uint8", 8, 3),
    ],
)
def test_pixel_formats_of_the_camera_in_this_process(
    aravis: Any, clock: RealClock, pixel_format: str, kind: str, bits: int, dimensions: int
) -> None:
    with opened(IN_PROCESS, clock, pixel_format=pixel_format, resolution=(320, 240)) as camera:
        assert camera.identity == f"Aravis Fake 1 (320 x 240, {pixel_format})"
        frame = whole(camera)
    pixels = frame.pixels
    assert (pixels.shape[:2], pixels.ndim) == ((240, 320), dimensions)
    assert (str(pixels.dtype), frame.bits) == (kind, bits)
    assert frame.pixels.max() > frame.pixels.min()


@pytest.mark.slow
def test_over_gige_vision_everything_that_is_asked_for_is_read_back(clock: RealClock) -> None:
    asked: dict[str, Any] = {
        "pixel_format": "Mono16",
        "resolution": (256, 128),
        "exposure": 5000.0,
        "gain": 3.0,
        "fps": 50.0,
    }
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
def test_one_of_this_machine_by_name_open_already_and_without_its_trigger(clock: RealClock) -> None:
    with gige_camera() as serial:
        with opened(f"Aravis-Fake-{serial}", clock) as camera:
            already = r"right camera .*: it is open already, here or .* Is it twice"
            with pytest.raises(LinkError, match=already):
                GenicamCamera("right", ADDRESS, clock)
            assert whole(camera).pixels.shape == (512, 512), "the first one goes on"
        asked = Settings(trigger="hardware", trigger_source="Line0")
        camera = GenicamCamera("thermal", ADDRESS, clock, asked, patience_s=0.3)
        camera.begin()
        never = r"no frame came .*after 0\.3 s\)\. Did its trigger come\?"
        with pytest.raises(FrameError, match=never) as error:
            camera.take()
        assert (error.value.fault, error.value.camera) == (FrameFault.DROPPED, "thermal")
        camera.close()
        camera.close()
        with pytest.raises(LinkError, match="is closed"):
            camera.begin()


@pytest.mark.slow
def test_lost_packets_are_reported_and_the_next_frame_is_whole(clock: RealClock) -> None:
    """One packet in a thousand is lost, and a frame has some 190: about one frame in six comes with
    holes.
    """
    seen: Counter[str] = Counter()
    with gige_camera("-r", "1"), opened(ADDRESS, clock, fps=100.0) as camera:
        for _ in range(300):
            seen[outcome(camera).split(":")[0]] += 1
            if min(seen["lost packets"], seen["whole"]) >= 3:
                break
    assert min(seen["lost packets"], seen["whole"]) >= 3


@pytest.mark.slow
@pytest.mark.parametrize("trigger", ["free", "software"])
def test_one_that_lost_control_says_so_and_is_opened_again(
    clock: RealClock, trigger: Trigger
) -> None:
    with gige_camera():
        # a frame fits into the socket's buffer, however long the reader waits for the processor
        small = Settings(trigger=trigger, resolution=(256, 128), pixel_format="Mono8")
        camera = GenicamCamera("left", ADDRESS, clock, small, patience_s=0.5)
        whole(camera)
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
    with pytest.raises(
        DeviceError,
        match=(
            r"settings did not take: pixel_format was refused: .*Mono12p.*; TrigerMode was refused:"
            r" .*did you mean"
        ),
    ):
        opened(IN_PROCESS, clock, pixel_format="Mono12p", features={"TrigerMode": "On"})
    at_odds: dict[str, Any] = {
        "exposure": 5000.0,
        "features": {"ExposureTimeAbs": 20000.0, "Nonsense": 3},
    }
    # one setting undid another
    with pytest.raises(DeviceError, match=r"Nonsense was refused.*exposure asked 5000, is 20000"):
        opened(IN_PROCESS, clock, **at_odds)
    with opened(IN_PROCESS, clock, **at_odds, tries=frozenset({"exposure", "Nonsense"})) as camera:
        assert "exposure asked 5000, is 20000" in camera.identity


@pytest.mark.slow
def test_a_camera_that_is_not_there(aravis: Any, clock: RealClock) -> None:
    with pytest.raises(
        LinkError, match=r"left camera genicam:nobody: can't be opened: .*Cameras that answer: "
    ):
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
    with pytest.raises(
        DeviceError,
        match=(
            r"No module named 'gi'\. Install Aravis .*apt install"
            r" gir1\.2-aravis-0\.8.*teatbench\[genicam\]"
        ),
    ):
        GenicamCamera("left", IN_PROCESS, clock)


def test_a_camera_that_refuses_when_it_is_opened_again_is_tried_once_more(
    aravis: Any, clock: RealClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> tuple[str, ...]:
        raise DeviceError("left", "it refused: timeout")

    with closing(GenicamCamera("left", IN_PROCESS, clock, patience_s=0.0)) as camera:
        with monkeypatch.context() as another_program:
            another_program.setattr("instruments.camera.genicam._controls", lambda _: False)
            assert "no longer under this program's control" in outcome(camera)
        with monkeypatch.context() as busy:
            busy.setattr("instruments.camera.genicam.apply", refuse)
            with pytest.raises(DeviceError, match="it refused"):
                camera.begin()
        camera.begin()
        assert "Fake" in camera.identity


# A camera with automatic functions, temperatures and a shutter: the library's, described otherwise

AUTO_XML = """
<Enumeration Name="{name}" NameSpace="Standard">
  <EnumEntry Name="{on}" NameSpace="Standard"><Value>0</Value></EnumEntry>
  <EnumEntry Name="{off}" NameSpace="Standard"><Value>1</Value></EnumEntry>
  <pValue>{name}{by}</pValue>
</Enumeration>
<IntReg Name="{name}Register" NameSpace="Custom">
  <Address>{address}</Address><Length>4</Length><AccessMode>RW</AccessMode>
  <pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess>
</IntReg>
<IntSwissKnife Name="{name}Fixed" NameSpace="Custom"><Formula>0</Formula></IntSwissKnife>
"""
COMMAND_XML = """
<Command Name="NUCAction" NameSpace="Custom">
  <pValue>NUCRegister</pValue><CommandValue>7</CommandValue>
</Command>
<IntReg Name="NUCRegister" NameSpace="Custom">
  <Address>0x2f00</Address><Length>4</Length><AccessMode>RW</AccessMode>
  <pPort>Device</pPort><Sign>Unsigned</Sign><Endianess>BigEndian</Endianess>
</IntReg>
"""


def described(
    aravis: Any, text: str, path: Path, *names: str, by: str = "Register", on: str = "Continuous"
) -> None:
    """The camera of ``text`` has the features ``names`` too, switched on, from now on."""
    nodes = [
        AUTO_XML.format(name=name, address=hex(0x2000 + 4 * i), by=by, on=on, off="Off")
        for i, name in enumerate(names)
    ]
    at = text.index("<StringReg")
    old = text.index('<Enumeration Name="GainAuto"')
    if "GainAuto" in names:  # it has one of its own, which is off
        end = text.index("</Enumeration>", old) + len("</Enumeration>")
        gone, after = text[old:end], text.index("</IntReg>", end) + len("</IntReg>")
        assert "GainAutoRegister" in gone
        text = text[:old] + text[after:]
    path.write_text(text[:at] + "".join(nodes) + COMMAND_XML + text[at:], encoding="utf-8")
    aravis.set_fake_camera_genicam_filename(str(path))


@pytest.fixture
def plain(aravis: Any, tmp_path: Path) -> Iterator[str]:
    """The description of the camera in this process, which is put back at the end."""
    aravis.enable_interface("Fake")
    text = str(aravis.Camera.new(IN_PROCESS).get_device().get_genicam_xml()[0])
    yield text
    (tmp_path / "plain.xml").write_text(text, encoding="utf-8")
    aravis.set_fake_camera_genicam_filename(str(tmp_path / "plain.xml"))


@pytest.mark.parametrize("name", AUTOMATIC)
def test_each_automatic_function_is_switched_off_or_told(
    aravis: Any, plain: str, clock: RealClock, tmp_path: Path, name: str
) -> None:
    described(aravis, plain, tmp_path / "obeys.xml", name)
    with opened(IN_PROCESS, clock, auto=True) as camera:
        assert f"automatic functions are on: {name} Continuous" in camera.identity
    with opened(IN_PROCESS, clock) as camera:
        assert "automatic" not in camera.identity
        node = camera._camera.get_device().get_feature(name)
        assert node.get_value_as_string() == "Off"
    described(aravis, plain, tmp_path / "fixed.xml", name, by="Fixed")
    with pytest.raises(DeviceError, match=f"be switched off: {name} Continuous.*auto = true"):
        opened(IN_PROCESS, clock)


FLIR = [name for name in PROFILES if name.startswith("flir-")]


@pytest.mark.parametrize("name", FLIR)
def test_temperatures_and_shutter_of_a_flir(
    aravis: Any, plain: str, clock: RealClock, tmp_path: Path, name: str
) -> None:
    profile = PROFILES[name]
    nodes = [
        AUTO_XML.format(name=one, address=hex(0x2000 + 4 * i), by="Register", on="No", off=value)
        for i, (one, value) in enumerate(profile.features.items())
    ]
    text = plain.replace("<StringReg", f"{''.join(nodes)}{COMMAND_XML}<StringReg", 1)
    (tmp_path / "flir.xml").write_text(text, encoding="utf-8")
    aravis.set_fake_camera_genicam_filename(str(tmp_path / "flir.xml"))
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
        device.write_register(0x2F00, 0)
        camera.prepare()
        assert device.read_register(0x2F00) == 7, "the shutter was told to close"
        frame = whole(camera)
        declared = Conversion(radiometry=Radiometry(profile.kelvin_per_count))
        assert frame.bits == 16
        assert declared.temperatures(replace(frame, pixels=frame.pixels // 64)).dtype == "uint16"
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


def scans(aravis: Any, plain: str, path: Path, **changed: str) -> None:
    """The camera in this process says that it sends Coord3D_C16, from now on; its payload bears the
    code of Mono16, the same bytes, for it fills no other of 16 bits.
    """
    told = "".join(xml.format(name, changed.get(name, v)) for name, (xml, v) in SCAN3D.items())
    text = plain.replace('Name="Mono16"', 'Name="Coord3D_C16"')
    path.write_text(text.replace("<StringReg", f"{told}<StringReg", 1), encoding="utf-8")
    aravis.set_fake_camera_genicam_filename(str(path))


def test_a_depth_camera_says_what_its_counts_are(
    aravis: Any, plain: str, clock: RealClock, tmp_path: Path
) -> None:
    scans(aravis, plain, tmp_path / "deep.xml")
    asked: dict[str, Any] = {"pixel_format": "Coord3D_C16", "resolution": (64, 48), "depth": True}
    with opened(IN_PROCESS, clock, **asked) as camera:
        assert "(64 x 48, Coord3D_C16)" in camera.identity
        frame = whole(camera)
    assert (frame.pixels.shape, frame.bits) == ((48, 64), 16)
    ranging = frame.ranging
    assert ranging is not None
    said = ranging.mm_per_count, ranging.mm_at_zero, ranging.none
    assert said == pytest.approx((0.254, 50.8, 7.0))
    tenths, _ = Conversion().depth(frame)
    expected = np.rint(508.0 + 2.54 * frame.pixels)
    kept = (frame.pixels != 7) & (expected <= 65535)
    assert np.array_equal(tenths, np.where(kept, expected, 0))
    for name, word in (
        ("Scan3dOutputMode", "DisparityC"),
        ("Scan3dCoordinateSystem", "Spherical"),
        ("Scan3dDistanceUnit", "Pixel"),
    ):
        scans(aravis, plain, tmp_path / f"{word}.xml", **{name: word})
        if name not in SCAN3D:
            extra = (tmp_path / f"{word}.xml").read_text(encoding="utf-8")
            extra = extra.replace("<StringReg", f"{WORD_XML.format(name, word)}<StringReg", 1)
            (tmp_path / f"{word}.xml").write_text(extra, encoding="utf-8")
            aravis.set_fake_camera_genicam_filename(str(tmp_path / f"{word}.xml"))
        with pytest.raises(DeviceError, match=f"no depth along its axis: {name} is {word}"):
            opened(IN_PROCESS, clock, **asked)
    # one that says nothing leaves it to the rig file
    aravis.set_fake_camera_genicam_filename(str(tmp_path / "plain.xml"))
    (tmp_path / "plain.xml").write_text(plain, encoding="utf-8")
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


@pytest.mark.parametrize("enable", ["PtpEnable", "GevIEEE1588"])
def test_clocks_that_ptp_keeps_in_step_are_waited_for_and_told(
    aravis: Any, plain: str, clock: RealClock, tmp_path: Path, enable: str
) -> None:
    with pytest.raises(DeviceError, match=r"offers no PTP.*Leave ptp out"):
        opened(IN_PROCESS, clock, ptp=True)
    switch = f"""
<Boolean Name="{enable}"><pValue>PtpRegister</pValue><OnValue>1</OnValue><OffValue>0</OffValue>
</Boolean>
<IntReg Name="PtpRegister"><Address>0x2e00</Address><Length>4</Length>
  <AccessMode>RW</AccessMode><pPort>Device</pPort><Sign>Unsigned</Sign>
  <Endianess>BigEndian</Endianess></IntReg>
"""
    status = dict(PTP)[enable]
    state = AUTO_XML.format(
        name=status, address="0x2e00", by="Register", on="Listening", off="Slave"
    )
    text = plain.replace("<StringReg", f"{switch}{state}<StringReg", 1)
    (tmp_path / "ptp.xml").write_text(text, encoding="utf-8")
    aravis.set_fake_camera_genicam_filename(str(tmp_path / "ptp.xml"))
    with opened(IN_PROCESS, clock, ptp=True) as camera:
        assert camera.identity.endswith("; PTP Slave")


def test_clocks_in_step_tell_the_skew_by_their_stamps() -> None:
    """Two cameras that expose 3 ms apart, and whose frames come 80 ms apart, the later one first."""
    time = DeviceTime()
    assert time.bench_s(1000.003, 10.010) - time.bench_s(1000.0, 10.090) == pytest.approx(
        0.003, abs=1e-4
    )

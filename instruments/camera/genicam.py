"""A GigE Vision or USB3 Vision camera, optical, radiometric or of depth, through Aravis, which is
loaded on demand. A damaged buffer is never a picture: the next whole frame is taken instead, with
the count of damaged ones. Distances are as in the SFNC 2.7, 3D scan control: count x scale +
offset, in a unit.
"""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from instruments.camera.closing import close_within
from instruments.camera.frame import FrameError, FrameFault, Pixels, Ranging, RawFrame
from instruments.camera.pixel_formats import BY_CODE, unpack
from instruments.camera.settings import Settings, Value, apply, hold_still, same
from instruments.clock import Clock
from instruments.errors import DeviceError, LinkError, ProtocolError

INSTALL = (
    'Install Aravis and its Python binding: on Debian and Ubuntu "apt install gir1.2-aravis-0.8'
    ' libgirepository1.0-dev libcairo2-dev pkg-config", then "pip install \'teatbench[genicam]\'".'
)
BUFFERS = 4
TIMEOUT_S = 2.0
INTERVALS = 3.0  # a frame under way, one that may be damaged, and the one that is taken
# a buffer that came back without a frame: its stream began anew or was stopped
UNFILLED = frozenset({"UNKNOWN", "CLEARED", "FILLING", "ABORTED"})
# what a buffer's status says of its frame; any other means that none came
DAMAGED = dict.fromkeys(
    ("MISSING_PACKETS", "WRONG_PACKET_ID", "TIMEOUT"), FrameFault.LOST_PACKETS
) | {"SIZE_MISMATCH": FrameFault.HALF}
FAKE = "Fake_"  # how the library's own camera in this process is named
# of the SFNC, and one of FLIR; "Once" is on until it has ended
AUTOMATIC = ("ExposureAuto", "GainAuto", "BalanceWhiteAuto", "FocusAuto", "BlackLevelAuto")
OFF = "Off"
DRIFT = 1e-4  # two crystals of 50 ppm each
BACK_S = 1.0  # a stamp may be so much older than the last one's: of another camera, with PTP
# how to switch PTP on and what then tells its state: of the SFNC since 2.2, and before
PTP = (("PtpEnable", "PtpStatus"), ("GevIEEE1588", "GevIEEE1588Status"))
IN_STEP = ("Master", "Slave")
PTP_S = 30.0  # the longest until a clock is master or slave; a change of master takes some seconds
# distances that are a depth along the axis, and what they may be in; DisparityC and others aren't
DEPTHS, SYSTEM = ("CalibratedC", "RectifiedC"), "Cartesian"
MM = {"Millimeter": 1.0, "Inch": 25.4}
RANGES = ("Coord3D_C16", "Coord3D_C32f")
KEPT_S = 600.0  # frames older than this say no more than their drift


class DeviceTime:
    """A camera's stamps on the bench's clock. A frame arrives after its stamp, so the least
    difference, aged by the clocks' drift, is the offset. A stamp that goes back starts anew.
    Cameras whose clocks PTP keeps in step share one: they differ as their stamps do.
    """

    def __init__(self) -> None:
        self._seen: list[tuple[float, float]] = []  # arrival and offset, s on the bench's clock
        self._last_s = float("-inf")

    def bench_s(self, device_s: float, arrived_s: float) -> float:
        """Exposure time of a frame with stamp ``device_s`` (0: none) that came at ``arrived_s``."""
        if device_s <= 0.0:
            return arrived_s
        if device_s < self._last_s - BACK_S:
            self._seen.clear()
        self._last_s = device_s
        self._seen = [seen for seen in self._seen if arrived_s - seen[0] <= KEPT_S]
        self._seen.append((arrived_s, arrived_s - device_s))
        offset_s = min(offset + DRIFT * (arrived_s - at) for at, offset in self._seen)
        return min(device_s + offset_s, arrived_s)


def load_aravis() -> Any:
    """The library's namespace. Raises DeviceError that says what to install."""
    try:
        gi = importlib.import_module("gi")
        gi.require_version("Aravis", "0.8")
        return importlib.import_module("gi.repository.Aravis")
    except (ImportError, ValueError) as error:  # ValueError: a binding without the library
        what = f"the library can't be loaded: {error}"
        raise DeviceError("genicam cameras", what, hint=INSTALL) from error


def _controls(camera: Any) -> bool:
    """Whether this program controls the camera; on a network only one can."""
    return not camera.is_gv_device() or bool(camera.get_device().is_controller())


Region = tuple[int, int, int, int]  # x, y, width, height


def _region(found: Any) -> Region:
    return int(found.x), int(found.y), int(found.width), int(found.height)


def _size(camera: Any) -> tuple[int, int]:
    return _region(camera.get_region())[2:]


def _shown(region: Region) -> str:
    x, y, width, height = region
    return f"{width} x {height} at ({x}, {y})"


def feature_names(device: Any) -> list[str]:
    """All features that a camera lists, by its categories."""
    names, categories, seen = set(), ["Root"], set()
    while categories:
        name = categories.pop()
        if name in seen or (found := device.get_feature(name)) is None:
            continue
        seen.add(name)
        if hasattr(found, "get_features"):
            categories += found.get_features()
        else:
            names.add(name)
    return sorted(names)


def _of_parts(buffer: Any) -> tuple[tuple[Pixels, int], Pixels | None]:
    """Distances, their bits and the first grey part, of a payload of parts. Raises ValueError."""
    found: dict[str, tuple[Pixels, int]] = {}
    for part in range(buffer.get_n_parts()):
        code = buffer.get_part_pixel_format(part)
        if code in BY_CODE:
            size = buffer.get_part_width(part), buffer.get_part_height(part)
            padding = int(buffer.get_part_padding(part).x_padding)
            one = unpack(buffer.get_part_data(part), code, *size, padding)
            found.setdefault(BY_CODE[code].name, one)
    ranges = [name for name in RANGES if name in found]
    if not ranges:
        sent = ", ".join(found) or "nothing that is unpacked here"
        raise ValueError(f"no part is a distance ({', '.join(RANGES)}): it sent {sent}")
    whole = found.pop(ranges[0])
    grey = [one for one, _ in found.values() if one.shape == whole[0].shape]
    return whole, next((one for one in grey if one.dtype != np.float32), None)


class GenicamCamera:
    """``device``: name as Aravis lists it, serial number or address; "" for the only one.
    ``in_step``: of all cameras with PTP. Raises LinkError without an answer, DeviceError without
    the library or for settings that did not take.
    """

    def __init__(
        self,
        name: str,
        device: str,
        clock: Clock,
        settings: Settings | None = None,
        *,
        timeout_s: float = TIMEOUT_S,
        in_step: DeviceTime | None = None,
    ) -> None:
        self._name, self._device, self._who = name, device, f"{name} camera genicam:{device}"
        self._clock, self._settings = clock, settings or Settings()
        self._timeout_s, self._in_step = timeout_s, in_step
        self._aravis = load_aravis()
        self._failure: type[Exception] = importlib.import_module("gi.repository.GLib").Error
        if device.startswith(FAKE):
            self._aravis.enable_interface("Fake")
        self._stream: Any = None
        self._camera: Any = None
        self._region: Region | None = None
        self._changed = False
        self._open()

    def _open(self) -> None:
        self._time = (self._settings.ptp and self._in_step) or DeviceTime()
        self._camera = self._found(self._device)
        self._lost_control = False
        try:
            if self._region and not self._settings.resolution:  # as it was opened first
                self._camera.set_region(*self._region)
            notes = self._apply_settings()
            self._region = _region(self._camera.get_region())
            self._wait_s = self._frame_wait_s()
            self._ranging = self._scan3d() if self._settings.depth else None
            c, (width, height) = self._camera, _size(self._camera)
            who = f"{c.get_vendor_name()} {c.get_model_name()} {c.get_device_serial_number()}"
            size = f"({width} x {height}, {c.get_pixel_format_as_string()})"
            self.identity = "; ".join([f"{who} {size}", *notes])
            trigger, source = self._settings.trigger, self._settings.trigger_source
            if trigger == "free":
                c.clear_triggers()
            else:
                c.set_trigger("Software" if trigger == "software" else source)
            c.set_acquisition_mode(self._aravis.AcquisitionMode.CONTINUOUS)
            self._code = self._pixel_format()
            self._stream = c.create_stream(None, None)
            for _ in range(BUFFERS):
                self._stream.push_buffer(self._aravis.Buffer.new_allocate(c.get_payload()))
            c.start_acquisition()
            self._changed = False
        except BaseException as error:
            self.close()
            if isinstance(error, self._failure):
                raise DeviceError(self._who, f"it refused: {error}") from error
            raise

    def _apply_settings(self) -> tuple[str, ...]:
        c, asked = self._camera, self._settings
        ways = {
            "pixel_format": (c.set_pixel_format_from_string, c.get_pixel_format_as_string),
            "resolution": (lambda size: c.set_region(0, 0, *size), lambda: _size(c)),
            "fps": (c.set_frame_rate, c.get_frame_rate),
            "exposure": (c.set_exposure_time, c.get_exposure_time),
            "gain": (c.set_gain, c.get_gain),
        }
        ways |= {name: self._feature(name) for name in asked.features}
        automatic = {
            name: partial(self._automatic, name)
            for name in AUTOMATIC
            if name not in asked.features and self._offers(name)
        }
        held = hold_still(self._who, asked, automatic)
        notes = (*held, *apply(self._who, asked, ways, (self._failure, DeviceError)))
        return (*notes, self._ptp()) if asked.ptp else notes

    def _pixel_format(self) -> int:
        return int(self._camera.get_pixel_format())

    def _frame_wait_s(self) -> float:
        """The longest wait for a frame: some intervals of a slow camera."""
        with suppress(self._failure):
            if self._camera.is_frame_rate_available() and (rate := self._camera.get_frame_rate()):
                return max(self._timeout_s, INTERVALS / float(rate))
        return self._timeout_s

    def _offers(self, name: str) -> bool:
        device = self._camera.get_device()
        return device.get_feature(name) is not None and bool(device.is_feature_available(name))

    def _feature(self, name: str) -> tuple[Callable[[Value], object], Callable[[], object]]:
        """How to write and read one of any kind; both raise DeviceError where it is missing."""
        device = self._camera.get_device()

        def node() -> Any:
            found = device.get_feature(name)
            if found is None or not hasattr(found, "set_value_from_string"):
                near = difflib.get_close_matches(name, list(feature_names(device)), n=1, cutoff=0.8)
                hint = f'; did you mean "{near[0]}"?' if near else ""
                raise DeviceError(self._who, f'the camera has no feature "{name}"{hint}')
            return found

        def write(value: Value) -> None:
            text = str(value).lower() if isinstance(value, bool) else str(value)
            node().set_value_from_string(text)

        return write, lambda: node().get_value_as_string()

    def _scan3d(self) -> Ranging | None:
        """What the camera says of its distances, if anything. Raises DeviceError."""

        def said(name: str, usual: str = "") -> str:
            return str(self._feature(name)[1]()) if self._offers(name) else usual

        if said("Scan3dCoordinateSelector"):
            self._feature("Scan3dCoordinateSelector")[0]("CoordinateC")
        wanted = {
            "Scan3dOutputMode": DEPTHS,
            "Scan3dCoordinateSystem": (SYSTEM,),
            "Scan3dDistanceUnit": tuple(MM),
        }
        for name, words in wanted.items():
            if (word := said(name, words[0])) not in words:
                what = f"sends no depth along its axis: {name} is {word}"
                hint = f'Set it in the rig file: features = {{ {name} = "{words[0]}" }}.'
                raise DeviceError(self._who, what, asked=name, hint=hint)
        if not (scale := said("Scan3dCoordinateScale")):
            return None
        mm = MM[said("Scan3dDistanceUnit", "Millimeter")]
        flagged = same(True, said("Scan3dInvalidDataFlag"))
        none = float(said("Scan3dInvalidDataValue", "0")) if flagged else None
        return Ranging(mm * float(scale), mm * float(said("Scan3dCoordinateOffset", "0")), none)

    def _ptp(self) -> str:
        """Have PTP set its clock, and wait until it does. Raises DeviceError."""
        for enable, status in PTP:
            if self._camera.get_device().get_feature(enable) is None:
                continue
            self._feature(enable)[0](True)
            _, read = self._feature(status)
            end_s = self._clock.now() + PTP_S
            while (state := str(read())) not in IN_STEP:
                if self._clock.now() >= end_s:
                    what = f"its clock is not in step: {status} is {state}"
                    hint = "Is a master on its network, and does the switch pass PTP?"
                    raise DeviceError(self._who, what, seconds=PTP_S, hint=hint)
                self._clock.sleep(0.1)
            return f"PTP {state}"
        hint = "Leave ptp out; its frames are then timed by their arrival."
        raise DeviceError(self._who, "the camera offers no PTP", asked=PTP[0][0], hint=hint)

    def _automatic(self, name: str, switch_off: bool) -> str:
        """What an automatic function is set to; "" where it is off."""
        write, read = self._feature(name)
        with suppress(self._failure):  # what it says then decides
            if switch_off and read() != OFF:
                write(OFF)
        try:
            state = str(read())
        except self._failure as error:
            return f"can't be read: {error}"
        return "" if state == OFF else state

    def glance(self) -> None:
        """Raises LinkError where the library's heartbeat (GigE Vision) has lost the camera."""
        if self._camera is None or not _controls(self._camera):
            hint = "Check its cable and power; did another program take it?"
            raise LinkError(self._who, "is no longer under this program's control", hint=hint)

    def prepare(self) -> None:
        """Have the shutter close where that is asked for, and wait for it. Raises LinkError."""
        if not self._settings.shutter or self._stream is None:
            return
        try:
            self._camera.get_device().execute_command(self._settings.shutter)
        except self._failure as error:
            what = f"did not close its shutter: {error}"
            hint = "Correct shutter in the rig file: the name of its command, or false."
            raise LinkError(self._who, what, asked=self._settings.shutter, hint=hint) from error
        self._clock.sleep(self._settings.shutter_s)

    def begin(self) -> None:
        """Return old buffers; trigger by software where set. Raises LinkError, or FrameError where
        the camera takes no trigger. One whose control was lost, or whose frames have changed, is
        opened again.
        """
        if self._lost_control or self._changed:
            changed, self._changed = self._changed, False
            if changed:
                self.close()
            try:
                self._open()
            except BaseException:
                self._lost_control = True  # the next call tries again
                raise
        if self._stream is None:
            raise LinkError(self._who, "is closed", asked="a frame")
        while (stale := self._stream.try_pop_buffer()) is not None:
            self._stream.push_buffer(stale)
        self._trigger()

    def _trigger(self) -> None:
        if self._settings.trigger != "software":
            return
        try:
            self._camera.software_trigger()
        except self._failure as error:
            self._check_control()
            what = f"did not take the trigger: {error}"
            hint = "Check cable and power."
            raise self._fault(FrameFault.DROPPED, what, hint) from error

    def take(self) -> RawFrame:
        """The next whole frame. Damaged ones are passed over and counted in it, and buffers that
        were given back unfilled are not. Raises FrameError where none came in time, or not as the
        camera was opened.
        """
        end_s = self._clock.now() + self._wait_s
        passed: list[str] = []  # the status of each damaged buffer
        while True:
            left_s = max(0.0, end_s - self._clock.now())
            buffer = self._stream.timeout_pop_buffer(int(left_s * 1e6))
            arrived_s = self._clock.now()
            if buffer is None:
                raise self._none_came(passed)
            try:
                status = buffer.get_status().value_nick.upper().replace("-", "_")
                if status == "SUCCESS":
                    (pixels, bits), amplitude = self._pixels(buffer)
                    exposed_s = self._time.bench_s(buffer.get_timestamp() * 1e-9, arrived_s)
                    return RawFrame(pixels, exposed_s, bits, self._ranging, amplitude, len(passed))
                if status not in UNFILLED:
                    passed.append(status)
            finally:
                self._stream.push_buffer(buffer)
            if arrived_s >= end_s:
                raise self._none_came(passed)
            self._trigger()

    def _none_came(self, passed: list[str]) -> FrameError:
        """Why there is no frame, after damaged ones with these statuses."""
        self._check_control()
        with suppress(self._failure):  # frames larger than their buffers may not come at all
            self._check_unchanged(_region(self._camera.get_region()), self._pixel_format())
        if not passed:
            waits = self._settings.trigger == "hardware"
            hint = "Check cable, power and the network's packet size."
            hint = "Did its trigger come?" if waits else hint
            return self._fault(FrameFault.DROPPED, "no frame came", hint, self._wait_s)
        status = passed[-1]
        what = f"no whole frame came, {len(passed)} with damage, the last with status {status}"
        hint = "Raise the socket's buffer and the packet size, or lower the frame rate."
        if status == "SIZE_MISMATCH":  # larger than the buffers that it was opened with
            self._changed = True
            hint = "Was its picture set to another size or pixel format? It is opened again."
        return self._fault(DAMAGED.get(status, FrameFault.DROPPED), what, hint, self._wait_s)

    def close(self) -> None:
        """Let it go, in 2 s at most; may be called again."""
        self._lost_control = self._changed = False
        held = [self._stream, self._camera]
        self._stream = self._camera = None
        if held == [None, None]:
            return

        def let_go() -> None:
            with suppress(self._failure):  # it has gone already
                if held[0] is not None:
                    held[1].stop_acquisition()
            held.clear()  # the stream first: a camera that doesn't answer takes seconds here, too

        close_within([let_go])

    def _found(self, device: str) -> Any:
        try:
            camera = self._aravis.Camera.new(device or None)
            if camera.is_gv_device():
                near = camera.get_device().get_interface_address().get_address()
                far = camera.get_device().get_device_address().get_address()
                # on this machine: frames from 127.0.0.1 reach no other interface
                if far.get_is_loopback() and not near.get_is_loopback():
                    del camera  # hands the control of the camera back
                    camera = self._aravis.Camera.new(far.to_string())
        except self._failure as error:
            self._aravis.update_device_list()  # takes a second
            known = map(self._aravis.get_device_id, range(self._aravis.get_n_devices()))
            hint = f"Cameras that answer: {', '.join(known) or 'none'}."
            hint += " On a network the bench and the camera must be in one subnet."
            raise LinkError(self._who, f"can't be opened: {error}", hint=hint) from error
        if not _controls(camera):  # the library opens it, but every setting would time out
            what = "can't be opened: it is open already, here or in another program"
            hint = "Is it twice in the rig file? Or close the other program."
            raise LinkError(self._who, what, hint=hint)
        return camera

    def _check_control(self) -> None:
        """Raise FrameError for a camera that this program no longer controls, and let it go."""
        if _controls(self._camera):
            return
        self._stream = self._camera = None
        self._lost_control = True
        what = "no frame came: the camera is no longer under this program's control"
        hint = "Another program took it, or its power was off."
        hint += " It is opened again for the next frame."
        raise self._fault(FrameFault.DROPPED, what, hint)

    def _fault(
        self, fault: FrameFault, what: str, hint: str, seconds: float | None = None
    ) -> FrameError:
        return FrameError(fault, self._name, self._who, what, seconds=seconds, hint=hint)

    def _check_unchanged(self, region: Region, code: int) -> None:
        """Raise FrameError for a frame that is not as the camera was opened; it is opened again."""
        assert self._region  # noqa: S101 - it was opened
        if region == (0, 0, *self._region[2:]):  # some cameras send no place with their frames
            with suppress(self._failure):
                region = _region(self._camera.get_region())
        if region == self._region and code == self._code:
            return
        self._changed = True
        if region != self._region:
            what = f"it sends {_shown(region)}; it was opened with {_shown(self._region)}"
        else:
            what = f"it sends pixel format 0x{code:08X}; it was opened with 0x{self._code:08X}"
        hint = "Was it set by another program? It is opened again for the next frame."
        raise self._fault(FrameFault.WRONG_SIZE, what, hint)

    def _pixels(self, buffer: Any) -> tuple[tuple[Pixels, int], Pixels | None]:
        """Pixels, their bits, and a depth camera's amplitude. Raises FrameError, ProtocolError."""
        kind = buffer.get_payload_type().value_nick
        images = ("image", "extended-chunk-data", "chunk-data")
        if kind not in (*images, *(("multipart",) if self._settings.depth else ())):
            raise ProtocolError(self._who, f"sent {kind}, not an image", asked="a frame")
        try:
            if kind == "multipart":
                return _of_parts(buffer)
            size = buffer.get_image_width(), buffer.get_image_height()
            padding = int(buffer.get_image_padding().x_padding)
            code = buffer.get_image_pixel_format()
            self._check_unchanged(_region(buffer.get_image_region()), code)
            return unpack(buffer.get_data(), code, *size, padding), None
        except ValueError as fault:
            hint = "Set another pixel_format in the rig file."
            raise ProtocolError(self._who, str(fault), asked="a frame", hint=hint) from fault

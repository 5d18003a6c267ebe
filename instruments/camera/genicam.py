"""A GigE Vision or USB3 Vision camera, optical or radiometric, through Aravis.

Every buffer's status is looked at: one with missing packets or of another size is a fault with a name, never a picture. Times are the
camera's own stamps, brought to the bench's clock. May not know what the pictures show.
"""

from __future__ import annotations

import importlib
from typing import Any, Protocol

from instruments.camera.aravis import FAKE, found_cameras, load_aravis
from instruments.camera.device_time import DeviceTime
from instruments.camera.faults import FrameError, FrameFault
from instruments.camera.features import set_all
from instruments.camera.pixel_formats import unpack
from instruments.camera.raw import RawFrame
from instruments.camera.settings import Settings
from instruments.errors import DeviceError, LinkError, ProtocolError

BUFFERS = 4
PATIENCE_S = 2.0
HOLES = ("MISSING_PACKETS", "WRONG_PACKET_ID", "TIMEOUT")


class Timed(Protocol):
    """What tells the time."""

    def now(self) -> float:
        """Seconds."""
        ...


class GenicamCamera:
    """``device`` is the camera's name as Aravis lists it, its serial number or its IP address; "" the only one there is.

    Raises LinkError where it doesn't answer, DeviceError where the library is missing or settings did not take.
    """

    def __init__(self, name: str, device: str, clock: Timed, settings: Settings | None = None, *, patience_s: float = PATIENCE_S) -> None:
        self._name = name
        self._who = f"{name} camera genicam:{device}"
        self._clock = clock
        self._settings = settings or Settings()
        self._patience_s = patience_s
        self._device = device
        self._lost_control = False
        self._aravis = load_aravis()
        self._failure = _failure()
        if device.startswith(FAKE):
            self._aravis.enable_interface("Fake")
        self._stream: Any = None
        self._open()

    def _open(self) -> None:
        self._time = DeviceTime()
        self._camera = self._found(self._device)
        self._lost_control = False
        try:
            notes = set_all(self._who, self._camera, self._settings, self._failure)
            self._identity = "; ".join([self._described(), *notes])
            self._start()
        except self._failure as error:
            self.close()
            raise DeviceError(self._who, f"it refused: {error}") from error
        except BaseException:
            self.close()
            raise

    @property
    def identity(self) -> str:
        """Vendor, model, serial number, size and pixel format, and settings that were tried in vain."""
        return self._identity

    def begin(self) -> None:
        """Give back what came unasked, and trigger where the bench is the trigger. Raises LinkError.

        Raises FrameError for a camera that this program no longer controls, and opens it next time.
        """
        if self._lost_control:
            self._open()
        if self._stream is None:
            raise LinkError(self._who, "is closed", asked="a frame")
        while (stale := self._stream.try_pop_buffer()) is not None:
            self._stream.push_buffer(stale)
        if self._settings.trigger == "software":
            try:
                self._camera.software_trigger()
            except self._failure as error:
                self._check_control()
                raise LinkError(self._who, f"did not take the trigger: {error}", asked="TriggerSoftware") from error

    def take(self) -> RawFrame:
        """The frame. Raises FrameError where none came or it came with holes."""
        buffer = self._stream.timeout_pop_buffer(int(self._patience_s * 1e6))
        arrived_s = self._clock.now()
        if buffer is None:
            self._check_control()
            hint = "Did its trigger come?" if self._settings.trigger == "hardware" else "Check cable, power and the network's packet size."
            raise FrameError(FrameFault.DROPPED, self._name, self._who, "no frame came", seconds=self._patience_s, hint=hint)
        try:
            self._check(buffer)
            pixels, bits = self._pixels(buffer)
            return RawFrame(pixels, self._time.bench_s(buffer.get_timestamp() * 1e-9, arrived_s), bits)
        finally:
            self._stream.push_buffer(buffer)

    def close(self) -> None:
        """Let it go; may be called again."""
        self._lost_control = False
        if self._stream is not None:
            self._stream = None
            try:
                self._camera.stop_acquisition()
            except self._failure:  # it has gone already, and with it whatever there was to stop
                return
            finally:
                self._camera = None

    def _found(self, device: str) -> Any:
        try:
            camera = self._by_loopback(self._aravis.Camera.new(device or None))
        except self._failure as error:
            there = ", ".join(found_cameras(self._aravis)) or "none"
            hint = f"Cameras that answer: {there}. On a network the bench and the camera must be in one subnet."
            raise LinkError(self._who, f"can't be opened: {error}", hint=hint) from error
        if not self._controls(camera):  # the library opens it, but every setting would time out
            what = "can't be opened: it is open already, here or in another program"
            hint = "Is it twice in the rig file? Close the other program; a crashed one's hold soon ends."
            raise LinkError(self._who, what, hint=hint)
        return camera

    def _controls(self, camera: Any) -> bool:
        """Whether this program may set and start the camera: on a network only one may."""
        return not camera.is_gv_device() or bool(camera.get_device().is_controller())

    def _check_control(self) -> None:
        """Raise FrameError for a camera that this program no longer controls, and let it go."""
        if self._controls(self._camera):
            return
        self._stream = self._camera = None
        self._lost_control = True
        what = "no frame came: the camera is no longer under this program's control"
        hint = "Another program took it, or its power was off. It is opened again for the next frame."
        raise FrameError(FrameFault.DROPPED, self._name, self._who, what, hint=hint)

    def _by_loopback(self, camera: Any) -> Any:
        """The same camera; one of this machine that was found through a network's interface is opened by its address instead.

        The library takes the interface whose answer came first; frames sent from 127.0.0.1 would never reach another one.
        """
        if not camera.is_gv_device():
            return camera
        device = camera.get_device()
        near, far = (end.get_address() for end in (device.get_interface_address(), device.get_device_address()))
        if not far.get_is_loopback() or near.get_is_loopback():
            return camera
        del camera, device  # hands the control of the camera back
        return self._aravis.Camera.new(far.to_string())

    def _described(self) -> str:
        camera = self._camera
        who = " ".join(str(part()) for part in (camera.get_vendor_name, camera.get_model_name, camera.get_device_serial_number))
        region = camera.get_region()
        return f"{who} ({region.width} x {region.height}, {camera.get_pixel_format_as_string()})"

    def _start(self) -> None:
        camera = self._camera
        if self._settings.trigger == "free":
            camera.clear_triggers()
        else:
            camera.set_trigger("Software" if self._settings.trigger == "software" else self._settings.trigger_source)
        camera.set_acquisition_mode(self._aravis.AcquisitionMode.CONTINUOUS)
        self._stream = camera.create_stream(None, None)
        for _ in range(BUFFERS):
            self._stream.push_buffer(self._aravis.Buffer.new_allocate(camera.get_payload()))
        camera.start_acquisition()

    def _check(self, buffer: Any) -> None:
        status = buffer.get_status().value_nick.upper().replace("-", "_")
        if status == "SUCCESS":
            return
        fault = FrameFault.LOST_PACKETS if status in HOLES else FrameFault.HALF if status == "SIZE_MISMATCH" else FrameFault.DROPPED
        hint = "Raise the socket's buffer and the packet size (jumbo frames), or lower the frame rate."
        raise FrameError(fault, self._name, self._who, f"a frame's buffer came with status {status}", hint=hint)

    def _pixels(self, buffer: Any) -> Any:
        if buffer.get_payload_type().value_nick not in ("image", "extended-chunk-data", "chunk-data"):
            raise ProtocolError(self._who, f"sent {buffer.get_payload_type().value_nick}, not an image", asked="a frame")
        x_padding = int(buffer.get_image_padding().x_padding)
        try:
            return unpack(
                buffer.get_data(), buffer.get_image_pixel_format(), buffer.get_image_width(), buffer.get_image_height(), x_padding
            )
        except ValueError as fault:
            raise ProtocolError(self._who, str(fault), asked="a frame", hint="Set another pixel_format in the rig file.") from fault


def _failure() -> type[Exception]:
    """What the library raises."""
    error: type[Exception] = importlib.import_module("gi.repository.GLib").Error
    return error

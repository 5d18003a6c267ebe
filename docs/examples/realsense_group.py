"""A RealSense as a group: two infrared pictures and depth of one device, exposed together.

    pip install pyrealsense2
    [cameras]
    url = "plugin:realsense?serial=012345678901"

In pyproject.toml of your package:

    [project.entry-points."teatbench.cameras"]
    realsense = "realsense_group:RealSense"

Keys: ``serial``; ``width``, ``height``, ``fps``; ``exposure_us``; ``emitter`` ("on": its dots lie
on the teats in both pictures, and help depth; "off", the default). A thermal camera beside it has
a table of its own, ``[cameras.thermal]``.
"""

from __future__ import annotations

import numpy as np
import pyrealsense2 as rs

from instruments import (
    Clock,
    FrameError,
    FrameFault,
    LinkError,
    MakersCalibration,
    MakersLens,
    Ranging,
    RawFrame,
)

TIMEOUT_MS = 2000
SETTLE = 10  # frames until the exposure has settled
IN_STEP_MS = 1.0  # the three of one set have one time stamp; others were not exposed together


class RealSense:
    """``left`` and ``right`` are its infrared imagers, ``depth`` stands in the left one's place."""

    parts = ("left", "right", "depth")

    def __init__(
        self,
        clock: Clock,
        serial: str,
        width: str = "1280",
        height: str = "720",
        fps: str = "15",
        exposure_us: str = "",
        emitter: str = "off",
    ) -> None:
        self._clock, self._serial = clock, serial
        size = int(width), int(height)
        config = rs.config()
        config.enable_device(serial)
        for number in (1, 2):
            config.enable_stream(rs.stream.infrared, number, *size, rs.format.y8, int(fps))
        config.enable_stream(rs.stream.depth, *size, rs.format.z16, int(fps))
        self._pipeline = rs.pipeline()
        hint = "Is it at a USB 3 port, and in no other program?"
        if serial not in _connected():  # the pipeline would wait for it for 15 s
            raise LinkError("RealSense", f"{serial} is not connected", hint=hint)
        try:
            self._profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise LinkError("RealSense", f"{serial}: {error}", hint=hint) from error
        self._open = True
        try:
            device = self._profile.get_device()
            sensor = device.first_depth_sensor()
            sensor.set_option(rs.option.emitter_enabled, 1.0 if emitter == "on" else 0.0)
            if exposure_us:
                sensor.set_option(rs.option.enable_auto_exposure, 0.0)
                sensor.set_option(rs.option.exposure, float(exposure_us))
            self._ranging = Ranging(mm_per_count=1000.0 * sensor.get_depth_scale(), none=0.0)
            about = (rs.camera_info.name, rs.camera_info.serial_number)
            firmware = device.get_info(rs.camera_info.firmware_version)
            self.identity = " ".join(device.get_info(key) for key in about)
            self.identity += f" (firmware {firmware})"
            for _ in range(SETTLE):
                self._wait()
        except BaseException:
            self.close()
            raise

    def capture(self) -> dict[str, RawFrame]:
        """A set that was exposed after it was asked for."""
        asked_s = self._clock.now()
        while self._pipeline.poll_for_frames():  # what waits is older
            pass
        frames = self._wait()
        left, right = (frames.get_infrared_frame(number) for number in (1, 2))
        depth = frames.get_depth_frame()
        for part, frame in zip(self.parts, (left, right, depth), strict=True):
            if not frame:
                raise FrameError(FrameFault.DROPPED, part, self.identity, "no frame came")
            apart_ms = abs(frame.get_timestamp() - left.get_timestamp())
            if apart_ms > IN_STEP_MS:
                what = f"exposed {apart_ms:.1f} ms beside the left picture"
                raise FrameError(FrameFault.LATE, part, self.identity, what)
        return {
            "left": self._raw(left, asked_s),
            "right": self._raw(right, asked_s),
            "depth": self._raw(depth, asked_s, self._ranging),
        }

    def makers_calibration(self) -> MakersCalibration:
        """As it was calibrated in the factory, which states no uncertainty."""
        streams = {
            "left": self._profile.get_stream(rs.stream.infrared, 1),
            "right": self._profile.get_stream(rs.stream.infrared, 2),
            "depth": self._profile.get_stream(rs.stream.depth),
        }
        lenses = {}
        for part, stream in streams.items():
            of = stream.as_video_stream_profile().get_intrinsics()
            matrix = np.array([[of.fx, 0.0, of.ppx], [0.0, of.fy, of.ppy], [0.0, 0.0, 1.0]])
            way = streams["left"].get_extrinsics_to(stream)
            R = np.array(way.rotation).reshape(3, 3).T  # by columns there
            T_mm = [1000.0 * m for m in way.translation]
            lenses[part] = MakersLens((of.width, of.height), matrix, of.coeffs, R, T_mm)
        return MakersCalibration(lenses)

    def close(self) -> None:
        if self._open:
            self._open = False
            self._pipeline.stop()

    def _wait(self) -> rs.composite_frame:
        try:
            return self._pipeline.wait_for_frames(TIMEOUT_MS)
        except RuntimeError as error:  # its word for no frame, and for a camera that has gone
            if self._serial in _connected():
                what = "no frame came"
                raise FrameError(FrameFault.DROPPED, "left", "RealSense", what) from error
            raise LinkError("RealSense", str(error), hint="Check cable and power.") from error

    @staticmethod
    def _raw(frame: rs.frame, exposed_s: float, ranging: Ranging | None = None) -> RawFrame:
        pixels = np.asanyarray(frame.get_data()).copy()  # the frame goes back
        bits = 16 if pixels.dtype == np.uint16 else 8
        return RawFrame(pixels, exposed_s, bits=bits, ranging=ranging)


def _connected() -> list[str]:
    found = rs.context().query_devices()
    return [one.get_info(rs.camera_info.serial_number) for one in found]

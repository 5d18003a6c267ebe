"""A camera by its maker's GenTL producer (.cti), for Windows and where Aravis is awkward.

    pip install harvesters
    url = "plugin:harvesters?cti=C:/Program Files/…/producer.cti&serial=22114455"

In pyproject.toml of your package:

    [project.entry-points."teatbench.cameras"]
    harvesters = "harvesters_camera:HarvestersCamera"

Keys: ``cti``, ``serial``; ``pixel_format`` (Mono8, Mono12, BGR8, …), ``exposure_us``, ``gain``;
``trigger``: "software" (exposed when the bench asks, the default) or "free"; ``timeout_s``.
"""

from __future__ import annotations

import re

import numpy as np
from genicam.gentl import GenericException, TimeoutException
from harvesters.core import Harvester

from instruments import Clock, DeviceError, FrameError, FrameFault, LinkError, RawFrame

COLOURS = {"BGR8": 3, "RGB8": 3}
BUFFERS = 4


class HarvestersCamera:
    """One camera, streaming from its opening on."""

    def __init__(
        self,
        clock: Clock,
        cti: str,
        serial: str,
        pixel_format: str = "Mono8",
        exposure_us: str = "",
        gain: str = "",
        trigger: str = "software",
        timeout_s: str = "2.0",
    ) -> None:
        self._clock, self._timeout_s = clock, float(timeout_s)
        self._software = trigger == "software"
        self._begun_s = clock.now()
        self._harvester = Harvester()
        self._acquirer = None
        try:
            self._harvester.add_file(cti)
            self._harvester.update()
            self._acquirer = self._harvester.create({"serial_number": serial})
            self._acquirer.num_buffers = BUFFERS
            self._set("PixelFormat", pixel_format)
            self._set("ExposureAuto", "Off", needed=False)
            if exposure_us:
                self._set("ExposureTime", float(exposure_us))
            if gain:
                self._set("Gain", float(gain))
            self._set("TriggerSelector", "FrameStart", needed=False)
            self._set("TriggerMode", "On" if self._software else "Off", needed=self._software)
            if self._software:
                self._set("TriggerSource", "Software")
            nodes = self._acquirer.remote_device.node_map
            self.identity = f"{nodes.DeviceVendorName.value} {nodes.DeviceModelName.value} {serial}"
            self._acquirer.start()
        except (GenericException, FileNotFoundError, IndexError, ValueError) as error:
            self.close()
            hint = "Is the .cti file the maker's, and the camera in no other program?"
            raise LinkError("camera", f"{serial}: {error}", asked=cti, hint=hint) from error
        except BaseException:
            self.close()
            raise

    def prepare(self) -> None:
        """Drop what was exposed before it was asked for."""
        while (buffer := self._acquirer.try_fetch(timeout=0.0)) is not None:
            buffer.queue()

    def begin(self) -> None:
        self._begun_s = self._clock.now()
        if self._software:
            self._acquirer.remote_device.node_map.TriggerSoftware.execute()

    def take(self) -> RawFrame:
        try:
            with self._acquirer.fetch(timeout=self._timeout_s) as buffer:
                [image] = buffer.payload.components
                kind = image.data_format
                shape = (image.height, image.width, COLOURS.get(kind, 1))
                pixels = image.data.reshape(shape).copy()  # the buffer goes back
        except TimeoutException as error:
            what = "no frame came"
            raise FrameError(
                FrameFault.DROPPED, "camera", self.identity, what, seconds=self._timeout_s
            ) from error
        except GenericException as error:
            raise LinkError(self.identity, str(error), hint="Check cable and power.") from error
        if kind == "RGB8":
            pixels = pixels[:, :, ::-1]
        if pixels.shape[2] == 1:
            pixels = pixels[:, :, 0]
        bits = re.search(r"\d+", kind)
        if pixels.dtype == np.uint16 and bits:
            return RawFrame(pixels, self._begun_s, bits=int(bits[0]))
        return RawFrame(np.ascontiguousarray(pixels), self._begun_s)

    def close(self) -> None:
        acquirer, self._acquirer = self._acquirer, None
        if acquirer is not None:
            acquirer.stop()
            acquirer.destroy()
        self._harvester.reset()

    def _set(self, name: str, value: object, *, needed: bool = True) -> None:
        """Set a feature and read it back."""
        node = getattr(self._acquirer.remote_device.node_map, name, None)
        if node is None:
            if needed:
                raise DeviceError("camera", f"it has no feature {name}", asked=f"{name} = {value}")
            return
        node.value = value
        same = node.value == value if isinstance(value, str) else abs(node.value - value) < 1.0
        if not same:
            seen = str(node.value)
            raise DeviceError("camera", f"{name} is not set", asked=f"{value}", seen=seen)

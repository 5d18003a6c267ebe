"""Cameras without a run: those of a rig, as frame sets through its own declarations, or one to
three by their URLs, as they are; looked at, focused, and grabbed into a recording.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from bench.config import ConfigError, read_text
from bench.rig.devices import Cameras
from bench.rig.frame_capture import FrameChecks
from bench.rig.loading import LoadedRig, find_rig, load_rig
from bench.rig.model import Cameras as CamerasTable
from bench.rig.model import OneCamera, camera_url
from bench.rig.opening import conversion_of, open_camera, open_instruments, rig_of
from instruments.camera.cameras import KNOWN, Camera
from instruments.camera.frame import Conversion, FrameError, FrameSet, Grey
from instruments.camera.genicam import load_aravis
from instruments.camera.quality import edge_blur_px, level_dn, saturated_share
from instruments.clock import Clock, RealClock
from instruments.errors import DeviceError

Seen = TypeVar("Seen")
Look = Callable[[], Mapping[str, Grey]]
TRIES = 4
ONE = "single"  # what one camera without a place in a rig is called


@dataclass(frozen=True, slots=True)
class Alone:
    """Open cameras. ``look`` gives each camera's picture; ``frame_set`` is None for one camera
    alone, which makes no set.
    """

    clock: Clock
    identity: Callable[[], Mapping[str, str]]
    look: Look
    frame_set: Cameras | None
    rig: LoadedRig

    @property
    def table(self) -> CamerasTable:
        """What the rig declares of them."""
        return self.rig.rig.cameras

    @property
    def checks(self) -> FrameChecks:
        """The rig's looks; a phantom that is still cold is no fault here."""
        table, calibration = self.table, self.rig.made_calibration
        return FrameChecks(table.checks, table.max_skew_s, calibration, flat=False)


@contextmanager
def open_alone(sources: Sequence[str]) -> Iterator[Alone]:
    """A rig's cameras by its name or file (the emulated one for none), or cameras by URL. Raises
    ConfigError, InstrumentError.
    """
    by_url = any(source.partition(":")[0] in ("opencv", "genicam") for source in sources)
    if by_url and len(sources) > len(KNOWN):
        raise ConfigError.plain(
            f"at most {len(KNOWN)} cameras: {', '.join(KNOWN)}; got {len(sources)}"
        )
    if not by_url and len(sources) > 1:
        raise ConfigError.plain(
            "one rig, or one to three cameras by URL (opencv:…, genicam:…); got"
            f" {' '.join(sources)}"
        )
    if not by_url:
        rig = load_rig(find_rig(sources[0] if sources else None))
    elif len(sources) == 1:
        rig, table = rig_of(cameras=CamerasTable(url="emulator:")), _table(sources[0])
        with (
            closing(RealClock()) as clock,
            closing(open_camera(ONE, table, Path(), clock)) as camera,
        ):
            look = patient(lambda: {ONE: _picture(camera)})
            yield Alone(clock, lambda: {ONE: camera.identity}, look, None, rig)
        return
    else:
        tables = {
            name: {"url": _table(source).url} for name, source in zip(KNOWN, sources, strict=False)
        }
        rig = rig_of(cameras=CamerasTable.model_validate(tables))
    with open_instruments(rig, ("cameras",)) as devices:
        cameras = devices.cameras
        look = patient(lambda: pictures(cameras.capture()))
        yield Alone(devices.clock, lambda: cameras.identity, look, cameras, rig)


def _table(source: str) -> OneCamera:
    try:
        return OneCamera(url=camera_url(source))
    except ValueError as error:
        raise ConfigError.plain(f"{source}: {error}") from error


def patient(look: Callable[[], Seen]) -> Callable[[], Seen]:
    """``look`` again where a frame did not come whole, three times. Raises FrameError then."""

    def again() -> Seen:
        for _ in range(TRIES - 1):
            with suppress(FrameError):
                return look()
        return look()

    return again


def _picture(camera: Camera) -> Grey:
    camera.begin()
    return Conversion().picture(camera.take())


def pictures(frames: FrameSet) -> dict[str, Grey]:
    """Each camera's picture in 8-bit grey; temperatures are stretched over the range where the
    camera delivers nothing else.
    """
    thermal = frames.thermal
    if thermal is None and frames.thermal_ck is not None:
        low, high = np.percentile(frames.thermal_ck, [0.5, 99.5])
        stretched = np.rint((frames.thermal_ck - low) * (255.0 / max(1.0, high - low)))
        thermal = np.clip(stretched, 0.0, 255.0).astype(np.uint8)
    return {
        "left": frames.left,
        "right": frames.right,
        **({} if thermal is None else {"thermal": thermal}),
    }


def figures(picture: Grey) -> dict[str, object]:
    """What one picture says of its camera; units are in the names."""
    return {
        "size_px": f"{picture.shape[1]} x {picture.shape[0]}",
        "mean_dn": round(float(picture.mean()), 1),
        "brightest_dn": level_dn(picture, 0.995),
        "white_percent": round(100.0 * saturated_share(picture), 2),
        "edge_blur_px": None if (blur_px := edge_blur_px(picture)) is None else round(blur_px, 2),
    }


def calibration_text(alone: Alone) -> str | None:
    """The rig's calibration file; None for cameras by URL, and where it has not been made."""
    return read_text(alone.rig.calibration_path) if alone.rig.made_calibration else None


def attached() -> Iterator[tuple[str, str]]:
    """URL and name of each camera that this machine can see. Devices of OpenCV are told by the
    system's list, and not opened.
    """
    for device in sorted(Path("/sys/class/video4linux").glob("video*")):
        yield (
            f"opencv:{device.name.removeprefix('video')}",
            (device / "name").read_text(encoding="utf-8").strip(),
        )
    try:
        aravis = load_aravis()
    except DeviceError as error:
        yield "genicam:", f"not looked for: {error}"
        return
    aravis.update_device_list()
    for i in range(aravis.get_n_devices()):
        told = (
            aravis.get_device_vendor(i),
            aravis.get_device_model(i),
            aravis.get_device_serial_nbr(i),
            aravis.get_device_protocol(i),
        )
        yield (
            f"genicam:{aravis.get_device_id(i)}",
            f"{' '.join(str(part) for part in told)} at {aravis.get_device_address(i)}",
        )


def of_rig(name: str) -> Iterator[tuple[str, str]]:
    """Each camera of a rig with its URL and what becomes of its frames; nothing is opened."""
    rig = load_rig(find_rig(name))
    cameras = rig.rig.cameras
    if cameras.url:
        yield "all", cameras.url
    for camera, table in cameras.tables.items():
        yield camera, f"{table.url} {conversion_of(table, rig.made_calibration)}"

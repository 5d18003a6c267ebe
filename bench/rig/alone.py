"""Instruments without a run: cameras, a stage or a bath opened alone; every instrument of a rig
connected to once, for who it is and one reading. Opening a stage's port resets most controllers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np

from bench.arguments import lent
from bench.config import ConfigError, checked, did_you_mean
from bench.rig.emulated_rig import EmulatedRig
from bench.rig.frame_capture import FrameChecks
from bench.rig.loading import AnyRig, LoadedRig, any_rig, find_rig, load_rig
from bench.rig.model import BathTable, CamerasTable, OneCamera, StageTable, camera_url
from bench.rig.opening import ALL, conversion_of, open_camera, open_instruments, rig_of
from bench.rig.urls import ELSEWHERE, bath_url, is_emulated, stage_url
from instruments.bath.driver import OwnBath
from instruments.bath.profile import PUMP, Profile, load_profile, profile_names
from instruments.camera.cameras import KNOWN
from instruments.camera.frame import Conversion, FrameError, FrameSet, Grey
from instruments.camera.genicam import load_aravis
from instruments.camera.quality import edge_blur_px, level_dn, saturated_share
from instruments.captures.capture import CaptureFile
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.device_file import DeviceFileError
from instruments.drivers.bath import profile_of
from instruments.drivers.entry_points import load as load_driver
from instruments.drivers.entry_points import plugin_url
from instruments.drivers.protocols import Cameras, Stage
from instruments.errors import DeviceError, InstrumentError
from instruments.stage.settings import check_within, declared

Returned = TypeVar("Returned")
TakePictures = Callable[[], Mapping[str, Grey]]
TRIES = 4
BY_URL = ("emulator", "files", "genicam", "opencv", "plugin")
EMULATED_ALONE = "an emulated {} lives in the bench; 'teatbench emulate' serves one at a port"
ONE = "single"  # what one camera without a place in a rig is called


@dataclass(frozen=True, slots=True)
class OpenCameras:
    """Open cameras. ``look`` gives pictures by camera; ``frame_set`` is None for a single one."""

    clock: Clock
    identity: Callable[[], Mapping[str, str]]
    look: TakePictures
    frame_set: Cameras | None
    rig: LoadedRig

    @property
    def table(self) -> CamerasTable:
        return self.rig.rig.cameras

    @property
    def checks(self) -> FrameChecks:
        """The rig's looks; a phantom that is still cold is no fault here."""
        return FrameChecks(self.table, self.rig.made_calibration, flat=False)

    def describe(self) -> dict[str, Any]:
        """``identity``; of all ``cameras`` what a picture says, units in its keys; and the
        ``faults`` that a run would find in a frame set. Raises FrameError.
        """
        if self.frame_set is None:
            taken, faults = self.look(), []
        else:
            frames = with_retries(self.frame_set.capture)()
            taken, faults = pictures(frames), [str(one) for one in self.checks.notice(frames)]
        seen = {name: figures(picture) for name, picture in taken.items()}
        return {"identity": dict(self.identity()), "cameras": seen, "faults": faults}


@contextmanager
def open_cameras(sources: Sequence[str]) -> Iterator[OpenCameras]:
    """Cameras of a rig (none: the emulated one) or by URL, until the block ends. Raises
    ConfigError, InstrumentError.
    """
    by_url = any(source.partition(":")[0] in BY_URL for source in sources)
    if by_url and len(sources) > len(KNOWN):
        raise ConfigError.plain(
            f"at most {len(KNOWN)} cameras: {', '.join(KNOWN)}; got {len(sources)}"
        )
    if not by_url and len(sources) > 1:
        raise ConfigError.plain(
            "one rig, or one to three cameras by URL (opencv:…, genicam:…, files:…, plugin:…); got"
            f" {' '.join(sources)}"
        )
    if not by_url:
        rig = load_rig(find_rig(sources[0] if sources else None))
    elif len(sources) == 1 and _is_group(sources[0]):
        rig = rig_of(cameras=CamerasTable(url=sources[0]))
    elif len(sources) == 1:
        rig, table = rig_of(cameras=CamerasTable(url="emulator:")), _table(sources[0])
        with (
            closing(RealClock()) as clock,
            closing(open_camera(ONE, table, Path(), clock)) as camera,
        ):

            def picture() -> dict[str, Grey]:
                one.begin()
                return {ONE: Conversion().picture(one.take())}

            look = with_retries(picture)
            opened = OpenCameras(clock, lambda: {ONE: one.identity}, look, None, rig)
            with lent(camera, ONE) as one, lent(opened, ONE) as given:
                yield given
        return
    else:
        tables = {
            name: {"url": _table(source).url} for name, source in zip(KNOWN, sources, strict=False)
        }
        rig = rig_of(cameras=CamerasTable.model_validate(tables))
    with (
        open_instruments(rig, ("cameras",)) as devices,
        lent(devices.cameras, "cameras") as cameras,
    ):
        look = with_retries(lambda: pictures(cameras.capture()))
        opened = OpenCameras(devices.clock, lambda: cameras.identity, look, cameras, rig)
        with lent(opened, "cameras") as given:
            yield given


def _is_group(source: str) -> bool:
    """Whether it is a plug-in's that gives several pictures of one device."""
    _table(source)
    plug = plugin_url(source)
    return plug is not None and hasattr(load_driver("camera", plug).maker, "parts")


def _table(source: str) -> OneCamera:
    try:
        if is_emulated(source):
            raise ValueError(EMULATED_ALONE.format("camera"))
        return OneCamera(url=camera_url(source))
    except ValueError as error:
        raise ConfigError.plain(f"{source}: {error}") from error


def with_retries(look: Callable[[], Returned]) -> Callable[[], Returned]:
    """``look`` again where a frame did not come whole, three times. Raises FrameError then."""

    def again() -> Returned:
        for _ in range(TRIES - 1):
            with suppress(FrameError):
                return look()
        return look()

    return again


def pictures(frames: FrameSet) -> dict[str, Grey]:
    """Each camera's 8-bit picture; temperatures are stretched where there is nothing else."""
    thermal = frames.thermal
    if thermal is None and frames.thermal_ck is not None:
        low, high = np.percentile(frames.thermal_ck, [0.5, 99.5])
        stretched = np.rint((frames.thermal_ck - low) * (255.0 / max(1.0, high - low)))
        thermal = np.clip(stretched, 0.0, 255.0).astype(np.uint8)
    pair = {"left": frames.left, "right": frames.right}
    return pair if thermal is None else {**pair, "thermal": thermal}


def figures(picture: Grey) -> dict[str, object]:
    """What one picture says of its camera; units are in the names."""
    return {
        "size_px": f"{picture.shape[1]} x {picture.shape[0]}",
        "mean_dn": round(float(picture.mean()), 1),
        "brightest_dn": level_dn(picture, 0.995),
        "white_percent": round(100.0 * saturated_share(picture), 2),
        "edge_blur_px": None if (blur_px := edge_blur_px(picture)) is None else round(blur_px, 2),
    }


def list_cameras(rig: AnyRig | None = None) -> Iterator[tuple[str, str]]:
    """URL and name of each camera that this machine lists, of which OpenCV's are not opened; or
    each one of ``rig``, with its URL and what becomes of its frames. Raises ConfigError.
    """
    if rig is not None:
        of = any_rig(rig)
        cameras = of.rig.cameras
        if cameras.url:
            yield "all", cameras.url
        for camera, table in cameras.tables.items():
            yield camera, f"{table.url} {conversion_of(table, of.made_calibration)}"
        return
    for device in sorted(Path("/sys/class/video4linux").glob("video*")):
        name = (device / "name").read_text(encoding="utf-8").strip()
        yield f"opencv:{device.name.removeprefix('video')}", name
    try:
        aravis = load_aravis()
    except DeviceError as error:
        yield "genicam:", f"not looked for: {error}"
        return
    aravis.update_device_list()
    for i in range(aravis.get_n_devices()):
        keys = ("vendor", "model", "serial_nbr", "protocol")
        who = " ".join(str(getattr(aravis, f"get_device_{key}")(i)) for key in keys)
        yield f"genicam:{aravis.get_device_id(i)}", f"{who} at {aravis.get_device_address(i)}"


KEYS = {"X": "x_mm", "Y": "y_mm", "Z": "z_mm", "A": "a_deg"}


@contextmanager
def open_stage(
    url: str | None = None,
    *,
    rig: AnyRig = "",
    axes: str = "XY",
    dialect: str = "grbl",
    capture: CaptureFile | None = None,
) -> Iterator[Stage]:
    """The stage at ``url`` (``axes`` of X, Y, Z, A; ``dialect`` grbl, marlin), or that of ``rig``:
    connected, in real time, stopped at the end. Raises ConfigError, InstrumentError.
    """
    if url:
        _refuse_address("stage", url, stage_url)
        at = checked(StageTable, {"url": url, "axes": axes, "dialect": dialect})
    else:
        of = any_rig(rig)
        if of.rig.stage is None or is_emulated(of.rig.stage.url):
            emulated = "its stage is emulated; 'teatbench emulate' serves one at a port, for `url`"
            none = "this rig has no stage; the operator moves its phantom"
            raise ConfigError.plain(f"{of.path}: {emulated if of.rig.stage else none}")
        at = of.rig.stage
    with open_instruments(rig_of(stage=at), ("stage",), capture=capture) as devices:
        stage = devices.stage
        assert stage  # noqa: S101 - it was asked for
        stage.connect()
        with lent(stage, "stage") as given:
            yield given


def _refuse_address(kind: str, url: str, check: Callable[[str], object]) -> None:
    """Raises ConfigError where no device of its own can be at ``url``."""
    try:
        if is_emulated(url):
            raise ValueError(EMULATED_ALONE.format(kind))
        check(url)
    except ValueError as error:
        raise ConfigError.plain(f"{url!r} is no {kind}: {error}") from error


def bath_profile(name: str) -> Profile:
    """A shipped profile by its name, or one of the user's own by its path. Raises ConfigError."""
    known = profile_names()
    if not name.endswith(".toml") and name not in known:
        near, there = did_you_mean(name, known) or ".", ", ".join(known)
        raise ConfigError.plain(
            f'no profile "{name}"{near} Shipped: {there}; or the path of a .toml file.'
        )
    try:
        return load_profile(Path(name) if name.endswith(".toml") else name)
    except DeviceFileError as error:
        raise ConfigError.plain(str(error)) from error


def _profile_at(url: str, profile: Profile | str) -> Profile:
    plug = plugin_url(url)
    if plug and profile:
        raise ConfigError.plain(f"{url} says itself what its bath is: leave the profile out")
    if plug:
        return profile_of(load_driver("bath", plug))
    if not profile:
        there = ", ".join(profile_names())
        what = "which controller is there? Name its profile"
        raise ConfigError.plain(f"{url}: {what}. Shipped: {there}; or the path of a .toml file.")
    return bath_profile(profile) if isinstance(profile, str) else profile


@contextmanager
def open_bath(
    url: str,
    profile: Profile | str = "",
    *,
    allow_inferred: bool = False,
    identify: bool = True,
    capture: CaptureFile | None = None,
    leave_running: bool = False,
) -> Iterator[OwnBath]:
    """The bath at ``url``, as in a rig file's [bath], in real time; made safe at the end where it
    was started, unless ``leave_running``. A plug-in says itself what its bath is, and has what
    `instruments.Bath` promises. Raises ConfigError, InstrumentError.
    """
    _refuse_address("bath", url, bath_url)
    of = _profile_at(url, profile)
    rig = rig_of(
        of, bath=BathTable.model_construct(url=url, profile="", allow_inferred=allow_inferred)
    )
    with (
        open_instruments(
            rig, ("bath",), capture=capture, identify=identify, leave_running=leave_running
        ) as devices,
        lent(cast(OwnBath, devices.bath), "bath") as bath,
    ):  # no plug-in has the rows of a profile
        yield bath


def describe_stage(stage: Stage) -> dict[str, object]:
    """Identity, state, position and travel; units are in the names."""
    identity, settings, status = stage.identity, stage.settings, stage.status()
    travel = {f"travel_{KEYS[axis]}": [at.low_mm, at.high_mm] for axis, at in stage.limits.items()}
    reports = identity.dialect in ("Grbl", "grblHAL", "FluidNC")
    pins = {"pins": ", ".join(status.pins) or "none active"} if reports else {}
    return {
        **{key: getattr(identity, key) for key in ("dialect", "version", "build")},
        "state": status.name,
        "homed": stage.homed,
        **pins,
        **position(stage),
        **travel,
        **{key: getattr(settings, key) for key in ("homing", "soft_limits", "hard_limits")},
    }


def position(stage: Stage) -> dict[str, float]:
    """Where the stage is by its controller, by axis with its unit, machine coordinates."""
    return {
        KEYS[axis]: round(float(at), 3)
        for axis, at in zip("XYZA", stage.position(), strict=False)
        if axis in stage.axes
    }


def shown(stage: Stage) -> str:
    return ", ".join(f"{key[0].upper()} {at:.3f} {key[2:]}" for key, at in position(stage).items())


def check_target(
    stage: Stage, x_mm: float, y_mm: float, *, z_mm: float | None = None, a_deg: float | None = None
) -> None:
    """Raise LimitError for a place that the stage can't go to, before anything moves."""
    target = declared({"X": x_mm, "Y": y_mm, "Z": z_mm, "A": a_deg}, stage.axes, who="stage")
    check_within(target, stage.settings, "move", who="stage")


def check_rig(
    rig: AnyRig, capture: CaptureFile | None = None
) -> Iterator[tuple[str, bool, list[str]]]:
    """For each instrument: its name, whether it has a fault, and lines to print."""
    rig = any_rig(rig)
    remote = rig.rig.operator.url.startswith(ELSEWHERE)
    names = [n for n in ALL if n in rig.rig.urls and (n != "operator" or remote)]
    with ExitStack() as stack:
        clock: Clock = VirtualClock()
        twin = None
        if not rig.rig.simulated:
            clock = stack.enter_context(closing(RealClock()))
        if rig.rig.emulated:
            twin = stack.enter_context(EmulatedRig(rig, clock, rig.rig.seed))
        for name in names:
            if unfilled := rig.unfilled(name):
                yield name, True, unfilled
                continue
            try:
                with open_instruments(rig, (name,), clock, twin=twin, capture=capture) as devices:
                    device = getattr(devices, name)
                    note = [*_READ[name](device)]
                    who: Any = device.identity
                    if is_dataclass(who) and not isinstance(who, type):
                        who = asdict(who)
                    note += who.items()
                    if hasattr(device, "safe_state"):  # cameras have none
                        note.append(("safe state", device.safe_state))
                    yield name, False, [f"{key}: {value}" for key, value in note if value != ""]
            except InstrumentError as error:
                yield name, True, [str(error)]


def _arm(arm: Any) -> Iterator[tuple[str, str]]:
    arm.sign_on()
    if seen := arm.glance():
        yield "counts", " ".join(map(str, seen.counts)) or "none"
    else:  # where its points come from
        yield from ((key, str(value)) for key, value in arm.record().items())
    for warning in arm.warnings:
        yield "warning", warning
    yield "position", "only after homing is confirmed ('teatbench run' asks for it)"


def _bath(bath: Any) -> Iterator[tuple[str, str]]:
    reading = bath.read()
    power = reading.power_percent
    output = "not reported" if power is None else f"{power:g} %"
    yield "temperature", f"{reading.temp_c:.2f} degC, output {output}"
    if bath.pump == "own":
        yield "pump", bath.profile.row(PUMP).label(bath.get(PUMP))
    elif bath.pump == "none":
        yield "pump", "not fitted to the controller"


def _stage(stage: Any) -> Iterator[tuple[str, str]]:
    stage.connect()
    yield "position", shown(stage) + " (machine)" + ("" if stage.homed else ", not homed")


def _cameras(cameras: Any) -> Iterator[tuple[str, str]]:
    frames = cameras.capture()
    for name in KNOWN:
        image = getattr(frames, name)
        if image is not None:
            yield name, f"{image.shape[1]} x {image.shape[0]}, mean level {image.mean():.1f}"
    if (depth := frames.depth_dmm) is not None:
        measured = 100.0 * np.count_nonzero(depth) / depth.size
        yield "depth", f"{depth.shape[1]} x {depth.shape[0]}, {measured:.0f} % of it measured"


_READ: dict[str, Callable[[Any], Iterator[tuple[str, str]]]] = {
    "arm": _arm,
    "bath": _bath,
    "stage": _stage,
    "cameras": _cameras,
    "operator": lambda _: iter(()),
}

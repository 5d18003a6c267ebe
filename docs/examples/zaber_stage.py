"""A Zaber stage over its maker's library.

    pip install zaber-motion
    [stage]
    url = "plugin:zaber?url=/dev/ttyUSB0&devices=1,2&microsteps=2015.748,2015.748"
    reference_mm = [150.0, 150.0]

In pyproject.toml of your package:

    [project.entry-points."teatbench.stages"]
    zaber = "zaber_stage:ZaberStage"

This library opens ports by itself, so that a capture has no bytes of this stage. On an emulator in
virtual time it takes no real time, as no call here waits for an end. Firmware 7.25 or newer, whose
moves have a speed of their own. Keys: ``url`` (a serial port, or ``tcp://host:port``); ``devices``
in the order of ``axes``, each an address or ``address.axis``; ``microsteps`` per mm, per degree of
A.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from urllib.parse import urlsplit

from zaber_motion import Units
from zaber_motion import exceptions as zaber
from zaber_motion.ascii import Connection

from instruments import Clock, DeviceError, LimitError, LinkError, StageState

SPEED = 1.6384  # the unit of speeds: microsteps a second times this
UNHOMED = {"WR", "WH"}  # no reference position, not homed
LOST = (
    zaber.ConnectionClosedException,
    zaber.ConnectionFailedException,
    zaber.RequestTimeoutException,
    zaber.SerialPortBusyException,
)


class ZaberStage:
    """Places are the devices' own positions, in mm (A: degrees)."""

    axes = "XY"

    def __init__(
        self, clock: Clock, url: str, devices: str, microsteps: str, axes: str = "XY"
    ) -> None:
        del clock  # no call waits for an end
        self.axes, self._url = axes, url
        steps = [float(one) for one in microsteps.split(",")]
        places = [one.partition(".")[::2] for one in devices.split(",")]
        if not len(axes) == len(places) == len(steps) or min(steps) <= 0.0:
            what = f"{len(places)} devices and {len(steps)} microsteps for the axes {axes}"
            raise LimitError("Zaber", what, hint="Give one above 0 for each axis.")
        self._steps = dict(zip(axes, steps, strict=True))
        with self._errors("open"):
            self._connection = _opened(url)
        try:
            self._axes = {
                letter: self._connection.get_device(int(address)).get_axis(int(number or 1))
                for letter, (address, number) in zip(axes, places, strict=True)
            }
            with self._errors("identify"):
                self._identify()
        except BaseException:
            self.close()
            raise

    def _identify(self) -> None:
        own = {axis.device.device_address: axis.device for axis in self._axes.values()}.values()
        self.identity = {
            name: ", ".join(device.generic_command(f"get {key}").data for device in own)
            for name, key in (("serial_number", "system.serial"), ("firmware", "version"))
        }
        ends = {
            letter: [axis.settings.get(f"limit.{end}") for end in ("min", "max")]
            for letter, axis in self._axes.items()
        }
        self.limits: Mapping[str, tuple[float, float]] = {
            letter: (low / self._steps[letter], high / self._steps[letter])
            for letter, (low, high) in ends.items()
        }
        self.feed_mm_min = min(
            60.0 * axis.settings.get("maxspeed") / SPEED / self._steps[letter]
            for letter, axis in self._axes.items()
        )

    def read(self) -> StageState:
        """Of each axis one answer, which has its place and whether it moves; and its flags."""
        place, flags, moving = dict[str, float](), set[str](), False
        with self._errors("read"):
            for letter, axis in self._axes.items():
                said = axis.generic_command("get pos")
                place[letter] = float(said.data) / self._steps[letter]
                moving |= said.status == "BUSY"
                flags |= axis.warnings.get_flags()
        faults = ", ".join(sorted(flag for flag in flags if flag.startswith("F")))
        return StageState(place, moving, not flags & UNHOMED, faults and f"warning flags {faults}")

    def home(self) -> None:
        with self._errors("home"):
            for axis in self._axes.values():
                axis.home(wait_until_idle=False)

    def move(self, place: Mapping[str, float], feed_mm_min: float) -> None:
        """Each axis at ``feed_mm_min``: they go at once, and it is no straight line."""
        with self._errors("move"):
            for letter, to in place.items():
                steps = self._steps[letter]
                self._axes[letter].move_absolute(
                    round(to * steps),
                    Units.NATIVE,
                    wait_until_idle=False,
                    velocity=round(feed_mm_min / 60.0 * steps * SPEED),
                )

    def stop(self) -> None:
        """Of all devices on the chain."""
        with self._errors("stop"):
            self._connection.stop_all(wait_until_idle=False)

    def close(self) -> None:
        self._connection.close()

    @contextmanager
    def _errors(self, asked: str) -> Iterator[None]:
        try:
            yield
        except zaber.MotionLibException as error:
            who, what = f"Zaber at {self._url}", error.message
            if isinstance(error, LOST):
                raise LinkError(who, what, asked=asked, hint="Check power and cable.") from error
            kind = LimitError if isinstance(error, zaber.BadDataException) else DeviceError
            raise kind(who, what, asked=asked) from error


def _opened(url: str) -> Connection:
    at = urlsplit(url)
    if at.scheme in ("tcp", "socket"):
        return Connection.open_tcp(at.hostname or "", at.port or Connection.TCP_PORT_CHAIN)
    return Connection.open_serial_port(url)

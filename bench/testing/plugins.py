"""A driver of another package as a subject of the conformance suite: on its emulator, where its
package has one, else on the device itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from typing import Any, cast

from bench.config import ConfigError
from bench.rig.opening import emulated_world
from bench.testing.conformance import Finding, NotCheckedError, Subject, Wired, conform
from instruments.clock import Clock, RealClock
from instruments.drivers import entry_points as plugs
from instruments.drivers.arm import PluggedArm
from instruments.drivers.bath import PluggedBath
from instruments.drivers.camera import PluggedCamera, PluggedGroup
from instruments.drivers.entry_points import Kind, Plugin, PluginUrl, available, load
from instruments.drivers.stage import PluggedStage
from instruments.errors import InstrumentError, LimitError
from instruments.listener import Device

LATE_S = 1.0
SET_POINT_C = 30.0


class PluginSubject(Subject):
    """``plugged`` as it is; ``works``: it may heat and move."""

    def __init__(self, kind: Kind, plugged: Plugin, clock: Clock, *, works: bool) -> None:
        self.kind, self.plugged, self.clock, self.works = kind, plugged, clock, works

    def open(self) -> None:
        of, clock = self.plugged, self.clock
        if self.kind == "camera":
            group = hasattr(of.maker, "capture")
            self.driver = PluggedGroup(of, clock) if group else PluggedCamera(of, "left", clock)
        elif self.kind == "stage":
            self.driver = PluggedStage(of, clock, getattr(of.maker, "axes", "XY"))
        else:
            self.driver = {"arm": PluggedArm, "bath": PluggedBath}[self.kind](of, clock)

    def identify(self) -> str:
        ask = {"stage": "connect", "arm": "sign_on"}.get(self.kind)
        return str(getattr(self.driver, ask)() if ask else self.driver.identity)

    def read(self) -> object:
        """What it measures, as steady as such a device is."""
        if self.kind == "bath":
            return round(self.driver.read().temp_c)
        if self.kind == "stage":
            return tuple(self.driver.position().round(2))
        if self.kind == "arm":
            return tuple(self.driver.glance().tip_mm.round(0))
        if isinstance(self.driver, PluggedGroup):
            shapes = {part: one.pixels.shape for part, one in self.driver.capture().items()}
            if stated := self.driver.makers_calibration():
                sizes = {part: shapes[part][1::-1] for part in stated.lenses if part in shapes}
                wanted = {part: lens.size_px for part, lens in stated.lenses.items()}
                assert sizes == wanted, f"its maker's lenses are of {wanted}, pictures {sizes}"  # noqa: S101
            return shapes
        self.driver.prepare()
        self.driver.begin()
        return self.driver.take().pixels.shape

    def work(self) -> None:
        if self.kind not in ("bath", "stage"):
            return
        if not self.works:
            does = "heat" if self.kind == "bath" else "move"
            raise NotCheckedError(f"it may not {does} here (`works`)")
        if self.kind == "bath":
            self.driver.start(SET_POINT_C)
            return
        self.driver.connect()
        self.driver.home()
        limits = self.driver.limits
        self.driver.begin_move(limits["X"].high_mm - 1.0, limits["Y"].high_mm - 1.0)

    def recover(self) -> None:
        if self.kind == "stage":
            self.driver.reconnect()
        elif self.kind == "arm":
            self.driver.recover()
        elif self.kind == "camera":
            with suppress(InstrumentError):
                self.driver.close()
            self.open()
        else:
            self.driver.read()

    def safe(self) -> None:
        if self.kind != "camera":
            self.driver.safe()

    def is_safe(self) -> bool:
        """As the driver reports it; an emulator is asked itself."""
        if self.kind == "bath":
            return bool(self.driver.read().running is False)
        if self.kind == "stage":
            return bool(self.driver.status().name != "Run")
        return True


class OnEmulator(PluginSubject, Wired):
    """The same on its package's emulator, whose ``is_safe``, where it has one, is asked."""

    def __init__(
        self, kind: Kind, plugged: Plugin, clock: Clock, emulator: Any, late_s: float = LATE_S
    ) -> None:
        Wired.__init__(self, clock, emulator, kind, late_s)
        self.emulator = emulator
        at = plugged.with_keys(url=self.listener.url)
        PluginSubject.__init__(self, kind, at, clock, works=True)

    def is_safe(self) -> bool:
        asked = getattr(self.emulator, "is_safe", None)
        return bool(asked()) if asked else super().is_safe()


def drivers() -> dict[str, str]:
    """Each driver of other packages, as ``bath tank``, with where it comes from; none is loaded."""
    return {
        f"{kind} {name}": source + ", with an emulator" * (name in available(plugs.EMULATORS[kind]))
        for kind in plugs.KINDS
        for name, source in available(plugs.GROUPS[kind]).items()
    }


def _installed(driver: str, kind: Kind | None) -> tuple[Kind, Plugin, Callable[..., Any] | None]:
    """Its kind, itself, its emulator if no key names a device. Raises LimitError, ValueError."""
    url = cast(PluginUrl, plugs.plugin_url("plugin:" + driver.removeprefix("plugin:")))
    kinds = [one for one in plugs.KINDS if url.name in available(plugs.GROUPS[one])]
    if len(kinds := [one for one in kinds if kind in (None, one)]) != 1:
        many = f"several: name one by `kind` ({', '.join(kinds)})"
        none = "none is installed. 'teatbench plugin' lists them"
        raise ValueError(f"the driver {driver!r}: {many if kinds else none}")
    emulated = not url.keys and url.name in available(plugs.EMULATORS[kinds[0]])
    emulator = load(kinds[0], url, emulator=True).make if emulated else None
    return kinds[0], load(kinds[0], url), emulator


def _emulated(emulator: Callable[..., Any], world: Any, clock: Clock) -> Device:
    """Raises ConfigError for what makes no emulator, such as the driver itself."""
    try:
        made: Device = emulator(world, clock)
        _ = made.connect, made.receive, made.disconnect
    except Exception as error:
        why = f"makes no emulator of a world and a clock: {type(error).__name__}: {error}"
        raise ConfigError.plain(f"`emulator`: {emulator} {why}") from error
    return made


def check_driver(
    driver: str | Callable[..., Any],
    kind: Kind | None = None,
    *,
    emulator: Callable[..., Any] | None = None,
    works: bool = False,
    clock: Clock | None = None,
) -> Iterator[Finding]:
    """Each check on a driver: ``NAME`` or ``plugin:NAME?key=value`` of another package, on its
    emulator where that has one and no key names a device; or a class of yours of this ``kind``
    (`functools.partial` gives it keys), with its ``emulator``. ``works``: a device may heat and
    move; ``clock``: a virtual one is for emulators, real time for None. Raises ConfigError.
    """
    with ExitStack() as stack:
        time = clock or stack.enter_context(closing(RealClock()))
        try:
            if isinstance(driver, str):
                of, plugged, emulator = _installed(driver, kind)
            elif kind:
                name = getattr(driver, "__name__", kind)  # a partial has none
                of, plugged = kind, Plugin(name, "this program", driver)
            else:
                raise ValueError(f"`kind` is needed of a class: {', '.join(plugs.KINDS)}")
        except (LimitError, ValueError) as error:
            raise ConfigError.plain(str(error)) from error
        if emulator:
            world = stack.enter_context(emulated_world(time, drawn=of == "camera"))
            made = lambda: OnEmulator(of, plugged, time, _emulated(emulator, world, time))  # noqa: E731
            yield from conform(made)
        else:
            yield from conform(lambda: PluginSubject(of, plugged, time, works=works))

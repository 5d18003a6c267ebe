"""A driver of another package as a subject of the conformance suite: on its emulator, where its
package has one, else on the device itself.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import numpy as np

from bench.config import ConfigError
from bench.rig.opening import emulated_world
from bench.testing.conformance import (
    AbortedError,
    Finding,
    NotCheckedError,
    Subject,
    Wired,
    abort_in,
    conform,
)
from instruments.camera.frame import RawFrame
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.drivers import entry_points as plugs
from instruments.drivers.arm import PluggedArm
from instruments.drivers.bath import PluggedBath
from instruments.drivers.camera import PluggedCamera, PluggedGroup
from instruments.drivers.entry_points import Kind, Plugin, PluginUrl, available, load
from instruments.drivers.stage import PluggedStage
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError
from instruments.world.world import World
from textfiles.text import named

LATE_S = 1.0
SET_POINT_C = 30.0
ON_ITS_WAY_S, UP_MM = 0.2, 20.0
UP = np.array([0.0, 0.0, 1.0])
# what an emulated world is changed to, in turn
BATH_C, TIP_MM = (27.0, 23.0), ((40.0, 60.0, 80.0), (30.0, 20.0, 90.0))
STOPS, MISSING = ("standby", "stop"), object()
OWN_TIME = (time.sleep, time.time, time.monotonic, time.perf_counter)


class Watch:
    """Notes what a driver under test does, also where the bench gets over it: by another try, over
    another link, as it closes. ``faults``: what it may not do, in words.
    """

    def __init__(self, plugged: Plugin, clock: Clock) -> None:
        self.plugged, self.clock = plugged, clock
        self.module = getattr(plugged.maker, "__module__", "")
        self.cut = False
        self.cuts = self.interruptions = 0
        self.identity = ""
        self.faults: list[str] = []
        self.made: list[Any] = []  # kept: Python closes the port of what is collected

    @property
    def opened(self) -> tuple[int, int]:
        """What a driver that is opened now has not gone through."""
        return self.cuts, self.interruptions

    @contextmanager
    def over(self, what: str, opened: tuple[int, int]) -> Iterator[None]:
        """A call of a driver."""
        before, virtual = sys.getprofile(), isinstance(self.clock, VirtualClock)
        if virtual:  # in real time all clocks are one
            sys.setprofile(self._called)
        try:
            yield
        except AbortedError:
            raise
        except BaseException as error:
            lost, interrupted = self.cut or opened[0] < self.cuts, opened[1] < self.interruptions
            may: tuple[type[BaseException], ...] = (InstrumentError,)
            if what == "close" or (what in STOPS and not lost):
                may = ()
            elif lost:
                may = LinkError, OSError
            if not isinstance(error, may) and not (interrupted and what != "close"):
                link = " over a lost link" if lost else ""
                self.faults.append(f"{what}{link} raises {named(error)}")
            raise
        finally:
            if virtual:
                sys.setprofile(before)

    def _called(self, frame: Any, event: str, called: Any) -> None:
        if event == "c_call" and called in OWN_TIME:
            module = frame.f_globals.get("__name__")
            if called is time.sleep or module == self.module:
                self.faults.append(f"{module} calls time.{called.__name__}, not the bench's clock")

    def identified(self, given: Any) -> None:
        said = str(given).strip() if given else ""
        if self.identity and said != self.identity:
            self.faults.append(f"its identity is {said}, and was {self.identity}")
        elif not said:
            self.faults.append("its identity is empty")
        self.identity = said


class WatchedDriver:
    """A driver whose calls are watched. It is closed twice each time, and stopped from a thread of
    its own.
    """

    def __init__(self, driver: Any, watch: Watch) -> None:
        self._driver, self._watch, self._opened = driver, watch, watch.opened

    def __getattr__(self, name: str) -> Any:
        with self._watch.over(name, self._opened):
            found = getattr(self._driver, name, MISSING)
        if found is MISSING:
            raise AttributeError(name)
        if name == "identity":
            self._watch.identified(found)
        if not callable(found):
            return found

        def call(*given: Any) -> Any:
            with self._watch.over(name, self._opened):
                return found(*given)

        return call if name not in STOPS else lambda: elsewhere(call)

    def close(self) -> None:
        for _ in range(2):
            with self._watch.over("close", self._opened):
                self._driver.close()


def elsewhere(work: Callable[[], Any]) -> Any:
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(work).result()


@dataclass(frozen=True)
class WatchedPlugin:
    """A plug-in whose driver is watched."""

    watch: Watch

    def __getattr__(self, name: str) -> Any:
        return getattr(self.watch.plugged, name)

    def __str__(self) -> str:
        return str(self.watch.plugged)

    def make(self, clock: Clock) -> WatchedDriver:
        with self.watch.over("opening", self.watch.opened):
            driver = self.watch.plugged.make(clock)
        self.watch.made.append(driver)
        return WatchedDriver(driver, self.watch)


class PluginSubject(Subject):
    """``plugged`` as it is; ``works``: it may heat and move."""

    def __init__(self, kind: Kind, plugged: Plugin, clock: Clock, *, works: bool) -> None:
        self.kind, self.plugged, self.clock, self.works = kind, plugged, clock, works
        self.watch = Watch(plugged, clock)
        self.last: dict[str, Any] = {}
        self.way = 0.0  # of its travel, a stage's last one

    def open(self) -> None:
        of, clock = cast(Plugin, WatchedPlugin(self.watch)), self.clock
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
            seen = self.driver.read()
            return round(seen.temp_c), seen.running
        if self.kind == "stage":
            return tuple(self.driver.position().round(2))
        if self.kind == "arm":
            return tuple(self.driver.glance().tip_mm.round(0))
        if isinstance(self.driver, PluggedGroup):
            frames = self.driver.capture()
            shapes = {part: one.pixels.shape for part, one in frames.items()}
            if stated := self.driver.makers_calibration():
                sizes = {part: shapes[part][1::-1] for part in stated.lenses if part in shapes}
                wanted = {part: lens.size_px for part, lens in stated.lenses.items()}
                assert sizes == wanted, f"its maker's lenses are of {wanted}, pictures {sizes}"  # noqa: S101
            self._new(frames)
            return shapes
        self.driver.prepare()
        self.driver.begin()
        frame = self.driver.take()
        self._new({"": frame})
        return frame.pixels.shape

    def _new(self, frames: Mapping[str, RawFrame]) -> None:
        """Each picture has noise of its own."""
        for part, frame in frames.items():
            if np.array_equal(frame.pixels, self.last.get(part, ())):
                raise AssertionError(
                    f"its {part or 'camera'} picture is the last one to the last bit"
                )
            self.last[part] = frame.pixels

    def change(self) -> object:
        """A stage moves; of a camera each picture is another one."""
        if self.kind == "camera":
            return self.read()
        if self.kind != "stage":
            return super().change()
        self.way += 0.05
        place = self._homed_way_to(self.way)
        self.driver.move_to(*place)
        return self.at(place)

    def at(self, place: Sequence[float]) -> object:
        """What `read` gives of a stage that stands there."""
        return (*(round(float(one), 2) for one in place[:2]), *self.driver.position()[2:])

    def work(self) -> None:
        if self.kind == "bath":
            self._may("heat")
            self.driver.start(SET_POINT_C)
        elif self.kind == "stage":
            place = self._homed_way_to(0.5)
            way_mm = math.dist(place, self.driver.position()[:2])
            # a minute's way: longer than the bench waits for a stand
            self.driver.begin_move(*place, feed_mm_min=way_mm)
        elif self.kind == "arm" and self.driver.touches:
            self._touch()

    def _homed_way_to(self, share: float) -> list[float]:
        """A place on the way from where it was homed to the far ends of X and Y."""
        self._may("move")
        self.driver.connect()
        self.driver.home()
        place = list[float]()
        for axis, at in zip("XY", self.driver.position(), strict=False):
            ends = self.driver.limits[axis]
            far = ends.low_mm if at - ends.low_mm > ends.high_mm - at else ends.high_mm
            place.append(float(at + share * (far - at)))
        return place

    def _touch(self) -> None:
        """Send it up its stylus, and leave it on its way: Ctrl-C."""
        self._may("move")
        self.driver.confirm_homed()
        here = self.driver.glance()
        if here.axis is None:
            raise NotCheckedError("it states no direction of its stylus to move along")
        with suppress(AbortedError, DeviceError, LimitError), abort_in(self.clock, ON_ITS_WAY_S):
            self.driver.touch(here.tip_mm + UP_MM * here.axis, here.axis)

    def _may(self, does: str) -> None:
        if not self.works:
            raise NotCheckedError(f"it may not {does} here (`works`)")

    def forgiven(self) -> str:
        return "; ".join(dict.fromkeys(self.watch.faults))

    def recover(self) -> None:
        if self.kind == "stage":
            self.driver.reconnect()
        elif self.kind == "arm":
            self.driver.recover()
        else:
            with suppress(InstrumentError):
                self.driver.close()
            self.open()

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
        self,
        kind: Kind,
        plugged: Plugin,
        clock: Clock,
        emulator: Any,
        late_s: float = LATE_S,
        *,
        world: World | None = None,
    ) -> None:
        Wired.__init__(self, clock, emulator, kind, late_s)
        self.emulator, self.world, self.changes = emulator, world, 0
        at = plugged.with_keys(url=self.listener.url)
        PluginSubject.__init__(self, kind, at, clock, works=True)

    def _own(self, name: str, read: Callable[[Any], object], without: Callable[[], object]) -> Any:
        """``read`` of what the emulator itself says, where it has such a method."""
        if not hasattr(self.emulator, name):
            return without()
        try:
            return read(getattr(self.emulator, name)())
        except Exception as error:  # another's code
            raise AssertionError(f"the emulator's own {name}(): {plugs.said(error)}") from error

    def is_safe(self) -> bool:
        return bool(self._own("is_safe", bool, super().is_safe))

    def at(self, place: Sequence[float]) -> object:
        at = super().at
        return self._own("position_mm", at, lambda: at(place))

    def change(self) -> object:
        """The water is warmer, or the tip is held elsewhere, in the world that it is made with."""
        self.changes += 1
        if self.world and self.kind == "bath":
            temp_c = BATH_C[self.changes % 2]
            with self.world.lock:
                self.world.plant.be_at(temp_c)
            return round(temp_c), False
        if self.world and self.kind == "arm":
            tip_mm = TIP_MM[self.changes % 2]
            self.world.hold(np.array(tip_mm), UP)
            return tip_mm
        return super().change()

    def forgiven(self) -> str:
        return self.cable.fault or super().forgiven()

    def cut(self) -> None:
        super().cut()
        self.watch.cuts, self.watch.cut = self.watch.cuts + 1, True

    def mend(self) -> None:
        super().mend()
        self.watch.cut = False

    def read_interrupted(self) -> None:
        self.watch.interruptions += 1
        super().read_interrupted()


def drivers() -> dict[str, str]:
    """Each driver of other packages, as ``bath tank``, with where it comes from; none is loaded."""
    return {
        f"{kind} {name}": source + ", with an emulator" * (name in available(plugs.EMULATORS[kind]))
        for kind in plugs.KINDS
        for name, source in available(plugs.GROUPS[kind]).items()
    }


def _installed(driver: str, kind: Kind | None) -> tuple[Kind, Plugin, Callable[..., Any] | None]:
    """Its kind, itself, its emulator if no key names a device. Raises LimitError, ValueError."""
    named = driver.startswith((plugs.PLUGIN, plugs.EMULATOR))
    url = cast(PluginUrl, plugs.plugin_url(driver if named else plugs.PLUGIN + driver))
    kinds = [one for one in plugs.KINDS if url.name in available(plugs.GROUPS[one])]
    if len(kinds := [one for one in kinds if kind in (None, one)]) != 1:
        many = f"several: name one by `kind` ({', '.join(kinds)})"
        none = "none is installed. 'teatbench plugin' lists them"
        raise ValueError(f"the driver {driver!r}: {many if kinds else none}")
    emulated = (url.emulated or not url.keys) and url.name in available(plugs.EMULATORS[kinds[0]])
    emulator = load(kinds[0], url, emulator=True).make if emulated else None
    return kinds[0], load(kinds[0], url), emulator


def check_driver(
    driver: str | Callable[..., Any],
    kind: Kind | None = None,
    *,
    emulator: Callable[..., Any] | None = None,
    works: bool = False,
    clock: Clock | None = None,
) -> Iterator[Finding]:
    """Each check on a driver: ``NAME`` or ``plugin:NAME?key=value`` of another package, on its
    emulator where that has one and no key names a device, or ``emulator:NAME?key=value``; or a
    class of yours of this ``kind`` (`functools.partial` gives it keys), with its ``emulator``.
    ``works``: a device may heat and move; ``clock``: a virtual one is for emulators, real time for
    None. Raises ConfigError.
    """
    with ExitStack() as stack:
        now = clock or stack.enter_context(closing(RealClock()))
        try:
            if isinstance(driver, str):
                of, plugged, emulator = _installed(driver, kind)
            elif kind:
                maker, keys = driver, dict[str, str]()
                if isinstance(driver, partial) and not driver.args:
                    maker, keys = driver.func, driver.keywords
                name = getattr(maker, "__name__", kind)
                of, plugged = kind, Plugin(name, "this program", maker, keys)
            else:
                raise ValueError(f"`kind` is needed of a class: {', '.join(plugs.KINDS)}")
        except (LimitError, ValueError) as error:
            raise ConfigError.plain(str(error)) from error
        if emulator:
            world = stack.enter_context(emulated_world(now, drawn=of == "camera"))
            make = emulator

            def emulated() -> Subject:
                try:
                    return OnEmulator(
                        of, plugged, now, plugs.emulator_of(make, world, now), world=world
                    )
                except LimitError as error:
                    raise ConfigError.plain(f"`emulator`: {error}") from error

            yield from conform(emulated)
        else:
            yield from conform(lambda: PluginSubject(of, plugged, now, works=works))

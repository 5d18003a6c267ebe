"""What docs/drivers.md promises, broken one by one: the conformance suite names the check."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from importlib import import_module
from itertools import count
from typing import Any

import numpy as np
import pytest

from bench.testing.plugins import check_driver
from instruments import BathState, StageState
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.drivers.entry_points import Kind
from tests.lab_drivers import importable, world_of_few_pixels

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings(
        "ignore::pytest.PytestUnraisableExceptionWarning"
    ),  # ports left open
]
Driver = Any
Was = Callable[[], Any]
Make = Callable[[Driver], Driver]
Work = Callable[..., Any]
DRIVERS: dict[str, tuple[Kind, str]] = {
    "Tank": ("bath", "lab_drivers"),
    "Slide": ("stage", "lab_drivers"),
    "Probe": ("arm", "lab_drivers"),
    "Robot": ("arm", "kettle"),
    "Eyes": ("camera", "lab_drivers"),
}
STOP = {"Tank": "standby", "Slide": "stop", "Robot": "stop"}
BEGIN = {"Tank": "start", "Slide": "move", "Robot": "touch"}
READ = dict.fromkeys(DRIVERS, "read") | {"Eyes": "capture"}


def method(where: Mapping[str, str] | str, work: Work) -> Make:
    """A driver whose method ``where`` is ``work`` of itself, of what it was, and its arguments."""

    def make(driver: Driver) -> Driver:
        name = where if isinstance(where, str) else where[driver.__name__]

        def instead(self: Any, *given: Any, **keys: str) -> Any:
            was = partial(getattr(super(faulty, self), name), *given, **keys)
            return work(self, was, *given, **keys)

        faulty = type(driver.__name__, (driver,), {name: instead})
        return faulty

    return make


def both(one: Make, other: Make) -> Make:
    return lambda driver: other(one(driver))


def second_raises(self: Any, was: Was) -> None:
    if vars(self).setdefault("was_called", False):
        raise RuntimeError("not open")
    self.was_called = True
    was()


def first_raises(self: Any, was: Was) -> None:
    if not vars(self).setdefault("was_called", False):
        self.was_called = True
        raise RuntimeError("busy")
    was()


def nothing(*_: Any) -> None: ...


def never_opens_again(driver: Driver) -> Driver:
    """All share the first link to an address."""
    kept: dict[str, Any] = {}

    def opened(self: Any, was: Was, _: object, *, url: str) -> None:
        if url not in kept:
            was()
            kept[url] = {**vars(self)}
        vars(self).update(kept[url])

    return method("__init__", opened)(driver)


def identity(of: Callable[[int], str]) -> Make:
    """``of`` how many were opened."""
    opened: list[object] = []

    def init(self: Any, was: Was, *_: object, **__: object) -> None:
        was()
        opened.append(None)
        said = of(len(opened))
        whole: object = said and {"serial_number": said}
        self.identity = whole or {} if isinstance(self.identity, dict) else said

    return method("__init__", init)


def repeats(*, once: bool) -> Make:
    """It gives the last reading over an earlier link to an address, once or for ever."""
    kept: dict[str, Any] = {}

    def read(self: Any, was: Was) -> Any:
        now = was()
        by, before = kept.setdefault(self.link.url, (self, now))
        if once or by is self:
            kept[self.link.url] = self, now
        if by is self:
            return now
        if isinstance(now, dict):  # an earlier picture, with the time of this one
            return {part: replace(one, pixels=before[part].pixels) for part, one in now.items()}
        return before

    return method(READ, read)


def in_units(of: Callable[[Any], Any]) -> Make:
    """Temperatures, places, or the times of pictures."""

    def read(_: Any, was: Was) -> Any:
        given = was()
        if isinstance(given, dict):
            return {part: replace(one, exposed_s=of(one.exposed_s)) for part, one in given.items()}
        if isinstance(given, BathState):
            return replace(given, temp_c=of(given.temp_c))
        if isinstance(given, StageState):
            return replace(given, place={axis: of(at) for axis, at in given.place.items()})
        return replace(given, tip_mm=of(given.tip_mm))

    return method(READ, read)


def own_errors(_: Any, was: Was, *__: Any) -> Any:
    try:
        return was()
    except Exception as error:
        raise KeyError("gone") from error


def asks_again(_: Any, was: Was, *__: Any) -> Any:
    with suppress(BaseException):
        return was()
    return was()


def sleeps(_: Any, was: Was) -> Any:
    time.sleep(0.001)
    return was()


def hangs(self: Any, was: Was) -> Any:
    self.clock.sleep(40.0)
    return was()


def noted(self: Any, was: Was, *_: Any, **__: Any) -> Any:
    self.noted = threading.get_ident()
    return was()


def stopped_in_words(self: Any, was: Was) -> Any:
    given = was()
    still = {"running": False} if isinstance(given, BathState) else {"moving": False}
    return replace(given, **still) if "noted" in vars(self) else given


def stops_in_words(self: Any, *_: Any) -> None:
    self.noted = True


def if_noted(self: Any, was: Was) -> None:
    if "noted" in vars(self):
        was()


def in_its_thread(self: Any, was: Was) -> None:
    if self.noted != threading.get_ident():
        raise RuntimeError("made in another thread")
    was()


ALL, STOPPED, COUNT = tuple(DRIVERS), tuple(STOP), count()
# what is broken, of which drivers, how, and the beginning of the check that has to fail
BROKEN: list[tuple[str, tuple[str, ...], Make, str]] = [
    ("opens no second link", ALL, never_opens_again, "lost link"),
    ("no identity", ALL, identity(lambda _: ""), "says who"),
    ("another identity each time", ALL, identity(str), "closes twice"),
    ("not a number", ALL, in_units(lambda value: value * np.nan), "says who"),
    ("another unit", ALL[:-1], in_units(lambda value: 1.3 * value + 10.0), "reads what"),
    ("pictures of another clock", ("Eyes",), in_units(lambda s: s + 3600.0), "says who"),
    ("reads at random", ALL[:-1], in_units(lambda value: value + 2.0 * next(COUNT)), "says who"),
    ("repeats itself", ALL, repeats(once=False), "reads what"),
    ("repeats itself once on a new link", ALL, repeats(once=True), "reads what"),
    ("exceptions of its own", ALL, method("ask", own_errors), "lost link"),
    ("hangs", ALL, method(READ, hangs), "says who"),
    ("sleeps by another clock", ALL, method(READ, sleeps), "says who"),
    ("asks again after Ctrl-C", ALL, method("ask", asks_again), "abort"),
    ("the second close raises", ALL, method("close", second_raises), "closes twice"),
    ("close leaves its port open", ALL, method("close", nothing), "closes twice"),
    ("the first stop raises", STOPPED, method(STOP, first_raises), "safe twice"),
    ("the second stop raises", STOPPED, method(STOP, second_raises), "safe twice"),
    ("stops nothing", STOPPED, method(STOP, nothing), "safe twice"),
    ("stops in words", STOPPED, both(method(STOP, stops_in_words), method(READ, stopped_in_words)), "safe twice"),
    ("stops what it began itself", STOPPED, both(method(BEGIN, noted), method(STOP, if_noted)), "safe over"),
    ("stops in its own thread", STOPPED, both(method("__init__", noted), method(STOP, in_its_thread)), "safe twice"),
    ("heats to another set point", ("Tank",), method(BEGIN, lambda self, *_: self.ask("start", 29.0)), "safe twice"),
]  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def _packages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    folder = tmp_path_factory.mktemp("packages")
    with importable(folder / "site"), world_of_few_pixels(folder):
        yield


@pytest.fixture(scope="module", autouse=True)
def _ports_left_open_are_python_s_to_close() -> Iterator[None]:
    """Here, not amid another module's tests."""
    yield
    gc.collect()


def failed(
    name: str, broken: Make, last: str = "none", clock: Clock | None = None
) -> dict[str, str]:
    """Why each check failed, up to the one that begins with ``last``."""
    kind, module = DRIVERS[name]
    there = import_module(module)
    emulator = getattr(there, f"{name}Emulator")
    said: dict[str, str] = {}
    # what is left of its generator closes what it has opened
    for one in check_driver(
        broken(getattr(there, name)), kind, emulator=emulator, clock=clock or VirtualClock()
    ):
        if one.outcome != "passed":
            said[one.check] = one.why
        if one.check.startswith(last):
            break
    return said


@pytest.mark.parametrize(
    ("name", "broken", "check"),
    [
        pytest.param(name, broken, check, id=f"{name} {promise}")
        for promise, names, broken, check in BROKEN
        for name in names
    ],
)
def test_a_broken_promise_fails_its_check(name: str, broken: Make, check: str) -> None:
    said = failed(name, broken, check)
    [why] = [why for one, why in said.items() if one.startswith(check)]
    assert not why.startswith(("it can't be opened", "cause as of")), said


def test_a_port_that_is_left_to_python_to_close_is_seen_in_real_time() -> None:
    with closing(RealClock()) as clock:
        said = failed("Tank", method("close", nothing), "closes", clock)
    assert [*said.values()] == ["its port is open though it was closed"]


@pytest.mark.parametrize("name", DRIVERS)
def test_the_same_driver_with_its_promises_kept_passes(name: str) -> None:
    assert failed(name, lambda driver: driver) == {}


@pytest.mark.parametrize("name", DRIVERS)
def test_its_keys_may_be_given_by_partial(name: str) -> None:
    def keyed(driver: Driver) -> Driver:
        def init(self: Any, clock: object, url: str, many: str) -> None:
            driver.__init__(self, clock, url)

        return partial(type("Keyed", (driver,), {"__init__": init}), many="1")

    assert failed(name, keyed) == {}

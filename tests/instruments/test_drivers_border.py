"""Nothing but an InstrumentError comes out of a driver of another package, whatever one of its
members gives or raises; and what comes out of it is a value that the bench can use.
"""

from __future__ import annotations

import builtins
import hashlib
import itertools
import json
import logging
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.safety.signals import installed
from instruments import (
    ArmPoint,
    BathState,
    LinkError,
    MakersCalibration,
    MakersLens,
    Ranging,
    RawFrame,
    RealClock,
    StageState,
    VirtualClock,
)
from instruments.camera.cameras import CameraSet
from instruments.drivers import border
from instruments.drivers.arm import PluggedArm
from instruments.drivers.bath import PluggedBath
from instruments.drivers.camera import PluggedCamera, PluggedGroup
from instruments.drivers.entry_points import Plugin
from instruments.drivers.stage import PluggedStage
from instruments.errors import InstrumentError
from tests.conftest import ROOT
from tests.waiting import PATIENCE_S

if sys.platform != "win32":
    import resource


class OwnError(BaseException):
    """Whose words fail."""

    def __str__(self) -> str:
        raise ValueError


class Evil:
    """Whatever is asked of it fails."""

    __hash__ = None  # type: ignore[assignment]

    def _fails(self, *_: object) -> Any:
        raise RuntimeError

    __bool__ = __eq__ = __float__ = __iter__ = __repr__ = __len__ = _fails


GREY = np.zeros((4, 4), np.uint8)
EVIL: Any = Evil()
NONE: Any = None
TEXT: Any = "x"
NAN = float("nan")
# so much that no thread can be started; Windows takes less than 256 MiB
HUGE_STACK = 1 << 40 if sys.platform != "win32" else (1 << 28) - (1 << 16)
LENS = MakersLens((4, 4), np.eye(3))
PLACE, UP = {"X": 0.0, "Y": 0.0}, np.array([0.0, 0.0, 1.0])
GIVEN: tuple[Any, ...] = (
    *(None, object(), EVIL, True, 0, -1, NAN, 10**400, "x", b"", [], (), {}, {"a": EVIL}),
    *(np.array([]), np.full(3, np.nan), ("left", EVIL), {"X": ("a", 1)}, {"X": EVIL}),
    *({"X": (300.0, 0.0), "Y": (0.0, 300.0)}, {"X": (0.0, NAN), "Y": (0.0, 1.0)}),
    *(BathState(EVIL, True, 1.0), BathState(20.0, NONE, 30.0), BathState(20.0, False, 10**400)),
    *(BathState(20.0, True, 30.0, EVIL), BathState(20.0, True, 30.0, alarm=EVIL)),
    *(StageState(NONE, False, True), StageState({"X": TEXT}, False, True)),
    *(StageState(PLACE, False, EVIL), StageState(PLACE, False, True, EVIL)),
    *(StageState({**PLACE, "Z": TEXT}, False, True), StageState(TEXT, False, True)),
    *(ArmPoint(EVIL), ArmPoint(np.zeros(3), TEXT), ArmPoint(np.zeros(3), np.zeros(3))),
    *(ArmPoint(np.zeros(3), np.zeros(2)), ArmPoint(np.zeros(3), None, EVIL)),
    RawFrame(np.broadcast_to(np.uint8(3), (1 << 20, 1 << 20)), 0.0),
    *(RawFrame(GREY.astype(kind), 0.0) for kind in (object, str, complex, np.float64, bool)),
    *(RawFrame(np.zeros((4, 4, 7), np.uint8), 0.0), RawFrame(GREY, EVIL), RawFrame(GREY, NAN)),
    *(RawFrame(GREY, 0.0, bits) for bits in (TEXT, -3, 10**9, EVIL)),
    *(RawFrame(GREY, 0.0, ranging=EVIL), RawFrame(GREY, 0.0, amplitude=EVIL)),
    *({"left": RawFrame(GREY, 0.0)}, {"left": RawFrame(GREY, 0.0), "right": EVIL}),
    *(MakersCalibration(NONE), MakersCalibration({"left": EVIL}), MakersCalibration({}, EVIL)),
    *(SystemExit("bye"), KeyError("k"), MemoryError(), GeneratorExit(), OwnError(), OSError()),
    *(StopIteration(), LinkError("me", "gone"), UnicodeDecodeError("utf8", b"x", 0, 1, "r")),
)
MAKES: dict[str, Callable[[Plugin, Any], Any]] = {
    "bath": PluggedBath,
    "stage": lambda plugged, clock: PluggedStage(plugged, clock, "XY"),
    "arm": PluggedArm,
    "camera": lambda plugged, clock: PluggedCamera(plugged, "left", clock),
    "group": PluggedGroup,
}
RIGHT: dict[str, Mapping[str, Any]] = {
    "bath": {"range_c": (15.0, 60.0), "step_k": 0.01, "pump": "none", "comms_loss": "hold", "identity": {"is": "1"}, "read()": BathState(20.0, False, 30.0), **dict.fromkeys(("start()", "standby()", "close()"))},
    "stage": {"axes": "XY", "feed_mm_min": 3000.0, "identity": {"is": "1"}, "limits": {"X": (0.0, 300.0), "Y": (0.0, 300.0)}, "read()": StageState(PLACE, False, True), **dict.fromkeys(("home()", "move()", "stop()", "close()"))},
    "arm": {"homing": "h", "touches": True, "identity": {"serial_number": "1"}, "read()": ArmPoint(np.zeros(3), UP), **dict.fromkeys(("touch()", "stop()", "close()"))},
    "camera": {"identity": "c", **dict.fromkeys(("prepare()", "begin()", "close()")), "take()": RawFrame(GREY, 0.0, ranging=Ranging(1.0))},
    "group": {"identity": "g", "parts": ("left", "right"), "close()": None, "capture()": {part: RawFrame(GREY, 0.0) for part in ("left", "right")}, "makers_calibration()": MakersCalibration({"left": LENS, "right": LENS})},
}  # fmt: skip
CALLS: dict[str, Callable[[Any], list[Callable[[], object]]]] = {
    "bath": lambda d: [
        *(d.read, lambda: d.start(30.0), lambda: d.set_point(30.0), d.standby, d.safe),
        lambda: d.get("temperature"),
    ],
    "stage": lambda d: [
        *(d.connect, d.home, d.status, d.position, lambda: d.move_to(10.0, 10.0), d.brake),
        *(lambda: d.jog(x_mm=1.0), d.stop, d.stands, d.recover, d.reconnect),
    ],
    "arm": lambda d: [
        *(d.sign_on, d.confirm_homed, d.read, d.glance, lambda: d.touch(np.zeros(3), UP)),
        *(d.safe, d.record, d.recover),
    ],
    "camera": lambda d: [
        *(d.prepare, d.begin, d.take),
        lambda: CameraSet(dict.fromkeys(("left", "right"), lambda: d), {}).capture(),
    ],
    "group": lambda d: [
        *(d.capture, d.makers_calibration),
        lambda: CameraSet({}, {}, lambda: d).capture(),
    ],
}


# what is asked again and again
LATE = "read()", "take()", "capture()"
# by a device whose readings never change
DONE = {"bath": 4, "stage": 10, "arm": 8, "camera": 4, "group": 3}


def gives(value: Any) -> Callable[..., Any]:
    def call(*_: object) -> Any:
        if isinstance(value, BaseException):
            raise value
        return value

    return call


def driver(kind: str, member: str, given: Any) -> type:
    """Right but for one member."""
    members: dict[str, Any] = {"__init__": lambda self, clock: None}
    for name, value in {**RIGHT[kind], **({member: given} if member else {})}.items():
        fails = isinstance(value, BaseException)
        one = gives(value)
        members[name.removesuffix("()")] = (
            one if name.endswith("()") else property(one) if fails else value
        )
    return type("Driver", (), members)


YES, AT = np.True_, dict[str, Any](X=np.float32(1.0), Y=2)
ASKED = {"bath": [0], "stage": [0, 2], "arm": [0, 3], "camera": [2], "group": [0, 1]}  # of CALLS
ODD: list[tuple[str, str, Any, str]] = [
    ("bath", "read()", BathState(Decimal("20.1"), YES, 30), ""),  # type: ignore[arg-type]
    ("bath", "read()", BathState(20.1, TEXT, 30.0), "running is neither True nor False .*str: x"),
    ("bath", "read()", (20.1, True, 30.0), "no BathState"),
    ("bath", "pump", "own", "pump is 'own', not 'none' or 'with run'"),
    ("bath", "comms_loss", "halt", "comms_loss is 'halt', not 'hold' or 'stop' or 'unknown'"),
    ("stage", "read()", StageState(AT, YES, 0), ""),  # type: ignore[arg-type]
    ("stage", "read()", StageState(AT, NONE, False), "moving is neither"),
    ("stage", "read()", StageState(np.zeros(2), False, False), "place is no mapping by axis"),  # type: ignore[arg-type]
    ("stage", "limits", {"x": (0, 300), "y": (0, 300)}, "limits are no pairs of numbers by axis"),
    ("stage", "read()", StageState(PLACE, False, True, "\x1b[31mlid\nopen"), r": \[31mlid open.*pkg 1"),
    ("stage", "feed_mm_min", -5.0, "feed is not above 0 mm/min"),
    ("stage", "axes", "xy", "axes are none of XY, XYZ, XYA, XYZA"),
    ("arm", "read()", ArmPoint(np.zeros(3), moving=TEXT), "moving is neither"),
    ("camera", "take()", GREY, r"no RawFrame \(got ndarray"),
    ("camera", "take()", RawFrame(TEXT, 0.0), r"no array of NumPy \(got str"),
    ("camera", "take()", RawFrame(GREY.astype(np.int64), 0.0), "8 or 16 bits .*int64"),  # type: ignore[arg-type]
    ("group", "capture()", {"left": RawFrame(GREY, 0.0)}, "no right frame.*Look at .* d of pkg 1"),
    *(("group", "makers_calibration()", MakersCalibration(*given), f"maker's calibration: {said}")
      for given, said in (
          (({"left": LENS, "right": NONE},), "right: 'NoneType'"), ((NONE,), "lenses: "),
          (({"left": MakersLens(NONE, np.eye(3))},), "left: 'None"), (({"left": LENS}, NONE), "sd: "))),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "member", "given", "said"), ODD)
def test_an_odd_value_is_taken_or_called_by_its_name(
    kind: str, member: str, given: Any, said: str
) -> None:
    with pytest.raises(InstrumentError, match=said) if said else nullcontext():
        device = MAKES[kind](Plugin("d", "pkg 1", driver(kind, member, given)), VirtualClock())
        for number in ASKED[kind]:
            CALLS[kind](device)[number]()


def test_a_driver_does_not_interrupt_the_bench_nor_change_its_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In virtual time, where the bench handles signals; its words are cut, and can be printed."""
    made, here, path = driver("bath", "read()", None), Path.cwd(), [*dict.fromkeys(sys.path)]
    monkeypatch.setattr(sys, "path", [*path])
    mask, level = os.umask(0o027), logging.root.level

    def fails(*_: object) -> None:
        raise RuntimeError("not here")

    log = logging.Handler()
    monkeypatch.setattr(log, "emit", fails)

    def odd(_: object) -> None:
        os.chdir(tmp_path)
        os.umask(0o777)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        np.seterr(all="raise")
        sys.path.clear()
        sys.meta_path.clear()
        threading.stack_size(HUGE_STACK)
        builtins.open = time.sleep = json.dumps = fails  # type: ignore[assignment]
        os.replace = hashlib.sha256 = None  # type: ignore[assignment]
        del sqlite3.connect
        threading.settrace(fails)
        sys.setrecursionlimit(200)
        logging.root.addHandler(log)
        logging.root.setLevel(logging.DEBUG)
        if sys.platform != "win32":
            resource.setrlimit(
                resource.RLIMIT_AS, (1 << 40, resource.getrlimit(resource.RLIMIT_AS)[1])
            )
        raise KeyboardInterrupt("\x1b[31m" + "x" * 999)

    made.read = odd  # type: ignore[attr-defined]
    said = r"^bath d: KeyboardInterrupt: \[31mx{100,180}\.\.\. .*the plug-in d of pkg 1"
    with np.errstate(), installed():
        before = _of_the_process()
        with pytest.raises(InstrumentError, match=said):
            PluggedBath(Plugin("d", "pkg 1", made), VirtualClock()).read()
        assert _of_the_process() == before
        try:
            logging.getLogger("of another library").debug("a word")
        finally:
            logging.root.removeHandler(log)
            logging.root.setLevel(level)
    assert Path.cwd() == here
    assert sys.path == path
    assert os.umask(mask) == 0o027


def _of_the_process() -> tuple[object, ...]:
    stack = threading.stack_size(0)
    threading.stack_size(stack)
    handlers = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    limit: object = None
    if sys.platform != "win32":
        limit = resource.getrlimit(resource.RLIMIT_AS)
    calls = open, time.sleep, json.dumps, os.replace, hashlib.sha256, sqlite3.connect
    traced = threading.gettrace(), sys.getrecursionlimit()
    return *handlers, np.geterr(), stack, *calls, *traced, [*sys.meta_path], limit


FORKS = """
import os
from instruments import BathState, VirtualClock
from instruments.drivers.bath import PluggedBath
from instruments.drivers.entry_points import Plugin

class Forks:
    identity, range_c, step_k, pump, comms_loss = {"model": "x"}, (15, 60), 0.1, "none", "hold"
    def __init__(self, clock): pass
    def close(self): pass
    def standby(self): pass
    def start(self, set_point_c): pass
    def read(self):
        if os.fork() == 0 and RAISES:
            raise SystemExit
        return BathState(20.0, False, 20.0)

bath = PluggedBath(Plugin("forks", "pkg 1", Forks), VirtualClock())
print(bath.read().temp_c, flush=True)
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.parametrize("raises", [False, True])
def test_a_copy_of_the_process_that_a_driver_forks_does_not_come_back(raises: bool) -> None:
    command = [sys.executable, "-c", f"RAISES = {raises}\n{FORKS}"]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (ended.stdout, ended.stderr) == ("20.0\n", "")


@pytest.mark.parametrize("seconds", [float("inf"), 61.0])
def test_a_driver_that_sleeps_for_ever_is_named(seconds: float) -> None:
    clock, made = VirtualClock(), driver("bath", "read()", None)

    def again() -> None:
        clock.call_at(clock.now() + 1.0, again)

    again()
    made.read = lambda _: clock.sleep(seconds)  # type: ignore[attr-defined]
    with pytest.raises(InstrumentError, match="the plug-in d of pkg 1"):
        PluggedBath(Plugin("d", "pkg 1", made), clock).read()


def test_axes_that_cancel_out_are_no_direction() -> None:
    made, axes = driver("arm", "", None), itertools.cycle((UP, -UP))
    made.read = lambda _: ArmPoint(np.zeros(3), next(axes))  # type: ignore[attr-defined]
    arm = PluggedArm(Plugin("d", "pkg 1", made), VirtualClock())
    arm.sign_on()
    arm.confirm_homed()
    with pytest.raises(InstrumentError, match=r"its axes are opposite.*pkg 1"):
        arm.read()


def test_a_key_that_is_no_number_is_said_as_a_key() -> None:
    plugged = Plugin("d", "pkg 1", lambda _, port: int(port), {"port": "abc"})
    with pytest.raises(InstrumentError, match=r"'abc'.*Correct the keys of plugin:d\?port=abc"):
        PluggedGroup(plugged, VirtualClock())


@pytest.mark.slow
@pytest.mark.parametrize("kind", MAKES)
def test_nothing_but_an_error_of_an_instrument_comes_out(kind: str) -> None:
    clock = VirtualClock()

    def tried(maker: Any) -> int:
        """How many calls did what they should."""
        done = 0
        with suppress(InstrumentError):
            device = MAKES[kind](Plugin("d", "pkg 1", maker), clock)
            for call in (*CALLS[kind](device), device.close, device.close):
                with suppress(InstrumentError):
                    call()
                    done += 1
        return done - 2

    assert tried(driver(kind, "", None)) == DONE[kind]
    for given in GIVEN:
        for member in RIGHT[kind]:
            tried(driver(kind, member, given))
        maker = gives(given)
        vars(maker).update({n: v for n, v in RIGHT[kind].items() if not n.endswith("()")})
        assert tried(maker) <= 1, "such an object is no driver"


@pytest.mark.parametrize("kind", MAKES)
def test_a_call_that_is_late_by_a_virtual_clock_is_a_lost_link(kind: str) -> None:
    """As in real time, so that a rehearsal shows it."""
    clock, made = VirtualClock(), driver(kind, "", None)
    member = next(name.removesuffix("()") for name in LATE if name in RIGHT[kind])
    made_in_time = getattr(made, member)

    def late(*given: Any) -> Any:
        clock.sleep(61.0)
        return made_in_time(*given)

    device = MAKES[kind](Plugin("d", "pkg 1", made), clock)
    calls = CALLS[kind](device)
    setattr(made, member, late)
    with pytest.raises(InstrumentError, match=r"no answer .*the plug-in d of pkg 1 hangs"):
        _ = [call() for call in calls]


def test_a_long_call_has_a_heartbeat(monkeypatch: pytest.MonkeyPatch) -> None:
    """Homing takes a minute, and a guardian takes a bench without one for hung after 10 s."""
    monkeypatch.setattr(border, "BEAT_S", 0.01)
    clock, beats, made = RealClock(), threading.Semaphore(0), driver("stage", "", None)
    stage = MAKES["stage"](Plugin("d", "pkg 1", made), clock)
    stage.connect()

    def beat(_: float) -> None:
        if threading.current_thread() is threading.main_thread():
            beats.release()

    def home(_: object) -> None:
        clock.subscribe(beat)
        for _beat in range(9):
            assert beats.acquire(timeout=PATIENCE_S)

    made.home = home  # type: ignore[attr-defined]
    stage.home()
    assert stage.homed
    clock.close()


@pytest.mark.parametrize("kind", MAKES)
def test_a_close_that_never_ends_costs_two_seconds(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    over, clock = threading.Event(), RealClock()
    monkeypatch.setattr(border, "CLOSE_S", 0.2)
    made = driver(kind, "", None)
    made.close = lambda _: over.wait(60.0)  # type: ignore[attr-defined]
    device = MAKES[kind](Plugin("d", "pkg 1", made), clock)
    CALLS[kind](device)[0]()  # opens it
    began_s = clock.now()
    device.close()
    assert clock.now() - began_s < 30.0
    over.set()
    clock.close()

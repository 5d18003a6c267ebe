"""A bath of another package stays on in no case: its driver dies, lies, raises or hangs in the
process that heats, and the guardian opens it in its own, by URL and clock alone. And a rig that is
emulated in part: what it shows is marked.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import pkgutil
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cache
from itertools import count
from operator import attrgetter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import bench
from bench.rig.guardian_client import GuardianClient, GuardianTarget, Heartbeat
from instruments import ArmPoint, RawFrame, StageState
from instruments.camera.cameras import CameraSet
from instruments.clock import RealClock, VirtualClock
from instruments.drivers.camera import PluggedGroup
from instruments.drivers.entry_points import Plugin, PluginUrl, load
from instruments.errors import InstrumentError, LimitError, LinkError
from instruments.listener import Listener
from instruments.world.plant import Plant
from tests.bench.commands import Said
from tests.bench.real_rig import script_of
from tests.bench.safety.guards import standby_after
from tests.bench.small_cameras import write_calibration
from tests.examples import few
from tests.lab_drivers import _install, importable
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow
Act = Callable[[bench.OpenRig], object]
Patch = pytest.MonkeyPatch

RIG = """
name = "lab"
calibration = "calibration.toml"
operator.url = "emulator:"
arm = {{ url = "emulator:", packets = 2, touches = 1 }}
bath = {{ url = "plugin:kettle?url={url}&mode={mode}", cut_out_tested = "2024-03-01" }}
cameras = {{ url = "emulator:", settle_s = 0.1 }}
limits.away_s = 5.0
"""

ALL_PLUGGED = """
name = "lab"
calibration = "calibration.toml"
operator.url = "emulator:"
arm.url = "emulator:probe"
bath.url = "emulator:tank"
cameras.url = "emulator:eyes"
limits.away_s = 5.0
stage = { url = "emulator:slide", reference_mm = [150.0, 150.0] }
"""


def touches(rig: bench.OpenRig) -> None:
    rig.set_up(bench.member("ideal", 3))
    rig.move()
    rig.touch(1)


# without a script: what breaks its promise, what it gives or raises in place of its answer, what is
# done then, what is said, and whether the heater is off
MOVES = ArmPoint(np.zeros(3), moving=True)
PLACE = StageState({"X": 1.0, "Y": 1.0}, moving=True, homed=True)
BYE, OWN_ERROR, MAKES_SAFE = SystemExit("bye"), KeyError("no"), bench.OpenRig.safe
ENDS: Act = lambda _: None  # noqa: E731
WAITS: Act = lambda rig: rig.wait(700.0)  # noqa: E731
ONE_BY_ONE: list[tuple[str, object, Act, str, bool]] = [
    ("Probe.stop", BYE, MAKES_SAFE, "robot could not be made safe.*SystemExit: bye", True),
    ("Slide.read", PLACE, MAKES_SAFE, "stage could not .*does not stop", True),
    ("Probe.read", MOVES, MAKES_SAFE, "robot could not .*it does not stand", True),
    ("Slide.stop", MemoryError(), MAKES_SAFE, "stage could not .*MemoryError", True),
    ("Tank.standby", None, ENDS, "bath could not .*goes on heating after standby", False),
    ("Tank.standby", BYE, ENDS, "bath could not .*SystemExit: bye", False),
    ("Tank.read", OWN_ERROR, WAITS, "no usable reading.*the plug-in tank of lab", True),
    ("Tank.standby", None, MAKES_SAFE, "bath could not .*goes on heating", False),
    ("Tank.close", BYE, ENDS, "^$", True),
    *((f"{name}.close", BYE, ENDS, "^$", True) for name in ("Slide", "Probe", "Eyes")),
    ("Probe.read", OWN_ERROR, touches, "KeyError: 'no'.*probe", True),
]
# what is done, and said then, where a driver's own thread, which asks the device, has died
REPEATED: dict[str, tuple[Act, str]] = {
    "Tank.read": (lambda rig: rig.wait(700.0), "lifeless reading"),
    "Slide.read": (lambda rig: rig.move(x_mm=5.0), r"not at its target, X = 155.*X = 150"),
    "Probe.read": (lambda rig: rig.touch(), "the end of teat 1 once more"),
    "Eyes.capture": (
        lambda rig: [rig.capture(), rig.capture()],
        r"last frame.*\(the plug-in eyes of lab",
    ),
}
EXPECTED = (InstrumentError, bench.InterlockTrip, bench.NotSafeError)

HEATS = """
import os, sys
os.environ["BROKEN_IN"] = str(os.getpid())
import bench
from instruments.drivers import border
with bench.open_rig(sys.argv[1], ("bath",)) as rig:
    rig.bath.start(30.0)
    print("heats", flush=True)
    border.CALL_S = 0.5  # a call that hangs is given up sooner
    if not sys.argv[2]:
        os.kill(os.getpid(), 9)
"""


@dataclass
class Lab:
    """``plant`` is what the kettle of ``folder``'s packages heats, at ``url``."""

    plant: Plant
    url: str
    folder: Path

    def rig(self, mode: str = "") -> Path:
        path = self.folder / "lab.toml"
        path.write_text(RIG.format(url=self.url, mode=mode), encoding="utf-8")
        return path


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    world, lock = SimpleNamespace(plant=Plant(1, start_c=33.0)), threading.RLock()
    write_calibration(tmp_path)
    with importable(tmp_path / "site"), closing(RealClock()) as clock:
        emulator = load("bath", PluginUrl("kettle"), emulator=True).make(world, clock)
        listener = Listener(emulator, clock, lock=lock, name="kettle")
        try:
            yield Lab(world.plant, listener.url, tmp_path)
        finally:
            listener.close()


@pytest.mark.parametrize("mode", few(["", "stays on", "standby hangs", "standby raises"], 2))
def test_the_guardian_opens_it_by_itself(mode: str, lab: Lab) -> None:
    command = [sys.executable, "-c", HEATS, str(lab.rig(mode)), mode]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert ended.stdout == "heats\n", ended.stderr
    standby_after(lab.plant)
    if mode:  # the process itself has said so
        assert "SWITCH OFF THE BATH AT ITS MAINS" in ended.stderr
        assert "NotSafeError" in ended.stderr


# what a driver's module does with what the guardian talks to the bench by
LOADS = "print('a banner')", "os.write(1, b'of C')", "sys.stdout = None", "os.close(0)"


@pytest.mark.parametrize("does", few(LOADS, 2))
def test_a_guardian_loads_a_driver_that_talks_and_names_one_that_is_slow(
    does: str, lab: Lab, monkeypatch: Patch
) -> None:
    code = f"import os, sys\n{does}\nfrom kettle import Kettle\n"
    _install(lab.folder / "site", "loud", "loud", code, "[teatbench.baths]\nloud = loud:Kettle\n")
    lab.plant.run(33.0)
    target = GuardianTarget(f"plugin:loud?url={lab.url}")
    GuardianClient(target, lab.folder, Heartbeat()).hand_over()
    standby_after(lab.plant)
    monkeypatch.setattr("bench.rig.guardian_client.START_S", 0.0)
    with pytest.raises(LinkError, match=r"not ready after 0 s.*plugin:loud\?url.* is slow: a dri"):
        GuardianClient(target, lab.folder, Heartbeat())


@pytest.mark.parametrize(("member", "gives", "does", "says", "off"), few(ONE_BY_ONE, 2))
def test_a_promise_broken_outside_of_a_run(
    member: str, gives: object, does: Act, says: str, off: bool, tmp_path: Path, monkeypatch: Patch
) -> None:
    write_calibration(tmp_path)
    (tmp_path / "lab.toml").write_text(ALL_PLUGGED, encoding="utf-8")
    warned, raised, tanks, asked = list[str](), "", list[Any](), list[object]()

    def broken(driver: object, *_: object) -> object:
        asked.append(driver)
        if isinstance(gives, BaseException):
            raise gives
        return gives

    with importable(tmp_path / "site"):
        inner = importlib.import_module("lab_drivers")
        monkeypatch.setattr(
            inner.TankEmulator, "id", lambda tank: tanks.__iadd__([tank]) and "Tank 1"
        )
        monkeypatch.setattr(inner.Probe, "touches", does is MAKES_SAFE)  # a robot stops
        try:
            with bench.open_rig(tmp_path / "lab.toml", warn=warned.append) as rig:
                rig.home()
                rig.heat(33.0, wait=False)
                assert tanks[0].world.plant.running
                monkeypatch.setattr(f"lab_drivers.{member}", broken)
                does(rig)
        except EXPECTED as error:
            raised = str(error)
    assert asked
    assert re.search(says, " ".join(f"{raised} {' '.join(warned)}".split()))
    plant = tanks[0].world.plant
    assert plant.running is not off
    assert off or plant.set_point_c == 15.0, "as cold as it goes"


@pytest.mark.parametrize("member", REPEATED)
def test_a_driver_that_repeats_what_it_gave_is_noticed(
    member: str, tmp_path: Path, monkeypatch: Patch
) -> None:
    write_calibration(tmp_path)
    (tmp_path / "lab.toml").write_text(ALL_PLUGGED, encoding="utf-8")
    (name, method), (act, said) = member.split("."), REPEATED[member]
    with importable(tmp_path / "site"):
        kind = getattr(importlib.import_module("lab_drivers"), name)
        gives = cache(getattr(kind, method))
        with bench.open_rig(tmp_path / "lab.toml", warn=lambda _: None) as rig:
            rig.home()
            rig.set_up(bench.member("ideal", 3))
            rig.heat(33.0, wait=False)
            rig.move()
            rig.touch(1)
            monkeypatch.setattr(kind, method, gives)
            with pytest.raises(EXPECTED, match=said):
                act(rig)


def fails(error: BaseException) -> Callable[[Any], None]:
    def raises(_: object) -> None:
        raise error

    return raises


AT_THE_END = (
    "bench.run.engine.Engine._make_safe",
    "instruments.drivers.border.Plugged.close",
    "bench.report.page.build_page",
)


def raised_again(kind: type[BaseException], work: Callable[..., Any]) -> Callable[..., Any]:
    """``work``, amid which ``kind`` is raised in the main thread by another."""

    def again(*given: object, **how: object) -> object:
        raise_in_main(ctypes.py_object(kind))
        try:
            return work(*given, **how)
        finally:
            raise_in_main(None)

    return again


def raise_in_main(kind: Any) -> None:
    main = ctypes.c_ulong(threading.main_thread().ident or 0)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(main, kind)


class DeliveredError(Exception): ...


@pytest.fixture
def nothing_pending() -> Iterator[None]:
    """What is taken back leaves CPython's mark that something is to be raised, with which a profile
    function, as that of `plugin check`, has no end (3.11). Delivery takes the mark away.
    """
    yield
    # first: what a close that was broken off left open is closed, and that raises and takes back too
    gc.collect()
    with suppress(DeliveredError):
        raise_in_main(ctypes.py_object(DeliveredError))
        for _ in range(1000):  # it is raised where Python looks
            pass


def changed(**how: Any) -> dict[str, Any]:
    frame = RawFrame(np.full((4, 4), 200, np.uint8), 0.0)
    return {part: replace(frame, **how) for part in ("left", "right")}


def closes(gives: Any) -> Any:
    sys.stdout.close()
    sys.stderr.close()
    return gives


LOOK = r"Look at the device, then at its driver: the plug-in {} of lab-dr"
OTHERS = LimitError("x", "no room")  # whose words don't say which instrument it is of
# what a driver does with what it gives, from this call on; the exit code, and what is said
RUNS: list[tuple[str, int, Callable[[Any], Any], int, str]] = [
    ("Tank.read", 9, lambda it: replace(it, alarm="no water:\nfill"), 3, "reports no water: fill"),
    ("Tank.read", 2, lambda it: replace(it, set_point_c=1.0), 3, "was asked .*" + LOOK.format("tank")),
    ("Tank.standby", 1, fails(KeyboardInterrupt()), 3, "ITS MAINS: KeyboardInterrupt"),
    ("Tank.read", 3, fails(SystemExit("no " * 999)), 3, r"SystemExit: (no ){60,70}[no]*\.\.\. \("),
    ("Slide.stop", 1, fails(BYE), 3, ""),
    ("Slide.move", 1, fails(OTHERS), 3, rf"stage slide \(x\): no room\. {LOOK.format('slide')}"),
    ("Probe.read", 2, fails(KeyError("no")), 3, f"({LOOK.format('probe')}.*The arm is back.*){{3}}"),
    ("Probe.read", 2, lambda it: print("hello") or it, 4, f"{__name__} prints: hello"),
    ("Probe.read", 2, closes, 4, "Verdict"),
    ("Eyes.capture", 1, fails(MemoryError()), 3, LOOK.format("eyes")),
]  # fmt: skip
# what cameras give, and what is said of it; what else they have is left alone
GIVEN: list[tuple[object, str]] = [
    (None, "no mapping of parts .*Correct the plug-in d of pkg 1"),
    (changed() | {"up": None}, ""),
    (changed(pixels=np.full((4, 4), 200, ">u2"), bits=16), ""),
    (changed(bits=5), "its left frame has values beyond its 5"),
    (changed(exposed_s=90.0), r"exposed at 90\.000 s of the"),
]


def eyes(capture: Callable[[object], object]) -> CameraSet:
    made = {"identity": "eyes", "parts": ("left", "right"), "close": lambda _: None}
    kind = type("Eyes", (), made | {"capture": capture, "__init__": lambda *_: None})
    group = PluggedGroup(Plugin("d", "pkg 1", kind), VirtualClock())
    return CameraSet({}, {}, lambda: group)


@pytest.mark.parametrize(("given", "says"), GIVEN)
def test_what_cameras_give_is_taken_or_named(given: object, says: str) -> None:
    with pytest.raises(InstrumentError, match=says) if says else nullcontext():
        eyes(lambda _: given).capture()


def test_a_picture_stays_when_its_driver_fills_the_buffer_again() -> None:
    buffer, greys = np.zeros((4, 4), np.uint8), count(100)

    def capture(_: object) -> dict[str, RawFrame]:
        buffer[:] = next(greys)
        return changed(pixels=buffer, exposed_s="0.0")

    cameras = eyes(capture)
    first, second = cameras.capture(), cameras.capture()
    assert (int(first.left.max()), int(second.left.max())) == (100, 101)


@pytest.mark.parametrize(("member", "first", "does", "code", "says"), RUNS)
def test_what_a_driver_does_in_a_run_is_said(
    member: str, first: int, does: Any, code: int, says: str, tmp_path: Path, said: Said
) -> None:
    write_calibration(tmp_path)
    (tmp_path / "lab.toml").write_text(ALL_PLUGGED, encoding="utf-8")
    (tmp_path / "two.toml").write_text(script_of(repeats=2), encoding="utf-8")
    with importable(tmp_path / "site"), pytest.MonkeyPatch.context() as patch:
        calls, inner = count(1), importlib.import_module("lab_drivers")
        true, tanks = attrgetter(member)(inner), list[Any]()

        def broken(driver: object, *given: object) -> object:
            gives = true(driver, *given)
            return does(gives) if next(calls) >= first else gives

        patch.setattr(inner.TankEmulator, "id", lambda tank: tanks.__iadd__([tank]) and "Tank 1")
        patch.setattr(f"lab_drivers.{member}", broken)
        files = (tmp_path / one for one in ("two.toml", "lab.toml", "runs"))
        there = said(code, "run {} --rig {} --out {}", *files)
    assert re.search(says, " ".join((there.out + there.err).split()))
    assert [one.world.plant.running for one in tanks] == [False] * len(tanks) != []


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("raised", [KeyError("no"), BYE], ids=repr)
def test_what_a_driver_raises_in_the_benchs_thread_ends_the_run(
    raised: BaseException,
    tmp_path: Path,
    said: Said,
    monkeypatch: Patch,
    nothing_pending: None,
) -> None:
    """As `PyThreadState_SetAsyncExc` does from a thread of the driver's own: between any calls, and
    again while the run goes to safe and while its report is written.
    """
    write_calibration(tmp_path)
    (tmp_path / "lab.toml").write_text(ALL_PLUGGED, encoding="utf-8")
    (tmp_path / "one.toml").write_text(script_of(), encoding="utf-8")
    monkeypatch.setattr("bench.run.trial.TrialRun._settle", fails(raised))
    for place in AT_THE_END:
        again = raised_again(type(raised), pkgutil.resolve_name(place))
        monkeypatch.setattr(place, again)
    with importable(tmp_path / "site"):
        files = (tmp_path / one for one in ("one.toml", "lab.toml", "runs"))
        there = said(3, "run {} --rig {} --out {}", *files)
    (folder,) = (tmp_path / "runs").iterdir()
    kept = folder / "mistake.txt"
    named = f"{type(raised).__name__}: {raised}"
    shown = " ".join((there.out + there.err).split())
    assert f"A mistake of the bench: {named}. Please report it with {kept}" in shown
    assert kept.read_text(encoding="utf-8").rstrip().endswith(named)
    assert "internal error" not in shown
    page = (folder / "report" / "index.html").read_text(encoding="utf-8")
    assert "mistake of the bench" in page
    run = bench.read_run(folder)
    assert run.ending == "faulted"
    assert "bath is safe" in [event["text"] for event in run.events]


def test_a_rig_that_is_emulated_in_part_is_marked(lab: Lab, said: Said) -> None:
    script = lab.folder / "short.toml"
    script.write_text(script_of(), encoding="utf-8")
    out = lab.folder / "runs"
    shown = said(0, "run {} --rig {} --out {}", script, lab.rig(), out).out
    (folder,) = out.iterdir()
    run = bench.read_run(folder)
    assert (run.ending, run.facts["kind"]) == ("finished", "mixed")
    assert run.facts["emulated"] == ["arm", "operator", "cameras"]
    assert "SOME INSTRUMENTS EMULATED: arm, operator, cameras" in shown
    page = (folder / "report" / "index.html").read_text(encoding="utf-8")
    assert "SOME INSTRUMENTS EMULATED" in page
    assert "Emulated, and so no measurement: arm, operator, cameras." in page
    assert run.facts["identities"]["bath"]["serial_number"] == "TankEmulator 1"
    assert not lab.plant.running

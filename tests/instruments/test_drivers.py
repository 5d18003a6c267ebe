"""Drivers of other packages: the page's pass the suite, and none gives anything but an
InstrumentError.
"""

from __future__ import annotations

import logging
import re
import socket
import sys
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

import bench
from bench.cli.main import main
from bench.rig.emulated_rig import PORTS, EmulatedRig
from bench.rig.loading import find_rig, load_rig
from bench.rig.urls import bath_url
from bench.safety.signals import installed
from bench.script.detectors import make_detectors
from bench.testing.plugins import check_driver, drivers
from detector.calibration import load_part
from instruments.clock import RealClock, VirtualClock
from instruments.drivers import border
from instruments.drivers.arm import PluggedArm
from instruments.drivers.bath import PluggedBath
from instruments.drivers.entry_points import (
    Kind,
    Plugin,
    PluginUrl,
    emulator_of,
    load,
    loading,
    plugin_url,
)
from instruments.drivers.plugin import ArmPoint, StageState
from instruments.drivers.stage import PluggedStage
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError
from instruments.listener import Listener
from instruments.world.world import World
from tests.bench.commands import Said
from tests.bench.small_cameras import write_calibration
from tests.lab_drivers import _install, importable, world_of_few_pixels
from tests.ports import free_ports

pytestmark = pytest.mark.slow
KINDS: dict[str, Kind] = {"tank": "bath", "slide": "stage", "probe": "arm", "eyes": "camera"}


@pytest.fixture(scope="module", autouse=True)
def _packages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    folder = tmp_path_factory.mktemp("packages")
    with importable(folder / "site"), world_of_few_pixels(folder):
        yield


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[World, VirtualClock]]:
    folder, clock = tmp_path_factory.mktemp("world"), VirtualClock()
    rig = replace(load_rig(find_rig(None)), calibration_path=write_calibration(folder))
    with EmulatedRig(rig, clock, 1) as twin:
        yield twin.world, clock


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("handled", [False, True])
def test_the_pages_drivers_conform(name: str, handled: bool) -> None:
    """Also where the bench handles Ctrl-C, as in `teatbench plugin check`."""
    with installed() if handled else nullcontext():
        found = list(check_driver(name, clock=VirtualClock()))
    assert [one for one in found if one.outcome != "passed"] == []


def test_cameras_have_drawn_before_a_driver_is_checked(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = list[str]()  # the first picture loads what draws, and a driver waits in real time
    monkeypatch.setattr("bench.testing.plugins.conform", lambda _: iter(drawn))
    draw: Any = lambda _: drawn.append("once")  # noqa: E731
    monkeypatch.setattr("bench.rig.emulated_rig.EmulatedCameras.capture", draw)
    for name in ("eyes", "tank"):
        assert [*map(str, check_driver(name, clock=VirtualClock()))] == ["once"]


def test_wrong_keys_and_what_is_no_emulator_are_said() -> None:
    for keys, said in (({"ulr": "x"}, "'url'"), ({"url": "x", "ulr": "y"}, "'ulr'")):
        with pytest.raises(LimitError, match=rf"argument:? {said} .*ulr=.*takes: url"):
            load("bath", PluginUrl("tank", keys)).make(VirtualClock())
    with pytest.raises(bench.ConfigError, match=r"^`emulator`: .*makes no emulator"):
        list(check_driver(dict, "bath", emulator=str, clock=VirtualClock()))


class WordlessError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("its words")


def broken(*_: object) -> Any:
    raise WordlessError


@pytest.mark.parametrize(
    ("method", "says"),
    {
        "connect": r"^its emulator raises WordlessError \(test_drivers\.py:\d+\)$",
        "receive": r"^its emulator raises WordlessError \(test_drivers\.py:\d+\)$",
        "disconnect": r"^its emulator raises WordlessError \(test_drivers\.py:\d+\)$",
        "is_safe": r"^the emulator's own is_safe\(\): WordlessError$",
    }.items(),
)
@pytest.mark.parametrize("virtual", [True, False])
def test_an_emulator_that_raises_is_the_one_that_is_named(
    method: str, says: str, virtual: bool
) -> None:
    tank, of_package = (
        load("bath", PluginUrl("tank"), emulator=one).maker for one in (False, True)
    )
    emulator = type("Broken", (of_package,), {method: broken})
    clock = VirtualClock() if virtual else None
    found = list(check_driver(tank, "bath", emulator=emulator, clock=clock))
    first, *later = [one.why for one in found if one.outcome == "failed"]
    assert re.search(says, first)
    assert all("cause as of" in why or re.search(says, why) for why in later)


def test_what_makes_no_emulator_is_named_in_a_rig_too(world: tuple[World, VirtualClock]) -> None:
    for make, says in ((broken, "WordlessError"), (lambda *_: None, "AttributeError: ")):
        with pytest.raises(LimitError, match=f"makes no emulator of a world and a clock: {says}"):
            emulator_of(Plugin("tank", "lab 1.0 (lab:make)", make).make, *world)


def test_a_command_that_ends_by_an_error_without_words_says_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("instruments.drivers.entry_points.emulator_of", broken)
    assert main(["plugin", "check", "tank"]) == 3
    assert "WordlessError" in capsys.readouterr().err


def test_a_device_that_nothing_can_be_done_to_is_not_checked() -> None:
    found = list(check_driver("plugin:tank?url=socket://127.0.0.1:9"))
    assert {one.outcome for one in found} == {"failed"}  # nobody is there
    assert "127.0.0.1:9" in found[0].why
    assert {one.why for one in found[1:]} == {f"cause as of: {found[0].check}"}


@pytest.fixture
def kettle(world: tuple[World, VirtualClock], monkeypatch: pytest.MonkeyPatch) -> Iterator[object]:
    """Makes a bath with a ``mode`` in real time, and what it has become of at its end."""
    monkeypatch.setattr(border, "CALL_S", 0.5)
    there, clock = world[0], RealClock()
    there.plant.standby()
    emulator = load("bath", PluginUrl("kettle"), emulator=True).make(there, world[1])
    listener = Listener(emulator, clock, lock=threading.RLock(), name="kettle")

    def made(mode: str) -> PluggedBath:
        keys = {"url": listener.url, "mode": mode}
        return PluggedBath(load("bath", PluginUrl("kettle", keys)), clock)

    hangs = sys.modules["kettle"].OVER
    hangs.clear()
    yield made
    hangs.set()
    listener.close()
    clock.close()


@pytest.mark.parametrize("mode", ["stays on", "standby raises", "standby hangs"])
def test_what_is_not_safe_is_not_called_safe(
    mode: str, kettle: object, world: tuple[World, VirtualClock]
) -> None:
    bath = kettle(mode)  # type: ignore[operator]
    bath.start(30.0)
    with pytest.raises(InstrumentError):
        bath.safe()
    assert bath.heats, "its guardian has to go on"
    assert world[0].plant.running
    bath.close()


def test_a_bath_that_hangs_is_made_safe_beside_the_call(
    kettle: object, world: tuple[World, VirtualClock], monkeypatch: pytest.MonkeyPatch
) -> None:
    bath = kettle("")  # type: ignore[operator]
    bath.start(30.0)
    monkeypatch.setattr(
        bath._border.open(), "ask", lambda *_: sys.modules["kettle"].OVER.wait(60.0)
    )
    with pytest.raises(LinkError, match=r"hangs.*kettle 1.0 \(kettle:Kettle\)|kettle 1.0 .*hangs"):
        bath.read()
    bath.safe()
    assert not world[0].plant.running
    assert not bath.heats
    bath.close()


@pytest.mark.parametrize("by", ["a call", "a thread of its own"])
def test_a_driver_that_keeps_threads_from_starting_is_made_safe(
    by: str, kettle: object, world: tuple[World, VirtualClock], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python starts no thread where `threading.excepthook` is None, and calls are in threads."""
    monkeypatch.setattr(threading, "excepthook", threading.excepthook)  # put back in any case
    bath = kettle("")  # type: ignore[operator]
    bath.start(30.0)
    made = bath._border.open()
    true = made.read

    def read() -> object:
        threading.excepthook = None  # type: ignore[assignment]
        return true()

    if by == "a call":
        monkeypatch.setattr(made, "read", read)
        bath.read()
        assert threading.excepthook is not None
    else:
        read()
    bath.safe()
    assert not world[0].plant.running
    bath.close()


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("plugin:", "which plug-in"),
        ("plugin:tnak", "did you mean"),
        ("emulator:nothing?a=b", "no plug-in 'nothing'"),
        ("plugin:tank?url=a&mode=b&url=c", "the key url is given twice"),
        ("plugin:tank?url=%00", r"the value of url is no text in UTF-8: '\\x00'"),
        ("plugin:tank?url=%C3%28", "no text in UTF-8"),
    ],
)
def test_a_wrong_url_says_what_there_is(url: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=says):
        bath_url(url)


POINTS = """
[teatbench.baths]
tank = other:Tank
alone = other:Tank
mute = other:Mute
odd = other:a:b
"""
MUTE = "import lab_drivers, sys\nTank = lab_drivers.Tank\ndef __getattr__(_): sys.exit()\n"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("tank", r"'tank' is of (lab-drivers 1.0|other 1.0) \S+ and .* Uninstall one of them"),
        ("mute", r"other 1.0 \(other:Mute\) can't be loaded: SystemExit\. Install"),
        ("odd", r"other 1.0 \(other:a:b\) can't be loaded: ValueError: no module:name"),
    ],
)
def test_an_entry_point_that_gives_no_driver_is_said(name: str, says: str, tmp_path: Path) -> None:
    _install(tmp_path, "other", "other", MUTE, POINTS)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(tmp_path))
        with pytest.raises(LimitError, match=says):
            load("bath", PluginUrl(name))
        if name == "tank":
            both = {"lab-drivers 1.0 (lab_drivers:Tank)", "other 1.0 (other:Tank)"}
            listed = drivers()["bath tank"].removesuffix(", with an emulator")
            assert {*listed.split(" and ")} == both
        with pytest.raises(ValueError, match="the plug-in 'alone' has no emulator"):
            bath_url("emulator:alone")


@pytest.mark.parametrize("kind", ["bath", "detector"])
def test_what_replaces_functions_that_the_bench_waits_by_is_refused(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As gevent's monkey.patch_all does, beside which no thread of the bench's goes on. Once more
    too, when nothing is replaced any more.
    """
    name = f"patches_{kind}"
    code = "import socket\nsocket.fromfd = print\nclass Green:\n    detect = print\n"
    _install(tmp_path, name, name, code, f"[teatbench.{kind}s]\ngreen = {name}:Green\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(socket, "fromfd", socket.fromfd)
    says = r"it replaces functions of Python .* such as socket\.fromfd: leave out"
    for _ in range(2):
        with pytest.raises((LimitError, bench.ConfigError), match=says):
            load("bath", PluginUrl("green")) if kind == "bath" else make_detectors(["green"])


def test_the_steps_of_the_benchs_own_libraries_are_not_shown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A driver's `logging.basicConfig(level=DEBUG)` is for its own words."""
    level = logging.root.level
    try:
        with loading("a_module"):
            logging.root.setLevel(logging.DEBUG)
        assert not logging.getLogger("matplotlib.font_manager").isEnabledFor(logging.INFO)
        assert logging.getLogger("lab").isEnabledFor(logging.DEBUG)
    finally:
        logging.root.setLevel(level)


def test_keys_are_text_and_come_back() -> None:
    url = plugin_url("plugin:tank?url=socket%3A%2F%2Fhost%3A1&mode=a b")
    assert url == PluginUrl("tank", {"url": "socket://host:1", "mode": "a b"})
    assert plugin_url(load("bath", url).url) == url
    assert plugin_url("emulator:") is None
    assert plugin_url("emulator://host:1") is None
    with pytest.raises(LimitError, match="Did you mean 'tank'"):
        load("bath", PluginUrl("tnk"))


def test_an_unknown_driver_is_wrong_use_and_those_that_are_there_are_listed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    said = Said(capsys)
    assert "none is installed" in said(2, "plugin check nothing").err
    listed = said(0, "plugin").out
    assert "bath tank: lab-drivers 1.0 (lab_drivers:Tank), with an emulator" in listed


def lab_rig(folder: Path) -> Path:
    """A rig file of drivers from the page, all on their emulators; gives back its path."""
    write_calibration(folder)
    words = {"bath": "emulator:tank", "arm": "emulator:probe", "cameras": "emulator:eyes"}
    tables = "".join(f'{name}.url = "{url}"\n' for name, url in words.items())
    head = 'name = "lab"\ncalibration = "calibration.toml"\noperator.url = "emulator:"\n'
    (folder / "lab.toml").write_text(head + tables, encoding="utf-8")
    return folder / "lab.toml"


def test_what_a_device_does_not_say_is_no_none(tmp_path: Path) -> None:
    found = {name: lines for name, _, lines in bench.check_rig(lab_rig(tmp_path))}
    assert "temperature: 20.00 degC, output not reported" in found["bath"]
    assert not [one for lines in found.values() for one in lines if one.endswith(("None", ": "))]


def test_emulators_of_others_are_served_and_a_written_rig_opens_them_by_their_drivers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab, written, base = lab_rig(tmp_path), tmp_path / "written.toml", free_ports(len(PORTS))
    with bench.serve_rig(lab, port_base=base) as served:
        assert {*served.urls} == {"arm", "bath", "cameras", "operator"}
        with urllib.request.urlopen(served.page_url) as page:
            cables = re.findall(r"<span>(\w+) cable<", page.read().decode("utf-8"))
        assert cables == ["Arm", "Bath", "Cameras"]
        written.write_text(served.rig_file(), encoding="utf-8")
        found = {name: (fault, lines) for name, fault, lines in bench.check_rig(written)}
        assert [name for name, (fault, _) in found.items() if fault] == []
        assert any("(the plug-in eyes of lab-drivers" in line for line in found["cameras"][1])
        said, at = Said(capsys), served.urls
        tank, eyes = f"plugin:tank?url={at['bath']}", f"plugin:eyes?url={at['cameras']}"
        assert "degC, by its driver" in said(0, f"bath read --port {tank}").out
        assert "in standby at 20.00 degC" in said(0, f"bath standby --port {tank}").out
        assert "can be changed while it heats" in said(2, f"bath set 30 --port {tank}").err
        assert "leave the profile out" in said(2, f"bath read --port {tank} --profile haake").err
        assert "plugin check" in said(2, f"bath learn --port {tank}").err
        assert "(the plug-in eyes of lab-drivers" in said(0, f"camera show {eyes}").out
        ports = f"127.0.0.1, ports {base} to {base + len(PORTS) - 1}: "
        assert ports in said(2, f"emulate {lab} --port-base {base}").err


def test_a_makers_calibration_becomes_the_cameras_part(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = Said(capsys)
    write_calibration(tmp_path)
    for name in ("calibrated", "eyes"):
        text = 'name = "lab"\ncalibration = "calibration.toml"\n'
        text += 'bath = { url = "emulator:", profile = "julabo-presto" }\n'
        text += 'operator.url = "emulator:"\narm.url = "emulator:"\n'
        text += f'cameras.url = "emulator:{name}"\n'
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
    told = said(0, "calibrate import --rig calibrated.toml --out cameras.toml").out
    assert "stated with standard deviations" in told
    part, exact = load_part(tmp_path / "cameras.toml"), bench.load_rig("eyes.toml").calibration
    assert part.left
    assert part.right_from_left
    assert part.record
    assert part.covariance
    np.testing.assert_allclose(part.left.matrix, exact.left.matrix, rtol=1e-9)
    np.testing.assert_allclose(part.right_from_left.T, exact.right_from_left.T, rtol=1e-9)
    assert part.covariance.sds == {("stereo", "T1"): 0.02}
    assert part.record.with_what.startswith("the maker's own, read by teatbench")
    assert part.record.cameras["left"].startswith("EyesEmulator 1 (the plug-in calibrated")
    none = said(2, "calibrate import --rig eyes.toml --out again.toml").err
    assert "has no calibration of their maker" in none
    assert "give either" in said(2, "calibrate import --out again.toml").err
    assert "Name it with --format" in said(2, "calibrate import a.yml --out again.toml").err


class Carrier:
    """A stage in memory that homes at once; ``state`` is what it says of its homing."""

    axes, feed_mm_min, limits = "XY", 600.0, {"X": (0.0, 50.0), "Y": (0.0, 50.0)}
    identity: ClassVar = {"serial_number": "1"}
    homed, lost = True, False
    moves: ClassVar[list[float]] = []

    def __init__(self, _: object) -> None:
        self.place = {"X": 0.0, "Y": 0.0}

    def read(self) -> StageState:
        if Carrier.lost:
            raise LinkError("carrier", "no answer")
        return StageState(dict(self.place), False, Carrier.homed)

    def home(self) -> None:
        Carrier.homed = True

    def move(self, place: dict[str, float], _: float) -> None:
        Carrier.moves.append(place["X"])
        self.place = place

    def stop(self) -> None: ...
    def close(self) -> None: ...


@pytest.fixture
def carrier(monkeypatch: pytest.MonkeyPatch) -> PluggedStage:
    for name, value in (("homed", True), ("lost", False), ("moves", [])):
        monkeypatch.setattr(Carrier, name, value)
    stage = PluggedStage(Plugin("carrier", "here", Carrier), VirtualClock(), "XY")
    stage.connect()
    stage.home()
    return stage


def test_a_stage_that_says_that_it_is_not_homed_any_more_is_not_moved(
    carrier: PluggedStage,
) -> None:
    carrier.move_to(1.0, 1.0)
    Carrier.homed = False  # its power dipped, and nobody asked it since
    with pytest.raises(LimitError, match="no move before homing"):
        carrier.move_to(2.0, 1.0)
    with pytest.raises(LimitError, match="no move before homing"):
        carrier.jog(x_mm=1.0)
    carrier.home()
    carrier.begin_move(3.0, 1.0)
    Carrier.homed = False
    with pytest.raises(DeviceError, match="interrupted: it is not homed any more"):
        carrier.finish_move()
    assert Carrier.moves == [1.0, 3.0]


def test_what_lost_its_link_is_not_homed_before_it_is_opened_again(carrier: PluggedStage) -> None:
    Carrier.lost = True
    with pytest.raises(LinkError):
        carrier.position()
    assert not carrier.homed
    Carrier.lost = False
    with pytest.raises(LimitError, match="no move before homing"):
        carrier.move_to(2.0, 1.0)
    assert Carrier.moves == []


def test_an_arm_that_lost_its_link_has_no_position_before_it_is_referenced_again() -> None:
    class Tip:
        homing, touches, identity = "Put it into its holder.", False, {"serial_number": "1"}
        lost = False

        def __init__(self, _: object) -> None: ...

        def read(self) -> ArmPoint:
            if Tip.lost:
                raise LinkError("tip", "no answer")
            return ArmPoint(np.zeros(3))

        def close(self) -> None: ...

    arm = PluggedArm(Plugin("tip", "here", Tip), VirtualClock())
    arm.sign_on()
    arm.confirm_homed()
    assert arm.read(n=8).spread_mm == 0.0
    Tip.lost = True
    with pytest.raises(LinkError):
        arm.read()
    Tip.lost = False
    assert not arm.homed
    with pytest.raises(LimitError, match="no position before homing"):
        arm.read()


@pytest.mark.parametrize(
    "tip_mm",
    [
        np.array(["1.5", "2", "3"]),
        np.array([np.float32(1.5), 2, Decimal(3)], dtype=object),
        (Fraction(3, 2), 2.0, "3"),
    ],
    ids=["texts", "of each kind", "a tuple"],
)
def test_a_tips_numbers_are_taken_as_any_others(tip_mm: Any) -> None:
    class Tip:
        homing, touches, identity = "Put it into its holder.", False, {"serial_number": "1"}

        def __init__(self, _: object) -> None: ...

        def read(self) -> ArmPoint:
            return ArmPoint(tip_mm, tip_mm)

        def close(self) -> None: ...

    arm = PluggedArm(Plugin("tip", "here", Tip), VirtualClock())
    arm.sign_on()
    arm.confirm_homed()
    assert arm.read().tip_mm.tolist() == [1.5, 2.0, 3.0]
    first, second = islice(arm.watch(0.2), 2)
    assert first.tip_mm.tolist() == [1.5, 2.0, 3.0]
    assert second.t_s - first.t_s >= 0.2

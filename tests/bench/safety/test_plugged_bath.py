"""A bath of another package stays on in no case: its driver dies, lies, raises or hangs in the
process that heats, and the guardian opens it in its own, by URL and clock alone. And a rig that is
emulated in part: what it shows is marked.
"""

from __future__ import annotations

import importlib
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import pytest

import bench
from instruments.clock import Clock, RealClock
from instruments.drivers.entry_points import PluginUrl, load
from instruments.errors import InstrumentError
from instruments.listener import Listener
from instruments.world.plant import Plant
from tests.bench.commands import Said
from tests.bench.real_rig import script_of
from tests.bench.safety.guards import standby_after
from tests.bench.small_cameras import write_calibration
from tests.examples import few
from tests.lab_drivers import importable

pytestmark = pytest.mark.slow

RIG = """
name = "lab"
calibration = "calibration.toml"
[operator]
url = "emulator:"
[arm]
url = "emulator:"
packets = 2
touches = 1
[bath]
url = "plugin:kettle?url={url}&mode={mode}"
cut_out_tested = "2024-03-01"
[cameras]
url = "emulator:"
settle_s = 0.1
[limits]
away_s = 5.0
"""

ALL_PLUGGED = """
name = "lab"
calibration = "calibration.toml"
operator.url = "emulator:"
arm.url = "emulator:probe"
bath.url = "emulator:tank"
cameras.url = "emulator:eyes"
stage = { url = "emulator:slide", reference_mm = [150.0, 150.0] }
"""


def touches(rig: bench.OpenRig) -> None:
    rig.move()
    rig.touch(1)


BREAKS: dict[str, Callable[[bench.OpenRig], object]] = {
    "Eyes.capture": lambda rig: rig.capture(),
    "Slide.move": lambda rig: rig.move(x_mm=5.0),
    "Slide.read": lambda rig: rig.move(x_mm=5.0),
    "Probe.read": touches,
    "Tank.read": lambda rig: rig.wait(700.0),
    **dict.fromkeys(("Slide.stop", "Probe.stop"), lambda rig: rig.safe()),
}
GIVES = [*product(BREAKS, (SystemExit("bye"), MemoryError(), None))]
# what is done, and said then, where a driver's own thread, which asks the device, has died
REPEATED: dict[str, tuple[Callable[[bench.OpenRig], object], str]] = {
    "Tank.read": (lambda rig: rig.wait(700.0), "lifeless reading"),
    "Slide.read": (lambda rig: rig.move(x_mm=5.0), r"not at its target, X = 155.*X = 150"),
    "Probe.read": (lambda rig: rig.touch(), "the end of teat 1 once more"),
    "Eyes.capture": (lambda rig: [rig.capture(), rig.capture()], "identical to the last frame"),
}
EXPECTED = (InstrumentError, bench.InterlockTrip, bench.NotSafeError)

HEATS = """
import os, sys
os.environ["BROKEN_IN"] = str(os.getpid())
import bench
with bench.open_rig(sys.argv[1], ("bath",)) as rig:
    rig.bath.start(30.0)
    print("heats", flush=True)
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


class World:
    def __init__(self) -> None:
        self.plant = Plant(1, start_c=33.0)


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[Lab]:
    world, lock = World(), threading.RLock()
    write_calibration(tmp_path)
    with importable(tmp_path / "site"), closing(RealClock()) as clock:
        emulator = load("bath", PluginUrl("kettle"), emulator=True).make(world, clock)
        listener = Listener(emulator, clock, lock=lock, name="kettle")
        try:
            yield Lab(world.plant, listener.url, tmp_path)
        finally:
            listener.close()


@pytest.mark.parametrize("mode", few(["", "stays on", "standby raises"], 2))
def test_the_guardian_opens_it_by_itself(mode: str, lab: Lab) -> None:
    ended = subprocess.run(
        [sys.executable, "-c", HEATS, str(lab.rig(mode)), mode],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.stdout == "heats\n", ended.stderr
    standby_after(lab.plant)
    if mode:  # the process itself has said so
        assert "SWITCH OFF THE BATH AT ITS MAINS" in ended.stderr
        assert "NotSafeError" in ended.stderr


@pytest.mark.parametrize(("member", "gives"), GIVES)
def test_no_driver_leaves_the_bath_on(
    member: str, gives: object, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_calibration(tmp_path)
    (tmp_path / "lab.toml").write_text(ALL_PLUGGED, encoding="utf-8")
    plants, asked = list[Plant](), list[object]()

    def broken(driver: object, *_: object) -> object:
        asked.append(driver)
        if isinstance(gives, BaseException):
            raise gives
        return gives

    with importable(tmp_path / "site"):
        drivers = importlib.import_module("lab_drivers")
        emulator = drivers.TankEmulator

        def seen(world: World, clock: Clock) -> object:
            plants.append(world.plant)
            return emulator(world, clock)

        monkeypatch.setattr(drivers, "TankEmulator", seen)
        monkeypatch.setattr(drivers.Probe, "touches", member == "Probe.stop")  # only a robot stops
        with suppress(*EXPECTED), bench.open_rig(tmp_path / "lab.toml", warn=lambda _: None) as rig:
            rig.home()
            rig.set_up(bench.member("ideal", 3))
            rig.heat(33.0, wait=False)
            rig.wait(2.0)
            assert plants[0].running
            monkeypatch.setattr(f"lab_drivers.{member}", broken)
            BREAKS[member](rig)
    assert asked
    assert not plants[0].running


@pytest.mark.parametrize("member", REPEATED)
def test_a_driver_that_repeats_what_it_gave_is_noticed(
    member: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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


def test_a_rig_that_is_emulated_in_part_is_marked(lab: Lab, said: Said) -> None:
    script = lab.folder / "short.toml"
    script.write_text(script_of(), encoding="utf-8")
    out = lab.folder / "runs"
    shown = said(0, "run {} --rig {} --out {}", script, lab.rig(), out).out
    (folder,) = out.iterdir()
    run = bench.read_run(folder)
    assert run.ending == "finished"
    assert run.facts["kind"] == "mixed"
    assert run.facts["emulated"] == ["arm", "operator", "cameras"]
    assert "SOME INSTRUMENTS EMULATED: arm, operator, cameras" in shown
    page = (folder / "report" / "index.html").read_text(encoding="utf-8")
    assert "SOME INSTRUMENTS EMULATED" in page
    assert "Emulated, and so no measurement: arm, operator, cameras." in page
    assert run.facts["identities"]["bath"]["serial_number"] == "TankEmulator 1"
    assert not lab.plant.running

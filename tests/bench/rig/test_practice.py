"""Each cable of an emulated rig pulled and put back, the room, the stage; the page of `emulate`
and its ports; a run at ten times real time.
"""

from __future__ import annotations

import json
import socket
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest
from playwright.sync_api import expect

import bench
from bench.cli.main import main
from bench.rig import practice
from bench.rig.devices import Devices
from bench.rig.emulated_rig import PORTS, EmulatedRig
from bench.rig.loading import load_rig
from bench.rig.opening import open_instruments
from instruments.camera.frame import FrameError
from instruments.clock import PacedClock, VirtualClock, stopwatch_s
from instruments.errors import InstrumentError
from tests.bench.campaign.small_campaign import write_small_rig
from tests.chromium import Scheme, browser_page, violations, weak_texts
from tests.ports import free_ports
from tests.waiting import PATIENCE_S

pytestmark = pytest.mark.slow

ALL = ("arm", "bath", "stage", "cameras")
SCHEMES: tuple[Scheme, ...] = ("light", "dark")


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[tuple[practice.Practice, Devices]]:
    """A practice rig with its instruments open, in virtual time."""
    loaded, clock = load_rig(write_small_rig(tmp_path)), VirtualClock()
    with EmulatedRig(loaded, clock, 1) as twin:
        opened = open_instruments(loaded, ALL, clock, twin=twin, supervised=True)
        with opened as devices:
            yield practice.Practice(twin), devices


USES: dict[str, Callable[[Devices], object]] = {
    "arm": lambda devices: devices.arm.sign_on(),
    "bath": lambda devices: devices.bath.read(),
    "stage": lambda devices: devices.stage and devices.stage.reconnect(),
    "left camera": lambda devices: devices.cameras.capture(),
    "right camera": lambda devices: devices.cameras.capture(),
    "thermal camera": lambda devices: devices.cameras.capture(),
}


def test_each_cable_is_pulled_and_put_back(rig: tuple[practice.Practice, Devices]) -> None:
    hands, devices = rig
    assert [*hands.shown.cables] == [*USES]
    for name, use in USES.items():
        use(devices)
        hands.do(f"pull {name}")
        assert not hands.shown.cables[name]
        if "camera" in name:
            with pytest.raises(FrameError, match=name):
                devices.cameras.glance()  # type: ignore[attr-defined]  # some have it
        with pytest.raises((InstrumentError, FrameError), match=name.split()[0]):
            use(devices)
        with pytest.raises(ValueError, match="done already"):
            hands.do(f"pull {name}")
        hands.do(f"put back {name}")
        use(devices)


def test_the_room_is_warmed_and_the_stage_jammed(rig: tuple[practice.Practice, Devices]) -> None:
    hands, devices = rig
    for _ in range(20):
        hands.do("warm the room")
    assert hands.twin.world.plant.ambient_c == hands.shown.room_c == practice.WARMEST_C
    stage = devices.stage
    assert stage
    stage.connect()
    stage.home()
    hands.do("jam the stage")
    emulated = hands.twin.stage
    assert emulated
    for x_mm in (-100.0, -200.0):  # a jam outlasts the motion that it stopped
        stage.move_to(x_mm, -100.0)
        assert emulated.position_mm()[0] > x_mm + 50.0
        hands.jam_again()
    hands.do("free the stage")
    assert hands.shown.jammed is False


def test_what_a_console_leaves_is_done_once(tmp_path: Path) -> None:
    loaded, began_s = load_rig(write_small_rig(tmp_path)), stopwatch_s()
    clock = PacedClock(1000.0)
    practice.leave(tmp_path, "pull bath")  # of an earlier session
    with (
        EmulatedRig(loaded, clock, 1) as twin,
        practice.following(practice.Practice(twin), clock, clock.speed, tmp_path),
    ):
        practice.leave(tmp_path, "warm the room")
        practice.leave(tmp_path, "nonsense")
        clock.sleep(1000.0)
        assert stopwatch_s() - began_s > 0.9, "a thousandth, from the clock's beginning on"
        shown = json.loads((tmp_path / practice.SHOWN).read_text(encoding="utf-8"))
        assert shown["room_c"] == 22.0
        assert shown["cables"]["bath"]
    assert not (tmp_path / practice.SHOWN).exists()


def post(url: str, words: str, **headers: str) -> str:
    """The page after a button."""
    data = f"words={words.replace(' ', '+')}".encode()
    with urllib.request.urlopen(urllib.request.Request(url, data, headers)) as answer:
        return str(answer.read().decode("utf-8"))


def test_a_written_rig_stays_good_and_its_cables_are_on_a_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small, written = write_small_rig(tmp_path), tmp_path / "written.toml"
    base = free_ports(len(PORTS))
    for turn in range(2):
        with bench.serve_rig(small, port_base=base) as served:
            page = served.page_url
            if not turn:
                written.write_text(served.rig_file(), encoding="utf-8")
            assert page == f"http://127.0.0.1:{base + PORTS.index('streams')}/"
            assert "OUT" in post(page, "pull bath")
            assert main(["check", str(written)]) == 3
            assert "bath: FAULT" in capsys.readouterr().out
            with pytest.raises(urllib.error.HTTPError, match="403") as refused:
                post(page, "put back bath", Origin="http://elsewhere.example")
            refused.value.close()
            assert "OUT" not in post(page, "put back bath")
            assert main(["check", str(written)]) == 0
            said = capsys.readouterr().out
            names = ("arm", "bath", "stage", "operator", "cameras")
            states = [line for line in said.splitlines() if not line.startswith(" ")]
            assert states == [f"{name}: ok" for name in names]
            assert "  left: " in said
    with closing(socket.create_server(("127.0.0.1", base))):
        assert main(["emulate", str(small), "--port-base", str(base)]) == 2


@pytest.mark.browser
def test_the_page_follows_the_cables_and_can_be_read_by_everybody(tmp_path: Path) -> None:
    with browser_page() as seen:
        page = seen.page
        page.context.set_offline(False)
        soon_ms = 1000.0 * PATIENCE_S
        with bench.serve_rig(write_small_rig(tmp_path)) as served:
            page.goto(served.page_url)
            assert violations(page, contrast=False) == []
            for scheme in SCHEMES:
                page.emulate_media(color_scheme=scheme)
                assert weak_texts(page) == []
            post(served.page_url, "pull bath")  # by another page
            page.get_by_role("button", name="put back bath").click(timeout=soon_ms)
            pull = page.get_by_role("button", name="pull bath")
            expect(pull).to_be_visible(timeout=soon_ms)
        gone = page.get_by_role("status")
        expect(gone).to_contain_text("The emulators don't answer", timeout=soon_ms)

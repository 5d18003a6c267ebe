"""A session of each driver with its emulator, captured and replayed: the driver finds the same
again, and no byte differs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from instruments.bath.driver import OwnBath
from instruments.bath.emulator import BathEmulator
from instruments.captures.capture import Capture, CaptureFile, read_capture
from instruments.captures.replay import Replay
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.errors import InstrumentError, LinkError
from instruments.link import Link, Tap
from instruments.listener import Connection, Device, Listener
from instruments.microscribe.driver import ANSWER_S, MicroScribe
from instruments.microscribe.emulator import ArmEmulator
from instruments.microscribe.faults import ArmFault
from instruments.microscribe.kinematics import Floats
from instruments.stage.driver import OwnStage
from instruments.stage.emulator.board import StageEmulator
from instruments.world.plant import Plant
from tests.instruments.bath.devices import load_register_profile

FACTS = {"teatbench": "0", "command": "c", "machine": "m"}
Found = list[object]
Session = Callable[[str, Clock, Tap | None], Found]


class Hand:
    """Moves the tip along x by a little whenever it is looked at, so that no two readings are
    alike and none takes longer than the machine: 0.01 mm a packet.
    """

    def __init__(self) -> None:
        self.looks = 0

    def arm_target(self) -> tuple[Floats, Floats] | None:
        self.looks += 1
        return np.array([-180.0 + 0.01 * self.looks, 240.0, 130.0]), np.array([0.0, 0.0, 1.0])


def arm_session(url: str, clock: Clock, tap: Tap | None) -> Found:
    answer_s = ANSWER_S if isinstance(clock, VirtualClock) else 30.0
    link = Link(url, clock, who="arm", tap=tap)
    with closing(MicroScribe(link, clock, answer_s=answer_s)) as arm:
        found: Found = [asdict(arm.sign_on()), asdict(arm.info.parameters), arm.info.beta]
        arm.confirm_homed()
        for _ in range(3):
            reading = arm.read(8)
            found += [reading.tip_mm.tolist(), reading.spread_mm, reading.counts]
            clock.sleep(0.2)
        return found


def stage_session(url: str, clock: Clock, tap: Tap | None) -> Found:
    with closing(OwnStage(Link(url, clock, who="stage", tap=tap), clock)) as stage:
        found: Found = [asdict(stage.connect()), asdict(stage.settings)]
        stage.home()
        for place in ((-20.0, -30.0), (-21.0, -30.5), (-5.0, -80.0)):
            stage.move_to(*place)
            found.append(stage.position().tolist())
        stage.stop()
        return found


def bath_session(url: str, clock: Clock, tap: Tap | None) -> Found:
    with closing(OwnBath(url, load_register_profile("julabo-presto"), clock, tap=tap)) as bath:
        found: Found = [{key: value for key, value in bath.identity.items() if key != "url"}]
        bath.start(33.0)
        for _ in range(60):
            clock.sleep(1.0)
            reading = bath.read()
            found.append((reading.temp_c, reading.power_percent))
        bath.standby()
        return found


SESSIONS: dict[str, Session] = {"arm": arm_session, "stage": stage_session, "bath": bath_session}


def device(name: str, clock: Clock) -> Device:
    if name == "arm":
        return ArmEmulator(Hand(), clock, seed=3)
    if name == "stage":
        return StageEmulator(clock)
    return BathEmulator(Plant(3), load_register_profile("julabo-presto"), clock)


@contextmanager
def served(far_end: Device, clock: Clock, name: str) -> Iterator[str]:
    listener = Listener(far_end, clock, lock=threading.RLock(), name=name)
    try:
        yield listener.url.replace("socket://", "tcp://") if name == "bath" else listener.url
    finally:
        listener.close()


def captured(
    name: str,
    path: Path,
    session: Session | None = None,
    far_end: Callable[[Clock], Device] | None = None,
) -> Found:
    clock = VirtualClock()
    end = far_end(clock) if far_end else device(name, clock)
    with CaptureFile(path, FACTS) as capture, served(end, clock, name) as url:
        return (session or SESSIONS[name])(url, clock, capture.tap(name, clock))


def replayed(
    capture: Capture, name: str, session: Session, clock: Clock, *, fast: bool = False
) -> tuple[Found, list[str]]:
    """What the session finds now, and what the replay has to tell."""
    with Replay(capture, clock, fast=fast) as replay:
        found = session(replay.urls[name], clock, None)
        real = RealClock()
        while not replay.finished and real.now() < 60.0:
            real.sleep(0.005)
        return found, [*map(str, replay.mismatches), *replay.unplayed]


@pytest.mark.slow
@pytest.mark.parametrize("name", SESSIONS)
def test_the_driver_finds_the_same_again_and_listening_in_changes_nothing(
    name: str, tmp_path: Path
) -> None:
    found = captured(name, tmp_path / "c")
    capture = read_capture(tmp_path / "c")
    for fast in (False, True):
        again = replayed(capture, name, SESSIONS[name], VirtualClock(), fast=fast)
        assert again == (found, [])
    clock = VirtualClock()
    with served(device(name, clock), clock, name) as url:
        assert SESSIONS[name](url, clock, None) == found


def test_a_replay_can_be_captured_and_is_the_capture(tmp_path: Path) -> None:
    """All but the times, which a replay keeps to within its lead."""
    captured("stage", tmp_path / "one")
    clock = VirtualClock()
    with (
        CaptureFile(tmp_path / "two", FACTS) as capture,
        Replay(read_capture(tmp_path / "one"), clock) as replay,
    ):
        stage_session(replay.urls["stage"], clock, capture.tap("stage", clock))
    (one,), (two,) = (read_capture(tmp_path / name).links["stage"] for name in ("one", "two"))
    assert [e.asked for e in one.exchanges] == [e.asked for e in two.exchanges]
    assert [b"".join(p.data for p in e.came) for e in one.exchanges] == [
        b"".join(p.data for p in e.came) for e in two.exchanges
    ]
    assert [e.asked_s for e in one.exchanges] == pytest.approx(
        [e.asked_s for e in two.exchanges], abs=1e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm", "bath"])
def test_a_session_in_real_time_is_replayed_in_real_time(name: str, tmp_path: Path) -> None:
    """What a busy machine holds up is asked once more, which no capture has: then again."""

    def short(url: str, clock: Clock, tap: Tap | None) -> Found:
        if name == "arm":
            return arm_session(url, clock, tap)
        with closing(OwnBath(url, load_register_profile("julabo-presto"), clock, tap=tap)) as bath:
            return [bath.read().temp_c for _ in range(20)]

    for number in range(5):
        path = tmp_path / str(number)
        with closing(RealClock()) as clock, closing(RealClock()) as again, suppress(LinkError):
            with (
                CaptureFile(path, FACTS) as capture,
                served(device(name, clock), clock, name) as url,
            ):
                found = short(url, clock, capture.tap(name, clock))
            seen, faults = replayed(read_capture(path), name, short, again, fast=True)
            if not faults:
                break
    assert (seen, faults) == (found, [])


def failing(session: Session) -> Session:
    """The session, and where it fails, the error's sentence but for the link's URL."""

    def tolerant(url: str, clock: Clock, tap: Tap | None) -> Found:
        try:
            return session(url, clock, tap)
        except InstrumentError as error:
            return [type(error).__name__, error.what.replace(url, "URL")]

    return tolerant


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", [ArmFault.SILENT, ArmFault.FLIPPED_BIT, ArmFault.DISCONNECT], ids=str
)
def test_an_arm_with_a_fault_has_it_again(fault: ArmFault, tmp_path: Path) -> None:
    """The driver does the same, byte for byte, and says the same, whether it finds its way."""

    def faulty(clock: Clock) -> Device:
        arm = ArmEmulator(Hand(), clock, seed=3)
        arm.faults.inject(fault)
        return arm

    session = failing(arm_session)
    found = captured("arm", tmp_path / "c", session, faulty)
    again = replayed(read_capture(tmp_path / "c"), "arm", session, VirtualClock())
    assert again == (found, [])


def test_a_bath_that_broke_off_is_met_anew_in_the_replay(tmp_path: Path) -> None:
    class Shaky(BathEmulator):
        asked = 0

        def receive(self, connection: Connection, data: bytes) -> None:
            self.asked += 1
            if self.asked % 20 == 0:
                connection.hang_up()
            else:
                super().receive(connection, data)

    found = captured(
        "bath",
        tmp_path / "c",
        bath_session,
        lambda clock: Shaky(Plant(3), load_register_profile("julabo-presto"), clock),
    )
    capture = read_capture(tmp_path / "c")
    assert len(capture.links["bath"]) > 2
    assert all(talk.broke for talk in capture.links["bath"][:-1])
    assert replayed(capture, "bath", bath_session, VirtualClock()) == (found, [])

"""The driver in real time: on a pseudo-terminal, from several threads, and Ctrl-C amid a question. And what
a tap sees of each link."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from instruments.bath.driver import OwnBath
from instruments.bath.emulator import BathEmulator
from instruments.clock import RealClock, VirtualClock
from instruments.errors import LinkError
from instruments.listener import Listener
from instruments.pty_listener import PtyListener
from instruments.world.plant import Plant
from tests.instruments.bath.devices import Stand, Watched, load_register_profile
from tests.instruments.bath.far_end import FarEnd, rtu, served
from tests.instruments.listening_in import Heard
from tests.waiting import within

pty = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals: POSIX only")


@contextmanager
def terminal(family: str) -> Iterator[tuple[PtyListener, Watched, RealClock]]:
    with closing(RealClock()) as clock:
        emulator = Watched(Plant(1), load_register_profile(family), clock, "rtu")
        with closing(PtyListener(emulator, clock, lock=threading.RLock(), name="bath")) as listener:
            yield listener, emulator, clock


@pytest.mark.slow
@pty
@pytest.mark.parametrize("family", ["eurotherm-3200", "omega-cn7"])
def test_a_serial_port_is_read_set_started_and_made_safe(family: str) -> None:
    with terminal(family) as (listener, emulator, clock):
        bath = OwnBath(f"{listener.url}?baud=19200", load_register_profile(family), clock)
        assert bath.read().temp_c == pytest.approx(20.0, abs=0.1)
        bath.start(33.0)
        assert emulator.runs()
        assert bath.read().set_point_c == pytest.approx(33.0)
        bath.safe()
        assert not emulator.runs()
        bath.close()


@pytest.mark.slow
@pty
def test_an_adapter_that_is_unplugged_is_reported_and_the_next_one_is_found() -> None:
    with terminal("eurotherm-2400") as (listener, emulator, clock):
        profile = load_register_profile("eurotherm-2400")
        bath = OwnBath(listener.url, profile, clock)
        within(lambda: emulator.hosts, "a host is there")
        # as long as it is open, the name goes to no other program's terminal
        kept = os.open(listener.url, os.O_RDWR | os.O_NOCTTY)
        emulator.pull_the_cable()
        within(lambda: not emulator.hosts, "it has gone")
        with pytest.raises(LinkError, match=r"the port can't be opened in 6 tries: .*list_ports"):
            bath.read()
        bath.close()
        os.close(kept)
        again = OwnBath(listener.url, profile, clock)  # it came back under another name
        assert again.read().temp_c == pytest.approx(20.0, abs=0.1)
        again.close()


def test_at_exit_standby_needs_no_look_and_no_second() -> None:
    with Stand(profile=load_register_profile("eurotherm-2400")) as stand:
        stand.plant.run(33.0)
        start_s = stand.clock.now()
        stand.bath(identify=False).safe()
        at_s, function, _ = stand.emulator.asked[0]
        assert function == 16, "a write"
        assert at_s - start_s < 0.3
        assert not stand.plant.running


# ---- taps


def test_a_tap_sees_every_byte_garbage_too() -> None:
    clock, tap = VirtualClock(), Heard()
    far_end = FarEnd(clock)
    far_end.memory = {0x1000: 200, 0x1001: 200, 0x0811: 1}
    with served(far_end) as url:
        bath = OwnBath(url, load_register_profile("omega-cn7"), clock, tap=tap)
        assert tap.text[0] == ("opened", url)
        del tap.text[:]
        far_end.spoils = [lambda frame: b"\xff" + frame]
        bath.get("run")
        assert tap.text == [
            ("sent", rtu("01 02 0814 0001")),
            ("received", b"\xff" + rtu("01 02 01 00")),
        ]
        bath.close()
        bath.close()
    assert tap.text[2:] == [("closed", "")]


def test_a_tap_gets_a_link_that_breaks_and_the_next_one(stand: Stand) -> None:
    tap = Heard()
    bath = OwnBath(stand.url, stand.profile, stand.clock, tap=tap)
    stand.emulator.pull_the_cable()
    bath.read()
    bath.close()
    events = [(what, text) for what, text in tap.text if what in ("opened", "closed")]
    assert events == [
        ("opened", stand.url),
        ("closed", "the other end hung up"),
        ("opened", stand.url),
        ("closed", ""),
    ]
    sent = [text for what, text in tap.text if what == "sent"]
    assert len(sent) - len(stand.emulator.asked) in (0, 1)  # one may have met nobody


@pytest.mark.slow
@pty
def test_a_setting_that_the_port_does_not_have_is_reported() -> None:
    with (
        terminal("omega-cn7") as (listener, _, clock),
        pytest.raises(LinkError, match=r"the port can't be opened in 6 tries"),
    ):
        # pseudo-terminals have no parity
        OwnBath(f"{listener.url}?parity=E", load_register_profile("omega-cn7"), clock)


# ---- trouble under way


@contextmanager
def over_tcp() -> Iterator[tuple[OwnBath, BathEmulator, RealClock]]:
    with closing(RealClock()) as clock:
        emulator = BathEmulator(Plant(1), load_register_profile("julabo-presto"), clock)
        with closing(Listener(emulator, clock, lock=threading.RLock(), name="bath")) as listener:
            bath = OwnBath(f"tcp://127.0.0.1:{listener.port}", emulator.profile, clock)
            yield bath, emulator, clock
            bath.close()
            bath.close()


@pytest.mark.slow
def test_in_real_time_it_works_from_several_threads() -> None:
    before = threading.active_count()
    with over_tcp() as (bath, emulator, _):
        wrong: list[object] = []

        def poll() -> None:
            for _ in range(100):
                if not 19.9 < bath.read().temp_c < 20.1:
                    wrong.append(bath.read())

        threads = [threading.Thread(target=poll) for _ in range(4)]
        for thread in threads:
            thread.start()
        bath.set_point(25.0)
        for thread in threads:
            thread.join()
        assert not wrong
        assert emulator.plant.set_point_c == 25.0
    assert threading.active_count() == before

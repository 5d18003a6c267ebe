"""The driver in real time: several threads, silence, and Ctrl-C amid a question."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator

import pytest

from instruments.bath.driver import Bath
from instruments.bath.emulator import BathEmulator
from instruments.bath.profile import load_profile
from instruments.clock import RealClock
from instruments.errors import LinkError
from instruments.listener import Listener
from instruments.world.plant import Plant

# ---- trouble under way


def test_in_real_time_it_works_from_several_threads() -> None:
    before, clock = threading.active_count(), RealClock()
    profile, plant = load_profile("julabo-presto"), Plant(1)
    listener = Listener(
        BathEmulator(plant, profile, clock), clock, lock=threading.RLock(), name="bath"
    )
    bath = Bath(f"tcp://127.0.0.1:{listener.port}", profile, clock)
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
    assert plant.set_point_c == 25.0
    bath.close()
    bath.close()
    listener.close()
    clock.close()
    assert threading.active_count() == before


def test_in_real_time_silence_takes_2_s() -> None:
    clock, profile = RealClock(), load_profile("julabo-presto")
    emulator = BathEmulator(Plant(1), profile, clock)
    listener = Listener(emulator, clock, lock=threading.RLock(), name="bath")
    bath = Bath(f"tcp://127.0.0.1:{listener.port}", profile, clock)
    emulator.fault("silence")
    start = clock.now()
    with pytest.raises(LinkError, match="no answer"):
        bath.read()
    assert 1.9 < clock.now() - start < 3.5
    bath.close()
    listener.close()
    clock.close()


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Ctrl-C raises KeyboardInterrupt, also where a shell has started us in the background, and so
    without it.
    """
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.skipif(sys.platform == "win32", reason="signals to a thread: POSIX only")
@pytest.mark.usefixtures("ctrl_c")
def test_in_real_time_ctrl_c_ends_a_question_at_once() -> None:
    clock, profile, plant = RealClock(), load_profile("julabo-presto"), Plant(1)
    emulator = BathEmulator(plant, profile, clock)
    listener = Listener(emulator, clock, lock=threading.RLock(), name="bath")
    bath = Bath(f"tcp://127.0.0.1:{listener.port}", profile, clock)
    bath.start(33.0)
    emulator.fault("silence")
    main = threading.main_thread().ident
    assert main is not None
    clock.call_at(clock.now() + 0.2, lambda: signal.pthread_kill(main, signal.SIGINT))
    start = clock.now()
    with pytest.raises(KeyboardInterrupt):
        bath.read()
    assert clock.now() - start < 0.9
    emulator.fault("silence", on=False)
    bath.safe()
    assert not plant.running
    bath.close()
    listener.close()
    clock.close()

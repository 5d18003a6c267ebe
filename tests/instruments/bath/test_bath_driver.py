"""The driver against the emulator over loopback: what it reads, what it refuses, and how it gets over trouble."""

from __future__ import annotations

import itertools
import math
import signal
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from instruments.bath.driver import Bath
from instruments.bath.emulator import BathEmulator
from instruments.bath.profile import Profile, load_profile
from instruments.clock import Clock, RealClock, VirtualClock
from instruments.errors import DeviceError, InstrumentError, LimitError, LinkError, ProtocolError
from instruments.listener import Connection, Listener
from instruments.world.plant import Plant, PlantConstants


class Watched(BathEmulator):
    """Notes the function and address of every request, and when it came."""

    def __init__(self, plant: Plant, profile: Profile, clock: Clock) -> None:
        super().__init__(plant, profile, clock)
        self.clock = clock
        self.asked: list[tuple[float, int, int]] = []
        self.hosts: set[Connection] = set()

    def connect(self, connection: Connection) -> None:
        super().connect(connection)
        self.hosts.add(connection)

    def disconnect(self, connection: Connection) -> None:
        super().disconnect(connection)
        self.hosts.discard(connection)

    def receive(self, connection: Connection, data: bytes) -> None:
        self.asked.append((self.clock.now(), data[7], int.from_bytes(data[8:10], "big")))
        super().receive(connection, data)

    def writes(self) -> list[tuple[float, int]]:
        return [(when, address) for when, function, address in self.asked if function in (6, 16)]


@dataclass
class Stand:
    clock: VirtualClock = field(default_factory=VirtualClock)
    plant: Plant = field(default_factory=lambda: Plant(1, constants=PlantConstants(sensor_noise_k=0.0)))
    profile: Profile = field(default_factory=lambda: load_profile("julabo-presto"))

    def __post_init__(self) -> None:
        self.emulator = Watched(self.plant, self.profile, self.clock)
        self.listener = Listener(self.emulator, self.clock, lock=threading.RLock(), name="bath")
        self.url = f"tcp://127.0.0.1:{self.listener.port}"
        self._opened: list[Bath] = []

    def bath(self, **options: bool) -> Bath:
        self._opened.append(Bath(self.url, self.profile, self.clock, **options))
        return self._opened[-1]

    def edited(self, row: str, **changes: object) -> None:
        """The profile with one row changed, on the driver's side only."""
        rows = tuple(known.model_copy(update=changes) if known.name == row else known for known in self.profile.rows)
        self.profile = self.profile.model_copy(update={"rows": rows})

    def close(self) -> None:
        for bath in self._opened:
            bath.close()
        self.listener.close()


@pytest.fixture
def stand() -> Iterator[Stand]:
    before = threading.active_count()
    stand = Stand()
    yield stand
    stand.close()
    assert threading.active_count() == before


def test_a_reading_says_it_all(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.clock.sleep(300.0)
    reading = bath.read()
    assert reading.t_s == stand.clock.now()
    assert reading.temp_c == pytest.approx(stand.plant.pv_c, abs=1e-5)
    assert reading.raw == struct.unpack(">HH", struct.pack(">f", stand.plant.pv_c))
    assert reading.external_c == pytest.approx(float(stand.plant.teat_c.mean()), abs=1e-5)
    assert reading.safety_c == pytest.approx(stand.plant.bath_c, abs=1e-5)
    assert reading.power_percent == 100.0
    assert (reading.alarm, reading.warning, reading.remote) == (0, 0, True)


def test_a_poll_is_one_question(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.asked.clear()
    bath.read()
    assert [(function, address) for _, function, address in stand.emulator.asked] == [(4, 5)]


def test_identity(stand: Stand) -> None:
    assert stand.bath().identity == {
        "family": "JULABO PRESTO",
        "url": stand.url,
        "order": "ABCD",
        "firmware": "10400",
        "cut_out": "40 degC",
    }
    assert stand.bath().pump == "with run"


def test_the_controller_is_looked_at_before_the_first_write(stand: Stand) -> None:
    stand.bath().start(33.0)
    looked = [(function, address) for _, function, address in stand.emulator.asked]
    first_write = next(at for at, (function, _) in enumerate(looked) if function in (6, 16))
    assert looked[0] == (3, 93)
    assert {(3, 93), (3, 90), (4, 5)} <= set(looked[:first_write])


def test_start_sets_the_set_point_before_run_and_keeps_the_spacing(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    bath.standby()
    assert [address for _, address in stand.emulator.writes()] == [2, 0, 0]
    times = [when for when, _ in stand.emulator.writes()]
    assert all(later - earlier >= 0.25 - 1e-9 for earlier, later in itertools.pairwise(times))
    assert stand.clock.now() == pytest.approx(0.5)
    assert stand.plant.set_point_c == 33.0
    assert not stand.plant.running


def test_what_is_so_already_is_not_written(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    count = len(stand.emulator.writes())
    bath.start(33.0)
    bath.set_point(33.0)
    assert len(stand.emulator.writes()) == count


def test_start_puts_the_controller_in_charge_of_the_heater(stand: Stand) -> None:
    bath = stand.bath()
    bath.set("actuating", "digital")
    bath.start(33.0)
    assert bath.get("actuating") == 0.0
    assert [address for _, address in stand.emulator.writes()] == [1, 1, 2, 0]


def test_heating_to_33_degc_and_back_to_standby(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    for _ in range(1200):
        stand.clock.sleep(1.0)
        reading = bath.read()
    assert reading.temp_c == pytest.approx(33.0, abs=0.05)
    bath.standby()
    assert not stand.plant.running


def test_two_runs_read_the_same() -> None:
    def run() -> list[object]:
        stand = Stand(plant=Plant(7))
        try:
            bath = stand.bath()
            bath.start(33.0)
            readings: list[object] = []
            for _ in range(300):
                stand.clock.sleep(1.0)
                readings.append(bath.read())
            return readings
        finally:
            stand.close()

    assert run() == run()


# ---- refusals before anything is sent


@pytest.mark.parametrize(
    ("row", "value", "message"),
    [
        ("set_point", 36.5, "set_point takes 5 to 36 degC"),
        ("set_point", math.nan, "set_point takes 5 to 36 degC"),
        ("run", 7, r"run takes 0 \(standby\), 1 \(started\)"),
        ("run", "on", "run has no value 'on'"),
        ("unit", "f", "unit is read-only"),
        ("temperature", 20.0, "temperature is read-only"),
        ("pump_stage", 5, "pump_stage takes 1 to 4"),
    ],
)
def test_what_the_profile_does_not_list_is_not_written(stand: Stand, row: str, value: float | str, message: str) -> None:
    bath = stand.bath()
    with pytest.raises(LimitError, match=message) as caught:
        bath.set(row, value)
    assert str(caught.value).startswith(f"bath at {stand.url}")
    assert not stand.emulator.writes()


def test_a_set_point_out_of_bounds_does_not_start(stand: Stand) -> None:
    with pytest.raises(LimitError, match="5 to 36"):
        stand.bath().start(80.0)
    assert not stand.emulator.writes()


def test_inferred_rows_are_not_written_unless_allowed(stand: Stand) -> None:
    stand.edited("heating_limit", evidence="INFERRED")
    with pytest.raises(LimitError, match="only infers where heating_limit is"):
        stand.bath().set("heating_limit", 50.0)
    assert not stand.emulator.writes()
    stand.bath(allow_inferred=True).set("heating_limit", 50.0)
    assert stand.plant.output_max == 0.5


def test_a_row_that_the_family_lacks(stand: Stand) -> None:
    with pytest.raises(KeyError, match="has no row 'flow'"):
        stand.bath().get("flow")


# ---- refusals at the first look


@pytest.mark.parametrize(
    ("fault", "error", "message"),
    [
        ("fahrenheit", DeviceError, r"does not speak degC \(asked its unit, got f\)\. Set the controller to degrees Celsius"),
        ("sensor break", DeviceError, r"has no temperature \(asked temperature, got alarm 5, working sensor"),
        ("silence", LinkError, r"no answer \(asked holding registers 93 to 93, after 2 s\)"),
        ("busy", DeviceError, r"refused: it is busy \(asked holding registers 93 to 93, got Modbus exception 6\)"),
        ("wrong length", ProtocolError, "0 registers were answered where 1 were asked"),
    ],
)
def test_a_controller_that_does_not_fit_is_refused(stand: Stand, fault: str, error: type[InstrumentError], message: str) -> None:
    stand.emulator.fault(fault)
    stand.clock.sleep(1.0)
    with pytest.raises(error, match=message):
        stand.bath()
    assert not stand.emulator.writes()
    stand.emulator.fault(fault, on=False)
    assert stand.bath().read().temp_c == pytest.approx(20.0, abs=0.05)


def test_another_order_of_bytes_is_learnt(stand: Stand) -> None:
    stand.emulator.fault("word order")
    bath = stand.bath()
    assert bath.identity["order"] == "CDAB"
    bath.start(33.0)
    assert stand.plant.set_point_c == 33.0
    assert bath.read().temp_c == pytest.approx(20.0, abs=0.02)


def test_a_code_of_order_that_nobody_knows_is_refused(stand: Stand) -> None:
    codes = stand.profile.order_from
    assert codes is not None
    stand.profile = stand.profile.model_copy(update={"order_from": codes.model_copy(update={"codes": {"9": "ABCD"}})})
    with pytest.raises(ProtocolError, match=r"order of bytes is none that the profile knows \(asked encoding, got 0\)"):
        stand.bath()


def test_an_order_that_changes_behind_our_back_is_noticed(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.clock.sleep(300.0)
    stand.emulator.fault("word order")
    with pytest.raises(ProtocolError, match="can't be: not within -5 to 60 degC"):
        bath.read()
    bath.safe()
    assert not stand.plant.running


def test_gaps_that_the_controller_refuses_are_left_out(stand: Stand) -> None:
    stand.emulator.fault("gaps refused")
    bath = stand.bath()
    stand.emulator.asked.clear()
    assert bath.read().safety_c == pytest.approx(20.0)
    assert [address for _, _, address in stand.emulator.asked] == [5, 10, 16]


@pytest.mark.parametrize(
    "url", ["tcp://", "socket://h:1", "tcp://h:99999", "tcp://h:1?unit=x", "tcp://h:1?unit=300", "tcp://h:1?word=1", "/dev/ttyUSB0"]
)
def test_a_url_that_is_none(stand: Stand, url: str) -> None:
    with pytest.raises(LinkError, match=r"not a link.*Write tcp://host:port"):
        Bath(url, stand.profile, stand.clock)


def test_a_family_that_does_not_speak_tcp(stand: Stand) -> None:
    stand.profile = stand.profile.model_copy(update={"transports": ("rtu",)})
    with pytest.raises(LinkError, match="JULABO PRESTO does not speak Modbus TCP"):
        stand.bath()


def test_another_unit_is_silence_and_the_url_names_it(stand: Stand) -> None:
    with pytest.raises(LinkError, match="no answer"):
        Bath(stand.url + "?unit=2", stand.profile, stand.clock)
    stand.emulator.unit_id = 2
    bath = Bath(stand.url + "?unit=2", stand.profile, stand.clock)
    assert bath.read().temp_c == 20.0
    bath.close()


def test_nobody_there_is_said_after_some_tries(stand: Stand) -> None:
    with pytest.raises(LinkError, match=r"nothing took the connection in 6 tries \(after 3\.1 s\)"):
        Bath("tcp://127.0.0.1:1", stand.profile, stand.clock)
    with pytest.raises(LinkError, match="nothing took the connection"):
        Bath("tcp://no-such-host.invalid:502", stand.profile, stand.clock)


def test_a_controller_that_comes_up_late_is_waited_for() -> None:
    clock, profile = VirtualClock(), load_profile("julabo-presto")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    listeners: list[Listener] = []

    def switch_on() -> None:
        listeners.append(Listener(BathEmulator(Plant(1), profile, clock), clock, lock=threading.RLock(), name="bath", port=port))

    clock.call_at(1.0, switch_on)
    bath = Bath(f"tcp://127.0.0.1:{port}", profile, clock)
    assert clock.now() == pytest.approx(1.5)
    assert bath.read().temp_c == pytest.approx(20.0, abs=0.05)
    bath.close()
    listeners[0].close()


# ---- refusals to start


@pytest.mark.parametrize(("fault", "message"), [("low level", "alarm 1, low level"), ("sensor break", "working sensor")])
def test_no_heat_with_an_alarm(stand: Stand, fault: str, message: str) -> None:
    bath = stand.bath()
    stand.emulator.fault(fault)
    stand.clock.sleep(1.0)
    with pytest.raises(DeviceError, match=message):
        bath.start(33.0)
    assert not stand.emulator.writes()
    assert not stand.plant.running


def test_a_write_that_does_not_stand_is_told(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("manual mode")
    assert bath.read().remote is False
    with pytest.raises(DeviceError, match=r"did not do it \(asked set_point = 33, got set_point = 20\).*'manual'"):
        bath.start(33.0)
    assert not stand.plant.running


# ---- trouble under way


def test_silence_costs_2_s_of_virtual_time_and_then_all_is_well(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("silence")
    real = time.perf_counter()
    with pytest.raises(LinkError, match=r"no answer \(asked input registers 5 to 17, after 2 s\)"):
        bath.read()
    assert time.perf_counter() - real < 0.5
    assert stand.clock.now() == pytest.approx(2.0)
    stand.emulator.fault("silence", on=False)
    assert bath.read().temp_c == 20.0


def test_a_late_answer_is_never_taken_for_the_next_one(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.emulator.fault("late answer")
    stand.emulator.late_s = 2.5  # both attempts are over by then
    with pytest.raises(LinkError, match="no answer"):
        bath.read()
    stand.emulator.fault("late answer", on=False)
    for wanted in (21.0, 22.0, 23.0):
        bath.set_point(wanted)
        stand.clock.sleep(0.7)
        assert bath.get("set_point") == wanted


def test_an_answer_within_the_second_attempt_counts(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("late answer")
    assert bath.read().temp_c == pytest.approx(20.0)
    assert stand.clock.now() == pytest.approx(1.5)


def test_a_wrong_length_is_nonsense(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("wrong length")
    with pytest.raises(ProtocolError, match=r"12 registers were answered where 13 were asked.*got 00"):
        bath.read()


def test_a_cable_pulled_between_two_questions_is_mended(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    for connection in list(stand.emulator.hosts):
        connection.hang_up()
    assert bath.read().temp_c == pytest.approx(20.0, abs=0.05)
    assert [address for _, function, address in stand.emulator.asked if function == 3].count(93) == 2  # looked at anew


def test_a_power_cut_is_told_once(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.plant.standby()
    for connection in list(stand.emulator.hosts):
        connection.hang_up()
    with pytest.raises(DeviceError, match="stopped by itself: a power cut"):
        bath.read()
    assert bath.read().power_percent == 0.0
    bath.start(33.0)
    assert stand.plant.running


def test_a_controller_switched_off_is_a_link_error(stand: Stand) -> None:
    bath = stand.bath()
    stand.listener.close()
    with pytest.raises(LinkError, match="nothing took the connection"):
        bath.read()
    with pytest.raises(LinkError, match="nothing took the connection"):
        bath.safe()


def test_an_event_of_virtual_time_may_ask_while_an_answer_is_awaited(stand: Stand) -> None:
    bath = stand.bath()
    stand.emulator.fault("late answer")
    seen: list[float] = []
    stand.clock.call_at(0.5, lambda: seen.append(bath.read().temp_c))
    assert bath.read().temp_c == pytest.approx(20.0)
    assert seen == [pytest.approx(20.0)]


def test_an_interrupted_question_drops_the_link(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.emulator.fault("late answer")

    def interrupt() -> None:
        raise KeyboardInterrupt

    stand.clock.call_at(stand.clock.now() + 0.5, interrupt)
    with pytest.raises(KeyboardInterrupt):
        bath.read()
    stand.emulator.fault("late answer", on=False)
    bath.safe()
    assert not stand.plant.running
    assert bath.read().temp_c == pytest.approx(20.0, abs=0.05)


# ---- safe


@pytest.mark.parametrize("fault", ["fahrenheit", "sensor break", "low level", "word order", "gaps refused", "stuck heater"])
def test_safe_is_standby_whatever_is_wrong(stand: Stand, fault: str) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.emulator.fault(fault)
    stand.clock.sleep(1.0)
    bath.safe()
    bath.safe()
    assert not stand.plant.running


def test_safe_writes_even_what_seems_so_already(stand: Stand) -> None:
    bath = stand.bath()
    bath.safe()
    assert [address for _, address in stand.emulator.writes()] == [0]


def test_safe_gets_over_a_silence_that_ends(stand: Stand) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.emulator.fault("silence")
    stand.clock.call_at(stand.clock.now() + 3.0, lambda: stand.emulator.fault("silence", on=False))
    bath.safe()
    assert not stand.plant.running


@pytest.mark.parametrize(("fault", "error"), [("silence", LinkError), ("busy", DeviceError), ("manual mode", DeviceError)])
def test_safe_says_so_when_it_can_not(stand: Stand, fault: str, error: type[InstrumentError]) -> None:
    bath = stand.bath()
    bath.start(33.0)
    stand.emulator.fault(fault)
    start = stand.clock.now()
    with pytest.raises(error):
        bath.safe()
    assert stand.clock.now() - start < 10.0
    stand.emulator.fault(fault, on=False)
    bath.safe()
    assert not stand.plant.running


def test_whoever_cleans_up_needs_no_look_at_the_controller(stand: Stand) -> None:
    stand.bath().start(33.0)
    stand.emulator.fault("fahrenheit")
    other = stand.bath(identify=False)
    other.safe()
    assert not stand.plant.running
    with pytest.raises(DeviceError, match="degC"):
        other.read()


# ---- a controller of another make: answers that pymodbus lets through


class Liar:
    """Answers every request with ``reply(request)``."""

    def __init__(self, reply: Callable[[bytes], bytes]) -> None:
        self.reply = reply

    def connect(self, connection: Connection) -> None:
        """Nothing unasked."""

    def disconnect(self, connection: Connection) -> None:
        """Nothing to forget."""

    def receive(self, connection: Connection, data: bytes) -> None:
        connection.send(self.reply(data))


@pytest.mark.parametrize(
    ("reply", "message"),
    [
        (lambda asked: asked[:2] + bytes.fromhex("0000 0005 01 04 02 0000"), "function 4 was answered to function 3"),
        (lambda asked: b"\0\x63" + bytes.fromhex("0000 0005 01 03 02 0000"), "what came is no answer to this"),  # another transaction
        (lambda asked: asked[:2] + bytes.fromhex("0000 0005 02 03 02 0000"), "what came is no answer to this"),  # another unit
        (lambda asked: asked[:2] + bytes.fromhex("0000 0005 01 2A 02 0000"), "what came is no answer to this"),  # no such function
        (lambda asked: b"HTTP/1.1 400 Bad Request\r\n\r\n", r"what came is no answer to this.*got 48 54 54 50"),
    ],
)
def test_answers_that_are_none(reply: Callable[[bytes], bytes], message: str) -> None:
    clock = VirtualClock()
    listener = Listener(Liar(reply), clock, lock=threading.RLock(), name="liar")
    with pytest.raises(ProtocolError, match=message):
        Bath(f"tcp://127.0.0.1:{listener.port}", load_profile("julabo-presto"), clock)
    listener.close()


# ---- real time


def test_in_real_time_it_works_from_several_threads() -> None:
    before, clock = threading.active_count(), RealClock()
    profile, plant = load_profile("julabo-presto"), Plant(1)
    listener = Listener(BathEmulator(plant, profile, clock), clock, lock=threading.RLock(), name="bath")
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
    """Ctrl-C raises KeyboardInterrupt, also where a shell has started us in the background, and so without it."""
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


# ---- any order of trouble


class BathUnderFaults(RuleBasedStateMachine):
    """Whatever breaks in whatever order: never a wrong value, never heat after safe, always mended in the end."""

    faults = st.sampled_from(["silence", "busy", "wrong length", "late answer", "manual mode", "fahrenheit", "gaps refused"])

    @initialize()
    def open(self) -> None:
        self.stand = Stand()
        self.bath = self.stand.bath()

    @rule(fault=faults, on=st.booleans())
    def break_or_mend(self, fault: str, on: bool) -> None:
        self.stand.emulator.fault(fault, on=on)

    @rule()
    def pull_the_cable(self) -> None:
        for connection in list(self.stand.emulator.hosts):
            connection.hang_up()

    @rule(seconds=st.floats(0.0, 60.0))
    def wait(self, seconds: float) -> None:
        self.stand.clock.sleep(seconds)

    @rule()
    def read(self) -> None:
        try:
            reading = self.bath.read()
        except InstrumentError:
            return
        late_k = 2.0 * 1.8 / 60.0  # a late answer is up to 2 s old, at 1.8 K/min
        assert reading.temp_c == pytest.approx(self.stand.plant.pv_c, abs=late_k + 0.03)

    @rule(wanted=st.sampled_from([20.0, 25.5, 33.0]))
    def start(self, wanted: float) -> None:
        try:
            self.bath.start(wanted)
        except InstrumentError:
            return
        assert self.stand.plant.running

    @rule()
    def safe(self) -> None:
        try:
            self.bath.safe()
        except InstrumentError:
            return
        assert not self.stand.plant.running

    @invariant()
    def no_set_point_that_nobody_asked_for(self) -> None:
        if hasattr(self, "stand"):
            assert self.stand.plant.set_point_c in (20.0, 25.5, 33.0)

    def teardown(self) -> None:
        if not hasattr(self, "stand"):
            return
        for fault in self.stand.emulator.faults:
            self.stand.emulator.fault(fault, on=False)
        self.bath.safe()
        assert not self.stand.plant.running
        self.stand.close()


TestBathUnderFaults = BathUnderFaults.TestCase
TestBathUnderFaults.settings = settings(max_examples=40, stateful_step_count=25, deadline=None)

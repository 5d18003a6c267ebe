"""Baths that speak lines of ASCII: replies typed from the makers' manuals, and no wrong value from
late, doubled, cut or garbled lines. CERTAIN lines are from a maker's manual; FIELD ones from
drivers that run against real circulators.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from instruments.bath.driver import OwnBath
from instruments.bath.line_emulator import LineEmulator
from instruments.bath.profile import LineProfile, Profile, load_profile, profile_names
from instruments.clock import Clock, VirtualClock
from instruments.device_file import DeviceFileError
from instruments.errors import DeviceError, InstrumentError, LinkError
from instruments.listener import Connection
from tests.examples import examples
from tests.instruments.bath.devices import LineDevice, calm_plant, driven

JULABO = "julabo-ascii"
LINE_FAMILIES = [name for name in profile_names() if isinstance(load_profile(name), LineProfile)]


@dataclass(frozen=True)
class Fault:
    """What becomes of one reply: it comes late, twice (the second one late), cut, or changed."""

    late_s: float = 0.0
    lost: bool = False
    again_s: float | None = None
    spoil: Callable[[bytes], bytes] = bytes


@dataclass
class Typed(LineDevice):
    """A controller whose replies are typed by hand: command to reply, both without their ends. It
    answers in order; each reply takes the next of ``faults``. A write is kept in ``told``.
    """

    clock: Clock
    replies: dict[str, str]
    end: bytes = b"\r"
    reply_end: bytes = b"\r\n"
    confirm: str = ""
    latency_s: float = 0.0
    faults: list[Fault] = field(default_factory=list)
    told: list[str] = field(default_factory=list)
    acts: Callable[[Typed, str], None] = lambda *_: None
    _free_s: float = 0.0

    def take(self, connection: Connection, line: bytes) -> None:
        command = line.decode("ascii")
        if command not in self.replies:
            self.told.append(command)
            self.acts(self, command)
        reply = self.replies.get(command, self.confirm)
        if reply:
            self._send(connection, reply.encode("ascii") + self.reply_end)

    def _send(self, connection: Connection, line: bytes) -> None:
        fault = self.faults.pop(0) if self.faults else Fault()
        if fault.lost:
            return
        line, now_s = fault.spoil(line), self.clock.now()
        self._free_s = max(self._free_s, now_s + self.latency_s + fault.late_s)
        self._put(connection, line, self._free_s - now_s)
        if fault.again_s is not None:
            self._free_s += fault.again_s
            self._put(connection, line, self._free_s - now_s)

    def _put(self, connection: Connection, line: bytes, after_s: float) -> None:
        if after_s > 0.0:
            connection.after(after_s, lambda: connection.send(line))
        else:
            connection.send(line)


@contextmanager
def served(typed: Typed, profile: str | Profile = JULABO) -> Iterator[tuple[Typed, OwnBath]]:
    """A driver on it, under its clock."""
    family = load_profile(profile) if isinstance(profile, str) else profile
    with driven(typed, family, typed.clock, unit_confirmed=True) as bath:
        yield typed, bath


# JULABO. CERTAIN: the commands and the texts of status (SL/HL manual, 12.3; FLW and CF manuals, 10.4
# and 10.5); a number has a period, and LF ends a reply. FIELD: CR LF, and ---.-- for no sensor.
JULABO_REPLIES = {
    "version": "JULABO SL-12 VER 4.0",
    "status": "02 REMOTE STOP",
    "in_pv_00": "20.00",
    "in_pv_01": "45",
    "in_pv_02": "31.00",
    "in_pv_03": "21.50",
    "in_pv_04": "40.0",
    "in_sp_00": "33.00",
    "in_mode_04": "0",
    "in_mode_05": "0",
}


def julabo(**replies: str) -> Typed:
    return Typed(VirtualClock(), {**JULABO_REPLIES, **replies})


@pytest.mark.parametrize(
    ("status", "alarm", "warning", "remote", "text"),
    [
        ("00 MANUAL STOP", 0, 0, False, ""),
        ("01 MANUAL START", 0, 0, False, ""),
        ("03 REMOTE START", 0, 0, True, ""),
        ("-01 LOW LEVEL ALARM", -1, 0, None, "low level"),
        ("-03 EXCESS TEMPERATURE WARNING", 0, 3, None, ""),
        ("-05 WORKING SENSOR ALARM", -5, 0, None, "working sensor"),
        ("-08 INVALID COMMAND", 0, 0, None, ""),
        ("-13 WARNING : VALUE EXCEEDS TEMPERATURE LIMITS", 0, 0, None, ""),
        ("-14 TEMPERATURE/LEVEL ALARM", -14, 0, None, "safety temperature"),
        ("-33 SAFETY SENSOR ALARM", -33, 0, None, "see the controller's manual"),
    ],
)
def test_a_julabos_status(
    status: str, alarm: int, warning: int, remote: bool | None, text: str
) -> None:
    with served(julabo(status=status)) as (_, bath):
        reading = bath.read()
        assert (reading.alarm, reading.warning, reading.remote) == (alarm, warning, remote)
        assert text in bath.profile.alarm_text(reading.alarm)


def test_a_reply_may_end_with_a_line_feed_alone_and_a_sensor_may_be_absent() -> None:
    """The manual's line end (CERTAIN), its own example 55.5, and no external sensor (FIELD)."""
    typed = julabo(in_sp_00="35.5", in_pv_02="---.--")
    typed.reply_end = b"\n"
    with served(typed) as (_, bath):
        assert (bath.read().set_point_c, bath.read().external_c) == (35.5, None)


def test_what_a_julabo_is_told() -> None:
    """CERTAIN: command, space, parameter; out_mode_05 1 starts and 0 stops; 250 ms apart."""

    def act(typed: Typed, command: str) -> None:
        word, _, parameter = command.partition(" ")
        read = {"out_sp_00": "in_sp_00", "out_mode_05": "in_mode_05"}[word]
        typed.replies[read] = parameter
        times_s.append(typed.clock.now())

    times_s: list[float] = []
    typed = julabo()
    typed.acts = act
    with served(typed) as (_, bath):
        bath.start(35.25)
        bath.standby()
    assert typed.told == ["out_sp_00 35.25", "out_mode_05 1", "out_mode_05 0"]
    assert min(b - a for a, b in pairwise(times_s)) >= 0.25


def test_a_write_that_is_not_done_is_reported_with_the_cause() -> None:
    with (
        served(julabo(status="00 MANUAL STOP")) as (_, bath),
        pytest.raises(DeviceError, match=r"did not do it.*'manual': set it to remote control"),
    ):
        bath.set_point(25.0)


@pytest.mark.parametrize(
    ("replies", "said"),
    [
        ({"version": "20.00"}, "may be the answer to"),
        ({"in_pv_00": "91.40"}, "In degF it would be 33.0 degC"),
        ({"in_mode_05": "7"}, "what came is no answer to this"),
        ({"status": "0"}, "what came is no answer to this"),
        ({"in_pv_00": ""}, "no answer"),
    ],
)
def test_what_no_julabo_answers_is_refused(replies: dict[str, str], said: str) -> None:
    with pytest.raises(InstrumentError, match=said), served(julabo(**replies)):
        pass


# LAUDA. CERTAIN: commands, OK and ERR_X, XXX.XX, CR LF (LOOP 100 manual, 5.11), and the characters of
# STAT (ECO Gold manual, p. 125); IN_MODE_02 is 1 in standby.
LAUDA_REPLIES = {
    "TYPE": "BC_LOOP",
    "VERSION_R": "1.10",
    "IN_PV_00": "020.50",
    "IN_PV_03": "ERR_3",
    "IN_SP_00": "033.00",
    "IN_SP_03": "040.00",
    "IN_MODE_01": "0",
    "IN_MODE_02": "1",
    "STAT": "0000000",
}


def test_what_a_lauda_is_told() -> None:
    """CERTAIN: its example sets 30.5 degC by OUT_SP_00_30.5, answered with OK."""

    def act(typed: Typed, command: str) -> None:
        changed = {"START": ("IN_MODE_02", "0"), "STOP": ("IN_MODE_02", "1")}
        changed |= {f"OUT_SP_08_{n}": ("IN_SP_08", f"0{n:0>2}.00") for n in ("0", "30", "45")}
        read, shown = changed.get(command, ("IN_SP_00", f"0{command[-5:]}"))
        typed.replies[read] = shown

    watched = {**LAUDA_REPLIES, "IN_SP_08": "045.00"}
    typed = Typed(VirtualClock(), dict(watched), confirm="OK", acts=act)
    with served(typed, "lauda-ascii") as (_, bath):
        bath.start(30.5)
        assert bath.watchdog_s == 30.0
        bath.safe()
        # FIELD: the seconds without a command after which it stops, as they were before
        heats, rests = ["OUT_SP_00_30.50", "OUT_SP_08_30", "START"], ["STOP", "OUT_SP_08_45"]
        assert typed.told == [*heats, *rests]
        typed.confirm = "ERR_6"
        with pytest.raises(DeviceError, match="refused: impermissible value"):
            bath.set_point(31.0)


@pytest.mark.parametrize("reply", ["ERR_3", "ERR_8", ""])
def test_a_lauda_without_a_watchdog_heats_all_the_same(reply: str) -> None:
    def act(typed: Typed, command: str) -> None:
        shown = {"START": ("IN_MODE_02", "0"), "STOP": ("IN_MODE_02", "1")}
        if command in shown:
            typed.replies.update([shown[command]])

    replies = {**LAUDA_REPLIES, "IN_SP_08": reply}
    typed = Typed(VirtualClock(), replies, confirm="OK", acts=act)
    with served(typed, "lauda-ascii") as (_, bath):
        bath.start(33.0)
        assert bath.watchdog_s is None
        bath.safe()
        assert typed.told == ["START", "STOP"]


POLYSCIENCE = {"RT": "+20.50", "RR": "?", "RS": "+33.00", "RO": "0", "RU": "C", "RF": "0"}


def test_a_set_point_that_shows_a_second_later_is_no_refusal() -> None:
    def act(on: Typed, command: str) -> None:
        connection_s = on.clock.now() + 0.9
        shown.append((connection_s, command))

    class Slow(dict[str, str]):
        def get(self, key: str, default: str = "") -> str:  # type: ignore[override]
            if key == "RS" and shown and typed.clock.now() >= shown[-1][0]:
                return "+30.50"
            return super().get(key, default)

    shown: list[tuple[float, str]] = []
    typed = Typed(VirtualClock(), Slow(POLYSCIENCE), confirm="!", reply_end=b"\r", acts=act)
    with served(typed, "polyscience") as (_, bath):
        bath.set_point(30.5)
        assert bath.read().set_point_c == 30.5


# Huber's values are 0.01 degC whatever it shows
@pytest.mark.parametrize("name", ["thermo-arctic", "haake", "polyscience"])
def test_a_display_in_fahrenheit_is_noticed(name: str) -> None:
    with emulated(name) as (device, bath):
        bath.start(33.0)
        device.fault("fahrenheit")
        with pytest.raises(InstrumentError):
            bath.read()


# ---- late, doubled, cut and garbled


def cut(count: int, *, head: bool) -> Fault:
    return Fault(spoil=lambda line: line[count:] if head else line[: max(0, len(line) - count)])


def changed(at: int, into: int) -> Fault:
    def spoil(line: bytes) -> bytes:
        place = at % len(line)
        return line[:place] + bytes((into,)) + line[place + 1 :]

    return Fault(spoil=spoil)


FAULTS = st.one_of(
    st.builds(Fault, late_s=st.sampled_from([0.01, 0.5, 1.2, 3.0, 6.0])),
    st.builds(Fault, lost=st.just(True)),
    st.builds(Fault, again_s=st.sampled_from([0.0, 0.005, 0.02, 0.03, 1.5])),
    st.builds(cut, st.integers(1, 4), head=st.booleans()),
    st.builds(changed, st.integers(0, 4), st.sampled_from(list(b"0123456789.-x\x00\r\n"))),
)


TWO_REPLIES = 0.1 + 1e-9  # what they may differ by; a tenth has no exact binary number


@pytest.mark.slow
@settings(max_examples=examples(20), deadline=None, suppress_health_check=list(HealthCheck))
@given(faults=st.dictionaries(st.integers(0, 40), FAULTS, min_size=1, max_size=4))
# both replies to one command come twice, each late enough to answer the next command: they agree
@example(faults={10: Fault(again_s=0.012), 11: Fault(again_s=0.012)})
@example(faults={19: changed(3, 52), 0: Fault(late_s=6.0)})  # another digit, a tenth off
def test_no_wrong_value_from_a_bad_line(faults: dict[int, Fault]) -> None:
    """Right within what two replies may differ by, or an error; never another row's value. Two
    replies in a row that are damaged in the same way can't be told from sound ones.
    """
    assume(
        all(
            faults[at].spoil is bytes or faults[at + 1].spoil is bytes
            for at in faults
            if at + 1 in faults
        )
    )
    with served(julabo()) as (typed, bath):
        typed.latency_s = 0.02
        typed.faults = [faults.get(at, Fault()) for at in range(41)]
        for _ in range(4):
            try:
                reading = bath.read()
                external_c = bath.get("external")
            except InstrumentError:
                continue
            assert reading.temp_c == pytest.approx(20.0, abs=TWO_REPLIES)
            assert reading.set_point_c == 33.0
            assert reading.external_c in (None, pytest.approx(31.0, abs=TWO_REPLIES))
            assert reading.safety_c in (None, pytest.approx(21.5, abs=TWO_REPLIES))
            assert external_c == pytest.approx(31.0, abs=TWO_REPLIES)
            assert (reading.running, reading.alarm) == (False, 0)
        typed.faults.clear()
        typed.clock.sleep(10.0)
        assert bath.read().temp_c == 20.0, "it recovers"


@pytest.mark.parametrize("lost", [2, 3, 4])
@pytest.mark.parametrize("doubled", range(7, 15))
def test_doubled_replies_are_not_taken_for_the_next_rows(doubled: int, lost: int) -> None:
    """Both replies to one command come twice, and one that is lost later would hide it."""
    faults = {doubled: Fault(again_s=0.005), doubled + 1: Fault(again_s=0.005)}
    faults |= {0: Fault(late_s=0.5), doubled + lost: Fault(lost=True)}
    far_end = Typed(VirtualClock(), POLYSCIENCE, reply_end=b"\r")
    with served(far_end, "polyscience") as (typed, bath):
        typed.latency_s = 0.02
        typed.faults = [faults.get(at, Fault()) for at in range(41)]
        for _ in range(4):
            with contextlib.suppress(InstrumentError):
                reading = bath.read()
                assert (reading.temp_c, reading.set_point_c) == (20.5, 33.0)


def test_standby_is_sent_at_once_on_a_line_that_is_out_of_step() -> None:
    typed = julabo(in_mode_05="1", status="03 REMOTE START")

    def act(on: Typed, command: str) -> None:
        on.replies["in_mode_05"] = command[-1]

    typed.acts = act
    with served(typed) as (_, bath):
        typed.faults = [Fault(late_s=3.0)] * 3
        with pytest.raises(InstrumentError):
            bath.read()
        asked_s, typed.told = typed.clock.now(), []
        bath.safe()
        assert typed.told[0] == "out_mode_05 0"
        assert typed.clock.now() - asked_s < 10.0


# ---- an independent client, and the driver, on a serial port


DIALOGUES = {  # command > answer
    "lauda-ascii": """OUT_SP_00_30.5 > OK | IN_SP_00 > 030.50 | out_sp_00 -5 > OK | IN_SP_00 > -005.00
        START > OK | IN_MODE_02 > 0 | STAT > 0000000 | OUT_SP_00_x > ERR_5 | OUT_SP_00_900 > ERR_6
        STRAT > ERR_3 | STOP > OK
        IN_SP_08 > 000.00 | OUT_SP_08_30 > OK | IN_SP_08 > 030.00 | OUT_SP_08_100 > ERR_6
        OUT_SP_08_x > ERR_5 | OUT_SP_08_0 > OK"""
    f"| OUT_SP_08_{'9' * 5000} > ERR_6",
    # 30.5 degC; 300 degC; a little more, which is not taken
    "huber-pb": """{M000BEA > {S000BEA | {M00**** > {S000BEA | {M007530 > {S007530 | {M007531 > {S007530
        {M140001 > {S140001 | {M16**** > {S160001 | {M05**** > {S050000 | {M66**** > {S667FFF
        {M140000 > {S140000""",
    "thermo-arctic": """SS 30.5 > OK | RS > 30.50C | SO 1 > OK | RO > 1 | RTU > C | RUFS > 0 0 0 12 64
        SO 0 > OK""",
    "haake": """W SW 30.50 > $ | R SW > SW30.50$ | W TS 1 > $ | R BS > BS100000000000$
        W SW 900 > F123 | R XX > F001 | W TS 0 > $""",
    "polyscience": """SS30.5 > ! | RS > +30.50 | SO1 > ! | RO > 1 | SS900 > ? | QQ > ? | SO0 > !""",
}


@pytest.mark.parametrize("name", DIALOGUES)
def test_a_dialogue_written_from_the_makers_documents_alone(name: str) -> None:
    with emulated(name) as (device, _):
        for turn in re.split(r"[|\n]", DIALOGUES[name]):
            command, _, answer = turn.strip().partition(" > ")
            assert device.panel.answer(command) == answer
        assert not device.plant.running


# ---- each family and its emulator


@contextmanager
def emulated(
    name: str, fault: str = "", *, confirmed: bool = True
) -> Iterator[tuple[LineEmulator, OwnBath]]:
    """A driver on an emulated circulator, whose unit a person has ``confirmed``."""
    profile, clock = load_profile(name), VirtualClock()
    assert isinstance(profile, LineProfile)
    device = LineEmulator(calm_plant(), profile, clock)
    with driven(device, profile, clock, unit_confirmed=confirmed) as bath:
        if fault:
            device.fault(fault)
        yield device, bath


def test_a_lauda_that_nobody_asks_any_more_stops_by_itself_with_an_alarm() -> None:
    """Alarm 22 (fact sheet, 4.1): pump, heater and cooling stop. Whoever asks in time feeds it."""
    with emulated("lauda-ascii") as (device, bath):
        clock, plant = device._clock, device.plant
        bath.start(33.0)
        for _ in range(10):
            clock.sleep(20.0)
            assert bath.read().running
        clock.sleep(29.0)
        assert device.plant.running
        clock.sleep(2.0)
        assert not plant.running
        with pytest.raises(DeviceError, match="stopped by itself"):
            bath.read()
        assert bath.read().alarm == 2
        with pytest.raises(DeviceError, match="not started: alarm 2"):
            bath.start(33.0)
        assert not plant.running


def test_a_lauda_that_was_left_in_standby_raises_no_alarm() -> None:
    with emulated("lauda-ascii") as (device, bath):
        for end in (bath.safe, bath.standby):
            bath.start(33.0)
            end()
            assert device.panel.watchdog_s == 0.0
            device._clock.sleep(120.0)
            assert bath.read().alarm == 0
        bath.watched = False
        bath.start(33.0)
        device._clock.sleep(120.0)
        assert bath.read().running


@pytest.mark.parametrize("name", LINE_FAMILIES)
@pytest.mark.parametrize("fault", ["silence", "late answer", "garbage", "cut answer"])
def test_each_family_with_a_bad_line_gives_an_error_and_recovers(name: str, fault: str) -> None:
    with emulated(name, fault) as (device, bath):
        with pytest.raises(InstrumentError):
            bath.read()
        device.fault(fault, on=False)
        bath.read()
        device.fault("doubled answer")
        assert bath.read().temp_c == pytest.approx(20.0, abs=0.1)


@pytest.mark.parametrize("name", LINE_FAMILIES)
def test_each_family_heats_and_after_a_power_cut_stands_by(name: str) -> None:
    with emulated(name) as (device, bath):
        bath.start(33.0)
        device.plant.advance_to(1800.0)
        assert bath.read().temp_c == pytest.approx(device.plant.pv_c, abs=0.06)
        device.fault("controller reset")
        with pytest.raises(LinkError):
            bath.read()
        device._clock.sleep(6.0)
        with pytest.raises(
            DeviceError, match=r"stopped by itself|restarted and lost its set point"
        ):
            bath.read()


# ---- profiles


OWN = (Path(__file__).parent / "own" / "sticker.toml").read_text(encoding="utf-8")


def own(folder: Path, old: str = "", new: str = "") -> Path:
    path = folder / "own.toml"
    assert old in OWN
    path.write_text(OWN.replace(old, new, 1), encoding="utf-8")
    return path


def test_a_url_that_a_lab_s_own_bath_can_not_have_is_refused(tmp_path: Path) -> None:
    profile, clock = load_profile(own(tmp_path)), VirtualClock()
    with pytest.raises(LinkError, match="the port is missing"):
        OwnBath("tcp://127.0.0.1", profile, clock)
    with pytest.raises(LinkError, match="has no unit"):
        OwnBath("COM9?unit=3", profile, clock)


@pytest.mark.parametrize(
    ("old", "new", "key", "message"),
    [
        ('kind = "line"', 'kind = "lines"', "kind", "input should be 'line'"),
        ('marker = "version"', 'marker = "verson"', "marker", "no row 'verson'"),
        ('marker = "version"', 'marker = "temperatur"', "marker", "no row"),
        ('ask = "S?"\n', "", "rows.1", "needs 'ask'"),
        ('tell = "S <number>"\n', "", "rows.1", "needs 'tell'"),
        ('"S <number>"', '"S <nummer>"', "rows.1", "has the field <nummer>"),
        ('"S=<number>"', '"S=<number> <hex>"', "rows.1", "more than one value"),
        ('standby = ["OFF"]', 'off = ["OFF"]', "rows.2", "shows.off is no label"),
        ('standby = "HEAT OFF", ', "", "rows.2", "a command for each label"),
        ('ask = "V?"', 'ask = "V?\\r"', "rows.3", "no printable ASCII"),
        ('confirm = "OK"', 'end = "!"', "end", "a carriage return, a line feed"),
        ('reply = "<text>"', 'reply = "<number>"', "marker", "is a number"),
    ],
)
def test_a_fault_of_a_profile_is_reported_with_its_place(
    tmp_path: Path, old: str, new: str, key: str, message: str
) -> None:
    with pytest.raises(DeviceFileError) as caught:
        load_profile(own(tmp_path, old, new))
    assert any(
        ".".join(map(str, at)) == key and message in said for at, said in caught.value.faults
    ), caught.value

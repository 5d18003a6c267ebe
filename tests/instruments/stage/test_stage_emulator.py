"""The emulated board, byte by byte, against the transcripts of the fact sheet."""

from __future__ import annotations

import contextlib
import math
import re
import threading
from collections.abc import Callable, Iterator, Mapping

import pytest

from instruments.clock import RealClock, VirtualClock
from instruments.errors import LinkError
from instruments.link import Link
from instruments.listener import Listener
from instruments.stage.emulator import CLASSIC, GRBL_HAL, Dialect, Fault, StageEmulator

WELCOME = b"\r\nGrbl 1.1h ['$' for help]\r\n"
LOCK = b"[MSG:'$H'|'$X' to unlock]\r\n"
UNLOCKED = b"[MSG:Caution: Unlocked]\r\nok\r\n"


class Board:
    """The emulator on a link: raw bytes out, raw bytes back."""

    def __init__(self, settings: Mapping[int, float] | None = None, *, dialect: Dialect = CLASSIC, fresh_eeprom: bool = False) -> None:
        self.clock = VirtualClock()
        self.emulator = StageEmulator(self.clock, settings=settings, dialect=dialect, fresh_eeprom=fresh_eeprom)
        self.listener = Listener(self.emulator, self.clock, lock=threading.RLock(), name="stage")
        self.links: list[Link] = []
        self.greeting = self.plug_in()

    def plug_in(self) -> bytes:
        self.links.append(Link(self.listener.url, self.clock, who="stage"))
        return self.hear(0.0)

    def hear(self, seconds: float) -> bytes:
        """All that comes within ``seconds`` of virtual time, all of which passes."""
        until, got = self.clock.now() + seconds, b""
        while data := self.links[-1].receive(max(0.0, until - self.clock.now())):
            got += data
        return got

    def say(self, data: bytes, seconds: float = 0.0) -> bytes:
        self.links[-1].write(data)
        return self.hear(seconds)

    def hear_until_broken(self) -> None:
        """Ask every second for a minute."""
        for _ in range(60):
            self.say(b"?", 1.0)

    def unlock(self) -> None:
        assert self.say(b"$X\n") == UNLOCKED

    def answered_at(self, data: bytes) -> float:
        """Seconds until the one answer to ``data`` comes."""
        start = self.clock.now()
        self.links[-1].write(data)
        assert self.links[-1].read_until(b"ok\r\n", 3600) == b"ok\r\n"
        return self.clock.now() - start

    def state(self) -> bytes:
        return self.say(b"?")[1:].split(b"|")[0]

    def close(self) -> None:
        for link in self.links:
            link.close()
        self.listener.close()


Make = Callable[..., Board]


@pytest.fixture
def make() -> Iterator[Make]:
    boards: list[Board] = []

    def one(settings: Mapping[int, float] | None = None, *, dialect: Dialect = CLASSIC, fresh_eeprom: bool = False) -> Board:
        boards.append(Board(settings, dialect=dialect, fresh_eeprom=fresh_eeprom))
        return boards[-1]

    yield one
    for board in boards:
        board.close()


@pytest.fixture
def board(make: Make) -> Board:
    return make()


@pytest.fixture
def free(make: Make) -> Board:
    """Unlocked without homing, soft limits off, count 0 in the middle of the table."""
    board = make({20: 0})
    board.unlock()
    return board


def test_a_locked_board_says_so_and_refuses_gcode(board: Board) -> None:
    assert board.greeting == WELCOME + LOCK
    assert board.say(b"G1X1F100\n") == b"error:9\r\n"
    assert board.state() == b"Alarm"
    assert board.say(b"$X\n") == UNLOCKED
    assert board.state() == b"Idle"


def test_a_board_without_homing_starts_idle(make: Make) -> None:
    board = make({22: 0, 20: 0})
    assert board.greeting == WELCOME
    assert board.say(b"$H\n") == b"error:5\r\n"
    assert board.state() == b"Idle"


def test_a_fresh_eeprom_speaks_of_an_error_first(make: Make) -> None:
    greeting = make(fresh_eeprom=True).greeting
    assert greeting.startswith(b"error:7\r\n$0=10\r\n$1=25\r\n")
    assert greeting.endswith(b"$132=50.000\r\n" + WELCOME + LOCK)


def test_identity_and_settings(board: Board) -> None:
    assert re.fullmatch(rb"\[VER:1\.1h\.\d{8}:\]\r\n\[OPT:V,15,128\]\r\nok\r\n", board.say(b"$I\n"))
    lines = board.say(b"$$\n").split(b"\r\n")
    for line in (b"$20=1", b"$22=1", b"$27=1.000", b"$110=3000.000", b"$120=200.000", b"$130=300.000", b"$131=275.000", b"$132=50.000"):
        assert line in lines
    assert lines[-2:] == [b"ok", b""]
    assert board.say(b"$130=250\n$$\n").count(b"$130=250.000") == 1


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"", b"ok"),
        (b" ( a comment ) ; and more", b"ok"),
        (b"g21 g90", b"ok"),
        (b"1X2", b"error:1"),
        (b"GX", b"error:2"),
        (b"G1X", b"error:2"),
        (b"$Q=1", b"error:2"),
        (b"$130", b"error:3"),
        (b"$999=1", b"error:3"),
        (b"$130=-5", b"error:4"),
        (b"$0=2", b"error:6"),
        (b"G2X1Y1I1", b"error:20"),
        (b"G99", b"error:20"),
        (b"M99", b"error:20"),
        (b"Q5", b"error:20"),
        (b"G0G1X1", b"error:21"),
        (b"G1X1", b"error:22"),
        (b"G1X1X2F100", b"error:25"),
        (b"G92", b"error:26"),
        (b"G4", b"error:28"),
        (b"G80G53X1", b"error:30"),
        (b"G80X1", b"error:31"),
        (b"$J=G91X1", b"error:22"),
        (b"$J=G1X1F100", b"error:16"),
        (b"(" + b"x" * 300 + b")", b"ok"),
        (b"G1" + b" " * 200, b"ok"),
        (b"G1X" + b"0" * 76, b"error:22"),
        (b"G1X" + b"0" * 77, b"error:11"),
    ],
)
def test_each_line_gets_its_one_answer(free: Board, line: bytes, answer: bytes) -> None:
    assert free.say(line + b"\n") == answer + b"\r\n"


def test_both_line_ends_are_lines(free: Board) -> None:
    assert free.say(b"G21\r\n") == b"ok\r\nok\r\n"


def test_soft_limits_need_homing(make: Make) -> None:
    board = make({20: 0, 22: 0})
    assert board.say(b"$20=1\n") == b"error:10\r\n"
    assert board.say(b"$22=1\n$20=1\n$22=0\n") == b"ok\r\nok\r\nok\r\n"
    assert b"$20=0" in board.say(b"$$\n")


def test_homing_answers_only_when_done_and_is_silent_until_then(board: Board) -> None:
    assert board.say(b"$H\n?", 5.0) == b""
    middle = board.emulator.position_mm()
    assert middle[2] == pytest.approx(-1.0)
    assert -150 < middle[0] < -1
    answer = board.hear(20.0)
    assert answer.startswith(b"<Home|MPos:-1.000,-1.000,-1.000|")
    assert answer.endswith(b">\r\nok\r\n")
    assert board.say(b"?") == b"<Idle|MPos:-1.000,-1.000,-1.000|FS:0,0|Ov:100,100,100>\r\n"
    assert board.emulator.position_mm() == pytest.approx([-1, -1, -1])


def test_a_reset_while_homing_is_alarm_6(board: Board) -> None:
    board.say(b"$H\n", 3.0)
    assert board.say(b"\x18") == b"ALARM:6\r\nok\r\n" + WELCOME + LOCK


def test_failed_homing_gives_alarm_ok_and_a_welcome(board: Board) -> None:
    board.emulator.inject(Fault.NO_SWITCH)
    assert board.say(b"$H\n", 60.0) == b"ALARM:9\r\nok\r\n" + WELCOME + LOCK
    board.emulator.cure(Fault.NO_SWITCH)
    board.emulator.inject(Fault.STUCK_SWITCH)
    assert board.say(b"$H\n", 60.0) == b"ALARM:8\r\nok\r\n" + WELCOME + LOCK
    board.emulator.cure(Fault.STUCK_SWITCH)
    assert board.say(b"$H\n", 60.0) == b"ok\r\n"


def test_beyond_the_soft_limit_nothing_is_heard_until_a_reset(board: Board) -> None:
    board.answered_at(b"$H\n")
    assert board.say(b"G53G1X-301F1000\n") == b"ALARM:2\r\n[MSG:Reset to continue]\r\n"
    assert board.say(b"?\n$X\n?!~", 10.0) == b""
    assert board.say(b"\x18") == b"ok\r\n" + WELCOME + LOCK
    assert board.state() == b"Alarm"


def test_a_soft_limit_behind_a_move_stops_that_move_without_losing_steps(board: Board) -> None:
    board.answered_at(b"$H\n")
    assert board.say(b"G53G1X-200F3000\n", 1.0) == b"ok\r\n"
    assert board.say(b"G53G1X5\n", 1.0) == b"ALARM:2\r\n[MSG:Reset to continue]\r\n"
    board.say(b"\x18")
    report = board.say(b"?")
    place = float(re.findall(rb"MPos:([-\d.]+)", report)[0])
    assert place == pytest.approx(board.emulator.position_mm()[0], abs=0.005)
    assert -60 < place < -40


def test_grblhal_still_reports_in_that_alarm(make: Make) -> None:
    board = make(dialect=GRBL_HAL)
    assert board.greeting.startswith(b"\r\nGrblHAL 1.1f ['$' or '$HELP' for help]\r\n")
    board.answered_at(b"$H\n")
    board.say(b"G53G1X-301F1000\n")
    report = board.say(b"?")
    assert report.startswith(b"<Alarm|")
    assert b"|H:" in report


def test_a_reset_in_motion_is_alarm_3_and_one_at_rest_is_not(free: Board) -> None:
    assert free.say(b"\x18") == WELCOME
    free.say(b"G1X-50F3000\n", 0.5)
    assert free.say(b"\x18") == b"ALARM:3\r\n" + WELCOME + LOCK
    assert free.say(b"G1X0F100\n") == b"error:9\r\n"


def test_a_reset_at_a_hold_keeps_the_position_without_alarm(free: Board) -> None:
    free.say(b"G1X-50F3000\n", 0.5)
    free.say(b"!", 1.0)
    place = free.emulator.position_mm()
    assert free.say(b"\x18") == WELCOME
    report = free.say(b"?")
    assert report.startswith(b"<Idle|MPos:")
    assert float(re.findall(rb"MPos:([-\d.]+)", report)[0]) == pytest.approx(place[0] + 150, abs=0.005)


def test_resume_is_lost_while_the_stage_still_brakes(free: Board) -> None:
    free.say(b"G1X-100F3000\n", 1.0)
    free.say(b"!", 0.1)
    assert free.state() == b"Hold:1"
    free.say(b"~", 0.5)
    assert free.state() == b"Hold:0"
    free.say(b"~", 0.1)
    assert free.state() == b"Run"
    free.hear(5.0)
    assert free.emulator.position_mm()[0] == pytest.approx(-250.0)


def test_a_hold_at_rest_waits_for_a_resume_and_keeps_lines_waiting(free: Board) -> None:
    assert free.say(b"!G21\n", 1.0) == b""
    assert free.state() == b"Hold:0"
    assert free.say(b"~") == b"ok\r\n"
    assert free.state() == b"Idle"


def test_the_door_stops_and_resumes(free: Board) -> None:
    assert free.say(b"G1X-10F600\n", 0.5) == b"ok\r\n"
    assert free.say(b"\x84", 0.02) == b"[MSG:Check Door]\r\n"
    assert free.state() == b"Door:2"
    free.hear(1.0)
    assert free.state() == b"Door:0"
    free.say(b"~", 5.0)
    assert free.state() == b"Idle"


def test_settings_and_homing_are_refused_in_motion(free: Board) -> None:
    free.say(b"G1X-50F3000\n", 0.5)
    assert free.say(b"$130=200\n$H\n$$\n$I\n") == b"error:8\r\n" * 4


def test_sleep_is_left_only_by_a_reset_and_into_the_alarm(free: Board) -> None:
    assert free.say(b"$SLP\n") == b"[MSG:Sleeping]\r\nok\r\n"
    assert free.state() == b"Sleep"
    assert free.say(b"$X\nG1X1F100\n~", 1.0) == b""
    assert free.say(b"\x18") == WELCOME + LOCK
    assert free.state() == b"Alarm"


def test_a_jog_beyond_the_travel_is_an_error_and_no_alarm(board: Board) -> None:
    board.answered_at(b"$H\n")
    assert board.say(b"$J=G91X5F1000\n") == b"error:15\r\n"
    assert board.state() == b"Idle"
    assert board.say(b"$J=G91X-50F3000\n", 0.5) == b"ok\r\n"
    assert board.state() == b"Jog"
    assert board.say(b"G1X-5F100\n") == b"error:9\r\n"
    board.say(b"\x85", 0.5)
    assert board.state() == b"Idle"
    assert -51 < board.emulator.position_mm()[0] < -10


def test_a_dwell_behind_a_move_is_answered_when_the_move_is_over(free: Board) -> None:
    assert free.answered_at(b"G1X-100F3000\n") == 0.0
    assert free.answered_at(b"G4P0\n") == pytest.approx(100 / 50 + 50 / 200, abs=1e-6)
    assert free.answered_at(b"G4P1.5\n") == pytest.approx(1.5, abs=1e-6)
    free.say(b"G1X-98F3000\n")
    assert free.answered_at(b"G4P0\n") == pytest.approx(2 * math.sqrt(2 / 200), abs=1e-6)


def test_position_and_speed_are_right_on_the_way(free: Board) -> None:
    free.say(b"G1X-100F3000\n", 1.25)
    state, place, speed, *_ = free.say(b"?").strip(b"<>\r\n").split(b"|")
    assert (state, speed) == (b"Run", b"FS:3000,0")
    x, y, z = (float(number) for number in place.removeprefix(b"MPos:").split(b","))
    assert x == pytest.approx(-56.25, abs=0.003)
    assert (y, z) == (0.0, 0.0)
    assert free.emulator.position_mm() == pytest.approx([-206.25, -137.5, -25.0])


def test_the_sixteenth_move_waits_for_a_free_place_in_the_planner(free: Board) -> None:
    lines = b"".join(b"G1X-%dF600\n" % (n + 1) for n in range(16))  # 160 bytes would not fit a waiting buffer
    answers = free.say(lines)
    assert answers == b"ok\r\n" * 15
    assert free.hear(60.0) == b"ok\r\n"
    assert free.emulator.position_mm()[0] == pytest.approx(-166.0)


def test_blasting_more_than_the_buffer_loses_bytes(free: Board) -> None:
    lines = b"".join(b"G1X%dY%dF1200\n" % (-n % 7, -n % 5) for n in range(100))
    answers = free.say(lines, 600.0)
    assert answers.count(b"\r\n") < 100
    assert answers.count(b"ok\r\n") >= 15


def test_the_buffer_holds_exactly_128_bytes(free: Board) -> None:
    free.say(b"!")
    free.say(b"\n" * 127 + b"$I\n")  # of the last line only the first byte finds room
    assert free.say(b"~") == b"ok\r\n" * 127
    assert free.say(b"G\n").startswith(b"[GC:G0 ")


def test_slow_fields_come_first_after_a_reset_and_then_in_turn(free: Board) -> None:
    free.say(b"\x18")
    reports = [free.say(b"?") for _ in range(24)]
    assert [i for i, report in enumerate(reports) if b"WCO:" in report] == [0, 10, 20]
    assert [i for i, report in enumerate(reports) if b"Ov:" in report] == [1, 11, 21]


def test_work_coordinates_are_the_machines_less_their_offset(make: Make) -> None:
    board = make({20: 0, 10: 2})
    board.unlock()
    board.say(b"G92X10Y-5\n")
    assert board.say(b"?") == b"<Idle|WPos:10.000,-5.000,0.000|Bf:15,128|FS:0,0|WCO:-10.000,5.000,0.000>\r\n"
    board.say(b"G0X0\n", 5.0)
    assert board.emulator.position_mm()[0] == pytest.approx(-160.0)
    board.say(b"G53G0X0\n", 5.0)
    assert board.emulator.position_mm()[0] == pytest.approx(-150.0)


def test_inches_relative_moves_and_modes(free: Board) -> None:
    free.say(b"G20G91G1X-1F100\n", 10.0)
    assert free.emulator.position_mm()[0] == pytest.approx(-150 - 25.4, abs=0.003)
    assert free.say(b"$G\n") == b"[GC:G1 G54 G17 G20 G91 G94 M5 M9 T0 F2540 S0]\r\nok\r\n"


def test_overrides_act_at_once(free: Board) -> None:
    free.say(b"G1X-100F3000\n", 0.5)
    free.say(b"\x92" * 5, 1.0)
    assert b"|FS:1500,0" in free.say(b"?")
    free.say(b"\x90", 1.0)
    assert b"|FS:3000,0" in free.say(b"?")


def test_a_limit_switch_in_motion_is_alarm_1_and_deaf(free: Board) -> None:
    free.emulator.inject(Fault.LIMIT_HIT, 0.5)
    assert free.say(b"G1X-50F3000\nG4P0\n", 2.0) == b"ok\r\nALARM:1\r\n[MSG:Reset to continue]\r\n"
    assert free.say(b"?", 1.0) == b""
    assert free.say(b"\x18") == b"ok\r\n" + WELCOME + LOCK


def test_a_stalled_carriage_stands_while_the_count_goes_on(free: Board) -> None:
    free.emulator.inject(Fault.STALL, 1.25)
    free.say(b"G1X-100F3000\n", 5.0)
    assert free.say(b"?").startswith(b"<Idle|MPos:-100.000,")
    assert free.emulator.position_mm()[0] == pytest.approx(-206.25)
    free.say(b"G1X-90F3000\n", 5.0)
    assert free.emulator.position_mm()[0] == pytest.approx(-196.25)
    free.answered_at(b"$H\n")
    assert free.emulator.position_mm() == pytest.approx([-1, -1, -1])


def test_lost_steps_part_carriage_and_count_until_homing(board: Board) -> None:
    board.answered_at(b"$H\n")
    board.emulator.lose_steps((-2.0, 0.0, 0.0))
    assert board.emulator.position_mm() == pytest.approx([-3, -1, -1])
    board.answered_at(b"$H\n")
    assert board.emulator.position_mm() == pytest.approx([-1, -1, -1])


def test_opening_the_port_again_resets_the_board_where_the_carriage_stands(board: Board) -> None:
    board.answered_at(b"$H\n")
    board.say(b"G53G1X-100F3000\n", 1.0)
    board.links[-1].close()
    assert board.plug_in() == WELCOME + LOCK
    assert b"MPos:0.000,0.000,0.000|" in board.say(b"?")
    assert -60 < board.emulator.position_mm()[0] < -40


def test_a_pulled_cable_ends_the_link_and_not_the_motion(free: Board) -> None:
    free.emulator.inject(Fault.DISCONNECT, 0.5)
    free.links[-1].write(b"G1X-50F3000\n")
    with pytest.raises(LinkError, match="hung up"):
        free.hear_until_broken()
    free.clock.sleep(5.0)
    assert free.emulator.position_mm()[0] == pytest.approx(-200.0)  # what was planned has run to its end


def test_faulty_answers(free: Board) -> None:
    free.emulator.inject(Fault.LOST_OK)
    assert free.say(b"G21\n", 5.0) == b""
    free.emulator.inject(Fault.LATE_OK, 3.0)
    assert free.say(b"G21\n", 2.9) == b""
    assert free.hear(0.2) == b"ok\r\n"
    free.emulator.inject(Fault.GARBAGE)
    assert free.say(b"G21\n").endswith(b"\r\nok\r\n")
    free.emulator.inject(Fault.SILENT)
    assert free.say(b"?\nG21\n\x18", 5.0) == b""
    free.emulator.cure(Fault.SILENT)
    assert free.state() == b"Idle"


def test_a_power_dip_in_motion_shows_as_a_welcome(free: Board) -> None:
    free.emulator.inject(Fault.RESTART, 0.5)
    assert free.say(b"G1X-50F3000\n", 2.0) == b"ok\r\n" + WELCOME + LOCK


def test_settings_that_the_board_does_not_have_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\$77"):
        StageEmulator(VirtualClock(), settings={77: 1})


def test_two_runs_give_the_same_bytes(make: Make) -> None:
    def run() -> bytes:
        board = make()
        said = board.say(b"$H\n", 30.0)
        for n in range(12):
            said += board.say(b"G53G1X-%dY-%dF%d\n?" % (20 * n + 3, 7 * n + 2, 900 + 100 * n), 0.37) + board.say(b"?")
        return said

    assert run() == run()


def test_under_real_time_a_move_takes_its_time() -> None:
    clock = RealClock()
    emulator = StageEmulator(clock, settings={20: 0, 22: 0, 120: 5000})
    listener = Listener(emulator, clock, lock=threading.RLock(), name="stage")
    with contextlib.closing(clock), contextlib.closing(listener), contextlib.closing(Link(listener.url, clock, who="stage")) as link:
        link.read_until(b"help]\r\n", 2.0)
        link.write(b"G1X-5F3000\n")
        assert link.read_until(b"ok\r\n", 2.0) == b"ok\r\n"
        start = clock.now()
        link.write(b"G4P0\n")
        assert link.read_until(b"ok\r\n", 2.0) == b"ok\r\n"
        assert clock.now() - start > 0.05
        assert emulator.position_mm()[0] == pytest.approx(-155.0)

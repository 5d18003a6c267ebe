"""Driver and emulator, each apart, against lines typed from firmwares' documents and source, or reported by
users (the files in `witnesses`, each line with its mark); and against programs of others that speak to such
boards, of which one has its words from Marlin's own source."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import closing
from itertools import cycle
from pathlib import Path

import marlin_host
import pytest
from grbl_link.messages import AlarmMessage, SettingsMessage, StatusMessage, WelcomeMessage
from grbl_link.parser import parse_line
from grbl_link.protocol import SimpleProtocol
from hypothesis import example, given, settings
from hypothesis import strategies as st
from marlin_host._constants import FATAL_MARKERS
from marlin_host.protocol import MarlinResponseKind, parse_response

from instruments.clock import RealClock, VirtualClock
from instruments.errors import InstrumentError
from instruments.link import Link
from instruments.listener import Connection, Listener
from instruments.stage import marlin, protocol
from instruments.stage.driver import OwnStage
from instruments.stage.emulator.board import StageEmulator
from instruments.stage.emulator.store import EMULATED, GRBL_HAL, MARLIN, ZABER, Firmware
from instruments.stage.protocol import Alarm, MalformedLine, Status
from tests.examples import examples
from tests.instruments.bath.peers import foreign
from tests.instruments.stage.board import Board
from tests.waiting import PATIENCE_S

WITNESSES = Path(__file__).parent / "witnesses"
MARKS = ("CERTAIN", "FIELD", "INFERRED")
PARSERS = {"marlin": marlin.parse}
LONG_S = {"G28": 20.0, "M400": 20.0, "G4": 1.0}  # what such a line's answer may take
BOARDS = {"grbl-locked": "Grbl", "fluidnc": "FluidNC", "marlin": "Marlin", "zaber": "Zaber"}
# without homing and limits, and quick
OPEN = {20: 0, 21: 0, 22: 0, 24: 25, 25: 500} | dict.fromkeys((130, 131, 132), 200)
OPEN |= dict.fromkeys((110, 111, 112), 9000) | dict.fromkeys((120, 121, 122), 500)


def typed(name: str) -> list[tuple[str, list[str]]]:
    """What is sent, each with its answers."""
    lines = []
    for text in (WITNESSES / f"{name}.txt").read_text(encoding="utf-8").splitlines():
        if text and not text.startswith("#"):
            mark, _, entry = text.partition(" ")
            assert mark in MARKS
            sent, _, answers = entry.rpartition(" ->")
            lines.append((sent, [one for one in answers[1:].split(" | ") if one]))
    return lines


def test_a_new_grbl_board_answers_each_line_as_the_firmware_does() -> None:
    table = typed("grbl-lines")
    assert len(table) >= 148
    for sent, answers in table:
        assert Board(OPEN).lines(sent.encode("ascii") + b"\n", 60.0) == answers, sent


def test_a_grbl_board_remembers_between_lines_as_the_firmware_does() -> None:
    board, table = Board(OPEN), typed("grbl-session")
    assert len(table) >= 107
    for sent, answers in table:
        data = b"?" if sent == "?" else sent.encode("ascii") + b"\n"
        assert board.lines(data, 60.0) == answers, sent


@pytest.mark.parametrize("name", BOARDS)
def test_an_emulator_answers_as_its_firmwares_documentation_says(
    make_board: Callable[..., Board], name: str
) -> None:
    board = make_board(dialect=EMULATED[BOARDS[name]])
    for line, expected in typed(name):
        if line.startswith("wait"):
            board.hear(float(line.split()[1]))
            continue
        data = b"\x18" if line == "^X" else line.encode("ascii") + b"\n" * (line not in "?!~")
        heard = board.say(data or b"\n", LONG_S.get(line.split(" ")[0].split("P")[0], 0.0))
        assert [one for one in heard.decode("ascii").split("\r\n") if one] == expected, line


@pytest.mark.parametrize(
    "name", [*(one for one in BOARDS if one != "zaber"), "grbl-lines", "grbl-session"]
)
def test_the_driver_reads_what_a_firmware_answers(name: str) -> None:
    parse = PARSERS.get(name, protocol.parse)
    for line, answers in typed(name):
        read = [parse(one.encode("ascii")) for one in answers]
        assert "help]" in "".join(answers) or not [
            one for one in read if isinstance(one, MalformedLine)
        ]
        if read and line not in ("?", "!", "~", "^X") and isinstance(read[-1], protocol.Message):
            assert "Sleeping" in answers[-1], "else a line's last answer is its answer"


@pytest.mark.parametrize(("report", "read"), typed("grbl-reports"))
def test_the_driver_reads_status_reports(report: str, read: list[str]) -> None:
    status = protocol.parse(report.encode("ascii"))
    if read == ["malformed"]:
        assert isinstance(status, MalformedLine)
        return
    assert isinstance(status, Status)
    assert status.mpos_mm
    state, x, y, z, *pins = read[0].split(" ", 4)
    assert (status.name, status.mpos_mm[:3]) == (state, (float(x), float(y), float(z)))
    assert ", ".join(status.pins) == "".join(pins)


# Marlin, build by build


class Build:
    """A board that answers as a section of ``marlin-builds.txt`` says; else ``ok``."""

    def __init__(self, answers: Mapping[str, list[str]]) -> None:
        self._answers = answers
        self._half = b""

    def connect(self, connection: Connection) -> None:
        connection.send(b"start\r\necho: External Reset\r\nMarlin 2.1\r\n")

    def receive(self, connection: Connection, data: bytes) -> None:
        *lines, self._half = (self._half + data).split(b"\n")
        for line in (one.decode("ascii") for one in lines if one):
            answers = self._answers.get(line, ["ok"])
            if line.startswith("M118 E1 "):
                answers = [f"echo:{line.removeprefix('M118 E1 ')}", "ok"]
            connection.send("".join(f"{one}\n" for one in answers).encode("ascii"))

    def disconnect(self, connection: Connection) -> None: ...


def builds() -> dict[str, tuple[str, dict[str, list[str]]]]:
    """What is expected of each build, and its answers."""
    found: dict[str, tuple[str, dict[str, list[str]]]] = {}
    text = (WITNESSES / "marlin-builds.txt").read_text(encoding="utf-8")
    for section in re.split(r"\n== ", text)[1:]:
        name, mark, *lines = section.strip("\n").split("\n")
        assert mark.startswith(("mark CERTAIN ", "mark FIELD "))
        answers: dict[str, list[str]] = {}
        expected = ""
        for line in lines:
            if line.startswith("like "):
                answers = dict(found[line.removeprefix("like ")][1])
            elif line.startswith("expect "):
                expected = line.removeprefix("expect ")
            else:
                sent, _, said = line.partition(" -> ")
                answers[sent] = said.split(" | ")
        found[name] = (expected, answers)
    return found


@pytest.mark.parametrize(
    ("expected", "answers"), builds().values(), ids=[name.replace(" ", "-") for name in builds()]
)
def test_the_driver_understands_marlin_build_by_build(
    expected: str, answers: dict[str, list[str]]
) -> None:
    clock = VirtualClock()
    with (
        closing(Listener(Build(answers), clock, lock=threading.RLock(), name="stage")) as listener,
        closing(Link(listener.url, clock, who="stage")) as link,
    ):
        axes = "XYZ" if "Z " in expected else "XY"
        stage = OwnStage(link, clock, axes, dialect="marlin")
        if expected.startswith("refused: "):
            with pytest.raises(InstrumentError, match=expected.removeprefix("refused: ")):
                stage.connect()
            return
        assert stage.connect().dialect == "Marlin"
        read = [f"{axis} {at.low_mm:g} {at.high_mm:g}" for axis, at in stage.limits.items()]
        assert ", ".join(read) == expected


@pytest.mark.parametrize("marker", FATAL_MARKERS)
def test_what_others_know_as_marlins_end_is_an_alarm(marker: str) -> None:
    assert isinstance(marlin.parse(f"Error:{marker}\r".encode("ascii")), Alarm)


# Programs of others


class Typed:
    """A board as the transport of `marlin_host`, under virtual time."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._lines = [one.decode("ascii") for one in board.greeting.split(b"\r\n") if one]

    def write_line(self, line: str) -> None:
        self._board.write(f"{line}\n".encode("ascii"))

    def read_line(self, timeout: float | None = None) -> str | None:
        waits = iter(cycle([1.0])) if timeout is None else iter([1.0] * int(timeout + 1))
        while not self._lines and next(waits, None):
            heard = self._board.hear(1.0).decode("ascii")
            self._lines = [one for one in heard.split("\r\n") if one]
        return self._lines.pop(0) if self._lines else None

    def close(self) -> None: ...


def test_another_programs_host_drives_the_emulated_marlin(make_board: Callable[..., Board]) -> None:
    board = make_board(dialect=MARLIN)
    host = marlin_host.MarlinHost(Typed(board))
    host.connect()
    assert host.profile
    assert host.profile.has("EMERGENCY_PARSER")
    assert "Marlin 2.1.2" in host.profile.firmware
    host.send("G28 X Y")
    for _ in host.stream(["G90", "G1 X30 Y20 F3000 ; a corner", "M400"]):
        pass
    assert host.position() == {"X": 30.0, "Y": 20.0, "Z": 0.0, "E": 0.0}
    assert board.emulator.position_mm()[:2] == pytest.approx([30.0, 20.0])
    unknown = {one.kind for one in host.query("M503") + host.query("M113")}
    assert unknown == {MarlinResponseKind.ECHO}
    host.emergency_stop()
    assert MarlinResponseKind.HALT in {
        parse_response(line).kind for line in board.hear(1.0).decode("ascii").split("\r\n")
    }


# 60 mm, quickly
QUICK = {24: 6000, 25: 12_000, 27: 1} | dict.fromkeys((110, 111, 112), 12_000)
QUICK |= dict.fromkeys((120, 121, 122), 2000) | dict.fromkeys((130, 131, 132), 60)
# in a process of its own: the library's threads go on after its connections are closed
MAKERS_LIBRARY = """
import sys
from zaber_motion import Units
from zaber_motion.ascii import Connection
from zaber_motion.exceptions import (
    BadDataException, CommandFailedException, DeviceDbFailedException, RequestTimeoutException
)

with Connection.open_tcp("127.0.0.1", int(sys.argv[1])) as connection:
    devices = connection.detect_devices(identify_devices=False)
    assert [one.device_address for one in devices] == [1, 2, 3]
    axis, other = (device.get_axis(1) for device in devices[:2])
    assert devices[0].warnings.get_flags() == {"WR"}
    assert not axis.is_homed()
    for one in (axis, other):
        one.home()
        assert one.is_homed()
    axis.move_absolute(12_500, Units.NATIVE)
    assert axis.get_position(Units.NATIVE) == 12_500
    axis.settings.set("maxspeed", 128)  # 0.3 mm/s: a step is soon done, the way isn't
    begun = axis.get_position(Units.NATIVE)
    axis.move_absolute(0, Units.NATIVE, wait_until_idle=False)
    while axis.get_position(Units.NATIVE) == begun:
        assert axis.is_busy()
    axis.stop()
    assert not axis.is_busy()
    other.move_relative(500, Units.NATIVE)
    for move, end in ((other.move_max, "max"), (other.move_min, "min")):
        move()
        assert other.get_position(Units.NATIVE) == other.settings.get(f"limit.{end}")
    other.move_absolute(250, Units.NATIVE, velocity=4096)
    other.park()
    try:
        other.move_absolute(0, Units.NATIVE)
    except CommandFailedException as error:
        print(error.details.response_data, other.is_parked())
    other.unpark()
    assert not other.is_parked()
    try:  # all that it asks the device is answered; its data base is elsewhere
        devices[0].identify()
    except DeviceDbFailedException as error:
        print(type(error).__name__)
    assert connection.stop_all() == [1, 2, 3]
    for alone in (devices[0].get_axis(2), connection.get_device(9)):
        try:
            alone.generic_command("get pos")
        except (CommandFailedException, RequestTimeoutException) as error:
            print(type(error).__name__)
    try:
        axis.move_absolute(10**9, Units.NATIVE)
    except BadDataException:
        alone = connection.generic_command("get system.serial", 3)
        print(alone.device_address, alone.data, axis.get_position(Units.NATIVE))
"""


@pytest.mark.slow
def test_the_makers_library_drives_the_emulated_zaber() -> None:
    """In real time: it has time-outs of its own, and knows no other clock."""
    foreign("zaber_motion", "zaber-motion")
    with closing(RealClock()) as clock:
        emulator = StageEmulator(clock, settings=QUICK, dialect=ZABER)
        with closing(Listener(emulator, clock, lock=threading.RLock(), name="stage")) as listener:
            command = [sys.executable, "-c", MAKERS_LIBRARY, str(listener.port)]
            ended = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    assert ended.returncode == 0, ended.stderr
    parked, yes, *failed, device, serial, steps = ended.stdout.split()
    assert (parked, yes) == ("PARKED", "True")
    known = [f"{kind}Exception" for kind in ("DeviceDbFailed", "CommandFailed", "RequestTimeout")]
    assert failed == known
    assert (device, serial) == ("3", "65002")
    x_mm, y_mm, _ = emulator.position_mm()
    assert 0.0 < x_mm < 50.0
    assert y_mm == pytest.approx(1.0)
    assert float(steps) == pytest.approx(250.0 * x_mm, abs=1.0)


class Wire:
    """A board as the serial port of `grbl_link`, under virtual time."""

    def __init__(self, board: Board) -> None:
        self._board, self._heard = board, b""

    @property
    def in_waiting(self) -> int:
        self._heard += self._board.hear(0.002)
        return len(self._heard)

    def readline(self) -> bytes:
        line, end, self._heard = self._heard.partition(b"\n")
        return line + end

    def write(self, data: bytes) -> None:
        self._board.write(data)


def test_another_programs_sender_streams_to_the_emulated_grbl(
    make_board: Callable[..., Board],
) -> None:
    board = make_board(OPEN)
    sender, seen = SimpleProtocol(Wire(board)), list[object]()
    sender.add_message_handler(seen.append)
    for n in range(60):
        sender.enqueue(f"G1X{-(n % 5)}Y{-(n % 3)}F6000")
    sender.enqueue("G4P0")
    for _ in range(20_000):
        if len(seen) == 61:
            break
        sender._process_serial()
        sender._process_queue()
    assert [type(one).__name__ for one in seen] == ["OKMessage"] * 61
    assert board.emulator.position_mm()[:2] == pytest.approx([-104.0, -102.0])


def test_another_programs_parser_reads_what_the_emulated_grbl_says(
    make_board: Callable[..., Board],
) -> None:
    board = make_board()
    lines = (board.greeting + board.say(b"?$$\n")).decode("ascii").split("\r\n")
    read = [parse_line(line) for line in lines if line]
    kinds = [type(one) for one in read]
    assert {WelcomeMessage, StatusMessage, SettingsMessage} <= set(kinds)
    status = next(one for one in read if isinstance(one, StatusMessage)).status
    assert (status["mode"], status["MPos"], status["FS"]) == ("Alarm", [0.0] * 3, [0.0] * 2)
    assert isinstance(parse_line("ALARM:9"), AlarmMessage)


EXTREMES = ("0", "0.001", "9" * 60)
AFTERWARDS = (
    "$J=G91X-1F1000",
    "G91G1X-1Y-2F1000",
    "G0Z-0.001",
    "G2X1Y1I1F500",
    "G38.3Z-1F100",
    "G90G53G0X0",
    "$H",
    "G20X1",
    "$#",
)


@pytest.mark.slow
def test_no_setting_that_a_board_takes_ends_it() -> None:
    """Whatever it makes of the lines, it can be reset and asked."""
    numbers = Board(dialect=GRBL_HAL).emulator._controller.settings.lines()
    for number in (line.partition("=")[0] for line in numbers):
        for value in EXTREMES:
            board = Board({20: 0}, dialect=GRBL_HAL)
            board.say(f"$X\n{number}={value}\n".encode("ascii"), 1.0)
            for line in AFTERWARDS:
                board.say(line.encode("ascii") + b"\n?", 900.0)
            assert board.say(b"\x18", 1.0)
            assert board.lines(b"$G\n?", 1.0)[-1].startswith(("<", "ok"))


PIECES = [
    piece.encode("latin-1").decode("unicode_escape").encode("latin-1")
    for piece in [
        r"G1X-5F500\n", r"$H\n", r"$X\n", r"?", r"!", r"~", r"\x18", r"\x84", r"\x85", r"\x91",
        r"\x96", r"$C\n", r"M0\n", r"G28\n", r"$J=G91X-1F1000\n", r"G2X1Y1R5\n", r"$110=0\n",
        r"$5=1\n", r"$22=0\n", r"$SLP\n", r"$RST=*\n", r"G93G1X1F2\n", r"G10L2P1X3\n",
        r"$N0=G91\n", r"$13=1\n", r"$27=0\n", r"$23=7\n", r"G38.2Z-1F50\n", r"M114\n", r"G28 X\n",
        r"G1 X F\n", r"G1 X1e Y-.\n", r"M113 S\n", r"M113 S-5\n", r"M118\n", r"M410\n", r"M112\n",
        r"M211\n", r"M503\n", r"/1 1 move abs 99\n", r"/1 home\n", r"/home\n", r"/stop\n",
        r"/1 1 set maxspeed 0\n", r"/get pos\n", r"/99 1 get\n",
    ]
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("dialect", EMULATED.values(), ids=list(EMULATED))
@given(
    said=st.lists(
        st.tuples(
            st.sampled_from(PIECES) | st.binary(min_size=1, max_size=12),
            st.sampled_from([0.0, 0.05, 1.0, 20.0, 900.0]),
        ),
        max_size=25,
    )
)
@example(said=[(b"/1 get p\xc3\n", 0.0), (b"M113 S" + b"9" * 400 + b"\n", 0.0)])
@example(said=[(b"/1 1 set maxspeed " + b"9" * 400 + b"\n/1 1 move abs 9\n", 1.0)])
@settings(max_examples=examples(15), deadline=None)
def test_nothing_on_the_wire_ends_an_emulator(
    dialect: Firmware, said: list[tuple[bytes, float]]
) -> None:
    board = Board(dialect=dialect)
    for data, seconds in said:
        board.say(data, seconds)

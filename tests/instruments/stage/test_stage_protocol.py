"""GRBL's bytes to values and back. Lines as the fact sheet and
the recorded transcripts give them.
"""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.errors import LimitError
from instruments.stage import protocol
from instruments.stage.protocol import (
    Alarm,
    Decoder,
    ErrorReply,
    MalformedLine,
    Message,
    Ok,
    Response,
    Setting,
    Status,
    Welcome,
    meaning,
)


def report(state: str, substate: int | None = None, **fields: str) -> Status:
    places = [
        tuple(map(float, fields[name].split(","))) if name in fields else None
        for name in ("MPos", "WPos", "WCO")
    ]
    return Status(state, substate, places[0], places[1], places[2], fields)


VECTORS: list[tuple[bytes, Response]] = [
    (b"ok", Ok()),
    (b"error:9", ErrorReply(9)),
    (b"error:20", ErrorReply(20)),
    (b"ALARM:2", Alarm(2)),
    (b"Grbl 1.1h ['$' for help]", Welcome("1.1h", "Grbl")),
    (b"GrblHAL 1.1f ['$' or '$HELP' for help]", Welcome("1.1f", "grblHAL")),
    (b"$130=300.000", Setting(130, "300.000")),
    (b"$22=1", Setting(22, "1")),
    (b"$N0=", Message("N0", "")),
    (b"[VER:1.1h.20190830:]", Message("VER", "1.1h.20190830:")),
    (b"[OPT:V,15,128]", Message("OPT", "V,15,128")),
    (b"[MSG:'$H'|'$X' to unlock]", Message("MSG", "'$H'|'$X' to unlock")),
    (b">G54G20:ok", Message(">", "G54G20:ok")),
    (b"<Idle|MPos:0.000,0.000,0.000|FS:0,0|WCO:0.000,0.000,0.000>", report("Idle", MPos="0.000,0.000,0.000", FS="0,0", WCO="0.000,0.000,0.000")),
    (b"<Hold:1|WPos:-1.500,2.000,-3.250|Bf:15,128|F:500>", report("Hold", 1, WPos="-1.500,2.000,-3.250", Bf="15,128", F="500")),
    (b"<Alarm|MPos:1.000,2.000,3.000,4.000|H:0|A:S|TLR:0|Pn>", report("Alarm", MPos="1.000,2.000,3.000,4.000", H="0", A="S", TLR="0", Pn="")),
]  # fmt: skip
NONSENSE = [
    b"OK",
    b"ok ok",
    b"error:",
    b"error:x",
    b"\xff\xfe",
    b"<Idle|MPos:0.000,0.000,0.000",
    b"<|MPos:0,0,0>",
    b"<Idle>",
    b"<Idle|MPos:0,0>",
    b"<Idle|MPos:nan,0,0>",
    b"<Idle|MPos:1e3,0,0>",
    b"<Idle|MPos:0,0,0|WCO:1,2>",
    b"hello",
    b"[MSG",
]


@pytest.mark.parametrize(("line", "value"), VECTORS)
def test_a_line_is_read_whole_in_bytes_and_with_more_behind_it(
    line: bytes, value: Response
) -> None:
    assert list(Decoder().feed(line + b"\r\n")) == [value]
    decoder = Decoder()
    assert [answer for byte in line + b"\r\n" for answer in decoder.feed(bytes([byte]))] == [value]
    assert list(Decoder().feed(line + b"\r\n\r\nok\r\nerr")) == [value, Ok()]
    assert list(Decoder().feed(line + b"\n")) == [value]


@pytest.mark.parametrize("line", NONSENSE)
def test_what_is_not_grbl_is_nonsense_with_a_reason(line: bytes) -> None:
    (answer,) = Decoder().feed(line + b"\r\n")
    assert isinstance(answer, MalformedLine)
    assert answer.raw == line
    assert answer.why


def test_bytes_without_a_line_end_are_given_up_after_a_kilobyte() -> None:
    decoder = Decoder()
    assert list(decoder.feed(b"x" * 1024)) == []
    (answer,) = decoder.feed(b"x")
    assert isinstance(answer, MalformedLine)
    assert list(decoder.feed(b"ok\r\n")) == [Ok()]


@given(
    st.lists(
        st.one_of(st.binary(max_size=60), st.sampled_from([line + b"\r\n" for line, _ in VECTORS])),
        max_size=8,
    )
)
def test_any_bytes_give_answers_however_they_are_cut(parts: list[bytes]) -> None:
    decoder = Decoder()
    cut = [answer for part in parts for answer in decoder.feed(part)]
    assert cut == list(Decoder().feed(b"".join(parts)))
    assert all(isinstance(answer, Response) for answer in cut)


def test_a_move_states_units_distance_mode_and_machine_coordinates() -> None:
    assert protocol.move_line({"X": -12.5, "Y": -275.0}, 3000) == "G21G90G94G53G1X-12.5Y-275F3000"
    assert (
        protocol.move_line({"X": -0.0001, "Z": -0.1236}, 99.95) == "G21G90G94G53G1X0Z-0.124F99.95"
    )
    assert protocol.jog_line({"X": 5}, 600) == "$J=G21G91X5F600"
    assert protocol.jog_line({"Y": -0.0004, "A": 12.5}, 99.95) == "$J=G21G91Y0A12.5F99.95"
    assert protocol.encode("$H") == b"$H\n"
    assert protocol.encode("G" * 79) == b"G" * 79 + b"\n"


@pytest.mark.slow
@given(
    st.fixed_dictionaries({axis: st.floats(-1e6, 1e6) for axis in "XYZA"}), st.floats(0.001, 1e6)
)
def test_every_move_fits_the_controllers_line_buffer(
    target_mm: dict[str, float], feed_mm_min: float
) -> None:
    line = protocol.move_line(target_mm, feed_mm_min)
    assert len(protocol.encode(line)) <= 80
    assert "E" not in line.upper().replace("-", "")


@pytest.mark.parametrize("text", ["G1X1?", "!", "~", "G1\nX2", "é", "G1" + "0" * 78])
def test_a_line_that_the_controller_would_mangle_is_refused(text: str) -> None:
    with pytest.raises(LimitError):
        protocol.encode(text)


def test_every_code_of_the_sheet_has_a_sentence_and_advice() -> None:
    tables = protocol.codes()
    assert {1, 2, 3, 5, 8, 9, 10, 11, 15, 20, 22, 33} <= tables["errors"].keys()
    assert set(range(1, 11)) == tables["alarms"].keys()
    alarms = [one for name, table in tables.items() if "alarms" in name for one in table.values()]
    unknown = [meaning(ErrorReply(999)), meaning(Alarm(999))]
    for what, do in (*(one for table in tables.values() for one in table.values()), *unknown):
        assert what
        assert do.endswith((".", ")."))
    assert all(do.endswith(protocol.HOME_AGAIN) for _, do in alarms)
    assert [what.split(": an ")[0] for what, _ in unknown] == ["error 999", "alarm 999"]
    assert all("does not know" in what for what, _ in unknown)
    assert meaning(Alarm(10), "FluidNC").what != meaning(Alarm(10)).what
    assert meaning(ErrorReply("said so"), "Marlin").what == "said so"

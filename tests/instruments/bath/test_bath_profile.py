"""Profiles: what ships, what is refused and with which words, and numbers against bytes typed from
the documents.
"""

from __future__ import annotations

import math
import re
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.bath.profile import Profile, ProfileError, load_profile, profile_names
from instruments.bath.registers import WORDS, Kind, Order, decode, encode
from instruments.bath.requests import blocks

ORDERS: list[Order] = ["ABCD", "CDAB", "BADC", "DCBA"]

SMALL = """
family = "SMALL"
source = "made up for this test"
transports = ["tcp"]
comms_loss = "unknown"
comms_loss_evidence = "INFERRED"
[[rows]]
name = "temperature"
table = "input"
address = 10
type = "f32"
evidence = "CERTAIN"
[[rows]]
name = "set_point"
table = "holding"
address = 2
type = "f32"
access = "rw"
range = [5.0, 36.0]
evidence = "CERTAIN"
[[rows]]
name = "run"
table = "holding"
address = 0
type = "u16"
access = "rw"
values = { standby = 0, started = 1 }
evidence = "CERTAIN"
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "a.toml"
    path.write_text(text, encoding="utf-8")
    return path


def faults_of(folder: Path, text: str) -> tuple[tuple[str, str], ...]:
    with pytest.raises(ProfileError) as caught:
        load_profile(written(folder, text))
    assert str(written(folder, text)) in str(caught.value)
    return caught.value.faults


def test_every_shipped_profile_loads() -> None:
    assert "julabo-presto" in profile_names()
    for name in profile_names():
        assert load_profile(name).row("temperature").poll


# Fact sheet, section 1.2: table, address, type, access.
@pytest.mark.parametrize(
    ("name", "table", "address", "kind", "access"),
    [
        ("run", "holding", 0, "u16", "rw"),
        ("actuating", "holding", 1, "u16", "rw"),
        ("set_point", "holding", 2, "f32", "rw"),
        ("heating_limit", "holding", 41, "i16", "rw"),
        ("pump_stage", "holding", 52, "u16", "rw"),
        ("unit", "holding", 90, "u16", "r"),
        ("encoding", "holding", 93, "u16", "r"),
        ("firmware", "input", 0, "u32", "r"),
        ("remote", "input", 5, "i16", "r"),
        ("alarm", "input", 6, "i16", "r"),
        ("warning", "input", 7, "i16", "r"),
        ("temperature", "input", 10, "f32", "r"),
        ("external", "input", 12, "f32", "r"),
        ("power", "input", 14, "i16", "r"),
        ("safety", "input", 16, "f32", "r"),
        ("cut_out", "input", 20, "f32", "r"),
    ],
)
def test_the_presto_is_as_its_manual_says(
    name: str, table: str, address: int, kind: str, access: str
) -> None:
    row = load_profile("julabo-presto").row(name)
    assert (row.table, row.address, row.type, row.access) == (table, address, kind, access)
    assert row.evidence == "CERTAIN"
    assert row.spacing_s == (0.25 if access == "rw" else 0.0)


def test_the_prestos_poll_is_three_questions_or_seven_without_gaps() -> None:
    profile = load_profile("julabo-presto")
    asked = [(block.function, block.address, block.count) for block in blocks(profile, gaps=True)]
    assert asked == [(3, 0, 4), (3, 90, 4), (4, 5, 13)]
    asked_apart = [(block.address, block.count) for block in blocks(profile, gaps=False)]
    assert asked_apart == [(0, 1), (2, 2), (90, 1), (93, 1), (5, 3), (10, 5), (16, 2)]


def test_the_small_profile_is_whole(tmp_path: Path) -> None:
    assert load_profile(written(tmp_path, SMALL)).family == "SMALL"


@pytest.mark.parametrize(
    ("old", "new", "key", "message"),
    [
        ("address = 2\n", "address = 1\n", "", ""),  # 1-2 leaves 0 free: no fault
        ("address = 2\n", "address = 65535\n", "rows.1", "leaves no room for 2 registers"),
        (
            "values = { standby = 0, started = 1 }",
            "values = { off = 0, on = 1 }",
            "rows.2.values",
            "'standby' and 'started'",
        ),
        (
            "values = { standby = 0, started = 1 }",
            "values = { standby = 1, started = 1 }",
            "rows.2",
            "mean the same code",
        ),
        (
            "values = { standby = 0, started = 1 }",
            "values = { standby = 0, started = 70000 }",
            "rows.2",
            "does not fit into u16",
        ),
        ("range = [5.0, 36.0]\n", "", "rows.1", "needs 'values' or 'range'"),
        ("range = [5.0, 36.0]", "range = [36.0, 5.0]", "rows.1", "is empty"),
        ("range = [5.0, 36.0]", 'range = ["5.0", 36.0]', "rows.1.range.0", "valid number"),
        (
            'table = "holding"\naddress = 2',
            'table = "input"\naddress = 2',
            "rows.1",
            "can't be written",
        ),
        ('type = "u16"', 'type = "bit"', "rows.2", "type bit does not go into table holding"),
        ('type = "u16"', 'type = "u8"', "rows.2.type", "Input should be 'u16'"),
        ('name = "run"', 'name = "go"', "rows", "the row 'run' is missing"),
        ('name = "run"', 'name = "set_point"', "rows.2.name", "a second row 'set_point'"),
        ('family = "SMALL"', 'familly = "SMALL"', "familly", "Extra inputs are not permitted"),
        (
            'evidence = "CERTAIN"\n[[rows]]\nname = "run"',
            '[[rows]]\nname = "run"',
            "rows.1.evidence",
            "Field required",
        ),
        (
            'comms_loss = "unknown"',
            'comms_loss = "unknown"\norder_from = { row = "run", codes = {} }',
            "order_from.row",
            "of its own",
        ),
        (
            'comms_loss = "unknown"',
            'comms_loss = "unknown"\nbefore_start = { run = "up" }',
            "before_start.run",
            "with the value 'up'",
        ),
    ],
)
def test_a_fault_is_told_with_its_place(
    tmp_path: Path, old: str, new: str, key: str, message: str
) -> None:
    assert SMALL.count(old) >= 1
    text = SMALL.replace(old, new, 1)
    if not message:
        assert load_profile(written(tmp_path, text))
        return
    assert any(place == key and message in said for place, said in faults_of(tmp_path, text)), (
        faults_of(tmp_path, text)
    )


def test_all_faults_are_told_at_once(tmp_path: Path) -> None:
    text = SMALL.replace("values = { standby = 0, started = 1 }", "values = { off = 0 }").replace(
        "range = [5.0, 36.0]\n", ""
    )
    assert {place for place, _ in faults_of(tmp_path, text)} == {"rows.1", "rows.2.values"}


def test_rows_may_not_overlap_even_across_a_gap(tmp_path: Path) -> None:
    extra = """
[[rows]]
name = "far"
table = "holding"
address = 100
type = "u16"
evidence = "FIELD"
[[rows]]
name = "under_the_set_point"
table = "holding"
address = 3
type = "u16"
evidence = "FIELD"
"""
    faults = faults_of(tmp_path, SMALL + extra)
    assert faults == (
        ("rows.4.address", "under_the_set_point at holding 3 overlaps set_point at 2"),
    )


def test_a_file_that_is_missing_or_no_toml_says_so(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match=r"can't be read.*shipped profiles: .*julabo-presto"):
        load_profile("julabo-prest")
    with pytest.raises(ProfileError, match="is no TOML"):
        load_profile(written(tmp_path, "family = "))


@pytest.mark.parametrize(
    ("row", "value", "reason"),
    [
        ("set_point", 36.5, "5 to 36 degC"),
        ("set_point", math.nan, "5 to 36 degC"),
        ("run", 2.0, r"0 \(standby\), 1 \(started\)"),
        ("temperature", 20.0, "read-only"),
        ("pump_stage", 5.0, "1 to 4"),
    ],
)
def test_only_what_is_listed_may_be_written(row: str, value: float, reason: str) -> None:
    refusal = load_profile("julabo-presto").row(row).refusal(value)
    assert refusal is not None
    assert re.search(reason, refusal)


def test_alarm_codes_are_told_with_their_doubt() -> None:
    profile = load_profile("julabo-presto")
    assert profile.alarm_text(1) == "alarm 1, low level (meaning inferred)"
    assert "manual" in profile.alarm_text(77)


# Eurotherm's handbook gives 1.001 as 3F80 20C5; Watlow's pages give 75.0, low word first, as 0000
# 4296.
@pytest.mark.parametrize(
    ("registers", "kind", "order", "value"),
    [
        ((0x3F80, 0x20C5), "f32", "ABCD", 1.001),
        ((0x0000, 0x4296), "f32", "CDAB", 75.0),
        ((0x4204, 0x0000), "f32", "ABCD", 33.0),
        ((0x0442, 0x0000), "f32", "BADC", 33.0),
        ((0x0000, 0x0442), "f32", "DCBA", 33.0),
        ((0xFF9C,), "i16", "ABCD", -100),
        ((0x9CFF,), "i16", "BADC", -100),
        ((0x0001, 0x0000), "u32", "ABCD", 65536),
        ((330,), "u16", "CDAB", 330),
    ],
)
def test_known_numbers(registers: tuple[int, ...], kind: Kind, order: Order, value: float) -> None:
    assert decode(registers, kind, order) == pytest.approx(value, rel=1e-7)
    assert encode(value, kind, order) == registers


@given(value=st.floats(width=32, allow_nan=False), order=st.sampled_from(ORDERS))
def test_floats_come_back(value: float, order: Order) -> None:
    assert decode(encode(value, "f32", order), "f32", order) == value


@given(
    value=st.integers(-0x8000, 0xFFFFFFFF),
    kind=st.sampled_from(["u16", "i16", "u32"]),
    order=st.sampled_from(ORDERS),
)
def test_whole_numbers_come_back_or_are_refused(value: int, kind: Kind, order: Order) -> None:
    low, high = {"u16": (0, 0xFFFF), "i16": (-0x8000, 0x7FFF), "u32": (0, 0xFFFFFFFF)}[kind]
    if low <= value <= high:
        assert decode(encode(value, kind, order), kind, order) == value
    else:
        with pytest.raises(ValueError, match="does not fit"):
            encode(value, kind, order)


@given(data=st.binary(min_size=4, max_size=4))
def test_the_orders_are_what_their_letters_say(data: bytes) -> None:
    for order in ORDERS:
        wire = bytes(data["ABCD".index(letter)] for letter in order)
        assert decode(struct.unpack(">HH", wire), "u32", order) == int.from_bytes(data, "big")


@pytest.mark.parametrize("kind", ["u16", "i16", "u32", "f32"])
def test_a_wrong_number_of_registers_is_refused(kind: Kind) -> None:
    with pytest.raises(ValueError, match="registers, not"):
        decode([0] * (WORDS[kind] + 1), kind, "ABCD")


def test_not_a_number_has_no_whole_register() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        encode(math.nan, "i16", "ABCD")


def test_scaled_rows_divide_and_multiply(tmp_path: Path) -> None:
    text = SMALL.replace('type = "f32"\nevidence', 'type = "i16"\nscale = 0.1\nevidence', 1)
    row = load_profile(written(tmp_path, text)).row("temperature")
    assert row.encode(33.0, "ABCD") == (330,)
    assert row.decode([0xFFF6], "ABCD") == pytest.approx(-1.0)


def test_a_profile_can_not_be_changed() -> None:
    profile: Profile = load_profile("julabo-presto")
    with pytest.raises(ValueError, match="frozen"):
        profile.family = "another"  # type: ignore[misc]

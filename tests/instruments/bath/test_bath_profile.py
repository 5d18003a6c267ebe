"""Profiles: what ships against the fact sheet, what is refused and with which
words, and numbers against bytes typed from the documents."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.bath.requests import markers
from instruments.bath.rows import WORDS, Kind, Order, decode, encode
from instruments.device_file import DeviceFileError
from tests.conftest import ROOT
from tests.instruments.bath.devices import REGISTER_FAMILIES, load_register_profile

ORDERS: list[Order] = ["ABCD", "CDAB", "BADC", "DCBA"]

SMALL = (ROOT / "tests/data/small_bath.toml").read_text(encoding="utf-8")


def written(folder: Path, text: str) -> Path:
    path = folder / "a.toml"
    path.write_text(text, encoding="utf-8")
    return path


def faults_of(folder: Path, text: str) -> tuple[tuple[str, str], ...]:
    with pytest.raises(DeviceFileError) as caught:
        load_register_profile(written(folder, text))
    assert str(written(folder, text)) in str(caught.value)
    return tuple((".".join(map(str, at)), said) for at, said in caught.value.faults)


VALUES, RANGE = "values = { standby = 0, started = 1 }", "range = [5.0, 36.0]"
LOSS, AT_2 = 'comms_loss = "unknown"', "address = 2\n"
LAST = '[[rows]]\nname = "run"'


@pytest.mark.parametrize(
    ("old", "new", "key", "message"),
    [
        (AT_2, "address = 1\n", "", ""),  # 1-2 leaves 0 free: no fault
        (AT_2, "address = 65535\n", "rows.1", "leaves no room for 2 registers"),
        (VALUES, "values = { off = 0, on = 1 }", "rows.2.values", "'standby' and 'started'"),
        (VALUES, "values = { standby = 1, started = 1 }", "rows.2", "mean the same code"),
        (VALUES, "values = { standby = 0, started = 70000 }", "rows.2", "does not fit into u16"),
        (RANGE + "\n", "", "rows.1", "needs 'values' or 'range'"),
        (RANGE, "range = [36.0, 5.0]", "rows.1", "is empty"),
        (RANGE, 'range = ["5.0", 36.0]', "rows.1.range.0", "valid number"),
        (f'"holding"\n{AT_2}', f'"input"\n{AT_2}', "rows.1", "can't be written"),
        ('type = "u16"', 'type = "bit"', "rows.2", "type bit does not go into table holding"),
        ('type = "u16"', 'type = "u8"', "rows.2.type", "input should be 'u16'"),
        ('name = "run"', 'name = "go"', "rows", "the row 'run' is missing"),
        ('name = "run"', 'name = "set_point"', "rows.2.name", "a second row 'set_point'"),
        ('family = "SMALL"', 'familly = "SMALL"', "familly", "unknown key"),
        (f'evidence = "CERTAIN"\n{LAST}', LAST, "rows.1.evidence", "field required"),
        (
            LOSS,
            f'{LOSS}\norder_from = {{ row = "run", codes = {{}} }}',
            "order_from.row",
            "of its own",
        ),
        (
            LOSS,
            f'{LOSS}\nbefore_start = {{ run = "up" }}',
            "before_start.run",
            "with the value 'up'",
        ),
    ],
)
def test_a_fault_is_reported_with_its_place(
    tmp_path: Path, old: str, new: str, key: str, message: str
) -> None:
    assert SMALL.count(old) >= 1
    text = SMALL.replace(old, new, 1)
    if not message:
        assert load_register_profile(written(tmp_path, text))
        return
    faults = faults_of(tmp_path, text)
    assert any(place == key and message in said for place, said in faults), faults


def test_all_faults_are_reported_at_once(tmp_path: Path) -> None:
    text = SMALL.replace(VALUES, "values = { off = 0 }").replace(RANGE, "")
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
    with pytest.raises(DeviceFileError, match=r"can't be read.*shipped profiles: .*julabo-presto"):
        load_register_profile("julabo-prest")
    with pytest.raises(DeviceFileError, match="not TOML"):
        load_register_profile(written(tmp_path, "family = "))


def test_alarm_codes_are_reported_with_their_doubt() -> None:
    profile = load_register_profile("julabo-presto")
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


def test_what_does_not_fit_the_registers_is_refused() -> None:
    for kind, words in WORDS.items():
        with pytest.raises(ValueError, match="registers, not"):
            decode([0] * (words + 1), kind, "ABCD")
    with pytest.raises(ValueError, match="does not fit"):
        encode(math.nan, "i16", "ABCD")


def test_what_the_interlocks_take_from_a_profile() -> None:
    for name in REGISTER_FAMILIES:
        profile = load_register_profile(name)
        fitted = profile.capabilities
        pump, level = ("with run", "alarm") if "julabo" in name else ("none", "none")
        assert (fitted.pump, fitted.level) == (pump, level)
        assert profile.comms_loss == ("unknown" if name == "omega-cn7" else "hold")
        assert profile.row("set_point").range == (5.0, 36.0)


def test_no_code_of_a_mode_that_may_do_harm_can_be_written() -> None:
    assert load_register_profile("eurotherm-3200").row("run").values == {"started": 0, "standby": 1}
    assert load_register_profile("eurotherm-3200").row("run").refusal(2.0) is not None
    assert load_register_profile("watlow-pm-map1").row("run").values == {
        "standby": 62,
        "started": 10,
    }
    assert load_register_profile("watlow-pm-map1").row("run").refusal(54.0) is not None
    assert load_register_profile("omega-cn7").row("control").refusal(2.0) is not None


@pytest.mark.parametrize("name", [name for name in REGISTER_FAMILIES if "julabo" not in name])
def test_there_are_shapes_enough_to_prove_a_line_clean(name: str) -> None:
    """Whatever one question is owed, another is left that can't be taken for it."""
    assert (
        len({(function, count) for function, _, count in markers(load_register_profile(name))}) >= 3
    )


# ---- what is read before the first write, at 20 degC, as other tests here hold it


EUROTHERM_MEMORY = {122: 0x2416, 199: 1, 0x8002: 0x41A0, 0x8004: 0x41A0}  # all else 0
WATLOW_MEMORY = {360: 0, 361: 0x41A0, 1880: 62, 2490: 15, 2510: 15, 2160: 0, 2161: 0x41A0}
OMEGA_MEMORY = {0x1000: 200, 0x1001: 200, 0x1005: 0, 0x0810: 1, 0x0811: 1, 0x0814: 0}
BROWSED = {
    "eurotherm-2400": EUROTHERM_MEMORY,
    "watlow-pm-map1": WATLOW_MEMORY,
    "omega-cn7": OMEGA_MEMORY,
}

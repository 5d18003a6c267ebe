"""Protocol Buffers as written: bytes typed from their documentation, and read back by a reader of
its own.
"""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.record.mcap import Choice, Field, Kind, MessageType, described, encoded
from tests.bench import mcap_reading

INNER = MessageType("t.Inner", (Field("a", 1, Kind.INT32),))
OUTER = MessageType(
    "t.Outer",
    (
        Field("c", 3, Kind.MESSAGE, INNER),
        Field("b", 2, Kind.STRING),
        Field("many", 4, Kind.MESSAGE, INNER, repeated=True),
        Field("row", 5, Kind.DOUBLE, repeated=True),
        Field("data", 6, Kind.BYTES),
        Field("size", 7, Kind.FIXED32),
        Field("level", 8, Kind.ENUM, Choice("Level", {"LOW": 0, "HIGH": 1})),
        Field("big", 9, Kind.INT64),
        Field("count", 10, Kind.UINT32),
        Field("some_value", 11, Kind.DOUBLE),
    ),
)


@pytest.mark.parametrize(
    ("kind", "values", "wanted"),
    # protobuf.dev, "Encoding": Test1, Test2, Test3; -2 in ten bytes; packed fields as there, with
    # doubles
    [
        (INNER, {"a": 150}, "08 96 01"),
        (OUTER, {"b": "testing"}, "12 07 74 65 73 74 69 6e 67"),
        (OUTER, {"c": {"a": 150}}, "1a 03 08 96 01"),
        (INNER, {"a": -2}, "08 fe ff ff ff ff ff ff ff ff 01"),
        (OUTER, {"row": [1.0, -2.0]}, "2a 10 00 00 00 00 00 00 f0 3f 00 00 00 00 00 00 00 c0"),
        (OUTER, {"b": "x", "c": {}}, "12 01 78 1a 00"),
        (
            OUTER,
            {"b": "", "data": b"", "size": 0, "level": 0, "row": [], "many": [], "some_value": 0.0},
            "",
        ),
        (OUTER, {"many": [{}, {"a": 1}]}, "22 00 22 02 08 01"),
    ],
)
def test_bytes_are_those_of_the_documentation(
    kind: MessageType, values: dict[str, Any], wanted: str
) -> None:
    assert encoded(kind, values).hex(" ") == wanted


def test_a_value_that_no_field_has_is_named() -> None:
    with pytest.raises(KeyError, match=r"t\.Inner has no b"):
        encoded(INNER, {"a": 1, "b": 2})


def test_a_message_is_described_with_all_that_it_holds() -> None:
    types = mcap_reading.described(described(OUTER))
    assert types["t.Inner"] == {1: ("a", mcap_reading.INT32, False, "")}
    assert types["t.Outer"][4] == ("many", mcap_reading.MESSAGE, True, "t.Inner")
    assert types["t.Outer"][8] == ("level", mcap_reading.ENUM, False, "t.Outer.Level")
    assert len(types["t.Outer"]) == len(OUTER.fields)


@given(
    st.fixed_dictionaries(
        {},
        optional={
            "b": st.text(),
            "c": st.fixed_dictionaries({"a": st.integers(-(2**31), 2**31 - 1)}),
            "data": st.binary(),
            "row": st.lists(st.floats(allow_nan=False)),
            "many": st.lists(st.fixed_dictionaries({"a": st.integers(0, 2**31 - 1)})),
            "size": st.integers(0, 2**32 - 1),
            "big": st.integers(-(2**63), 2**63 - 1),
            "count": st.integers(0, 2**32 - 1),
            "level": st.sampled_from([0, 1]),
            "some_value": st.floats(),
        },
    )
)
def test_whatever_is_written_is_read_back(values: dict[str, Any]) -> None:
    types = mcap_reading.described(described(OUTER))
    read = mcap_reading.decoded(types, "t.Outer", encoded(OUTER, values))
    for name, value in values.items():
        if isinstance(value, float) and (math.isnan(value) or value == 0.0):
            assert struct.pack("<d", abs(read[name])) == struct.pack("<d", abs(value)), (
                "a zero may lose its sign"
            )
        else:
            assert read[name] == value

"""Pixels off the wire: golden bytes from the layouts of the PFNC and of GigE Vision, and every
value there and back by another way.
"""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from instruments.camera.pixel_formats import BY_CODE, FORMATS, unpack
from tests.instruments.bath.peers import absent

CODES = {known.name: known.code for known in FORMATS}


@pytest.mark.parametrize(
    ("name", "data", "pixels"),
    [
        ("Mono8", "00 7F FF", [0x00, 0x7F, 0xFF]),
        ("Mono10", "FF 03 01 02 00 00", [0x3FF, 0x201, 0]),
        ("Mono12", "BC 0A FF 0F 01 00", [0xABC, 0xFFF, 1]),
        ("Mono14", "FF 3F 34 12 00 00", [0x3FFF, 0x1234, 0]),
        ("Mono16", "34 12 FF FF 00 80", [0x1234, 0xFFFF, 0x8000]),
        # GigE Vision: byte 0 = P0[9:2], byte 1 = P1[1:0] in bits 5:4 and P0[1:0] in bits 1:0, byte
        # 2 = P1[9:2]
        ("Mono10Packed", "80 31 40", [0x201, 0x103]),
        ("Mono10Packed", "FF 03 00", [0x3FF, 0]),
        # GigE Vision: byte 0 = P0[11:4], byte 1 = P1[3:0] in the high and P0[3:0] in the low half,
        # byte 2 = P1[11:4]
        ("Mono12Packed", "AB FC DE", [0xABC, 0xDEF]),
        ("Mono12Packed", "12 63 45 FF 0F 00", [0x123, 0x456, 0xFFF, 0x000]),
        # PFNC: P0[7:0] | P1[5:0] P0[9:8] | P2[3:0] P1[9:6] | P3[1:0] P2[9:4] | P3[9:2]
        ("Mono10p", "01 06 30 00 01", [0x201, 0x001, 0x003, 0x004]),
        ("Mono10p", "FF 03 00 00 00", [0x3FF, 0, 0, 0]),
        ("Mono10p", "00 00 00 C0 FF", [0, 0, 0, 0x3FF]),
        # PFNC: P0[7:0] | P1[3:0] P0[11:8] | P1[11:4]
        ("Mono12p", "BC FA DE", [0xABC, 0xDEF]),
        ("Mono12p", "23 61 45", [0x123, 0x456]),
        ("Coord3D_C16", "34 12 FF FF", [0x1234, 0xFFFF]),
        # IEEE 754, little-endian: 1076.25 is 0x44868800
        ("Coord3D_C32f", "00 88 86 44 00 00 80 BF", [1076.25, -1.0]),
    ],
)
def test_golden_bytes(name: str, data: str, pixels: list[int]) -> None:
    image, bits = unpack(bytes.fromhex(data), CODES[name], len(pixels), 1)
    assert image.tolist() == [pixels]
    assert bits == BY_CODE[CODES[name]].bits
    assert image.dtype == {8: np.uint8, 32: np.float32}.get(bits, np.uint16)


def packed(name: str, values: list[int]) -> bytes:
    """The values as bytes, built from bits as the standards draw them."""
    bits = BY_CODE[CODES[name]].bits
    if name.endswith("p"):
        number = sum(value << (i * bits) for i, value in enumerate(values))
        return number.to_bytes(-(-len(values) * bits // 8), "little")
    if name.endswith("Packed"):
        data = b""
        for first, second in zip(values[::2], [*values[1::2], 0], strict=False):
            low = (1 << (bits - 8)) - 1
            middle = (second & low) << 4 | first & low
            data += bytes([first >> (bits - 8), middle, second >> (bits - 8)])
        return data
    return b"".join(value.to_bytes(1 if bits == 8 else 2, "little") for value in values)


@pytest.mark.slow
@given(
    st.data(),
    st.sampled_from([known.name for known in FORMATS if known.name.startswith("Mono")]),
    st.integers(1, 9),
    st.integers(1, 5),
)
def test_every_value_of_every_mono_format_survives(
    data: st.DataObject, name: str, width: int, height: int
) -> None:
    top = (1 << BY_CODE[CODES[name]].bits) - 1
    size = width * height
    values = data.draw(st.lists(st.integers(0, top), min_size=size, max_size=size))
    image, _ = unpack(packed(name, values), CODES[name], width, height)
    assert image.reshape(-1).tolist() == values


@given(st.integers(1, 7), st.integers(1, 4), st.integers(1, 5))
def test_padded_lines(width: int, height: int, padding: int) -> None:
    rng = np.random.default_rng([width, height, padding])
    lines = rng.integers(0, 4096, (height, width)).tolist()
    data = b"".join(packed("Mono12p", line) + b"\xee" * padding for line in lines)
    assert unpack(data, CODES["Mono12p"], width, height, padding)[0].tolist() == lines


def test_colour_comes_as_blue_green_red() -> None:
    rgb = bytes([255, 0, 0, 0, 255, 0])
    assert unpack(rgb, CODES["RGB8"], 2, 1)[0].tolist() == [[[0, 0, 255], [0, 255, 0]]]
    assert unpack(rgb, CODES["BGR8"], 2, 1)[0].tolist() == [[[255, 0, 0], [0, 255, 0]]]


@pytest.mark.parametrize(
    ("name", "red"),
    [("BayerRG8", (0, 0)), ("BayerGR8", (0, 1)), ("BayerGB8", (1, 0)), ("BayerBG8", (1, 1))],
)
def test_a_mosaic_that_only_sees_red_is_red(name: str, red: tuple[int, int]) -> None:
    mosaic = np.zeros((16, 16), np.uint8)
    mosaic[red[0] :: 2, red[1] :: 2] = 200
    image, _ = unpack(mosaic.tobytes(), CODES[name], 16, 16)
    assert image[4:12, 4:12].reshape(-1, 3).mean(axis=0).round().tolist() == [0, 0, 200]


def test_what_cannot_be_unpacked_is_said() -> None:
    with pytest.raises(ValueError, match=r"3 x 2 pixels of Mono12p take 9 bytes, 8 came"):
        unpack(bytes(8), CODES["Mono12p"], 3, 2)
    unknown = "0x01080002 is not one that is unpacked here; choose one of Mono8"
    with pytest.raises(ValueError, match=unknown):
        unpack(b"", 0x01080002, 1, 1)


def test_codes_are_those_of_aravis() -> None:
    try:
        gi = importlib.import_module("gi")
        gi.require_version("Aravis", "0.8")
        aravis = importlib.import_module("gi.repository.Aravis")
    except (ImportError, ValueError):
        absent("needs Aravis: apt-get install gir1.2-aravis-0.8, pip install 'PyGObject<3.51'")
    names = """Mono8=MONO_8 Mono10=MONO_10 Mono12=MONO_12 Mono14=MONO_14 Mono16=MONO_16
        Mono10Packed=MONO_10_PACKED Mono12Packed=MONO_12_PACKED Mono10p=MONO_10_P Mono12p=MONO_12_P
        RGB8=RGB_8_PACKED BGR8=BGR_8_PACKED BayerGR8=BAYER_GR_8 BayerRG8=BAYER_RG_8
        BayerGB8=BAYER_GB_8 BayerBG8=BAYER_BG_8 Coord3D_C16=COORD3D_C_16
        Coord3D_C32f=COORD3D_C_32F Confidence8=CONFIDENCE_8 Confidence16=CONFIDENCE_16"""
    theirs = dict(name.split("=") for name in names.split())
    known = {
        name: getattr(aravis, f"PIXEL_FORMAT_{word}")
        for name, word in theirs.items()
        if hasattr(aravis, f"PIXEL_FORMAT_{word}")
    }
    assert len(known) > 10
    assert {name: CODES[name] for name in known} == known
    assert theirs.keys() == CODES.keys()

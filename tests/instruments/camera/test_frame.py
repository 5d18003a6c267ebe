"""Frame sets refuse what isn't one; raw frames become 8-bit grey and upright, or temperatures, as
declared: each declaration alone, and the order of all.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from instruments.camera.frame import (
    Channel,
    Conversion,
    FrameSet,
    Radiometry,
    Ranging,
    RawFrame,
    grey8,
)

GREY = np.arange(12, dtype=np.uint8).reshape(3, 4)


def test_a_frame_set_holds_its_images_and_kelvin_where_it_is_radiometric() -> None:
    kelvin = np.full((2, 3), 30515, dtype=np.uint16)
    frames = FrameSet(GREY, GREY, GREY, kelvin)
    assert frames.thermal_k is not None
    assert frames.thermal_k == pytest.approx(np.full((2, 3), 305.15))
    assert FrameSet(GREY, GREY).thermal_k is None
    assert FrameSet(GREY, GREY).depth_mm is None
    deep = FrameSet(GREY, GREY, depth_dmm=np.array([[0, 10763]], np.uint16)).depth_mm
    assert np.array_equal(np.asarray(deep), [[np.nan, 1076.3]], equal_nan=True)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"left": GREY.astype(np.uint16)}, r"left must be .* of uint8, is \(3, 4\) of uint16"),
        ({"right": np.zeros((3, 4, 3), np.uint8)}, r"right must be .* is \(3, 4, 3\)"),
        ({"right": [[1, 2]]}, r"right must be .* is a list"),
        ({"thermal": np.zeros((0, 4), np.uint8)}, r"thermal must be"),
        ({"thermal_ck": GREY}, r"thermal_ck must be .* of uint16"),
        ({"depth_dmm": GREY}, r"depth_dmm must be .* of uint16"),
        ({"amplitude": GREY.astype(np.uint16)}, "goes with a depth picture of its size"),
    ],
)
def test_anything_else_is_refused(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FrameSet(**{"left": GREY, "right": GREY, **kwargs})


BGR = np.array([[[255, 0, 0], [0, 255, 0], [0, 0, 255]]], dtype=np.uint8)


@pytest.mark.parametrize(
    ("raw", "full_scale", "grey"),
    [
        (GREY, 65535, GREY.tolist()),
        (GREY[:, :, None], 65535, GREY.tolist()),
        (BGR, 65535, [[29, 150, 76]]),  # the weights of BT.601
        (np.dstack([BGR, np.full((1, 3), 255, np.uint8)]), 65535, [[29, 150, 76]]),
        (np.array([[0, 257, 65535]], np.uint16), 65535, [[0, 1, 255]]),
        (np.array([[0, 2048, 4095, 5000]], np.uint16), 4095, [[0, 128, 255, 255]]),
    ],
)
def test_any_image_becomes_8_bit_grey(
    raw: np.ndarray[Any, Any], full_scale: int, grey: list[list[int]]
) -> None:
    assert grey8(raw, full_scale=full_scale).tolist() == grey


NO_SHAPES: list[tuple[int, ...]] = [(3, 4, 2), (5,), (0, 0)]


@pytest.mark.parametrize(
    "image", [np.zeros((3, 4)), *(np.zeros(shape, np.uint8) for shape in NO_SHAPES)]
)
def test_what_is_no_image_is_refused(image: np.ndarray[Any, Any]) -> None:
    with pytest.raises(ValueError, match="an image must"):
        grey8(image)


CORNERS = np.array([[10, 20, 30], [40, 50, 60]], dtype=np.uint8)


@pytest.mark.parametrize(
    ("declared", "seen"),
    [
        (Conversion(), [[10, 20, 30], [40, 50, 60]]),
        (Conversion(mirrored=True), [[30, 20, 10], [60, 50, 40]]),
        (Conversion(flip="horizontal"), [[30, 20, 10], [60, 50, 40]]),
        (Conversion(flip="vertical"), [[40, 50, 60], [10, 20, 30]]),
        (Conversion(flip="both"), [[60, 50, 40], [30, 20, 10]]),
        (Conversion(turn_deg=90), [[40, 10], [50, 20], [60, 30]]),
        (Conversion(turn_deg=180), [[60, 50, 40], [30, 20, 10]]),
        (Conversion(turn_deg=270), [[30, 60], [20, 50], [10, 40]]),
        # mirrored back first, turned then
        (Conversion(mirrored=True, turn_deg=90), [[60, 30], [50, 20], [40, 10]]),
        # turned first, flipped then
        (Conversion(turn_deg=90, flip="vertical"), [[60, 30], [50, 20], [40, 10]]),
        (Conversion(inverted=True), [[245, 235, 225], [215, 205, 195]]),
    ],
)
def test_each_declaration(declared: Conversion, seen: list[list[int]]) -> None:
    picture = declared.picture(RawFrame(CORNERS, 0.0))
    assert picture.tolist() == seen
    assert picture.flags.c_contiguous


@pytest.mark.parametrize(
    ("bits", "white", "count", "grey"),
    [(12, None, 4095, 255), (12, None, 2048, 128), (16, None, 65535, 255), (16, 16383, 8192, 128)],
)
def test_more_than_eight_bits_are_scaled_by_the_format_or_by_the_declared_white(
    bits: int, white: int | None, count: int, grey: int
) -> None:
    raw = RawFrame(np.full((2, 2), count, np.uint16), 0.0, bits)
    assert Conversion(white=white).picture(raw)[0, 0] == grey


def test_colour_to_grey() -> None:
    channels: dict[Channel, int] = {"luma": 29, "blue": 255, "green": 0, "red": 0}
    for channel, grey in channels.items():
        assert Conversion(grey=channel).picture(RawFrame(BGR, 0.0))[0, 0] == grey


def test_counts_become_hundredths_of_a_kelvin_and_stay_upright() -> None:
    counts = np.array([[7500, 7700]], np.uint16)  # TLinear of 0.04 K: 300 and 308 K
    declared = Conversion(mirrored=True, radiometry=Radiometry(0.04))
    assert declared.temperatures(RawFrame(counts, 0.0, 16)).tolist() == [[30800, 30000]]
    offset, raw = Conversion(radiometry=Radiometry(0.01, 273.15)), np.array([[3300]], np.uint16)
    assert offset.temperatures(RawFrame(raw, 0.0, 16)).tolist() == [[30615]]


def test_temperatures_that_cannot_be_are_refused() -> None:
    hot = RawFrame(np.array([[100, 65535]], np.uint16), 0.0, 16)
    colour, declared = RawFrame(np.zeros((2, 2, 3), np.uint16), 0.0, 16), Radiometry(0.04)
    wrong = (
        r"counts 100 to 65535 would be 4 to 2621\.4 K: kelvin_per_count or kelvin_at_zero is wrong"
    )
    for frame, radiometry, said in (
        (hot, declared, wrong),
        (
            RawFrame(np.full((2, 2), 8192, np.uint16), 0.0, 16),
            Radiometry(0.01),
            "-191 degC in the mid",
        ),
        (
            RawFrame(np.full((2, 2), 2620, np.uint16), 0.0, 14),
            Radiometry(0.01),
            "-247 degC.*no hundred",
        ),
        (
            RawFrame(np.full((2, 2), 6000, np.uint16), 0.0, 16),
            Radiometry(0.1),
            "327 degC.*is wrong",
        ),
        (hot, None, "no radiometry"),
        (colour, declared, "from a grey frame"),
    ):
        with pytest.raises(ValueError, match=said):
            Conversion(radiometry=radiometry).temperatures(frame)


COUNTS = np.array([[0, 4305, 65535]], np.uint16)


@pytest.mark.parametrize(
    ("pixels", "ranging", "tenths"),
    [
        (COUNTS, Ranging(0.25), [[0, 10762, 0]]),  # 16.4 m don't fit
        (COUNTS, Ranging(0.1, none=65535.0), [[0, 4305, 0]]),
        (COUNTS, Ranging(0.25, 100.0, None), [[1000, 11762, 0]]),
        # a scale below zero turns the axis round
        (COUNTS, Ranging(-0.02, 1310.72), [[0, 12246, 0]]),
        (np.array([[1076.25, np.nan, -1.0]], np.float32), Ranging(1.0, none=-1.0), [[10762, 0, 0]]),
    ],
)
def test_counts_of_a_depth_camera_become_tenths_of_a_millimetre(
    pixels: Any, ranging: Ranging, tenths: list[list[int]]
) -> None:
    found, strength = Conversion().depth(RawFrame(pixels, 0.0, ranging=ranging))
    assert (found.tolist(), strength) == (tenths, None)
    # declared in the rig file, and turned with its amplitude
    raw = RawFrame(pixels, 0.0, ranging=Ranging(7.0), amplitude=np.array([[1, 2, 3]], np.uint8))
    found, strength = Conversion(turn_deg=180, ranging=ranging).depth(raw)
    assert found.tolist() == [tenths[0][::-1]]
    assert strength is not None
    assert strength.tolist() == [[3, 2, 1]]


def test_what_is_no_depth_is_said() -> None:
    with pytest.raises(ValueError, match=r"nothing says how far a count .* set mm_per_count"):
        Conversion().depth(RawFrame(COUNTS, 0.0))
    with pytest.raises(ValueError, match=r"16 bits or more, this one is \(3, 4\) of uint8"):
        Conversion(ranging=Ranging(0.1)).depth(RawFrame(GREY, 0.0))

"""Raw frames become grey and upright, or temperatures, as declared: each declaration alone, and the
order of all.
"""

from __future__ import annotations

import numpy as np
import pytest

from instruments.camera.frame import Conversion, Radiometry, RawFrame

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


@pytest.mark.parametrize(
    ("channel", "grey"), [("luma", 29 + 0), ("blue", 255), ("green", 0), ("red", 0)]
)
def test_colour_to_grey(channel: str, grey: int) -> None:
    blue = np.zeros((2, 2, 3), np.uint8)
    blue[:, :, 0] = 255
    assert Conversion(grey=channel).picture(RawFrame(blue, 0.0))[0, 0] == grey  # type: ignore[arg-type]


def test_counts_become_hundredths_of_a_kelvin_and_stay_upright() -> None:
    counts = np.array([[7500, 7700]], np.uint16)  # TLinear of 0.04 K: 300 and 308 K
    declared = Conversion(mirrored=True, radiometry=Radiometry(0.04))
    assert declared.temperatures(RawFrame(counts, 0.0, 16)).tolist() == [[30800, 30000]]
    offset = Conversion(radiometry=Radiometry(0.01, 273.15))
    assert offset.temperatures(RawFrame(np.array([[3300]], np.uint16), 0.0, 16)).tolist() == [
        [30615]
    ]


def test_temperatures_that_cannot_be_are_refused() -> None:
    hot = RawFrame(np.array([[100, 65535]], np.uint16), 0.0, 16)
    with pytest.raises(
        ValueError,
        match=(
            r"counts 100 to 65535 would be 4 to 2621\.4 K: kelvin_per_count or kelvin_at_zero is"
            r" wrong"
        ),
    ):
        Conversion(radiometry=Radiometry(0.04)).temperatures(hot)
    with pytest.raises(ValueError, match="no radiometry"):
        Conversion().temperatures(hot)
    with pytest.raises(ValueError, match="from a grey frame"):
        Conversion(radiometry=Radiometry(0.04)).temperatures(
            RawFrame(np.zeros((2, 2, 3), np.uint8), 0.0)
        )

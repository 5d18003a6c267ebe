"""Frame sets refuse what isn't one; raw images become 8-bit grey in one place."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from instruments.camera.frame import FrameSet, grey8

GREY = np.arange(12, dtype=np.uint8).reshape(3, 4)


def test_a_frame_set_holds_its_images() -> None:
    kelvin = np.full((2, 3), 30515, dtype=np.uint16)
    frames = FrameSet(GREY, GREY, GREY, kelvin, {"left": 1.5}, {"left": "a camera"})
    assert frames.thermal_k is not None
    assert frames.thermal_k == pytest.approx(np.full((2, 3), 305.15))
    assert frames.thermal_k.dtype == np.float64
    assert frames.exposed_s["left"] == 1.5


def test_without_radiometry_there_are_no_kelvin() -> None:
    assert FrameSet(GREY, GREY).thermal_k is None


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        (
            {"left": GREY.astype(np.uint16)},
            r"a frame set's left must be an array .* of uint8, is \(3, 4\) of uint16",
        ),
        ({"right": np.zeros((3, 4, 3), np.uint8)}, r"right must be .* is \(3, 4, 3\)"),
        ({"right": [[1, 2]]}, r"right must be .* is a list"),
        ({"thermal": np.zeros((0, 4), np.uint8)}, r"thermal must be"),
        ({"thermal_ck": GREY}, r"thermal_ck must be .* of uint16"),
    ],
)
def test_anything_else_is_refused(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FrameSet(**{"left": GREY, "right": GREY, **kwargs})


def test_grey_stays_grey() -> None:
    assert np.array_equal(grey8(GREY), GREY)
    assert np.array_equal(grey8(GREY[:, :, None]), GREY)


def test_colour_becomes_grey_by_the_weights_of_bt_601() -> None:
    bgr = np.zeros((1, 3, 3), dtype=np.uint8)
    bgr[0, 0], bgr[0, 1], bgr[0, 2] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    assert grey8(bgr).tolist() == [[29, 150, 76]]
    alpha = np.dstack([bgr, np.full((1, 3), 255, np.uint8)])
    assert grey8(alpha).tolist() == [[29, 150, 76]]


def test_sixteen_bits_are_scaled_and_clipped() -> None:
    raw = np.array([[0, 257, 65535]], dtype=np.uint16)
    assert grey8(raw).tolist() == [[0, 1, 255]]
    assert grey8(np.array([[0, 2048, 4095, 5000]], dtype=np.uint16), full_scale=4095).tolist() == [
        [0, 128, 255, 255]
    ]


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((3, 4)),
        np.zeros((3, 4, 2), np.uint8),
        np.zeros(5, np.uint8),
        np.zeros((0, 0), np.uint8),
    ],
)
def test_what_is_no_image_is_refused(image: np.ndarray[Any, Any]) -> None:
    with pytest.raises(ValueError, match="an image must"):
        grey8(image)

"""The page with live pictures, read as a browser reads it."""

from __future__ import annotations

import urllib.request

import cv2
import numpy as np
import pytest

from bench.rig.live_page import live_page
from instruments.camera.frame import Grey
from tests.waiting import PATIENCE_S


@pytest.mark.parametrize("names", [("left", "right", "thermal"), ("single",)])
def test_each_camera_is_shown_with_a_cross_and_its_figures(names: tuple[str, ...]) -> None:
    pictures = {name: np.full((120, 160), 100, np.uint8) for name in names}
    with live_page(pictures, 0.02) as page:
        page.show(pictures, [f"{name} no edge" for name in names])
        with urllib.request.urlopen(page.url, timeout=PATIENCE_S) as answer:
            text = answer.read().decode("utf-8")
        assert text.count("<img") == len(names)
        assert all(f"{name} camera, live" in text for name in names)
        with urllib.request.urlopen(f"{page.url}left.mjpg", timeout=PATIENCE_S) as stream:
            seen = _first(stream.read(6000))
    assert (abs(seen.astype(int) - 100) > 60)[55:65, 70:90].any(), "the cross"
    assert (abs(seen.astype(int) - 100) > 60)[:20].any(), "the figures"
    assert (pictures[names[0]] == 100).all(), "the picture itself is as it was"


def _first(stream: bytes) -> Grey:
    start = stream.index(b"\xff\xd8")
    decoded = cv2.imdecode(np.frombuffer(stream[start:], np.uint8), cv2.IMREAD_GRAYSCALE)
    assert decoded is not None
    return decoded.astype(np.uint8)

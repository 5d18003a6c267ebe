"""Whatever frames and calibration a shipped detector gets: it works, or gives a reason; and in a
process of its own it stays below 300 MiB.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import Calibration
from detector.external.serve import Pictures
from detector.protocol import Detection
from detector.registry import available, create
from tests.conftest import ROOT
from tests.detector.conftest import Draw
from tests.detector.thesis_fits import thesis_published
from tests.examples import few
from tests.waiting import PATIENCE_S

NAMES = list(available([]))


@pytest.fixture(scope="module")
def frames(draw: Draw, teats_mm: NDArray[np.float64]) -> Pictures:
    return draw(teats_mm)


def every(change: Callable[[NDArray[Any]], NDArray[Any]]) -> Callable[[Pictures], Pictures]:
    def changed(frames: Pictures) -> Pictures:
        assert frames.thermal is not None
        left, right, thermal = map(change, (frames.left, frames.right, frames.thermal))
        return Pictures(left, right, thermal, frames.thermal_k)

    return changed


def noise(like: NDArray[Any]) -> NDArray[Any]:
    return np.random.default_rng(like.size).integers(0, 256, like.shape).astype(np.uint8)


def kelvin(frames: Pictures, thermal_k: NDArray[Any]) -> Pictures:
    return replace(frames, thermal=None, thermal_k=thermal_k)


MET: dict[str, Callable[[Pictures], Pictures]] = {
    "1 x 1": every(lambda p: p[:1, :1]),
    "1 x 1 thermal": lambda f: replace(f, thermal=np.zeros((1, 1), np.uint8)),
    "1 x 1 left": lambda f: replace(f, left=f.left[:1, :1]),
    "half size": every(lambda p: np.ascontiguousarray(p[::2, ::2])),
    "turned": every(lambda p: np.ascontiguousarray(p.T)),
    "empty": every(lambda p: p[:0, :0]),
    "one row": every(lambda p: p[:1]),
    "16-bit": every(lambda p: p.astype(np.uint16) * 257),
    "float": every(lambda p: p / 255.0),
    "boolean": every(lambda p: p > 100),
    "colour": every(lambda p: np.dstack([p, p, p])),
    "black": every(np.zeros_like),
    "saturated": every(lambda p: np.full_like(p, 255)),
    "noise only": every(noise),
    "thermal black": lambda f: replace(f, thermal=np.zeros_like(f.thermal)),
    "thermal noise": lambda f: replace(f, thermal=noise(np.zeros((480, 640)))),
    "swapped": lambda f: replace(f, left=f.right, right=f.left),
    "no thermal": lambda f: replace(f, thermal=None),
    "kelvin of one pixel": lambda f: kelvin(f, np.full((1, 1), 305.0)),
    "kelvin not a number": lambda f: kelvin(f, np.full((120, 160), np.nan)),
    "kelvin in a row": lambda f: kelvin(f, np.full(7, 305.0)),
}
HOPELESS = {
    *("1 x 1", "1 x 1 thermal", "1 x 1 left", "half size", "turned", "empty", "one row"),
    *("black", "saturated", "thermal black", "no thermal"),
}
# the published chain doesn't ask whether what it sees are teats
DECEPTIVE = {"noise only", "thermal noise", "swapped"}


def is_an_answer(found: Detection) -> None:
    """Numbers that are finite, or one sentence."""
    assert isinstance(found, Detection)
    for teat in found.teats:
        assert teat.world_mm.shape == (3,)
        assert np.isfinite(teat.world_mm).all()
    assert 0 <= found.hidden <= 4
    assert found.teats or found.reason
    reason = found.reason or ""
    assert len(reason) < 200
    assert not [word for word in ("\n", "Error", "Traceback") if word in reason]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("what", list(MET))
def test_it_works_or_says_why_not(name: str, what: str, frames: Pictures, rig: Calibration) -> None:
    found = create(name, []).detect(MET[what](frames), rig)
    is_an_answer(found)
    if what in HOPELESS or (what in DECEPTIVE and not name.startswith("thesis")):
        assert found.teats == (), what
        assert found.reason, what


@pytest.mark.parametrize("what", sorted(DECEPTIVE))
def test_the_published_chain_is_deceived(what: str, frames: Pictures, rig: Calibration) -> None:
    """Its faults are the original's: docs/detectors.md tells of this one."""
    assert len(create("thesis", []).detect(MET[what](frames), rig).teats) == 4


@pytest.mark.parametrize("name", NAMES)
def test_a_calibration_without_a_thermal_pose(name: str, frames: Pictures) -> None:
    calibration = thesis_published()
    assert calibration.thermal_from_left is None
    is_an_answer(create(name, []).detect(frames, calibration))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_16_bit_pictures_are_the_8_bit_ones(name: str, frames: Pictures, rig: Calibration) -> None:
    narrow, wide = (create(name, []).detect(f, rig) for f in (frames, MET["16-bit"](frames)))
    assert len(narrow.teats) == len(wide.teats)
    for a, b in zip(narrow.teats, wide.teats, strict=True):
        # edges as hard as drawn ones fall on either side of a pixel by rounding
        assert np.allclose(a.world_mm, b.world_mm, atol=0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_read_only_pictures_are_enough(name: str, frames: Pictures, rig: Calibration) -> None:
    fixed = every(np.copy)(frames)
    for picture in (fixed.left, fixed.right, fixed.thermal):
        np.asarray(picture).setflags(write=False)
    is_an_answer(create(name, []).detect(fixed, rig))


PROGRAM = """
import sys
from pathlib import Path
from detector.calibration import load_calibration
from detector.external.serve import read_pictures
from detector.registry import create

detector, calibration = create(sys.argv[1], []), load_calibration(Path(sys.argv[2]))
asked = {name: f"{sys.argv[3]}/{name}.png" for name in ("left", "right", "thermal")}
for _ in range(3):
    print(len(detector.detect(read_pictures(asked), calibration).teats))
status = Path("/proc/self/status").read_text(encoding="ascii")
print(int(status.partition("VmHWM:")[2].split()[0]) // 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(
    sys.platform != "linux",
    reason="only Linux tells a program's own peak, without that of whoever started it",
)
# variants of the thesis hold what it does; the frames that are drawn here have no depth
@pytest.mark.parametrize("name", few(["thesis", "fused"], 2))
def test_it_needs_little_memory(
    name: str, frames: Pictures, rig_file: Path, tmp_path: Path
) -> None:
    for what in ("left", "right", "thermal"):
        cv2.imwrite(str(tmp_path / f"{what}.png"), getattr(frames, what))
    command = [sys.executable, "-c", PROGRAM, name, str(rig_file), str(tmp_path)]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=PATIENCE_S
    )
    *found, peak_mib = (int(line) for line in done.stdout.split())
    assert found == [4, 4, 4]
    assert peak_mib < 300

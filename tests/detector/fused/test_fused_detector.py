"""The whole detector on drawn scenes at known places, and on frames that can't be used."""

from __future__ import annotations

import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from detector.calibration import Calibration, ParameterCovariance
from detector.fused.detector import FusedDetector
from detector.fused.parameters import Parameters
from detector.protocol import Detection, Detector, Teat
from tests.detector.fused.conftest import Body, Draw, Find

pytestmark = pytest.mark.slow

Array = NDArray[np.float64]


def errors(found: Detection, bodies: list[Body]) -> Array:
    """Each answer's way (n, 3) from the nearest body's end."""
    ends = np.array([b.end_mm for b in bodies])
    return np.array(
        [t.world_mm - ends[np.linalg.norm(ends - t.world_mm, axis=1).argmin()] for t in found.teats]
    ).reshape(-1, 3)


def held(found: Detection, bodies: list[Body], most_mm: float) -> None:
    """One answer for each body, all within ``most_mm``."""
    assert len(found.teats) == len(bodies)
    assert np.linalg.norm(errors(found, bodies), axis=1).max() < most_mm


def refused(found: Detection) -> str:
    """Why there is no answer."""
    assert found.teats == ()
    assert found.reason is not None
    return found.reason


def covariance(teat: Teat) -> Array:
    assert teat.covariance_mm2 is not None
    return teat.covariance_mm2


def test_it_is_a_detector() -> None:
    detector: Detector = FusedDetector()
    assert (detector.name, detector.version) == ("fused", "31")
    assert detector.parameters["prior"]["radius_mm"] == 11.0
    assert FusedDetector(Parameters(most_bars=0)).parameters != detector.parameters


def test_teats_of_any_lean_and_shape_are_found(
    find: Find, udder: list[Body], rig: Calibration
) -> None:
    found = find(udder)
    held(found, udder, 0.4)
    assert (found.hidden, found.reason) == (0, None)
    for teat in found.teats:
        for seen, projected in zip(
            (teat.left_px, teat.right_px), rig.project(teat.world_mm[None]), strict=True
        ):
            assert seen is not None
            assert np.allclose(seen, projected[0])
        assert np.linalg.eigvalsh(covariance(teat)).min() > 0


def test_calibration_uncertainty_is_added(
    draw_scene: Draw, udder: list[Body], rig: Calibration
) -> None:
    frames = draw_scene(udder)
    exact = replace(rig, covariance=ParameterCovariance((), np.zeros((0, 0))))
    shaky = replace(rig, covariance=ParameterCovariance((("world", "T1"),), np.array([[4.0]])))
    found = [FusedDetector().detect(frames, calibration).teats for calibration in (exact, shaky)]
    for plain, added in zip(*found, strict=True):
        assert np.array_equal(plain.world_mm, added.world_mm)
        more = covariance(added) - covariance(plain)
        assert np.allclose(more, np.diag([4.0, 0.0, 0.0]), atol=1e-6)


@pytest.mark.parametrize("gap_mm", [0.0, 1.5])
def test_touching_teats_are_told_apart(find: Find, udder: list[Body], gap_mm: float) -> None:
    """The thermal picture shows one broad thing; greys differ a little."""
    one = replace(udder[2], end_mm=(-150.0, 205.0, 130.0), height=1.0, grey=22.0)
    place = (-150.0 + 9.5 + 11.0 + gap_mm, 215.0, 138.0)
    other = replace(udder[3], end_mm=place, lean=(0.0, 0.0), grey=34.0)
    bodies = [one, other, udder[0]]
    held(find(bodies), bodies, 1.5)


@pytest.mark.parametrize(
    "change",
    [
        {"end_mm": (-170.0, 300.0, 140.0), "kelvin": 293.0},
        {"end_mm": (-170.0, 420.0, 180.0), "radius_mm": 40.0, "kelvin": 305.0, "grey": 90.0},
    ],
    ids=["cold", "warm, of another size"],
)
def test_another_thing_is_no_teat(find: Find, udder: list[Body], change: dict[str, Any]) -> None:
    held(find([*udder, replace(udder[0], **change)]), udder, 1.0)


@pytest.mark.parametrize("camera", ["L", "R"])
def test_a_teat_that_one_camera_doesnt_see_is_hidden_and_the_trace_says_why(
    find: Find, udder: list[Body], camera: str
) -> None:
    found = find([*udder[:3], replace(udder[3], seen_by="LRT".replace(camera, ""))])
    held(found, udder[:3], 0.5)
    assert found.hidden == 1
    assert [stage.name for stage in found.trace] == ["thermal", "starts", "decisions", "answers"]
    decisions = found.stage("decisions")
    assert decisions is not None
    reasons = decisions.data["reasons"].tolist()
    assert reasons.count("") == len(found.teats)
    assert str(found.reason).startswith("left out at ")
    assert len(reasons) == len(decisions.data["teats"])


def test_warm_grey_levels_do(draw_scene: Draw, udder: list[Body], rig: Calibration) -> None:
    frames = draw_scene(udder)
    assert frames.thermal_k is not None
    grey = np.clip(255 - (frames.thermal_k - 290.0) * 14.0, 0, 255)  # hot is black
    # as delivered: mirrored, at 640 x 480
    large = np.kron(grey, np.ones((4, 4))).astype(np.uint8)[:, ::-1]
    held(FusedDetector().detect(replace(frames, thermal=large, thermal_k=None), rig), udder, 0.4)


def odd_frames(frames: Any) -> dict[str, tuple[dict[str, Any], str]]:
    """Pictures that can't be used, and what must be said."""
    dot, noise = np.zeros((1, 1), np.uint8), np.random.default_rng(0)
    left, right, kelvin = frames.left, frames.right, frames.thermal_k
    black, white = np.zeros_like(left), np.full_like(left, 255)
    grain = noise.integers(0, 256, left.shape).astype(np.uint8)
    cold = np.random.default_rng(0).normal(295, 0.05, kelvin.shape)
    nan = np.where(np.eye(*kelvin.shape) > 0, np.nan, kelvin)
    of = "picture is 1 x 1, the calibration is for"
    return {
        "dot left": ({"left": dot}, f"the left {of} 1360 x 1024"),
        "dot right": ({"right": dot}, "the right picture is 1 x 1"),
        "dot thermal": ({"thermal_k": dot}, f"the radiometric thermal {of} 160 x 120"),
        "small": ({"left": left[::2, ::2]}, "the left picture is 680 x 512"),
        "no thermal": ({"thermal_k": None}, "there is no thermal picture"),
        "volume": ({"left": np.zeros((4, 4, 4, 4))}, "the left picture has the shape"),
        "text": ({"right": np.full((1024, 1360), "x")}, "numbers are needed"),
        "nan": ({"thermal_k": nan}, "no numbers"),
        "raw": ({"thermal_k": np.full_like(nan, 81.92)}, "reads -191 degC in the middle of all"),
        "black": ({"left": black, "right": black}, "show no outline"),
        "saturated": ({"left": white, "right": white}, "show no outline"),
        "swapped": ({"left": right, "right": left}, "outline"),
        "optical noise": ({"left": grain, "right": grain[::-1]}, "outline"),
        "thermal noise": ({"thermal_k": cold}, "teat"),
        "one temperature": ({"thermal_k": np.full_like(kelvin, 300.0)}, "nothing like a teat"),
    }


def test_frames_without_teats(draw_scene: Draw, udder: list[Body], rig: Calibration) -> None:
    frames = draw_scene(udder)
    for name, (changes, words) in odd_frames(frames).items():
        assert words in refused(FusedDetector().detect(replace(frames, **changes), rig)), name


PAGES = """\
import pickle, resource, sys
from detector.fused.detector import FusedDetector
rig, *sets = pickle.load(open(sys.argv[1], "rb"))
counts = []
for frames in sets:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    assert len(FusedDetector().detect(frames, rig).teats) == 4
    counts.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
print(*counts)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="glibc's malloc is asked of")
def test_memory_is_kept_from_one_frame_set_to_the_next(
    tmp_path: Path, draw_scene: Draw, udder: list[Body], rig: Calibration
) -> None:
    sets, file = [draw_scene(udder, seed=seed) for seed in range(4)], tmp_path / "sets.pickle"
    file.write_bytes(pickle.dumps((rig, *sets)))
    asked = [sys.executable, "-c", PAGES, str(file)]
    answer = subprocess.run(asked, capture_output=True, text=True, check=True, timeout=600)
    _, _, *later = map(int, answer.stdout.split())
    assert max(later) < 500  # pages; some 2 000 without

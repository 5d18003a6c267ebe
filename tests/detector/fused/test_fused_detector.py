"""The whole detector on drawn scenes at known places, and on frames that can't be used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from detector.calibration import Calibration, ParameterCovariance
from detector.fused.detector import FusedDetector
from detector.fused.parameters import Parameters
from detector.protocol import Detection, Detector, Teat

Array = NDArray[np.float64]


def errors(found: Detection, bodies: list[Any]) -> Array:
    """Each answer's way (n, 3) from the nearest body's end."""
    ends = np.array([b.end_mm for b in bodies])
    return np.array(
        [t.world_mm - ends[np.linalg.norm(ends - t.world_mm, axis=1).argmin()] for t in found.teats]
    ).reshape(-1, 3)


def covariance(teat: Teat) -> Array:
    assert teat.covariance_mm2 is not None
    return teat.covariance_mm2


def test_it_is_a_detector() -> None:
    detector: Detector = FusedDetector()
    assert (detector.name, detector.version) == ("fused", "2")
    assert detector.parameters["prior"]["radius_mm"] == 11.0
    assert FusedDetector(Parameters(most_bars=0)).parameters != detector.parameters


def test_teats_of_any_lean_and_shape_are_found(
    draw_scene: Callable[..., Any], udder: list[Any], rig: Calibration
) -> None:
    found = FusedDetector().detect(draw_scene(udder), rig)
    assert (len(found.teats), found.hidden, found.reason) == (4, 0, None)
    assert np.linalg.norm(errors(found, udder), axis=1).max() < 0.4
    for teat in found.teats:
        left_px, right_px = rig.project(teat.world_mm[None])
        assert teat.left_px is not None
        assert teat.right_px is not None
        assert np.allclose(teat.left_px, left_px[0])
        assert np.allclose(teat.right_px, right_px[0])
        assert np.linalg.eigvalsh(covariance(teat)).min() > 0


def test_covariances_are_honest(
    draw_scene: Callable[..., Any], udder: list[Any], rig: Calibration
) -> None:
    """Normalised squared errors within chi-square's bounds (Bar-Shalom, section 5.4)."""
    rng = np.random.default_rng(5)
    normalised = []
    for seed in range(5):
        shift = rng.uniform([-25, -40, -8], [25, 40, 8])
        bodies = [
            replace(b, end_mm=tuple(np.add(b.end_mm, shift + rng.uniform(-5, 5, 3)))) for b in udder
        ]
        found = FusedDetector().detect(draw_scene(bodies, seed, noise=3.0), rig)
        assert len(found.teats) == 4
        for teat, error in zip(found.teats, errors(found, bodies), strict=True):
            normalised.append(float(error @ np.linalg.solve(covariance(teat), error)))
    n = len(normalised)
    # claims hold what paint and shadow add in real pictures, so drawn ones may do better; they may
    # not do worse than chi-square allows
    assert np.mean(normalised) < chi2.ppf(0.975, 3 * n) / n
    assert np.mean(normalised) > 0.1
    assert max(normalised) < chi2.ppf(1 - 0.01 / n, 3)


def test_calibration_uncertainty_is_added(
    draw_scene: Callable[..., Any], udder: list[Any], rig: Calibration
) -> None:
    frames = draw_scene(udder)
    shaky = replace(rig, covariance=ParameterCovariance((("world", "T1"),), np.array([[4.0]])))
    for plain, added in zip(
        FusedDetector().detect(frames, rig).teats,
        FusedDetector().detect(frames, shaky).teats,
        strict=True,
    ):
        assert np.array_equal(plain.world_mm, added.world_mm)
        assert np.allclose(
            covariance(added) - covariance(plain), np.diag([4.0, 0.0, 0.0]), atol=1e-6
        )


@pytest.mark.parametrize("gap_mm", [0.0, 1.5])
def test_touching_teats_are_told_apart(
    draw_scene: Callable[..., Any], udder: list[Any], rig: Calibration, gap_mm: float
) -> None:
    """The thermal picture shows one broad thing; greys differ a little."""
    pair = [
        replace(udder[2], end_mm=(-150.0, 205.0, 130.0), height=1.0, grey=22.0),
        replace(
            udder[3],
            end_mm=(-150.0 + 9.5 + 11.0 + gap_mm, 215.0, 138.0),
            lean=(0.0, 0.0),
            grey=34.0,
        ),
    ]
    bodies = [*pair, udder[0]]
    found = FusedDetector().detect(draw_scene(bodies), rig)
    assert len(found.teats) == 3
    assert np.linalg.norm(errors(found, bodies), axis=1).max() < 1.5


def test_a_cold_teat_is_none(
    draw_scene: Callable[..., Any], udder: list[Any], rig: Calibration
) -> None:
    decoy = replace(udder[0], end_mm=(-170.0, 300.0, 140.0), kelvin=293.0)
    found = FusedDetector().detect(draw_scene([*udder, decoy]), rig)
    assert len(found.teats) == 4
    assert np.linalg.norm(errors(found, udder), axis=1).max() < 1.0


def test_a_warm_thing_of_another_size_is_none(
    draw_scene: Callable[..., Any], udder: list[Any], rig: Calibration
) -> None:
    leg = replace(udder[0], end_mm=(-170.0, 420.0, 180.0), radius_mm=40.0, kelvin=305.0, grey=90.0)
    found = FusedDetector().detect(draw_scene([*udder, leg]), rig)
    assert len(found.teats) == 4
    assert np.linalg.norm(errors(found, udder), axis=1).max() < 1.0


@pytest.mark.parametrize("camera", ["L", "R"])
def test_a_teat_that_one_camera_doesnt_see_is_hidden(
    draw_scene: Callable[..., Any], udder: list[Any], rig: Calibration, camera: str
) -> None:
    bodies = [*udder[:3], replace(udder[3], seen_by="LRT".replace(camera, ""))]
    found = FusedDetector().detect(draw_scene(bodies), rig)
    assert len(found.teats) == 3
    assert np.linalg.norm(errors(found, udder[:3]), axis=1).max() < 0.5
    assert found.hidden == 1


def test_the_trace_tells_every_rejected_candidate_and_why(
    draw_scene: Callable[..., Any], udder: list[Any], rig: Calibration
) -> None:
    found = FusedDetector().detect(draw_scene([*udder[:3], replace(udder[3], seen_by="LT")]), rig)
    assert [stage.name for stage in found.trace] == ["thermal", "starts", "decisions"]
    decisions = found.stage("decisions")
    assert decisions is not None
    reasons = decisions.data["reasons"].tolist()
    assert reasons.count("") == len(found.teats)
    assert len(reasons) == len(decisions.data["teats"])


def test_warm_grey_levels_do_in_place_of_kelvin(
    draw_scene: Callable[..., Any], udder: list[Any], rig: Calibration
) -> None:
    frames = draw_scene(udder)
    grey = np.clip(255 - (frames.thermal_k - 290.0) * 14.0, 0, 255)  # hot is black
    # as delivered: mirrored, at 640 x 480
    large = np.kron(grey, np.ones((4, 4))).astype(np.uint8)[:, ::-1]
    found = FusedDetector().detect(replace(frames, thermal=large, thermal_k=None), rig)
    assert len(found.teats) == 4
    assert np.linalg.norm(errors(found, udder), axis=1).max() < 0.4


def odd_frames(frames: Any) -> dict[str, tuple[Any, str]]:
    """Frame sets that can't be used, and what must be said."""
    dot = np.zeros((1, 1), np.uint8)
    black = np.zeros_like(frames.left)
    white = np.full_like(frames.left, 255)
    noise = np.random.default_rng(0).integers(0, 256, frames.left.shape).astype(np.uint8)
    cold = np.random.default_rng(0).normal(295, 0.05, frames.thermal_k.shape)
    nan = np.where(np.eye(*frames.thermal_k.shape) > 0, np.nan, frames.thermal_k)
    return {
        "dot left": (
            replace(frames, left=dot),
            "the left picture is 1 x 1, the calibration is for 1360 x 1024",
        ),
        "dot right": (replace(frames, right=dot), "the right picture is 1 x 1"),
        "dot thermal": (
            replace(frames, thermal_k=dot),
            "the radiometric thermal picture is 1 x 1, the calibration is for 160 x 120",
        ),
        "small": (replace(frames, left=frames.left[::2, ::2]), "the left picture is 680 x 512"),
        "no thermal": (replace(frames, thermal_k=None), "there is no thermal picture"),
        "volume": (replace(frames, left=np.zeros((4, 4, 4, 4))), "the left picture has the shape"),
        "text": (replace(frames, right=np.full((1024, 1360), "x")), "numbers are needed"),
        "nan": (replace(frames, thermal_k=nan), "no numbers"),
        "black": (replace(frames, left=black, right=black), "show no outline"),
        "saturated": (replace(frames, left=white, right=white), "show no outline"),
        "swapped": (replace(frames, left=frames.right, right=frames.left), "outline"),
        "optical noise": (replace(frames, left=noise, right=noise[::-1]), "outline"),
        "thermal noise": (replace(frames, thermal_k=cold), "teat"),
        "one temperature": (
            replace(frames, thermal_k=np.full_like(frames.thermal_k, 300.0)),
            "nothing like a teat",
        ),
    }


def test_frames_without_teats_give_none_and_a_reason(
    draw_scene: Callable[..., Any], udder: list[Any], rig: Calibration
) -> None:
    for name, (frames, words) in odd_frames(draw_scene(udder)).items():
        found = FusedDetector().detect(frames, rig)
        assert found.teats == (), name
        assert found.reason is not None, name
        assert words in found.reason, name


def test_a_calibration_without_a_thermal_pose_gets_one_sentence(
    draw_scene: Callable[..., Any], udder: list[Any], rig: Calibration
) -> None:
    bare = replace(rig, thermal=replace(rig.thermal, lens=None), thermal_from_left=None)
    found = FusedDetector().detect(draw_scene(udder), bare)
    assert found.teats == ()
    assert found.reason is not None
    assert "lens and pose of the thermal camera" in found.reason


def test_colour_and_sixteen_bits_are_taken_as_they_come(
    draw_scene: Callable[..., Any], udder: list[Any], rig: Calibration
) -> None:
    frames = draw_scene(udder)
    plain = FusedDetector().detect(frames, rig)
    deep = replace(
        frames, left=frames.left.astype(np.uint16) * 257, right=frames.right.astype(np.uint16) * 257
    )
    colour = replace(frames, left=np.dstack([frames.left] * 3), right=np.dstack([frames.right] * 3))
    for other in (deep, colour):
        found = FusedDetector().detect(other, rig)
        assert len(found.teats) == 4
        assert np.abs(errors(found, udder) - errors(plain, udder)).max() < 0.01

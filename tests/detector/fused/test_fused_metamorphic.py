"""Changes of known effect: mirrors, brightness, gain, another world, another order."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.cli.detectors import try_out
from bench.config import ConfigError
from bench.rig import moved
from bench.run.detections import detect_recording
from bench.run.start import score_recording
from bench.script.detectors import introduced
from detector.calibration import Calibration, dump_calibration
from detector.fused.detector import FusedDetector
from detector.geometry import Camera, Motion
from detector.protocol import Detection
from tests.detector.fused.conftest import Body, Draw, Find, drawer

Array = NDArray[np.float64]
M = np.diag([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def frames(draw_scene: Draw, udder: list[Body]) -> Any:
    return draw_scene(udder, seed=2)


@pytest.fixture(scope="module")
def plain(frames: Any, rig: Calibration) -> Detection:
    found = FusedDetector().detect(frames, rig)
    assert len(found.teats) == 4
    return found


def places(found: Detection) -> Array:
    world = np.array([teat.world_mm for teat in found.teats]).reshape(-1, 3)
    return world[np.argsort(world[:, 0])]


def mirrored_camera(camera: Camera) -> Camera:
    k1, k2, p1, p2, k3 = camera.kc
    return replace(
        camera,
        cc=(camera.image_size[0] - 1 - camera.cc[0], camera.cc[1]),
        alpha_c=-camera.alpha_c,
        kc=(k1, k2, p1, -p2, k3),
    )


def mirrored_motion(motion: Motion) -> Motion:
    return Motion(M @ motion.R @ M, M @ motion.T)


def mirrored_rig(rig: Calibration) -> Calibration:
    """The rig in a mirror: left and right cameras change places, the world's x changes sign."""
    assert rig.thermal.lens is not None
    assert rig.thermal_from_right is not None
    return replace(
        rig,
        left=mirrored_camera(rig.right),
        right=mirrored_camera(rig.left),
        thermal=replace(rig.thermal, lens=mirrored_camera(rig.thermal.lens)),
        right_from_left=mirrored_motion(rig.right_from_left.inverse()),
        thermal_from_left=mirrored_motion(rig.thermal_from_right),
        world_from_right=mirrored_motion(rig.world_from_right @ rig.right_from_left),
    )


@pytest.mark.slow
def test_a_mirrored_scene_mirrors_answers(frames: Any, plain: Detection, rig: Calibration) -> None:
    left = np.ascontiguousarray(frames.right[:, ::-1])
    right = np.ascontiguousarray(frames.left[:, ::-1])
    mirrored = replace(
        frames, left=left, right=right, thermal_k=np.ascontiguousarray(frames.thermal_k[:, ::-1])
    )
    found = FusedDetector().detect(mirrored, mirrored_rig(rig))
    assert np.abs(places(found)[::-1] * [-1, 1, 1] - places(plain)).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("gain", "offset"), [(0.5, 0.0), (0.8, 40.0), (1.2, 10.0)])
def test_brightness_and_gain_hardly_move_the_ends(
    frames: Any, plain: Detection, rig: Calibration, gain: float, offset: float
) -> None:
    left, right = (
        np.clip(np.rint(p * gain + offset), 0, 255).astype(np.uint8)
        for p in (frames.left, frames.right)
    )
    found = FusedDetector().detect(replace(frames, left=left, right=right), rig)
    assert np.linalg.norm(places(found) - places(plain), axis=1).max() < 0.1


@pytest.mark.slow
def test_a_warmer_room_moves_nothing(frames: Any, plain: Detection, rig: Calibration) -> None:
    found = FusedDetector().detect(replace(frames, thermal_k=frames.thermal_k + 8.0), rig)
    assert np.linalg.norm(places(found) - places(plain), axis=1).max() < 0.01


@pytest.mark.slow
def test_a_world_upside_down_has_hanging_teats(
    frames: Any, plain: Detection, rig: Calibration
) -> None:
    over = Motion.from_vectors([np.pi, 0.0, 0.0], [0.0, 0.0, 0.0])
    hung = replace(rig, world_from_right=over @ rig.world_from_right, hanging=True)
    found = FusedDetector().detect(frames, hung)
    for before, after in zip(plain.teats, found.teats, strict=True):
        assert np.allclose(over.apply(before.world_mm), after.world_mm, atol=1e-6)


def test_frames_turned_over_give_the_same_ends(
    frames: Any, plain: Detection, rig: Calibration
) -> None:
    """The rig hangs upside down: its right camera is on the left of its pictures."""
    half = Motion(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))

    def turned(camera: Camera) -> Camera:
        (columns, rows), (k1, k2, p1, p2, k3) = camera.image_size, camera.kc
        cc = columns - 1 - camera.cc[0], rows - 1 - camera.cc[1]
        return replace(camera, cc=cc, kc=(k1, k2, -p1, -p2, k3))

    assert rig.thermal.lens is not None
    assert rig.thermal_from_left is not None
    right_from_left = half @ rig.right_from_left @ half
    over = replace(
        rig,
        left=turned(rig.right),
        right=turned(rig.left),
        thermal=replace(rig.thermal, lens=turned(rig.thermal.lens)),
        right_from_left=right_from_left.inverse(),
        thermal_from_left=half @ rig.thermal_from_left @ half @ right_from_left.inverse(),
        world_from_right=rig.world_from_right @ rig.right_from_left @ half,
    )
    left, right, kelvin = (
        np.ascontiguousarray(one[::-1, ::-1])
        for one in (frames.right, frames.left, frames.thermal_k)
    )
    found = FusedDetector().detect(replace(frames, left=left, right=right, thermal_k=kelvin), over)
    assert np.linalg.norm(places(found) - places(plain), axis=1).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "amount"),
    [
        ("tilt", 30.0),
        ("tilt", -30.0),
        ("roll", -90.0),
        ("roll", 180.0),
        ("away", 1600.0),
        ("baseline", 60.0),
        ("baseline", 240.0),
        ("pixels", 0.5),
        ("thermal-pixels", 0.5),
        ("distortion", -0.1),
    ],
)
def test_other_rigs_find_the_same_ends(
    rig: Calibration, udder: list[Body], name: str, amount: float
) -> None:
    other = moved.DRAWN[name][0](moved.aimed(rig), amount)
    found = FusedDetector().detect(drawer(other)(udder, seed=2), other)
    ends = np.array([body.end_mm for body in udder])
    assert len(found.teats) == len(udder), found.reason
    assert np.linalg.norm(places(found) - ends[np.argsort(ends[:, 0])], axis=1).max() < 1.0


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rig: moved.tilted(rig, 70.0), "looks up or down by"),
        (lambda rig: moved.with_thermal_pixels(rig, 0.03), "pixels wide in the thermal"),
        (lambda rig: moved.with_pixels(rig, 0.02), "pixels"),
        (
            lambda rig: replace(
                rig, thermal_from_left=Motion.from_vectors([0.0, 2.0, 0.0], np.zeros(3))
            ),
            "no place in common",
        ),
    ],
)
def test_a_rig_outside_of_the_domain_is_refused_by_name(
    rig: Calibration, change: Callable[[Calibration], Calibration], says: str, frames: Any
) -> None:
    detector, other = FusedDetector(), change(rig)
    assert detector.refuses(rig) is None
    why = detector.refuses(other)
    assert why is not None
    assert says in why
    refused = pytest.raises(ConfigError, match=r"fused can.t be used with this rig")
    with refused, introduced([detector], {}, other):
        pass


def test_a_recording_of_such_a_rig_is_refused_before_its_first_frame(
    rig: Calibration, tmp_path: Path
) -> None:
    recording, text = tmp_path / "tilted", dump_calibration(moved.tilted(rig, 70.0))
    (recording / "frames" / "0").mkdir(parents=True)
    (recording / "calibration.toml").write_text(text, encoding="utf-8")
    for what in (
        lambda: score_recording(recording, tmp_path / "runs", Mock(), ["fused"]),
        lambda: list(detect_recording(recording, ["fused"])),
        lambda: try_out(Namespace(word="fused", recording=recording)),
    ):
        with pytest.raises(ConfigError, match=r"fused can.t be used with this rig: .*looks up"):
            what()
    assert not (tmp_path / "runs").exists()


def test_another_world_turns_the_answers(frames: Any, plain: Detection, rig: Calibration) -> None:
    turn = Motion.from_vectors([0.0, 0.0, 1.1], [10.0, -200.0, 35.0])
    found = FusedDetector().detect(
        frames, replace(rig, world_from_right=turn @ rig.world_from_right)
    )
    for before, after in zip(plain.teats, found.teats, strict=True):
        assert np.allclose(turn.apply(before.world_mm), after.world_mm, atol=1e-6)
        assert before.covariance_mm2 is not None
        assert after.covariance_mm2 is not None
        assert np.allclose(
            turn.R @ before.covariance_mm2 @ turn.R.T, after.covariance_mm2, atol=1e-9
        )


@pytest.mark.slow
def test_shifted_teats_shift_the_answers(find: Find, udder: list[Body]) -> None:
    by = np.array([7.3, -11.7, 4.1])
    shifted = [replace(b, end_mm=tuple(np.add(b.end_mm, by))) for b in udder]
    found, before = (find(bodies, noise=0.5) for bodies in (shifted, udder))
    assert np.linalg.norm(places(found) - places(before) - by, axis=1).max() < 0.4

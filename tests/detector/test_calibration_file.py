"""The calibration file: what it gives, what it derives, and every fault at once."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from pathlib import Path

import numpy as np
import pytest

from detector.calibration import (
    DEFAULT_PLANE_DEPTH_MM,
    Calibration,
    CalibrationError,
    dump_calibration,
    load_calibration,
)
from detector.geometry import Motion, apply_homography

Edit = Callable[[str], str]
Load = Callable[[Edit], Calibration]


@pytest.fixture
def load(tmp_path: Path, rig_file: Path) -> Load:
    """Load the shipped file after an edit of its text."""

    def edited(edit: Edit) -> Calibration:
        path = tmp_path / "calibration.toml"
        path.write_text(edit(rig_file.read_text(encoding="utf-8")), encoding="utf-8")
        return load_calibration(path)

    return edited


def without(text: str, *starts: str) -> str:
    return "\n".join(line for line in text.splitlines() if not line.startswith(starts))


def block_removed(text: str, block: str) -> str:
    before, _, rest = text.partition(f"\n[{block}]")
    return before + "\n" + ("[" + rest.split("\n[", 1)[1] if "\n[" in rest else "")


def test_dump_and_load_are_inverse(rig: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "again.toml"
    path.write_text(dump_calibration(rig, "two\nlines"), encoding="utf-8")
    again = load_calibration(path)
    assert (again.left, again.right, again.thermal) == (rig.left, rig.right, rig.thermal)
    assert again.thermal_from_left is not None
    assert rig.thermal_from_left is not None
    assert np.allclose(again.thermal_from_left.R, rig.thermal_from_left.R, atol=1e-9)
    assert np.allclose(again.homographies.left, rig.homographies.left, rtol=1e-9)
    assert path.read_text(encoding="utf-8").startswith("# two\n# lines\n")


def test_a_depth_camera_has_a_lens_and_a_place_that_come_back(
    rig: Calibration, load: Load, tmp_path: Path
) -> None:
    assert (rig.depth, rig.depth_from_world) == (None, None)
    there = load(lambda text: text + "".join(DEPTH))
    (tmp_path / "again.toml").write_text(dump_calibration(there), encoding="utf-8")
    again = load_calibration(tmp_path / "again.toml")
    assert again.depth == there.depth is not None
    assert again.depth_from_world is not None
    # 1 m before the depth camera, by hand: X_left = R^T (X_depth - T)
    left_from_depth = Motion.from_vectors([0.0, -0.05, 0.0], [0.0, 0.0, 0.0])
    in_left = left_from_depth.apply(np.array([40.0, -25.0, 999.0]))
    world_mm = again.world_from_right.apply(again.right_from_left.apply(in_left))
    assert again.depth_from_world.apply(world_mm) == pytest.approx([0.0, 0.0, 1000.0], abs=1e-5)


def test_an_absent_homography_is_derived(rig: Calibration, load: Load) -> None:
    at_depth = load(lambda text: without(text, "left = [[", "right = [["))
    corners = np.array([[0.0, 0], [639, 0], [0, 479], [639, 479]])
    assert at_depth.homographies.plane_depth_mm == rig.homographies.plane_depth_mm
    for side in ("left", "right"):
        ours, given = (
            apply_homography(getattr(c.homographies, side), corners) for c in (at_depth, rig)
        )
        assert np.abs(ours - given).max() < 1e-3
    without_any = load(lambda text: block_removed(text, "homography"))
    assert without_any.homographies.plane_depth_mm == DEFAULT_PLANE_DEPTH_MM


def test_a_rig_may_have_only_homographies(rig: Calibration, load: Load) -> None:
    def edit(text: str) -> str:
        head, _, tail = block_removed(text, "thermal").partition("[cameras.thermal]")
        return head + "[cameras.thermal]" + without(tail, "fc", "cc", "alpha_c", "kc")

    bare = load(edit)
    assert bare.thermal.lens is None
    assert bare.thermal_from_left is None
    assert bare.thermal_from_right is None
    assert np.array_equal(bare.homographies.right, rig.homographies.right)


def faults(load: Load, edit: Edit) -> dict[str, str]:
    with pytest.raises(CalibrationError) as caught:
        load(edit)
    for fault in caught.value.faults:
        assert str(fault) in str(caught.value)
    return {".".join(fault.key): fault.message for fault in caught.value.faults}


def put(old: str, new: str) -> Edit:
    return lambda text: text.replace(old, new, 1)


def instead_of(start: str, line: str) -> Edit:
    """The last block with another line in place of one."""
    return lambda text: f"{without(text, start)}\n{line}"


STEREO_T, STEREO_OM = "T = [-100.317, 0.242, -0.401]", "om = [-0.0011, -0.0008, 0.0085]\n"
MIRRORING, FLAT = "left = [[1, 0, 0], [0, -1, 0], [0, 0, 1]]", "left = [[1, 0, 0], [0, 1, 0]]"
LENS, HUGE = "fc = [1291.0", "fc = [1" + "0" * 400
LENS_OF_DEPTH = """
[cameras.depth]
image_size = [320, 240]
fc = [410.0, 411.0]
cc = [159.5, 119.5]
kc = [0.01, 0.0, 0.0, 0.0, 0.0]
"""
DEPTH = LENS_OF_DEPTH, "\n[depth]\nom = [0.0, 0.05, 0.0]\nT = [-40.0, 25.0, 1.0]\n"
RECORD = '[record]\nby = ""\nwith_what = ""\ncameras = {}\ninputs = {}\nmade = "yesterday"\n'


def uncertain(parameters: str, rows: str) -> Edit:
    return lambda t: f"{t}\n[uncertainty]\nparameters = [{parameters}]\ncovariance = [{rows}]\n"


COVARIANCE = "uncertainty.covariance"
CASES: list[tuple[Edit, str, str]] = [
    (lambda t: f"{t}\n{RECORD}", "record.made", "a day such as"),
    (uncertain('"left fx"', "[-1.0]"), COVARIANCE, "not a covariance"),
    (uncertain('"left fx"', "[1.0], [0.0, 1.0]"), COVARIANCE, "1 x 1 finite numbers"),
    (uncertain('"left focus"', "[1.0]"), COVARIANCE, "no such parameter: left focus"),
    (uncertain('"left fx", "left fx"', "[1.0], [0.0, 1.0]"), COVARIANCE, "named twice"),
    (uncertain('"left fx"', "[1.0, 2.0]"), COVARIANCE, "lower triangle"),
    (put(LENS, "fc = [-1291.0"), "cameras.left.fc", "above zero"),
    (put(LENS + ", ", "fc = ["), "cameras.left.fc", "must have 2 numbers"),
    (put(LENS, 'fc = ["1291"'), "cameras.left.fc", "must be a number, not text"),
    (put(LENS, "fc = [true"), "cameras.left.fc", "must be a number, not true or false"),
    (put(LENS, "fc = [inf"), "cameras.left.fc", "finite"),
    (put(LENS, HUGE), "cameras.left.fc", "finite"),
    (put("alpha_c = 0.0", "alpha_k = 0.0"), "cameras.left.alpha_k", "did you mean 'alpha_c'"),
    (put("[1360, 1024]", "[1360.0, 1024]"), "cameras.left.image_size", "whole numbers"),
    (put("[1360, 1024]", "[0, 1024]"), "cameras.left.image_size", "1 to 65535"),
    (put("is_black", "is_blakc"), "cameras.thermal.polarity", "did you mean 'hot_is_black'"),
    (put("mirrored = true", "mirrored = 1"), "cameras.thermal.mirrored", "true or false"),
    (put("[world]", "[wrold]"), "world", "missing block [world]"),
    (put("[world]", "[wrold]"), "wrold", "did you mean 'world'"),
    (put("[cameras.left]", "[cameras.lift]"), "cameras.lift", "did you mean 'left'"),
    (put(STEREO_T, "T = [0, 0, 0]"), "stereo.T", "no depth"),
    (put(STEREO_OM, ""), "stereo.om", "missing"),
    (lambda t: block_removed(t, "thermal"), "thermal", "lens but no pose"),
    (lambda t: without(t, "right = [["), "homography.right", "missing"),
    (instead_of("left = [[", MIRRORING), "homography.left", "neither mirrors"),
    (instead_of("left = [[", FLAT), "homography.left", "three rows"),
    (instead_of("plane_depth", "plane_depth_mm = -3"), "homography.plane_depth_mm", "above zero"),
    (lambda t: "stereo = 3\n" + block_removed(t, "stereo"), "stereo", "must be a block"),
    (lambda t: t + DEPTH[0], "depth", "missing block [depth]: a depth camera has a lens"),
    (lambda t: t + DEPTH[1], "cameras.depth", "missing block [cameras.depth]"),
    (lambda t: "cameras = 3\n" + t[t.index("[stereo]") :], "cameras.left", "missing block"),
]


@pytest.mark.parametrize(("edit", "key", "message"), CASES)
def test_each_fault_is_named_where_it_is(load: Load, edit: Edit, key: str, message: str) -> None:
    assert message in faults(load, edit)[key]


def test_all_faults_come_at_once(load: Load) -> None:
    edits = put(LENS, "fc = [-1"), put("hot_is_black", "hot"), put("[world]", "[wrold]")
    found = faults(load, lambda text: reduce(lambda so_far, edit: edit(so_far), edits, text))
    assert set(found) == {"cameras.left.fc", "cameras.thermal.polarity", "wrold", "world"}


def test_a_plane_that_the_cameras_cannot_see_is_a_fault(load: Load) -> None:
    def backwards(text: str) -> str:
        turned = text.replace("om = [-0.01086", "om = [3.01086")
        assert turned != text
        return without(turned, "left = [[", "right = [[")

    assert "isn't in front of both cameras" in faults(load, backwards)["homography"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "can't be read"),
        (b"= 3", "not TOML"),
        (b"\xff\xff", "not UTF-8"),
        (b"", "missing block [cameras.left]"),
    ],
)
def test_a_file_that_is_no_calibration(tmp_path: Path, content: bytes | None, message: str) -> None:
    path = tmp_path / "c.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(CalibrationError, match=r"c\.toml") as caught:
        load_calibration(path)
    assert message in str(caught.value)

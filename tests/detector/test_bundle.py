"""Bundle adjustment: what was put in comes out within the stated covariance; known sets."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from detector.calibration.boards import Board
from detector.calibration.bundle import LENS, POSE, BundleError, Freedom, Rig, Sighting, adjust
from detector.calibration.cameras import (
    Calibrated,
    TooFewViewsError,
    View,
    calibrate_camera,
    join_cameras,
    pair_of,
    split_half,
)
from detector.calibration.corners import SubPixel, find_board
from detector.calibration.diagnosis import PairView, remeasure
from detector.geometry import Camera, Motion
from tests.detector.boards_seen import BOARD, missed, seen, thesis_rig

SIZE = (1360, 1024)
OPENCV_MODEL = "k1 k2 p1 p2 k3"


def alone_of(views: Mapping[str, list[View]]) -> dict[str, Calibrated]:
    return {name: calibrate_camera(name, views[name], SIZE) for name in ("left", "right")}


def joined(seed: int) -> Calibrated:
    return join_cameras(alone_of(seen(thesis_rig(), seed)), joint_lenses=("left", "right"))


@pytest.mark.slow
def test_rigs_are_found_within_the_stated_covariance() -> None:
    distances = []
    for found in map(joined, range(8)):
        off = missed(found, thesis_rig())
        distances.append(float(off @ np.linalg.solve(found.fit.covariance, off)))
    freedom = 22 * len(distances)  # 8 parameters a lens, 6 of the motion: a chi-square of so many
    assert abs(sum(distances) - freedom) < 4 * np.sqrt(2 * freedom), np.mean(distances)


@pytest.mark.slow
def test_noise_is_told_apart_from_reprojection_error() -> None:
    fit = joined(3).fit
    assert fit.sigma_px == pytest.approx(0.1, rel=0.03)
    assert fit.rms_px == pytest.approx(0.1 * np.sqrt(2), rel=0.03)


def test_fixed_lenses_stay_and_only_the_motion_moves() -> None:
    alone = alone_of(seen(thesis_rig(), 4))
    fixed = join_cameras(alone)
    assert fixed.fit.rig.cameras["left"] == alone["left"].fit.rig.cameras["left"]
    assert fixed.fit.names == tuple(("right", name) for name in POSE)
    off = fixed.fit.rig.from_reference["right"].T - thesis_rig().right_from_left.T
    assert np.linalg.norm(off) < 1.0


@pytest.mark.slow
def test_a_third_camera_hangs_on_the_pair() -> None:
    rig = thesis_rig()
    views = seen(rig, 5, thermal=True)
    assert rig.thermal_from_left is not None
    assert len(views["thermal"]) > 8
    alone, size = alone_of(views), rig.thermal.image_size
    alone["thermal"] = calibrate_camera("thermal", views["thermal"], size, model="k1")
    fit = join_cameras(alone, joint_lenses=tuple(alone)).fit
    off = fit.rig.from_reference["thermal"].T - rig.thermal_from_left.T
    sds = [fit.sd("thermal", name) or np.inf for name in POSE[3:]]
    assert np.all(np.abs(off) < 4 * np.array(sds))
    assert max(sds) < 20.0


@pytest.mark.slow
def test_halves_differ_by_what_their_deviations_allow() -> None:
    halves = split_half(seen(thesis_rig(), 6), SIZE, model="k1 k2 p1 p2")
    apart = np.array(list(halves.differences.values()))
    assert 0.4 < np.sqrt(np.mean(apart**2)) < 2.0


def test_zhangs_own_points(shared_data: Path) -> None:
    folder = shared_data / "zhang_planar"
    flat = np.loadtxt(folder / "Model.txt").reshape(-1, 2)
    board = np.column_stack([flat, np.zeros(len(flat))])
    views = [
        View(str(n), board, np.loadtxt(folder / f"data{n}.txt").reshape(-1, 2)) for n in range(1, 6)
    ]
    fit = calibrate_camera("zhang", views, (640, 480), model="k1 k2").fit
    camera = fit.rig.cameras["zhang"]
    assert round(fit.rms_px, 4) == 0.3369
    assert (round(camera.fc[0], 2), round(camera.cc[0], 2)) == (832.21, 304.07)
    assert fit.sd("zhang", "fx") == pytest.approx(1.4039, abs=2e-3)
    assert fit.sd("zhang", "k1") == pytest.approx(0.00413, abs=2e-5)
    assert fit.sd("zhang", "p1") is None


def opencv_views(folder: Path, camera: str, sub_pixel: SubPixel) -> list[View]:
    board = Board("chessboard", 9, 6, 25.0)
    views = []
    for path in sorted(folder.glob(f"{camera}*.jpg")):
        image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        found = find_board(image, board, sub_pixel=sub_pixel)
        views.append(View(path.stem[-2:], board.points_mm[found.ids], found.pixels_px))
    return views


def opencv_camera(folder: Path, camera: str, sub_pixel: SubPixel) -> Calibrated:
    views = opencv_views(folder, camera, sub_pixel)
    return calibrate_camera(camera, views, (640, 480), model=OPENCV_MODEL, square_pixels=True)


@pytest.mark.parametrize(
    ("sub_pixel", "rms", "focal", "worst", "digit"),
    [
        (SubPixel(11, 30, 0.1), 0.393, 535.92, ("02", 1.18), 0.01),
        (SubPixel(5, 30, 0.1), 0.196, None, (None, 0.254), 0.001),
    ],
    ids=["window 11", "window 5"],
)
def test_opencvs_pictures(
    shared_data: Path,
    sub_pixel: SubPixel,
    rms: float,
    focal: float | None,
    worst: tuple[str | None, float],
    digit: float,
) -> None:
    found = opencv_camera(shared_data / "opencv_stereo_chessboards" / "photos", "left", sub_pixel)
    errors = found.view_rms_px("left")
    name = max(errors, key=lambda view: errors[view])
    assert round(found.fit.rms_px, 3) == rms
    # to the digits given; OpenCV's own solver gives 1.1835 and 0.2549
    assert worst[1] <= errors[name] < worst[1] + digit
    if focal:
        assert (round(found.fit.rig.cameras["left"].fc[0], 2), name) == (focal, worst[0])


@pytest.mark.slow
def test_opencvs_pictures_as_a_pair(shared_data: Path) -> None:
    folder = shared_data / "opencv_stereo_chessboards" / "photos"
    alone = {name: opencv_camera(folder, name, SubPixel(5)) for name in ("left", "right")}
    lenses = ("left", "right")
    joint = join_cameras(alone, joint_lenses=lenses, model=OPENCV_MODEL, square_pixels=True)
    fit = joint.fit
    assert 0.215 <= fit.rms_px <= 0.217
    assert np.linalg.norm(fit.rig.from_reference["right"].T) == pytest.approx(83.2, abs=0.05)
    board, ids = Board("chessboard", 9, 6, 25.0), np.arange(54)
    seen_by = {
        name: {view.name: view.pixels_px for view in opencv_views(folder, name, SubPixel(5))}
        for name in alone
    }
    pairs = [
        PairView(name, ids, left, seen_by["right"][name]) for name, left in seen_by["left"].items()
    ]
    spacing_mm = 25.0 + np.concatenate(
        [view.spacing_mm for view in remeasure(pair_of(joint), board, pairs).views]
    )
    assert spacing_mm.mean() == pytest.approx(25.01, abs=0.005)


@pytest.mark.slow
def test_the_window_that_is_chosen_does_no_worse_than_the_best_fixed_one(shared_data: Path) -> None:
    folder = shared_data / "opencv_stereo_chessboards" / "photos"
    for camera in ("left", "right"):
        chosen, small, large = (
            opencv_camera(folder, camera, SubPixel(px)).fit.rms_px for px in (None, 5, 11)
        )
        assert chosen < small < large


class TestRefusals:
    def test_too_few_views(self) -> None:
        text = "left has 2 usable views of the board, at least 3"
        with pytest.raises(TooFewViewsError, match=text):
            calibrate_camera("left", seen(thesis_rig(), 1)["left"][:2], SIZE)

    def test_views_from_one_side(self) -> None:
        rig, views = thesis_rig(), []
        for number, x in enumerate((-200.0, -100.0, 0.0, 100.0)):
            pose = Motion.from_vectors([0.1, 0.02, 0.0], [x - 160.0, -100.0, 900.0 + x])
            pixels = rig.left.project(pose.apply(BOARD.points_mm))
            views.append(View(str(number), BOARD.points_mm, pixels))
        with pytest.raises(TooFewViewsError, match=r"from one side.*tilt it by 20 to 40 degrees"):
            calibrate_camera("left", views, SIZE)

    def test_cameras_that_share_nothing(self) -> None:
        views = seen(thesis_rig(), 2)
        alone = {
            "left": calibrate_camera("left", views["left"][:12], SIZE),
            "right": calibrate_camera("right", views["right"][12:], SIZE),
        }
        with pytest.raises(TooFewViewsError, match="left and right share 0 views"):
            join_cameras(alone)

    def test_more_parameters_than_corners(self) -> None:
        camera = Camera(SIZE, (1290.0, 1290.0), (680.0, 512.0))
        rig = Rig({"left": camera}, {"left": Motion.identity()})
        few = Sighting("left", 0, BOARD.points_mm[:4], np.zeros((4, 2)))
        with pytest.raises(BundleError, match="4 corners can't fix 15 parameters"):
            adjust(rig, [Motion.identity()], [few], Freedom({"left": frozenset(LENS)}))

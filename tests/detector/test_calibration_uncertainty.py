"""A triangulated point's stated uncertainty is the one that repeated calibrations show."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from detector.calibration import (
    Calibration,
    ParameterCovariance,
    Record,
    dump_calibration,
    load_calibration,
)
from detector.calibration.bundle import POSE
from detector.calibration.cameras import calibrate_camera, join_cameras
from detector.calibration.homographies import fit_homography
from detector.calibration.values import Pair
from detector.geometry import Array, Motion, apply_homography
from tests.detector.boards_seen import TOUCHED, seen, thesis_rig, world_fit

pytestmark = pytest.mark.slow

POINTS = np.array([[-190.0, 235.0, 135.0], [-110.0, 284.0, 134.0], [-300.0, 180.0, 90.0]])


def with_covariance(covariance: ParameterCovariance) -> Calibration:
    rig = thesis_rig()
    board, inputs = 'board "B" of 9 x 6', {"left/01.png": "0" * 64}
    record = Record("2026-11-20", "A. Tester", board, {"left": "SN 1"}, inputs)
    return replace(rig, covariance=covariance, record=record)


@pytest.fixture(scope="module")
def covariance() -> ParameterCovariance:
    """That of one calibration of the pair, with a world of eighteen touched points behind it."""
    rig, views = thesis_rig(), seen(thesis_rig(), 11)
    alone = {name: calibrate_camera(name, views[name], (1360, 1024)) for name in ("left", "right")}
    fit = join_cameras(alone, joint_lenses=("left", "right")).fit
    names = tuple(("stereo", name) if name in POSE else (owner, name) for owner, name in fit.names)
    left, right = rig.project(TOUCHED)
    given = ParameterCovariance(names, fit.covariance)
    pair = rig.left, rig.right, rig.right_from_left
    return world_fit(*pair, left, right, TOUCHED, pair_covariance=given).covariance


def drawn(pair: Pair, covariance: ParameterCovariance, count: int, seed: int) -> list[Pair]:
    """Pairs whose parameters are drawn from the covariance."""
    draws = np.random.default_rng(seed).multivariate_normal(
        np.zeros(len(covariance.names)), covariance.matrix, count, method="eigh"
    )
    pairs = []
    for draw in draws:
        changed = pair
        for (owner, name), step in zip(covariance.names, draw, strict=True):
            changed = changed.moved(owner, name, float(step))
        pairs.append(changed)
    return pairs


def test_it_agrees_with_monte_carlo_within_ten_percent(covariance: ParameterCovariance) -> None:
    rig = with_covariance(covariance)
    left, right = rig.project(POINTS)
    rng = np.random.default_rng(2)
    pairs = drawn(rig, covariance, 1000, 1)
    noises = [rng.normal(0, 0.2, (2, *left.shape)) for _ in pairs]
    shots = np.array(
        [pair.place(left + n[0], right + n[1]) for pair, n in zip(pairs, noises, strict=True)]
    )
    stated = rig.covariance_of(POINTS, pixel_sd_px=0.2)
    for point in range(len(POINTS)):
        seen_sd = np.sqrt(np.linalg.eigvalsh(np.cov(shots[:, point].T)))
        np.testing.assert_allclose(np.sqrt(np.linalg.eigvalsh(stated[point])), seen_sd, rtol=0.1)


def test_errors_cancel_where_points_were_touched(
    covariance: ParameterCovariance,
) -> None:
    apart = covariance.matrix.copy()
    world = np.array([owner == "world" for owner, _ in covariance.names])
    apart[np.ix_(world, ~world)] = apart[np.ix_(~world, world)] = 0.0
    both = covariance, ParameterCovariance(covariance.names, apart)
    together, without = (np.trace(with_covariance(c).covariance_of(POINTS)[0]) for c in both)
    assert together < 0.5 * without


def test_pixels_alone_give_the_depth_of_a_disparity() -> None:
    rig = thesis_rig()
    sd = 0.1
    along = rig.world_from_right.R[:, 2]
    (of_depth,) = rig.covariance_of(POINTS[:1], pixel_sd_px=sd)
    by_formula = np.sqrt(2) * sd * rig.depth_per_disparity_px_mm(POINTS[:1])[0]
    assert np.sqrt(along @ of_depth @ along) == pytest.approx(by_formula, rel=0.05)
    assert np.array_equal(rig.covariance_of(POINTS), np.zeros((3, 3, 3))), "no covariance, no noise"


def test_repeated_calibrations_scatter_as_each_says(covariance: ParameterCovariance) -> None:
    """Boards and touches anew each time: the mean squared normalised error is about 1."""
    rig, squared = thesis_rig(), []
    for seed in range(8):
        rng, views = np.random.default_rng([seed, 5]), seen(rig, 100 + seed)
        alone = {
            name: calibrate_camera(name, views[name], (1360, 1024)) for name in ("left", "right")
        }
        fit = join_cameras(alone, joint_lenses=("left", "right")).fit
        names = tuple(("stereo", n) if n in POSE else (owner, n) for owner, n in fit.names)
        left, right = rig.project(TOUCHED)
        left, right = left + rng.normal(0, 0.1, left.shape), right + rng.normal(0, 0.1, right.shape)
        cameras = fit.rig.cameras["left"], fit.rig.cameras["right"], fit.rig.from_reference["right"]
        given = ParameterCovariance(names, fit.covariance)
        touched = TOUCHED + rng.normal(0, 0.2, TOUCHED.shape)
        world = world_fit(*cameras, left, right, touched, pair_covariance=given)
        stated = Calibration(
            *cameras, world.world_from_right, rig.thermal, None, rig.homographies, world.covariance
        )
        off = stated.place(*rig.project(POINTS[:1]))[0] - POINTS[0]
        squared.append(off @ np.linalg.solve(stated.covariance_of(POINTS[:1])[0], off) / 3)
    # chi-square of 24: its mean is 1, its standard deviation 0.29
    assert 0.4 < np.mean(squared) < 2.0


def uncertainty(parameters: str, rows: str) -> str:
    return f"[uncertainty]\nparameters = [{parameters}]\ncovariance = [{rows}]"


class TestFile:
    def test_round_trip(self, covariance: ParameterCovariance, tmp_path: Path) -> None:
        written = with_covariance(covariance)
        path = tmp_path / "calibration.toml"
        path.write_text(dump_calibration(written), encoding="utf-8")
        read = load_calibration(path)
        assert read.covariance is not None
        assert read.covariance.names == covariance.names
        both = read.covariance_of(POINTS), written.covariance_of(POINTS)
        np.testing.assert_allclose(*both, rtol=1e-3)
        assert read.record == written.record

    @pytest.mark.parametrize(
        ("block", "said"),
        [
            (uncertainty('"left fx"', "[-1.0]"), "not a covariance"),
            (uncertainty('"left fx"', "[1.0], [0.0, 1.0]"), "1 x 1 finite numbers"),
            (uncertainty('"left focus"', "[1.0]"), "no such parameter: left focus"),
            (uncertainty('"left fx", "left fx"', "[1.0], [0.0, 1.0]"), "named twice"),
            (uncertainty('"left fx"', "[1.0, 2.0]"), "lower triangle"),
            (
                '[record]\nmade = "yesterday"\nby = ""\nwith_what = ""\ncameras = {}\ninputs = {}',
                "a day such as",
            ),
        ],
    )
    def test_faults_are_reported(self, tmp_path: Path, block: str, said: str) -> None:
        path = tmp_path / "calibration.toml"
        path.write_text(dump_calibration(thesis_rig()) + "\n" + block + "\n", encoding="utf-8")
        with pytest.raises(ValueError, match=said):
            load_calibration(path)


class TestPairs:
    H = np.array([[0.615, 0.007, 672.8], [-0.004, 0.616, 363.6], [1e-5, -2e-5, 1.0]])

    def pairs(self) -> tuple[Array, Array]:
        rng = np.random.default_rng(3)
        thermal = rng.uniform((0, 0), (640, 480), (40, 2))
        return thermal, apply_homography(self.H, thermal) + rng.normal(0, 0.5, (40, 2))

    def test_outliers_are_listed_and_do_not_count(self) -> None:
        thermal, optical = self.pairs()
        optical[[4, 9]] += 60.0
        found = fit_homography(thermal, optical)
        assert np.flatnonzero(~found.inliers).tolist() == [4, 9]
        assert found.rms_px == pytest.approx(0.5 * np.sqrt(2), rel=0.25)
        assert found.missed_px[4] > 70

    def test_what_determines_none_is_refused(self) -> None:
        thermal, optical = self.pairs()
        with pytest.raises(ValueError, match="at least 6 pairs, got 5"):
            fit_homography(thermal[:5], optical[:5])
        with pytest.raises(ValueError, match="thermal points lie on one line"):
            fit_homography(np.column_stack([np.arange(8.0), np.arange(8.0)]), optical[:8])
        with pytest.raises(ValueError, match="no homography holds"):
            fit_homography(thermal, np.random.default_rng(1).uniform(0, 1000, optical.shape))


def test_a_rotation_near_half_a_turn_keeps_its_covariance() -> None:
    rig = thesis_rig()
    turned = Motion.from_vectors([3.13, 0.01, 0.0], [0.0, 0.0, 0.0])
    left, right = rig.project(TOUCHED)
    touched = turned.apply(rig.world_from_right.inverse().apply(TOUCHED))
    pair = rig.left, rig.right, rig.right_from_left
    fit = world_fit(*pair, left, right, touched, pair_covariance=None)
    assert max(fit.covariance.sd("world", name) or 0.0 for name in POSE[:3]) < 0.01

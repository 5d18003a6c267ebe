"""Rigid, similar and affine fits and their errors, against closed forms and known noise; and
homographies of point pairs.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from detector.calibration import ParameterCovariance
from detector.calibration.homographies import fit_homography
from detector.calibration.rigid import (
    MODELS,
    WorldFit,
    compare,
    cross_matrix,
    fit_points,
    held_out_mm,
    rotation_covariance,
    target_error_mm,
)
from detector.geometry import Array, Motion, apply_homography

CUBE = np.array([[x, y, z] for x in (0.0, 100.0) for y in (0.0, 80.0) for z in (0.0, 60.0)])
SQUARE = np.array(
    [[-100.0, -100.0, 5.0], [100.0, -100.0, 5.0], [100.0, 100.0, 5.0], [-100.0, 100.0, 5.0]]
)
TURNED = Motion.from_vectors((0.2, -0.4, 1.1), (30.0, -70.0, 12.0))


@given(
    st.tuples(*[st.floats(-1.7, 1.7)] * 3),
    st.tuples(*[st.floats(-500, 500)] * 3),
    st.floats(0.5, 2.0),
)
def test_each_model_fits(om: tuple[float, ...], shift: tuple[float, ...], scale: float) -> None:
    motion = Motion.from_vectors(om, shift)
    assert np.allclose(
        fit_points("rigid", motion.apply(CUBE), CUBE).apply(CUBE), motion.apply(CUBE), atol=1e-9
    )
    similar = fit_points("similarity", motion.apply(scale * CUBE), CUBE)
    assert np.allclose(similar.A, scale * motion.R, atol=1e-9)
    bent = np.array([[1.01, 0.02, 0.0], [0.0, 0.99, -0.01], [0.0, 0.0, 1.02]])
    affine = fit_points("affine", motion.apply(CUBE @ bent.T), CUBE)
    assert np.allclose(affine.A, motion.R @ bent, atol=1e-9)
    assert affine.fre_mm < 1e-9


def test_a_mirror_image_is_no_rigid_fit() -> None:
    mirrored = CUBE * [1.0, 1.0, -1.0]
    fit = fit_points("rigid", mirrored, CUBE)
    assert np.linalg.det(fit.A) == pytest.approx(1.0)
    assert fit.fre_mm > 10.0
    assert np.allclose(fit.A @ fit.A.T, np.eye(3))


def test_points_in_a_plane_are_fitted_in_their_plane() -> None:
    bent = np.array([[1.02, 0.03, 0.0], [0.0, 0.97, 0.0], [0.0, 0.0, 1.0]])
    affine = fit_points("affine", TURNED.apply(SQUARE @ bent.T), SQUARE)
    assert affine.fre_mm < 1e-9
    assert np.allclose(affine.A[:, :2], (TURNED.R @ bent)[:, :2])
    assert np.linalg.det(affine.A) > 0.0
    assert np.allclose(affine.A[:, 2], TURNED.R[:, 2])


def test_the_thesis_s_unconstrained_fit_shows_by_its_singular_values() -> None:
    stretched = CUBE * [1.0, 0.99, 0.92]  # metrology.md: 1.000, 0.990, 0.920
    found = compare(TURNED.apply(stretched), CUBE)
    assert found.affine.singular_values == pytest.approx([1.0, 0.99, 0.92])
    assert found.affine.fre_mm < 1e-9 < found.similarity.fre_mm < found.rigid.fre_mm
    assert found.rigid.singular_values == pytest.approx([1.0, 1.0, 1.0])


def test_held_out_points_tell_more_than_residuals() -> None:
    rng = np.random.default_rng(1)
    found = compare(TURNED.apply(CUBE) + rng.normal(0.0, 0.5, CUBE.shape), CUBE)
    assert found.affine.fre_mm < found.rigid.fre_mm
    held = found.held_out_mm
    assert held["affine"] is not None
    assert held["rigid"] is not None
    assert held["affine"] > found.affine.fre_mm
    assert held["affine"] > held["rigid"], "freedom that isn't needed costs"


def test_three_points_hold_none_out() -> None:
    assert np.isnan(held_out_mm("rigid", SQUARE[:3], SQUARE[:3])).all()
    assert compare(SQUARE[:3], SQUARE[:3]).held_out_mm["rigid"] is None


@pytest.mark.parametrize("model", MODELS)
def test_points_that_determine_no_fit_are_refused(model: str) -> None:
    line = np.linspace(0, 1, 5)[:, None] * [[100.0, 20.0, 0.0]]
    with pytest.raises(ValueError, match="line"):
        fit_points(model, line, line)
    with pytest.raises(ValueError, match="line"):
        rotation_covariance(line, 0.1)
    with pytest.raises(ValueError, match="at least 3 points, has 2"):
        target_error_mm(0.2, line[:2], line)


def test_fiducial_error_is_what_the_formula_says() -> None:
    rng, sd, none = np.random.default_rng(2), 0.2, ParameterCovariance((), np.zeros((0, 0)))
    noisy = [TURNED.apply(CUBE) + rng.normal(0.0, sd, CUBE.shape) for _ in range(600)]
    fre_mm = np.sqrt(np.mean([fit_points("rigid", one, CUBE).fre_mm ** 2 for one in noisy]))
    assert fre_mm == pytest.approx(sd * 3**0.5 * np.sqrt(1.0 - 2.0 / len(CUBE)), rel=0.03)
    found = compare(noisy[0], CUBE)
    world = WorldFit(TURNED, found, none, CUBE, noisy[0])
    by_fle = target_error_mm(sd * 3**0.5, noisy[0], CUBE) * found.rigid.fre_mm / fre_mm
    assert world.target_error_mm(CUBE) == pytest.approx(by_fle, rel=0.03)


def test_target_error_is_what_the_formula_says() -> None:
    rng = np.random.default_rng(3)
    at = np.array([250.0, -40.0, 90.0])
    missed = []
    for _ in range(1000):
        fit = fit_points("rigid", TURNED.apply(SQUARE) + rng.normal(0.0, 0.2, SQUARE.shape), SQUARE)
        missed.append(TURNED.R.T @ (fit.apply(at) - TURNED.apply(at)))
    formula = target_error_mm(0.2 * 3**0.5, SQUARE, at)[0]
    arm = cross_matrix(at - SQUARE.mean(axis=0))
    turned = arm @ rotation_covariance(SQUARE, 0.2) @ arm.T
    covariance = 0.2**2 / len(SQUARE) * np.eye(3) + turned
    assert np.sqrt(np.mean(np.sum(np.square(missed), axis=1))) == pytest.approx(formula, rel=0.04)
    assert np.trace(covariance) == pytest.approx(formula**2, rel=1e-9), (
        "both are the same first-order error"
    )
    assert np.allclose(np.cov(np.transpose(missed)), covariance, atol=0.1 * np.trace(covariance))


class TestHomographies:
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

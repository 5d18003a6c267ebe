"""What makes an end unsure: terms of one variance, with learned factors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.rig.loading import find_rig, load_rig
from bench.rig.scenes import rig_renderer
from detector.calibration import ParameterCovariance
from detector.external.serve import Pictures
from detector.fused.covariances import TERMS, stated, variance_terms
from detector.fused.decide import Fits
from detector.fused.detector import FusedDetector
from detector.fused.evidence import Evidence
from detector.fused.learned import learned
from detector.outline.prior import Prior, world_from_teats
from tests.detector.fused.difficult import rendered

Array = NDArray[np.float64]


def test_each_term_has_a_factor_that_counts() -> None:
    assert list(learned().factors) == list(TERMS)
    assert min(learned().factors.values()) > 0


def test_other_fits_of_a_place_count_the_more_the_less_likely_it_is() -> None:
    """The same scatter of fits beside an end that is beyond doubt, and beside one that isn't."""
    rig = load_rig(find_rig(None))
    exact = replace(rig.calibration, covariance=ParameterCovariance((), np.zeros((0, 0))))
    scene = rendered(rig_renderer(rig, 1), "ideal", 1, 100)
    answer = FusedDetector().detect(Pictures(scene.left, scene.right, None, scene.thermal_k), exact)
    given, decisions = answer.stage("answers"), answer.stage("decisions")
    assert given is not None
    assert decisions is not None
    rows = given.data["rows"]
    evidence = Evidence(*(decisions.data[name] for name in Evidence.__slots__)).take(rows)
    fits = Fits(given.data["teats"], evidence, Prior())
    own = given.data["terms"][:, list(TERMS).index("edges")]

    def sd_mm(scatter_mm: float, odds: float) -> Array:
        between = np.tile(scatter_mm**2 * np.eye(3), (len(rows), 1, 1))
        terms = variance_terms(own, between, np.full(len(rows), odds), fits, exact)
        return np.asarray(np.sqrt(np.linalg.eigvalsh(stated(terms, learned()))[:, -1]))

    alone, sure, doubtful = sd_mm(0.0, 7.0), sd_mm(2.0, 7.0), sd_mm(2.0, 0.0)
    assert (alone < sure).all()
    assert (sure < 0.5).all()  # of 2 mm, which was added whole
    assert (doubtful > 2.0).all()
    # as it is answered
    turned = world_from_teats(exact).R
    rest = given.data["rest"] + stated(given.data["terms"], learned())
    for teat, one in zip(answer.teats, turned @ rest @ turned.T, strict=True):
        assert teat.covariance_mm2 == pytest.approx(one)

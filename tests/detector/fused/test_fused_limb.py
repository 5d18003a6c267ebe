"""The fall of brightness towards a limb, shared between pictures and along an outline."""

from __future__ import annotations

import numpy as np

from detector.fused.edges import own_share, shared_limb


def test_what_outlines_share_is_the_mean_over_views_and_neighbours() -> None:
    own = np.stack([np.full((1, 40), 0.10), np.full((1, 40), 0.30)])
    assert np.allclose(shared_limb(own), 0.20)


def test_what_isnt_known_counts_for_nothing() -> None:
    own = np.full((2, 1, 40), 0.2)
    own[1] = np.nan
    own[0, 0, 10:14] = np.nan
    assert np.allclose(shared_limb(own), 0.2)
    assert np.allclose(shared_limb(np.full((2, 1, 40), np.nan)), 0.0)


def test_noise_of_single_lines_averages_out() -> None:
    own = 0.1 + np.random.default_rng(2).normal(0.0, 0.1, (2, 50, 80))
    assert np.std(shared_limb(own)[:, 5:-5]) < 0.1 / np.sqrt(2 * 9) * 1.1


def test_a_lines_own_counts_the_more_the_larger_the_fall_and_the_less_the_noise() -> None:
    shared, quiet = np.array([0.0, 0.05, 0.2, 0.6]), np.zeros(4)
    share = own_share(shared, quiet)
    assert share[0] < 0.15
    assert share[-1] > 0.9
    assert (np.diff(share) > 0).all()
    assert (own_share(shared, np.full(4, 0.2)) < share).all()

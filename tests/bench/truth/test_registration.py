"""Where the stage's axes lie: errors that are put in are found again, within what is stated; what
can't be fitted is refused.
"""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest
import scipy

from bench.config import ConfigError
from bench.truth.registration import (
    Registration,
    RegistrationError,
    as_facts,
    load_registration,
    registration_from_facts,
    registration_text,
    write_registration,
)
from bench.truth.stage_registration import around
from detector.geometry import Motion
from instruments.world.phantom import PlatePose
from tests.bench.truth.touches import (
    CORNERS_MM,
    MADE,
    U_MM,
    TrueStage,
    axes_turned,
    registered,
    stage_of,
)

SEEDS = 200
# of 200 honest figures no more lie beyond 2 u, but once in ten thousand
MOST = int(scipy.stats.binom.ppf(0.9999, SEEDS, 0.0455))
TILTED_MM = np.vstack([CORNERS_MM, CORNERS_MM + np.array([0.0, 0.0, -60.0])])


@pytest.mark.slow
@pytest.mark.parametrize("at_mm", [CORNERS_MM, TILTED_MM], ids=["flat", "with heights"])
def test_scale_squareness_and_rotation_are_found_again_within_twice_their_uncertainty(
    at_mm: np.ndarray,
) -> None:
    beyond: dict[str, int] = {}
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        stage = stage_of(rng, scale=3e-3, squareness=3e-3)
        found = registered(stage, rng, at_mm=at_mm)
        E = stage.E
        put_in = (E[0, 0], E[1, 1], -E[0, 1], E[2, 2], -E[0, 2], -E[1, 2])
        for one, value in zip(found.diagnostics, put_in, strict=False):
            beyond[one.name] = beyond.get(one.name, 0) + (abs(one.value - value) > 2.0 * one.u)
        turned, covariance = axes_turned(found)
        off = Motion(stage.R.T @ turned.R, np.zeros(3)).om
        for name, angle, u in zip("xyz", off, np.sqrt(np.diag(covariance)), strict=True):
            beyond[f"rotation {name}"] = beyond.get(f"rotation {name}", 0) + bool(
                abs(angle) > 2.0 * u
            )
    assert len(beyond) == (6 if at_mm is CORNERS_MM else 9)
    assert all(1 <= count <= MOST for count in beyond.values()), (
        f"of {SEEDS}, beyond 2 u: {beyond}; at most {MOST} of each"
    )


def test_a_perfect_stage_is_fitted_rigidly_and_nothing_is_said_against_it() -> None:
    rng = np.random.default_rng(5)
    stage = stage_of(rng)
    found = registered(stage, rng, u_mm=1e-6)
    assert np.allclose(found.world_from_stage.R, stage.R, atol=1e-7)
    assert found.faults == ()


@pytest.mark.slow
def test_residuals_are_what_the_formula_expects() -> None:
    fre = []
    for seed in range(150):
        rng = np.random.default_rng([3, seed])
        found = registered(stage_of(rng), rng)
        fre.append(found.comparison.rigid.fre_mm**2)
    assert np.sqrt(np.mean(fre)) == pytest.approx(found.expected_fre_mm, rel=0.06)


def test_a_crooked_stage_is_reported_with_what_to_do() -> None:
    rng = np.random.default_rng(1)
    found = registered(TrueStage(np.eye(3), np.diag([0.012, 0.0, 0.0])), rng)
    assert found.contradicted
    (note,) = found.faults
    assert "scale x +9.69e-03 (u 1.9e-03)" in note
    assert "steps per mm" in note


def test_touches_that_scatter_more_than_stated_say_so_and_count_for_less() -> None:
    found = registered(
        stage_of(np.random.default_rng(2)), np.random.default_rng(2), at_mm=TILTED_MM, u_mm=0.9
    )
    claimed = replace(found, stations=tuple(replace(s, u_mm=0.3) for s in found.stations))
    assert claimed.stated_u_mm == pytest.approx(0.3)
    assert claimed.u_mm > 0.5
    assert "scatter more" in claimed.faults[-1]


def test_target_error_grows_away_from_the_touched_places() -> None:
    found = registered(stage_of(np.random.default_rng(4)), np.random.default_rng(4))
    near, far = (found.target_error_mm((-150.0 + x, -137.5, -1.0)) for x in (0.0, 300.0))
    assert near == pytest.approx(np.sqrt(3.0) * U_MM / np.sqrt(5.0), rel=0.01)
    assert far > 2.0 * near


@pytest.mark.parametrize(
    ("at_mm", "why"),
    [
        (CORNERS_MM[:2], "three or more"),
        (CORNERS_MM[-1] + 0.1 * (CORNERS_MM - CORNERS_MM[-1]), "near together"),
        (CORNERS_MM[[0, 2, 4]], "line"),
    ],
)
def test_too_few_too_near_and_in_line_are_refused(at_mm: np.ndarray, why: str) -> None:
    rng = np.random.default_rng(6)
    with pytest.raises(RegistrationError, match=why):
        registered(stage_of(rng), rng, at_mm=at_mm)


def test_another_teat_among_the_touches_is_refused() -> None:
    found = registered(stage_of(np.random.default_rng(7)), np.random.default_rng(7))
    first, second, third, *others = found.stations
    x, y, z = third.touched_mm
    wrong = replace(third, touched_mm=(x - 50.0, y - 90.0, z))
    with pytest.raises(RegistrationError, match=r"position 3 of 5.*another teat"):
        replace(found, stations=(first, second, wrong, *others))


def test_it_holds_in_the_world_that_it_was_made_in() -> None:
    found = registered(stage_of(np.random.default_rng(8)), np.random.default_rng(8))
    assert found.outdated("40937", None) == ""
    assert found.outdated("40937", MADE - timedelta(days=1)) == ""
    assert "arm that answers is 1" in found.outdated("1", None)
    assert "before the arm's table frame" in found.outdated("40937", MADE + timedelta(days=1))


def test_the_places_to_touch_span_what_the_script_uses() -> None:
    poses = around([PlatePose(-60.0, 0.0), PlatePose(90.0, 40.0)])
    corners = [(-60.0, -55.0), (90.0, -55.0), (90.0, 95.0), (-60.0, 95.0)]
    assert [(p.x_mm, p.y_mm) for p in poses] == [*corners, (15.0, 20.0)]


def test_the_file_reads_back_and_the_record_too(tmp_path: Path) -> None:
    found = registered(stage_of(np.random.default_rng(8), scale=1e-3), np.random.default_rng(8))
    write_registration(tmp_path / "stage.toml", found)
    for again in (
        load_registration(tmp_path / "stage.toml"),
        registration_from_facts(as_facts(found)),
    ):
        assert isinstance(again, Registration)
        assert again.stations == found.stations
        assert (again.made, again.teat, again.stated) == (found.made, found.teat, found.stated)
        assert registration_text(again) == registration_text(found)
    assert registration_from_facts({}) is None


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("teat = 1", "teat = 0", "teat"),
        ("u_mm = 0.28", "u_mm = 0.1", "changed by hand"),
        ("om = [", "om = [0.01, 0.0, 0.0]\n#", "changed by hand"),
        ("scale_u", "scale", "did you mean"),
    ],
)
def test_a_file_that_was_changed_is_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    found = registered(stage_of(np.random.default_rng(9)), np.random.default_rng(9))
    text = registration_text(found)
    assert old in text
    (tmp_path / "stage.toml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigError, match=said):
        load_registration(tmp_path / "stage.toml")


def test_a_file_whose_touches_make_no_registration_is_refused(tmp_path: Path) -> None:
    found = registered(stage_of(np.random.default_rng(9)), np.random.default_rng(9))
    text, (near, *others) = registration_text(found), found.stations
    for one in others:
        text = text.replace(f"stage_mm = {list(one.stage_mm)}", f"stage_mm = {list(near.stage_mm)}")
    (tmp_path / "stage.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match="near together"):
        load_registration(tmp_path / "stage.toml")

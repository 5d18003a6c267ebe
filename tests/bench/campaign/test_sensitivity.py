"""The sensitivity study: counts and distances at each value, their files, each quantity's scenes,
docs/scene.md; and the physical limits against simulated edges, closed forms of stereo, the
sensor's model, and their own scaling.
"""

from __future__ import annotations

import csv
import re
import shlex
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.special import erf

from bench.campaign import limits, quantities
from bench.campaign.chunk import Scene, run_scene
from bench.campaign.limits import Limit, Outline, limit_at, outline_of, shifts_mm
from bench.campaign.quantities import QUANTITIES, Optics, Varied, chosen
from bench.campaign.sensitivity import Measured, Study, Tally, measured, opened
from bench.campaign.shards import query
from bench.campaign.worker import attempt
from bench.cli.main import parser
from bench.config import ConfigError
from bench.report.sensitivity import COLUMNS, PAGE, POINTS, figure_of, write_figure, write_numbers
from bench.rig.loading import RIGS, LoadedRig
from bench.rig.scenes import warm
from detector.calibration import Calibration, ParameterCovariance, load_calibration
from detector.registry import available
from instruments.world.scene import Renderer
from instruments.world.sensor import OpticalSensor
from instruments.world.setups import EYES_MM, collisions
from instruments.world.situations import situation
from instruments.world.solids import clearance_mm
from instruments.world.state import SceneState
from instruments.world.thermal_camera import ThermalSensor
from reports.trust import svg_facts
from tests.bench.campaign.small_campaign import Knowing, small_bench
from tests.bench.commands import Said
from tests.conftest import ROOT

LIMIT = Limit(0.01, 0.03, 0.2, None)


@pytest.mark.slow
def test_a_quantity_at_a_value_is_a_family_of_scenes(small_rig: LoadedRig) -> None:
    ends = situation("ideal", 0).phantom.ends_mm
    right = Knowing([*ends[:3], ends[0] + [0.0, 300.0, 0.0]], error_mm=0.5)
    bench = small_bench(small_rig, right, Knowing([], breaks=True, name="failing"))
    none, _ = (run_scene(bench, Scene(f"calibration={size}", 0)) for size in ("0", "0.5"))
    good, failing = none.scenes
    assert (good.visible, good.found, good.false_teats, failing.failure) == (4, 3, 1, "failure")
    assert good.max_mm == pytest.approx(0.5)
    assert right.note[0].left == bench.calibration.left
    assert right.note[1].left != bench.calibration.left


@pytest.mark.slow
def test_the_limit_grows_with_the_errors_of_the_calibration(
    renderer: Renderer, calibration: Calibration
) -> None:
    for size, least_mm, most_mm in ((0.0, 0.0, 0.1), (0.5, 0.1, 2.0)):
        at = Varied(QUANTITIES["calibration"], size)
        visible, limit = limit_at(at, [0], renderer, 1, calibration)
        assert (visible, limit is not None and limit.share is None) == (4, True)
        assert limit is not None
        assert least_mm < limit.median_mm < limit.p95_mm < most_mm


@pytest.mark.slow
def test_a_thermal_quantity_has_the_share_that_can_be_nominated_beside_it(
    small_rig: LoadedRig,
) -> None:
    bench = small_bench(small_rig)
    for netd_k, share in ((0.05, 1.0), (400.0, 0.0)):
        at = Varied(QUANTITIES["netd"], netd_k)
        assert at.renderer(bench.renderer, 1) is at.renderer(bench.renderer, 1)
        limit = limit_at(at, [1], bench.renderer, 1, bench.calibration)[1]
        assert limit is not None
        assert limit.share == pytest.approx(share, abs=0.01)


@pytest.mark.slow
def test_the_command_writes_the_same_figures_and_numbers_each_time(
    tmp_path: Path, said: Said
) -> None:
    command = (
        "scene sensitivity --quantity overlap --detector thesis --seeds 1 --first 2 --workers 1"
    )
    command += " --out {}"
    other = said(0, command.replace("overlap", "range"), tmp_path / "one").out
    assert "range 1: found of " in other
    (tmp_path / "one" / "range.svg").unlink()
    texts = []
    for _ in ("in place of another", "done already"):
        assert "overlap 0.2: found of " in said(0, command, tmp_path / "one").out
        names = sorted(path.name for path in (tmp_path / "one").iterdir())
        assert names == ["campaign", "measured.md", "overlap.svg", "points.csv"]
        texts.append([(tmp_path / "one" / name).read_bytes() for name in names[1:]])
    assert texts[0] == texts[1]
    asked = "SELECT DISTINCT family FROM scenes ORDER BY ALL"
    families = [row[0] for row in query(tmp_path / "one" / "campaign", asked)[1]]
    assert sorted(families) == sorted(Study.names([QUANTITIES["overlap"]]))
    with (tmp_path / "one" / "points.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["value"]) for row in rows] == list(QUANTITIES["overlap"].values)
    assert all(int(row["found"]) <= int(row["visible"]) <= 4 for row in rows)
    page = (tmp_path / "one" / "measured.md").read_text(encoding="utf-8")
    assert "thesis (version 1); cameras of `emulated.toml`; members 2 to 2" in page


def test_what_was_not_measured_is_said_so(tmp_path: Path) -> None:
    quantity = QUANTITIES["netd"]
    nothing = Measured(0.05, 0, {"a": Tally(), "b": Tally()}, None)
    tallies = {"a": Tally((0.3,), 0, 1), "b": Tally()}
    failed = Measured(0.2, 8, tallies, replace(LIMIT, share=1.0))
    write_numbers(tmp_path, [quantity], {"netd": [nothing, failed]}, "Made with nothing.")
    page = (tmp_path / "measured.md").read_text(encoding="utf-8")
    none = "0 of 0 | 0 | not measured"
    assert f"| 0.05 | {none} | {none} | not measured | not measured |" in page
    one = "1 of 8 (without an answer on 1) | 0 | 0.30, 0.30"
    assert f"| 0.2 | {one} | 0 of 8 | 0 | not measured | 0.010, 0.030 | 100 % |" in page
    assert (tmp_path / "points.csv").read_text(encoding="utf-8").startswith(",".join(COLUMNS))
    assert "not measured" in figure_of(quantity, [nothing])


@pytest.mark.slow
def test_a_figure_stands_alone_on_paper_of_its_own(tmp_path: Path) -> None:
    points = [
        Measured(value, 4, {"a": Tally((0.2, 0.4)), "b": Tally((2.0,), 1)}, LIMIT)
        for value in QUANTITIES["tilt"].values
    ]
    text = write_figure(tmp_path, QUANTITIES["tilt"], points).read_text(encoding="utf-8")
    assert text.startswith("<svg ")
    assert 'font-family="system-ui, sans-serif"><rect width="100%"' in text
    assert "lean (degrees)" in text
    assert svg_facts(figure_of(QUANTITIES["tilt"], points), "tilt").ids is not None


SIX = " ".join(f"--detector {name}" for name in (*available([]), "{}", "{}"))


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ("--quantity contrats", 'did you mean "contrast"'),
        ("--detector thesys", "thesys"),
        ("--rig no-such-rig", "no-such-rig"),
        ("--seeds 0", "'0' is not a whole number of 1 or more"),
        (SIX, "a figure shows 4 detectors at most, 6 are asked for: thesis, fused,"),
    ],
)
def test_wrong_use_is_explained(arguments: str, why: str, tmp_path: Path, said: Said) -> None:
    programs = [tmp_path / f"program-{number}" for number in range(arguments.count("{}"))]
    for program in programs:
        program.touch(0o755)
    named = [f"exec:{program}" for program in programs]
    wrong = said(2, f"scene sensitivity {arguments} --out {{}}", *named, tmp_path / "out")
    assert why in wrong.err
    assert wrong.out == ""


@pytest.mark.slow
def test_a_scene_that_cannot_stand_before_the_cameras_is_reported(tmp_path: Path) -> None:
    quantity = replace(QUANTITIES["range"], values=(3.0,))
    plan = Study(families=Study.names([quantity]), scenes=1, detectors=("thesis",))
    campaign = opened(plan, tmp_path)
    campaign.begin()
    bench = campaign.job.bench(campaign.job.renderer(), campaign.job.make_detectors())
    for chunk in plan.chunks():
        campaign.shards.write(chunk.family, chunk.number, attempt(bench, chunk.scenes[0]))
    why = "range 3 can't be set up for member 0: .* stands behind the board .*; choose others by"
    with pytest.raises(ConfigError, match=f"{why} --first"):
        list(measured(campaign, quantity))
    with pytest.raises(ValidationError, match="a quantity and its value are wanted, not ideal"):
        Study(families=("ideal",))


def test_a_place_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    with pytest.raises(ConfigError, match="can't be written"):
        write_figure(tmp_path / "file", QUANTITIES["range"], [Measured(1.0, 4, {}, LIMIT)])


MEMBERS = range(3)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer.from_calibration(
        tomllib.loads((RIGS / "calibration.toml").read_text(encoding="utf-8")), 1
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", QUANTITIES)
def test_every_scene_can_be_set_up_is_seen_and_comes_again(name: str, renderer: Renderer) -> None:
    quantity = QUANTITIES[name]
    assert list(quantity.values) == sorted(quantity.values)
    for value in quantity.values:
        for member in MEMBERS:
            found = quantity.set_up(value, member, renderer)
            assert found == quantity.set_up(value, member, renderer)
            assert not list(collisions(found))
            assert renderer.visible_ends(warm(found)).all(axis=1).sum() >= 2


def test_the_range_is_the_mean_depth_of_the_ends(renderer: Renderer) -> None:
    for range_m in QUANTITIES["range"].values:
        found = quantities.at_range(range_m, 2, renderer)
        depth = renderer.cameras[1].camera_from_world(found.phantom.ends_mm)[:, 2]
        assert depth.mean() == pytest.approx(1e3 * range_m, abs=0.5)
        assert found.phantom.teats == situation("ideal", 2).phantom.teats


def test_the_contrast_is_that_of_the_picture(renderer: Renderer) -> None:
    """Grey levels in the middle of a teat's side and of the board beside it, without noise."""
    for contrast in (0.03, 0.25, 0.85):
        state = warm(quantities.of_contrast(contrast, 1, renderer))
        picture = renderer.left.expected(state, renderer.shadows(state))
        teat = state.phantom.ends_mm[0] - 40.0 * state.phantom.axes[0]
        x, y = np.rint(renderer.cameras[0].project(teat[None])[0]).astype(int)
        left, inside, right = (
            picture[y - 5 : y + 6, at - 2 : at + 3].mean() - renderer.left.readout.sensor.offset_dn
            for at in (x - 20, x, x + 20)
        )
        outside = 0.5 * (left + right)
        assert 1.0 - inside / outside == pytest.approx(contrast, abs=0.02)
        assert 120.0 < outside < 235.0


def test_all_teats_lean_by_the_angle_said(renderer: Renderer) -> None:
    for lean_deg in (0.0, 10.0, 22.0):
        axes = quantities.leaning(lean_deg, 0, renderer).phantom.axes
        lean = np.degrees(np.arccos(np.clip(axes[:, 2], -1.0, 1.0)))
        assert lean == pytest.approx(lean_deg, abs=1e-4)


def test_the_far_teat_is_covered_by_the_share_said(renderer: Renderer) -> None:
    for share in (-0.4, 0.2, 0.5):
        phantom = quantities.overlapping(share, 1, renderer).phantom
        for near, far in ((0, 2), (1, 3)):
            left, right = [], []
            for teat in (near, far):
                away = phantom.ends_mm[teat] - np.asarray(EYES_MM[2])
                radius = phantom.teats[teat].shape.radius_mm / away[1]
                left.append(away[0] / away[1] - radius)
                right.append(away[0] / away[1] + radius)
            covered = min(right) - max(left)
            assert covered / (right[1] - left[1]) == pytest.approx(share, abs=1e-6)
            assert phantom.ends_mm[far, 1] - phantom.ends_mm[near, 1] == pytest.approx(
                quantities.BEHIND_MM
            )


@pytest.mark.parametrize("gap_mm", [10.0, 100.0])
@pytest.mark.parametrize("member", [0, 1])
def test_the_arm_is_as_far_behind_the_teats_as_said(
    gap_mm: float, member: int, renderer: Renderer
) -> None:
    found = quantities.before_arm(gap_mm, member, renderer)
    (arm,) = found.objects
    teats = [hull for (hull,) in found.phantom.teat_hulls()]
    nearest = min(hull.a_mm[1] - max(hull.radius_a_mm, hull.radius_b_mm) for hull in arm.hulls)
    farthest = max(hull.b_mm[1] + hull.radius_b_mm for hull in teats)
    assert nearest - farthest == pytest.approx(gap_mm, abs=1e-6)
    clear = min(clearance_mm(hull, teat) for hull in arm.hulls for teat in teats)
    assert clear >= gap_mm - 1e-6


def test_sensors_get_the_noise_said() -> None:
    usual = Optics(OpticalSensor(), ThermalSensor())
    noisy = QUANTITIES["pixel-noise"].optics(8.0, usual)
    assert noisy.optical.read_noise_e * noisy.optical.gain_dn_per_e == pytest.approx(8.0)
    assert noisy.thermal == usual.thermal
    assert QUANTITIES["netd"].optics(2.0, usual).thermal.netd_k == 2.0
    assert QUANTITIES["netd"].optics(2.0, usual).optical == usual.optical
    assert QUANTITIES["tilt"].optics(2.0, usual) is usual


def test_quantities_are_chosen_by_name() -> None:
    assert chosen([]) == tuple(QUANTITIES.values())
    assert [one.name for one in chosen(["netd", "tilt", "netd"])] == ["netd", "tilt"]
    why = r"no quantity 'contrats'; did you mean \"contrast\"\? \(known: pixel-noise"
    with pytest.raises(ConfigError, match=why):
        chosen(["contrats"])


DOCS = ROOT / "docs"
TEXT = (DOCS / "scene.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_every_quantity_has_its_figure() -> None:
    page = (DOCS / "sensitivity" / PAGE).read_text(encoding="utf-8")
    assert re.findall(r"\]\(([a-z-]+)\.svg\)", page) == list(QUANTITIES)
    for name, quantity in QUANTITIES.items():
        figure = (DOCS / "sensitivity" / f"{name}.svg").read_text(encoding="utf-8")
        assert quantity.label in figure.replace("&#39;", "'").replace("&apos;", "'")
    assert f"(sensitivity/{PAGE})" in TEXT


def points() -> list[dict[str, str]]:
    with (DOCS / "sensitivity" / POINTS).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_its_command_made_what_lies_beside_it() -> None:
    (command,) = re.findall(r"^teatbench (scene sensitivity .*)$", TEXT, flags=re.MULTILINE)
    given = parser().parse_args(shlex.split(command))
    rows = points()
    assert tuple(rows[0]) == COLUMNS
    assert {row["detector"] for row in rows} == set(given.detector)
    for name, quantity in QUANTITIES.items():
        values = {float(row["value"]) for row in rows if row["quantity"] == name}
        assert sorted(values) == list(quantity.values)
    assert max(int(row["visible"]) for row in rows) == 4 * given.seeds
    page = (DOCS / "sensitivity" / PAGE).read_text(encoding="utf-8")
    assert f"members 0 to {given.seeds - 1} of `ideal`" in page
    for row in rows:  # beside what physics allows
        assert min(float(row["limit_median_mm"]), float(row["disparity_mm"])) > 0.0
        assert bool(row["limit_share"]) == (row["quantity"] == "netd")


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return load_calibration(RIGS / "calibration.toml")


@pytest.fixture(scope="module")
def state() -> SceneState:
    return warm(situation("ideal", 3))


def test_no_estimate_of_an_edge_scatters_less_than_its_information_says() -> None:
    """Edges drawn pixel by pixel, their place estimated by matching the true profile: the scatter
    is the bound, within its own error.
    """
    sigma_px, contrast, noise, rows, trials = 0.9, 80.0, 4.0, 12, 3000
    rng = np.random.default_rng(5)
    x = np.arange(-10.0, 11.0)
    profile = 0.5 * contrast * (1.0 + erf(x / (np.sqrt(2.0) * sigma_px)))
    slope = -contrast / (np.sqrt(2.0 * np.pi) * sigma_px) * np.exp(-(x**2) / (2.0 * sigma_px**2))
    seen = profile + noise / np.sqrt(rows) * rng.standard_normal((trials, len(x)))
    estimated = (seen - profile) @ slope / (slope @ slope)
    outline = Outline(
        np.tile([1.0, 0.0], (rows, 1)),
        np.ones(rows),
        np.zeros(rows),
        np.full(rows, contrast),
        np.zeros(rows),
    )
    information = limits.edge_information(outline, sigma_px, np.full(rows, noise))
    assert estimated.std() == pytest.approx(information[0, 0] ** -0.5, rel=0.05)
    assert information[1, 1] == 0.0


def test_noise_is_that_of_the_sensors_own_frames() -> None:
    sensor = replace(OpticalSensor(), prnu=0.0, dsnu_e=0.0, read_noise_e=60.0)
    k, units = sensor.gain_dn_per_e, np.random.default_rng(2).standard_normal(200_000)
    grey = sensor.offset_dn + 6500.0 * k
    drawn = np.rint(grey + k * np.sqrt(6500.0 + 60.0**2) * units)
    once, twice = (limits.noise_dn(sensor, np.array([grey]), gain)[0] for gain in (1.0, 2.0))
    assert once == pytest.approx(drawn.std(), rel=0.01)
    assert twice < 2.0 * once


def test_an_outline_lies_where_the_picture_changes(renderer: Renderer, state: SceneState) -> None:
    """Dark teats before a light board: inside is dark and outside light, all along the upper part."""
    found = replace(
        state,
        teat_paint=replace(state.teat_paint, albedo=0.05),
        backdrop=replace(state.backdrop, board_albedo=0.6),
    )
    picture = renderer.left.expected(found, renderer.shadows(found))
    outline = outline_of(found.phantom, 0, renderer.cameras[0], picture)
    top = outline.below_mm < 50.0
    assert np.count_nonzero(top) > 100
    assert (outline.outside[top] > 2.0 * outline.inside[top]).all()
    assert np.linalg.norm(outline.normal, axis=1) == pytest.approx(1.0)
    # the top of the end faces up in the picture
    assert outline.normal[outline.below_mm == 0.0][:, 1].min() < -0.99
    px_a_mm = 1290.0 / renderer.cameras[0].camera_from_world(found.phantom.ends_mm[:1])[0, 2]
    shape = found.phantom.teats[0].shape
    long_mm = 2.0 * (shape.length_mm - shape.radius_mm - 8.0) + np.pi * shape.radius_mm
    assert outline.length_px.sum() == pytest.approx(long_mm * px_a_mm, rel=0.05)


def test_the_limit_is_the_disparitys_noise_times_z_squared_over_f_b(
    renderer: Renderer, state: SceneState, calibration: Calibration
) -> None:
    covariance = limits.end_covariances(renderer, state, [1])[0]
    end, shadows = state.phantom.ends_mm[1], renderer.shadows(state)
    variance = 0.0
    for eye, camera in zip((renderer.left, renderer.right), renderer.cameras[:2], strict=True):
        sensor = eye.readout.sensor
        outline = outline_of(state.phantom, 1, camera, eye.expected(state, shadows))
        noise = limits.noise_dn(sensor, 0.5 * (outline.inside + outline.outside), 1.0)
        depth = float(camera.camera_from_world(end[None])[0, 2])
        sigma_px = limits.edge_sigma_px(sensor, depth, float(camera.fc.mean()))
        variance += 1.0 / limits.edge_information(outline, sigma_px, noise)[0, 0]
    along = calibration.world_from_right.R[:, 2]
    per_px = float(calibration.depth_per_disparity_px_mm(end)[0])
    assert np.sqrt(along @ covariance @ along) == pytest.approx(per_px * variance**0.5, rel=0.03)


def test_quantiles_are_those_of_a_shifted_normal_distribution() -> None:
    one_axis = np.diag([1e-12, 1e-12, 4.0])[None]
    median, p95 = limits.error_quantiles_mm(one_axis, np.zeros((1, 3)), (0.5, 0.95))
    assert median == pytest.approx(2.0 * 0.6745, rel=0.05)
    assert p95 == pytest.approx(2.0 * 1.96, rel=0.05)
    shifted = limits.error_quantiles_mm(
        1e-12 * np.eye(3)[None], np.array([[3.0, 4.0, 0.0]]), (0.5,)
    )
    assert shifted[0] == pytest.approx(5.0, abs=1e-4)


@pytest.mark.slow
def test_miscalibration_moves_perfect_pixels_as_its_covariance_says(
    calibration: Calibration, state: SceneState
) -> None:
    size_px, ends = 0.05, state.phantom.ends_mm
    shifts = np.array(
        [
            shifts_mm(calibration, quantities.miscalibrated(size_px, seed, calibration), ends)
            for seed in range(300)
        ]
    )
    spread = ParameterCovariance(
        tuple(quantities.SPREAD_PER_PX),
        np.diag([(size_px * one) ** 2 for one in quantities.SPREAD_PER_PX.values()]),
    )
    expected = replace(calibration, covariance=spread).covariance_of(ends)
    rms = np.sqrt((shifts**2).sum(axis=2).mean(axis=0))
    assert rms == pytest.approx(np.sqrt(np.trace(expected, axis1=1, axis2=2)), rel=0.15)


def test_miscalibration_is_seeded_scales_and_leaves_the_rest_alone(
    calibration: Calibration,
) -> None:
    none, one, twice = (quantities.miscalibrated(size, 4, calibration) for size in (0.0, 0.1, 0.2))
    assert quantities.miscalibrated(0.1, 4, calibration).left == one.left
    assert quantities.miscalibrated(0.1, 5, calibration).left != one.left
    moved = np.subtract(one.left.cc, calibration.left.cc)
    assert np.subtract(twice.left.cc, calibration.left.cc) == pytest.approx(2.0 * moved)
    before = calibration.right_from_left.T
    carried = one.right_from_left.T - before
    assert np.allclose(twice.right_from_left.T, before + 2.0 * carried)
    assert one.world_from_right is calibration.world_from_right
    assert one.thermal_from_left is calibration.thermal_from_left
    ends = np.array([[-150.0, 240.0, 135.0]])
    assert shifts_mm(calibration, none, ends) == pytest.approx(0.0, abs=1e-6)

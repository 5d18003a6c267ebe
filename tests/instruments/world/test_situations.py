"""Families of situations: reproducible, possible to set up, in view, and what their names say."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from instruments.world.objects import SceneObject, make_object
from instruments.world.optics import CameraModel
from instruments.world.phantom import Phantom, Teat
from instruments.world.setups import Situation, hidden_ways, situation_faults
from instruments.world.situations import SITUATIONS, member, situation
from instruments.world.solids import Solids
from instruments.world.state import SceneState
from tests.examples import few
from tests.instruments.world.scenes import renderer

NAMES = tuple(SITUATIONS)
SEEDS = range(12)


@cache
def members(name: str) -> tuple[Situation, ...]:
    return tuple(situation(name, seed) for seed in SEEDS)


def state(found: Situation) -> SceneState:
    return found.state((32.5,) * len(found.phantom.teats), 33.0, 20.0)


@cache
def visible(name: str) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.bool_]], ...]:
    return tuple(renderer().visible_ends(state(found)) for found in members(name))


def test_there_are_the_eleven_and_those_of_a_cowshed() -> None:
    thesis = (
        "non_vertical overlapping spurious_teat hot_body_at_base hot_body_at_ends cooler_bodies"
    )
    others = "low_contrast dim_light missing_or_hidden anywhere"
    cowshed = (
        "cool_quarters warm_room straw_and_legs cow_teats wet cluttered outward swollen liners"
    )
    assert tuple(f"ideal {thesis} {others} {cowshed} rods".split()) == NAMES


@pytest.mark.slow
@pytest.mark.parametrize("name", few(NAMES, 3))
def test_members_are_values_of_name_and_seed_that_can_be_set_up_drawn_and_seen(name: str) -> None:
    found = members(name)
    assert [(one.name, one.seed) for one in found] == [(name, seed) for seed in SEEDS]
    assert len({one.phantom for one in found}) == len(SEEDS)
    for one in found:
        assert situation_faults(one) == ()
        state(one)  # checks that nothing is below the table or behind the board
        for camera in renderer().cameras:
            pixels = camera.project(one.phantom.ends_mm)
            inside = (pixels > 4.0) & (pixels < [camera.width_px - 5, camera.height_px - 5])
            assert np.all(inside), (one.seed, camera.name)
    if name not in ("overlapping", "missing_or_hidden"):  # nothing is meant to hide an end
        assert np.concatenate(visible(name)).mean() > 0.99


def test_seeds_differ_in_paint_light_and_background() -> None:
    found = members("ideal")
    light = [one.teat_paint.albedo > 0.2 for one in found]
    assert 2 <= sum(light) <= 8
    assert (
        len({one.lighting for one in found}) == len({one.backdrop for one in found}) == len(found)
    )
    assert {len(one.lighting.lamps) for one in found} == {2, 3}


def test_leans_are_as_named() -> None:
    def leans_deg(phantom: Phantom) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
        return np.degrees(np.arccos(phantom.axes[:, 2]))

    for found in members("non_vertical"):
        assert np.all((leans_deg(found.phantom) >= 4.99) & (leans_deg(found.phantom) <= 19.01))
    assert max(leans_deg(found.phantom).max() for found in members("ideal")) <= 2.01


@pytest.mark.slow
def test_overlapping_teats_touch_and_cover() -> None:
    for found in members("overlapping"):
        ends, radii = found.phantom.bases_mm, [teat.shape.radius_mm for teat in found.phantom.teats]
        gap = float(np.linalg.norm(ends[0] - ends[1])) - radii[0] - radii[1]
        assert 0.0 <= gap <= 1.5
        assert _covered(renderer().cameras[2], found, 2, 3)


def _covered(camera: CameraModel, found: Situation, near: int, far: int) -> bool:
    """Whether the near teat hides a part, but not all, of the far one."""
    pixels = camera.project(found.phantom.ends_mm - [0.0, 0.0, 40.0])
    depth = camera.camera_from_world(found.phantom.ends_mm)[:, 2]
    radii = [found.phantom.teats[i].shape.radius_mm * camera.fc[0] / depth[i] for i in (near, far)]
    return bool(0.0 < abs(pixels[near, 0] - pixels[far, 0]) < sum(radii))


@pytest.mark.slow
def test_what_is_warm_and_cold_is_so() -> None:
    teat, room = 32.5, 20.0

    def temperatures_c(found: Situation) -> list[float]:
        scene = state(found)
        return [scene.temperature_c(one.temperature) + one.offset_k for one in found.objects]

    for found in members("spurious_teat"):
        assert set(temperatures_c(found)) == {room}
        assert all(thing.paint == found.teat_paint for thing in found.objects)
    for found in members("cooler_bodies"):
        assert all(room < each < teat for each in temperatures_c(found))
        assert 2 <= len(found.objects) <= 6
    for name in ("hot_body_at_base", "hot_body_at_ends"):
        assert all(
            abs(each - teat) <= 4.0 for found in members(name) for each in temperatures_c(found)
        )


@pytest.mark.slow
def test_the_cup_stays_below_the_ends_and_the_arm_behind_them() -> None:
    for found in members("hot_body_at_base"):
        rim_mm = max(hull.b_mm[2] for hull in found.objects[0].hulls)
        assert rim_mm <= found.phantom.ends_mm[:, 2].min() - 25.0
    for found in members("hot_body_at_ends"):
        arm, ends = Solids.from_hulls(found.objects[0].hulls), found.phantom.ends_mm
        assert (np.minimum(arm.a[:, 1], arm.b[:, 1]) - arm.radius_a).min() > ends[:, 1].max()
        bearings = (ends[:, 2] - 62.0) / (ends[:, 1] + 840.0)
        low, high = (
            (arm.a[:, 2] + side * arm.radius_a - 62.0) / (arm.a[:, 1] + 840.0) for side in (-1, 1)
        )
        assert np.any((bearings > low.min()) & (bearings < high.max()))


def test_quarters_are_cooler_than_the_warmest_and_rooms_warm() -> None:
    for found in members("cool_quarters"):
        teats_c = np.array(state(found).teat_temps_c)
        assert teats_c.max() == 32.5
        assert teats_c.min() >= 27.5
    assert any(min(state(found).teat_temps_c) < 29.0 for found in members("cool_quarters"))
    rooms_c = {state(found).ambient_c for found in members("warm_room")}
    assert min(rooms_c) >= 26.0
    assert 29.0 < max(rooms_c) <= 31.0


@pytest.mark.slow
def test_straws_lie_before_teats_and_legs_behind() -> None:
    for found in members("straw_and_legs"):
        straws = [thing.hulls[0] for thing in found.objects if thing.name == "straw"]
        legs = [thing for thing in found.objects if thing.name == "leg"]
        assert 2 <= len(straws) <= 5
        assert 1 <= len(legs) <= 2
        back = max(hull.a_mm[1] for (hull,) in found.phantom.teat_hulls())
        assert all(0.5 * (hull.a_mm[1] + hull.b_mm[1]) < back for hull in straws)
        assert min(leg.hulls[1].a_mm[1] for leg in legs) > back
        scene = state(found)
        assert all(
            19.0 < 20.0 + one.offset_k < 30.6 for one in found.objects if one.name == "straw"
        )
        assert all(23.0 < scene.temperature_c("teat") + leg.offset_k < 31.0 for leg in legs)


@pytest.mark.slow
def test_teats_of_a_cow_end_where_their_axes_leave_them() -> None:
    flat, lengths = 0, []
    for found in members("cow_teats"):
        udder = found.phantom.udder
        assert udder is not None
        for hulls, end, axis, teat in zip(
            found.phantom.teat_hulls(),
            found.phantom.ends_mm,
            found.phantom.axes,
            found.phantom.teats,
            strict=True,
        ):
            assert teat.shape.form is not None
            flat += teat.shape.form.flat_mm > 0.0
            solids = Solids.from_hulls(hulls)
            reaches = np.concatenate(
                [
                    (solids.a - end) @ axis + np.where(solids.flat_a, 0.0, solids.radius_a),
                    (solids.b - end) @ axis + np.where(solids.flat_b, 0.0, solids.radius_b),
                ]
            )
            assert max(reaches) == pytest.approx(0.0, abs=1e-6)
            lengths.append((end[2] - udder.height_mm) / axis[2])
    assert 34.9 < min(lengths) < 40.0
    assert 65.0 < max(lengths) < 70.1
    assert 0.3 < flat / len(lengths) < 0.7
    scene = state(members("cow_teats")[0])
    assert scene.teat_fall > SceneState(Phantom(()), (), 33.0, 20.0).teat_fall


@pytest.mark.slow
def test_pipes_cross_behind_the_teats_about_as_high_as_their_ends() -> None:
    kinds = set()
    for found in members("cluttered"):
        kinds |= {thing.name for thing in found.objects}
        back = found.phantom.ends_mm[:, 1].max()
        first, *_ = (thing.hulls[0] for thing in found.objects if thing.name == "pipe")
        assert min(first.a_mm[1], first.b_mm[1]) - first.radius_a_mm > back
        assert 50.0 < min(first.a_mm[2], first.b_mm[2]) < max(first.a_mm[2], first.b_mm[2]) < 230.0
    assert kinds == {"pipe", "rod", "hot_cup", "hose"}
    emissivities = [thing.paint.emissivity for one in members("cluttered") for thing in one.objects]
    assert min(emissivities) < 0.35  # bare steel mirrors the room


@pytest.mark.slow
def test_drops_and_dirt_sit_on_the_skin_of_wet_teats_and_leave_their_ends_free() -> None:
    names = set()
    for found in members("wet"):
        scene = state(found)
        assert max(scene.teat_temps_c) <= 31.5
        assert found.teat_paint.gloss_exponent >= 60.0
        things = [thing for thing in scene.everything() if thing.name in ("drops", "dirt")]
        assert len(things) == len(found.phantom.spots)
        for thing, spots in zip(things, found.phantom.spots, strict=True):
            names.add(thing.name)
            for hull, (teat, *_) in zip(thing.hulls, spots.places, strict=True):
                end, axis = found.phantom.ends_mm[teat], found.phantom.axes[teat]
                off = np.array(hull.a_mm) - end
                along = float(off @ axis)
                out = float(np.linalg.norm(off - along * axis)) + hull.radius_a_mm
                skin = found.phantom.teats[teat].shape.radius_mm
                assert along + hull.radius_a_mm <= -6.0
                assert out == pytest.approx(skin + spots.out_mm)
    assert names == {"drops", "dirt"}


def test_low_contrast_is_low_and_dim_is_dim() -> None:
    for found in members("low_contrast"):
        assert 0.75 < found.backdrop.board_albedo / found.teat_paint.albedo < 1.35
    assert all(found.lighting.brightness < 0.3 for found in members("dim_light"))


@pytest.mark.slow
def test_missing_or_hidden_is_one_or_the_other_and_hidden_as_the_renderer_says() -> None:
    kinds, agree = set(), []
    for found, seen in zip(members("missing_or_hidden"), visible("missing_or_hidden"), strict=True):
        missing, hidden = len(found.phantom.teats) == 3, hidden_ways(found)
        kinds.add("missing" if missing else "panel" if found.boards else "post")
        assert seen.all() if missing else not seen.all()
        assert missing or 1 <= hidden.any(axis=1).sum() <= 2
        agree.append(np.mean(hidden == ~seen))
    assert kinds == {"missing", "panel", "post"}
    # its eyes stand where the rig's cameras do, to a few mm; an end half behind a rim is hidden for
    # one and free for the other
    assert np.mean(agree) > 0.93


BALLS = make_object("ball", y_mm=700.0), make_object("ball", y_mm=720.0)


def _rod_in(one: Situation) -> SceneObject:
    x, y, _ = one.phantom.ends_mm[0]
    return make_object("rod", x_mm=float(x), y_mm=float(y))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda one: {"objects": (_rod_in(one),)}, "within the phantom"),
        (lambda one: {"objects": BALLS}, "in each other"),
        (
            lambda one: {"phantom": Phantom((*one.phantom.teats, *one.phantom.teats[:1]))},
            "teats 1 and",
        ),
        (lambda one: {"phantom": Phantom((Teat((-600.0, 250.0)),))}, "out of the arm's reach"),
        (lambda one: {"phantom": Phantom((Teat((-320.0, 250.0)),))}, "out of the cameras' view"),
    ],
)
def test_faults_are_reported(change: Callable[[Situation], dict[str, object]], said: str) -> None:
    one = members("ideal")[0]
    changed = replace(one, **change(one))  # type: ignore[arg-type]
    assert any(said in fault for fault in situation_faults(changed)), situation_faults(changed)


def test_a_scene_that_is_in_use_is_drawn_once() -> None:
    """As of a run with more scenes than `member` remembers."""
    one = situation("ideal", 12)
    member.cache_clear()
    assert situation("ideal", 12) is one


def test_unknown_names_and_seeds_are_refused() -> None:
    with pytest.raises(ValueError, match="did you mean 'overlapping'"):
        situation("overlaping", 0)
    with pytest.raises(ValueError, match="0 or more"):
        situation("ideal", -1)

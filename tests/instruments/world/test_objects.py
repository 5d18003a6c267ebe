"""Objects of the scene by name, and what is said when the name or a parameter is wrong."""

from __future__ import annotations

from dataclasses import replace

import pytest

from instruments.world.objects import KINDS, make_object, parameters
from instruments.world.phantom import upright
from instruments.world.solids import Hull, Solids, ball, cylinder
from tests.instruments.world.scenes import NOBODY


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_kind_stands_on_the_table_is_placed_and_painted(kind: str) -> None:
    thing = make_object(kind)
    assert thing.name == kind
    assert Solids.from_hulls(thing.hulls).nearest_depth().min() >= -1e-9
    looks = {"x_mm", "y_mm", "albedo", "gloss", "emissivity", "temperature", "offset_k"}
    assert looks <= set(parameters(kind))
    here, there = make_object(kind, x_mm=0.0, albedo=0.4), make_object(kind, x_mm=25.0, albedo=0.4)
    assert there.hulls[0].a_mm[0] - here.hulls[0].a_mm[0] == pytest.approx(25.0)
    assert here.paint.albedo == 0.4


def test_temperatures_absolute_teat_ambient_and_offset() -> None:
    def of(**given: object) -> float:
        thing, scene = make_object("ball", **given), replace(NOBODY, ambient_c=21.0)
        warm = replace(scene, phantom=upright([(0.0, 300.0, 130.0)]), teat_temps_c=(32.0,))
        return warm.temperature_c(thing.temperature) + thing.offset_k

    assert of(temperature=45.0, offset_k=0.0) == 45.0
    assert of(temperature="teat", offset_k=-5.0) == 27.0
    assert of(temperature="ambient", offset_k=1.5) == 22.5


@pytest.mark.parametrize(
    ("kind", "params", "message"),
    [
        (
            "hot_cop",
            {},
            r"'hot_cop' is no kind of object; did you mean 'hot_cup'\? Known: cold_teat",
        ),
        (
            "hot_cup",
            {"radius": 30.0},
            r"'radius' is no parameter of .*; did you mean 'radius_mm'\?",
        ),
        ("hot_cup", {"radius_mm": -3.0}, r"hot_cup: a solid needs .* radii above zero"),
        ("hot_cup", {"radius_mm": "wide"}, r"radius_mm must be a finite number, is 'wide'"),
        ("hot_cup", {"radius_mm": True}, r"hot_cup: radius_mm must be a finite number"),
        ("hot_cup", {"height_mm": float("nan")}, r"hot_cup: height_mm must be a finite number"),
        ("hot_cup", {"temperature": "teet"}, r"'teet' is no temperature .*; did you mean 'teat'\?"),
        ("warm_arm", {"albedo": 1.5}, r"warm_arm: albedo must be from 0 to 1, is 1.5"),
        ("cooler_body", {"height_mm": 20.0}, r"cooler_body: height_mm must be more than"),
    ],
)
def test_wrong_words_are_explained(kind: str, params: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_object(kind, **params)


@pytest.mark.parametrize(
    "make",
    [
        lambda: ball((0.0, 0.0, 0.0), 0.0),
        lambda: ball((0.0, float("nan"), 0.0), 1.0),
        lambda: cylinder((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0),
        lambda: Hull((0.0, 0.0, 0.0), (0.0, 0.0, 5.0), 10.0, 2.0),
        lambda: Hull((0.0, 0.0, 0.0), (0.0, 0.0, 50.0), 10.0, 2.0, flat_a=True),
    ],
)
def test_impossible_solids_are_refused(make: object) -> None:
    assert callable(make)
    with pytest.raises(ValueError, match="solid"):
        make()

"""Scenes for hypothesis: what is drawn can stand, shrinks to the plainest, and can be pasted back."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, find, given, seed, settings
from hypothesis import strategies as st

from bench.config import ConfigError
from bench.record.recording import Recording
from bench.testing import (
    Applied,
    Object,
    Pose,
    Scene,
    SceneFailedError,
    Teat,
    check,
    checking,
    layouts,
    objects,
    perturbations,
    poses,
    scenes,
)
from bench.testing.found import SCENE, read_scene, write_found
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.commands import Said

NAMES = {"Applied": Applied, "Object": Object, "Pose": Pose, "Scene": Scene, "Teat": Teat}
FOUR = Scene((Teat(),) * 4)
KINDS = ("leg", "rod")
FIRST = settings(max_examples=1, database=None, phases=[Phase.generate])


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Cameras so small that a scene is drawn in no time."""
    return str(write_small_rig(tmp_path_factory.mktemp("rig")))


@pytest.mark.slow
@given(st.data(), st.booleans())
def test_what_is_drawn_can_stand_and_its_repr_is_itself(
    data: st.DataObject, published: bool
) -> None:
    scene = data.draw(scenes(published=published))
    assert not scene.faults()
    assert eval(repr(scene), {"__builtins__": {}}, NAMES) == scene
    assert (scene.differences() == 0) == (scene == Scene())
    if published:
        assert len(scene.teats) == 4
        assert (scene.pose, scene.perturbations) == (Pose(), ())
        for name in ("lean_deg", "right_mm"):
            low, high = Teat.STEPS[name].published
            assert all(low <= getattr(one, name) <= high for one in scene.teats)
    near = scene.neighbours()
    assert scene not in near
    assert len(set(near)) == len(near)


@pytest.mark.slow
def test_four_teats_keep_what_is_drawn_and_move_sideways() -> None:
    """95 % of what is drawn has one teat before another."""
    drawn: list[tuple[Teat, ...]] = []

    @seed(1)
    @settings(FIRST, max_examples=40, deadline=None)
    @given(layouts(4, 4))
    def draw(teats: tuple[Teat, ...]) -> None:
        drawn.append(teats)

    draw()
    teats = [one for few in drawn for one in few]
    away_mm = np.array([one.away_mm for one in teats])
    assert np.mean(away_mm == 0) < 0.16
    assert np.mean(np.abs(away_mm)) > 19.0
    assert not any(Scene(few).faults() for few in drawn)


WANTED = {
    "a thing": (lambda s: bool(s.objects), Scene(objects=(Object("cold_teat"),))),
    "two teats": (lambda s: len(s.teats) > 1, Scene((Teat(), Teat()))),
    "a lean": (lambda s: abs(s.teats[0].lean_deg) > 3, Scene((Teat(lean_deg=4),))),
    "a dark room": (lambda s: s.light_percent < -25, Scene(light_percent=-30)),
    "a perturbation": (
        lambda s: any(one.name == "noise" for one in s.perturbations),
        Scene(perturbations=(Applied("noise", 1.0),)),
    ),
}


@pytest.mark.weekly
@pytest.mark.parametrize("name", WANTED)
def test_a_scene_shrinks_to_the_plainest_that_has_what_is_wanted(name: str) -> None:
    """In each run a part does, and test_plugin lets a failing test shrink to the simplest scene."""
    wanted, simplest = WANTED[name]
    found = find(scenes(), wanted, settings=settings(max_examples=2000, database=None))
    assert found == simplest
    assert found.differences() == 1


@pytest.mark.weekly
def test_teats_shrink_to_the_plainest_that_lean() -> None:
    found = find(
        layouts(), lambda teats: abs(teats[0].lean_deg) > 3, settings=settings(database=None)
    )
    assert found == (Teat(lean_deg=4),)


OWN_PARTS = scenes(
    layouts=layouts(2, 2),
    poses=poses(),
    objects=objects(*KINDS),
    perturbations=perturbations("jpeg"),
)


@pytest.mark.slow
@given(OWN_PARTS)
def test_parts_have_strategies_of_their_own(scene: Scene) -> None:
    assert len(scene.teats) == 2
    assert {one.kind for one in scene.objects} <= {*KINDS}
    assert {one.name for one in scene.perturbations} <= {"jpeg"}


def test_what_cannot_be_is_refused_in_words(rig: str) -> None:
    assert Scene(()).faults() == ("a scene has 1 to 4 teats, this one 0",)
    (fault,) = Scene(objects=(Object("rodd"),)).faults()
    assert "did you mean 'rod'?" in fault
    assert Scene((Teat(right_mm=300),)).faults()
    with pytest.raises(ConfigError, match="rodd"):
        check("fused", Scene(objects=(Object("rodd"),)), rig=rig)


def drawn(strategy: st.SearchStrategy[Scene]) -> Scene:
    return find(strategy, bool, settings=FIRST)


ANY: Any = {"amount": "x", "teat": ("x",), "paint": "blue", "poses": objects()}
WRONG: dict[str, Callable[[], object]] = {
    "no 'nois'; did you mean": lambda: perturbations("nois"), "no 'rodd'; did": lambda: objects("rodd"),
    "3, 2 is no span": lambda: layouts(3, 2), "most_objects is -1": lambda: drawn(scenes(most_objects=-1)),
    "no perturbation": lambda: Applied("nois", 1.0), "gamma has to be": lambda: Applied("gamma", ANY["amount"]),
    "teats is .*list": lambda: Scene(ANY["teat"]), "paint is .*dark": lambda: Scene(paint=ANY["paint"]),
    "nan, not a number": lambda: Teat(lean_deg=math.nan), "no kind of object": lambda: Object("rodd").placed(),
    "1 to 4 teats": lambda: Scene(()).state(), "pose is .*Pose": lambda: drawn(scenes(poses=ANY["poses"])),
}  # fmt: skip


@pytest.mark.parametrize("said", WRONG)
def test_wrong_names_and_values_are_refused_by_name(said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        WRONG[said]()


@pytest.mark.slow
def test_a_sample_of_the_neighbours_says_so_and_names_the_plainest_that_passes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def only_four_passes(_: object, scene: Scene, *more: object, **rig: object) -> Any:
        return SimpleNamespace(fault="" if scene == FOUR else "misses an end")

    monkeypatch.setattr(checking, "look", only_four_passes)
    edge = replace(FOUR, teats=(Teat(lean_deg=1), *FOUR.teats[1:]))
    look: Any = SimpleNamespace(fault="misses an end", late=False)
    near = SceneFailedError("thesis", edge, look, 5.0, "emulated").neighbourhood()
    sample = f"{near.of} scenes one step away looked at, a sample of {len(edge.neighbours())},"
    assert near.of <= 24
    assert str(near) == f"{near.of - 1} of {sample} fail too; {FOUR!r} passes."


@pytest.mark.slow
def test_a_failing_scene_s_picture_has_the_colours_of_a_report() -> None:
    with pytest.raises(SceneFailedError, match=r"^thesis ") as raised:
        check("thesis", FOUR)
    blue, green, red = np.moveaxis(raised.value.picture().astype(int), 2, 0)
    reddish = red - blue > 100
    assert reddish.any()
    assert (green - blue)[reddish].min() > 20, "its answers are orange, not red"
    assert (blue - red).max() < 100, "and none is blue, as those of fused"


@pytest.mark.slow
def test_a_failing_scene_is_said_shown_written_and_kept(
    rig: str, tmp_path: Path, said: Said
) -> None:
    scene = replace(FOUR, perturbations=(Applied("noise", 3.0),))
    assert check("fused", FOUR, rig=rig).success
    with pytest.raises(SceneFailedError, match=r"^thesis .* in Scene\(") as raised:
        check("thesis", scene, rig=rig)
    error = raised.value
    near = error.neighbourhood()
    assert 0 < near.failing <= near.of <= 24 < near.there
    lines = error.lines()
    assert "from bench.testing import Applied, Scene, Teat, check" in lines
    compile(lines, "pasted", "exec")
    folder = write_found(error, tmp_path / "found")
    assert error.picture().shape[2] == 3
    assert (folder / "scene.png").stat().st_size > 10_000
    again, facts = read_scene(folder / SCENE)
    assert again == scene
    assert (facts["neighbours"], facts["neighbours_looked_at"]) == (near.there, near.of)
    kept = tmp_path / "kept"
    wrote = said(0, "campaign keep {} --into {} --name noisy", folder, kept)
    assert wrote.out == f"noisy in {kept}\n"
    recording = Recording(kept)
    assert recording.frames == ("noisy",)
    assert len(recording.truth["noisy"]) == 4
    twice = said(2, "campaign keep {} --into {} --name noisy", folder, kept)
    assert "there is such a frame already; give another --name" in twice.err
    (kept / "calibration.toml").write_text("another", encoding="utf-8")
    assert "has another calibration" in said(2, "campaign keep {} --into {}", folder, kept).err
    nothing = said(2, "campaign keep {} --into {}", kept, kept)
    assert "no scene is there" in nothing.err


@pytest.mark.slow
def test_the_search_climbs_the_error(rig: str, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: dict[str, float] = {}
    monkeypatch.setattr("hypothesis.target", lambda value, label: seen.update({label: value}))

    @settings(max_examples=1, database=None, deadline=None, phases=[Phase.generate])
    @given(st.just(FOUR))
    def once(scene: Scene) -> None:
        check("fused", scene, 50.0, rig=rig)

    once()
    ((label, value),) = seen.items()
    assert label == "fused, mm"
    assert 0.0 < value < 50.0


def shrunk(detector: str, limit_mm: float, number: int, *, published: bool = False) -> Scene:
    """What a test of ``detector`` finds with this seed."""

    @seed(number)
    @settings(
        max_examples=100,
        database=None,
        deadline=None,
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )
    @given(scenes(published=published))
    def passes(scene: Scene) -> None:
        check(detector, scene, limit_mm)

    with pytest.raises(SceneFailedError) as raised:
        passes()
    scene: Scene = raised.value.scene
    return scene


@pytest.mark.weekly
@pytest.mark.timeout(3600)
def test_the_plainest_scene_of_all_breaks_the_thesis_detector() -> None:
    assert shrunk("thesis", 5.0, 1) == Scene()


@pytest.mark.weekly
@pytest.mark.timeout(3600)
def test_what_breaks_the_thesis_detector_differs_in_at_most_three_things() -> None:
    """20 mm: at 5 mm the plainest scene does."""
    found = [shrunk("thesis", 20.0, number, published=True) for number in range(10)]
    assert sum(one.differences(FOUR) <= 3 for one in found) >= 9
    assert all(one != FOUR for one in found)

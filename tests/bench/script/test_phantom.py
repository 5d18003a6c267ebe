"""Phantom files: what ships is as published, drawn udders keep to their envelope."""

from __future__ import annotations

import re
import tomllib
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.config import ConfigError
from bench.script.phantom import find_layout, layout_names, load_layout, shipped_phantom
from instruments.clock import VirtualClock
from instruments.world.scene import Renderer
from instruments.world.solids import clearance_mm
from instruments.world.world import World
from tests.conftest import ROOT

RANDOM = load_layout(find_layout("random-udder"))
ENVELOPE = """about = "x"
[envelope]
middle_mm = [0.0, 0.0]
front_spacing_mm = [80.0, 90.0]
front_to_rear_mm = [60.0, 80.0]
rear_spacing_mm = [40.0, 50.0]
"""
TEAT = '[[teats]]\nname = "LF"\nbase_mm = [0.0, 0.0]\n'


def written(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_table_5_1_is_the_published_one(shared_data: Path) -> None:
    path = shared_data.parent / "seed" / "published.toml"
    published = tomllib.loads(path.read_text(encoding="utf-8"))["table_5_1"]["teat_ends_mm"]
    assert shipped_phantom("table-5-1").ends_mm == pytest.approx(np.array(published), abs=1e-9)


def test_what_ships() -> None:
    names = "narrow-rear non-vertical overlapping random-udder single table-5-1 widest"
    assert layout_names() == names.split()
    for name in layout_names():
        phantom = load_layout(find_layout(name)).phantom(1)
        assert phantom.name == name
        assert phantom.emissivity == 0.95
        assert sorted(teat.name for teat in phantom.teats) == (
            ["RF"] if name == "single" else ["LF", "LR", "RF", "RR"]
        )


def test_narrow_rear_teats_are_the_nearest_and_widest_the_widest() -> None:
    def rear(name: str) -> float:
        teats = {teat.name: np.array(teat.base_mm) for teat in shipped_phantom(name).teats}
        return float(np.linalg.norm(teats["LR"] - teats["RR"]))

    def width(name: str) -> float:
        return float(np.ptp(shipped_phantom(name).ends_mm[:, 0]))

    assert rear("narrow-rear") == pytest.approx(26.0)
    assert rear("narrow-rear") < rear("table-5-1")
    assert width("widest") > 1.5 * width("table-5-1")


@given(seed=st.integers(0, 2**32))
def test_a_drawn_udder_keeps_to_its_envelope(seed: int) -> None:
    phantom = RANDOM.phantom(seed)
    assert [teat.name for teat in phantom.teats] == ["LF", "RF", "LR", "RR"]
    hulls = [hull for (hull,) in phantom.teat_hulls()]
    assert min(clearance_mm(one, other) for one, other in combinations(hulls, 2)) >= 4.0
    for teat in phantom.teats:
        assert 120.0 <= teat.shape.length_mm <= 145.0
        assert 9.0 <= teat.shape.radius_mm <= 13.0
        assert max(abs(lean) for lean in teat.tilt_rad) <= np.radians(10.0)
    bases = {teat.name: np.array(teat.base_mm) for teat in phantom.teats}
    assert 90.0 - 12.0 <= bases["RF"][0] - bases["LF"][0] <= 170.0 + 12.0
    assert 40.0 - 12.0 <= bases["RR"][0] - bases["LR"][0] <= 100.0 + 12.0


def test_a_seed_is_one_udder_and_another_seed_another() -> None:
    assert RANDOM.phantom(7) == RANDOM.phantom(7)
    assert RANDOM.phantom(7) != RANDOM.phantom(8)
    assert RANDOM.phantom(7, 1) != RANDOM.phantom(7, 2)


@pytest.mark.slow
def test_the_paint_of_the_file_is_the_paint_of_the_scene(tmp_path: Path) -> None:
    calibration = tomllib.loads((ROOT / "bench/rigs/calibration.toml").read_text(encoding="utf-8"))
    world = World(VirtualClock(), 1, lambda: Renderer.from_calibration(calibration, 1))
    world.arrange(
        load_layout(written(tmp_path, f'about = "dull"\nemissivity = 0.6\n{TEAT}')).phantom(), ()
    )
    assert world.scene().teat_paint.emissivity == 0.6
    assert len(world.ends_mm()) == 1


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        (f'about = "x"\n{TEAT}lenght_mm = 3.0\n', 5, 'did you mean "length_mm"'),
        (f'about = "x"\n{TEAT}end = "flat"\n', 5, "hemisphere"),
        (f'about = "x"\n{TEAT}radius_mm = 200.0\n', 2, "a teat needs"),
        (f'about = "x"\n{TEAT}tilt_deg = [0.0, 75.0]\n', 5, "less than 60"),
        (f'about = "x"\n{TEAT}{TEAT}', 2, "two teats are LF"),
        (
            f'about = "x"\n{TEAT}{TEAT.replace("LF", "RF").replace("[0.0", "[15.0")}',
            2,
            "teats LF and RF stand 7.0 mm inside each other",
        ),
        (f'about = "x"\n{TEAT.replace("LF", "FL")}', 3, "'FL' is not allowed"),
        ('about = "x"\n', 1, "either [[teats]] or an [envelope]"),
        ('about = "x"\nemissivity = 1.5\n' + TEAT, 2, "less than or equal to 1"),
        (
            ENVELOPE.replace("[80.0, 90.0]", "[90.0, 80.0]"),
            4,
            "the first number must be the smaller one",
        ),
    ],
)
def test_a_wrong_file_says_what_and_where(
    tmp_path: Path, text: str, line: int, message: str
) -> None:
    with pytest.raises(ConfigError, match=rf"mine\.toml:{line}: (.|\n)*{re.escape(message)}"):
        load_layout(written(tmp_path, text))


@pytest.mark.slow
def test_an_envelope_in_which_no_udder_fits_is_refused(tmp_path: Path) -> None:
    text = re.sub(r"(spacing_mm|rear_mm) = .*", r"\1 = [20.0, 21.0]", ENVELOPE)
    with pytest.raises(ConfigError, match="widen the spacings"):
        load_layout(written(tmp_path, text))


def test_a_layout_that_is_not_there_lists_what_is(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=r'did you mean "overlapping"\? \(shipped: narrow-rear, non-vertical'
    ):
        find_layout("overlaping")
    with pytest.raises(ValueError, match="no such file"):
        find_layout("mine.toml", tmp_path)

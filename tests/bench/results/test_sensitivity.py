"""Counts and distances at each value, and what becomes of them as files: a detector that knows the
truth, one that fails, the real one.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.cli.main import main
from bench.config import ConfigError
from bench.report.sensitivity import COLUMNS, figure_of, write_figure, write_numbers
from bench.results.sensitivity import QUANTITIES, Bench, Limit, Measured, Tally, measure
from bench.rig.loading import find_rig, load_rig
from detector.calibration import Calibration
from detector.protocol import Detection, Frames, Teat
from detector.registry import available
from instruments.world.situations import situation
from reports.trust import svg_facts

LIMIT = Limit(0.01, 0.03, 0.2, None)


def test_what_is_found_false_and_missing_is_counted_against_the_truth() -> None:
    ends = situation("ideal", 0).phantom.ends_mm
    right = Knowing([*ends[:3], ends[0] + [0.0, 300.0, 0.0]], error_mm=0.5)
    failing = Knowing([], breaks=True, name="failing")
    quantity = replace(QUANTITIES["calibration"], values=(0.0, 0.5))
    bench = Bench(load_rig(find_rig(None)), [right, failing], [0], 1)
    none, half = measure(bench, quantity)
    assert (none.value, half.value) == (0.0, 0.5)
    assert none.visible == half.visible == 4
    assert none.tallies["knowing"].distances_mm == pytest.approx([0.5] * 3)
    assert (none.tallies["knowing"].false, none.tallies["knowing"].failures) == (1, 0)
    assert none.tallies["failing"] == Tally((), 0, 1)
    assert right.told[0].left == bench.rig.calibration.left
    assert right.told[1].left != bench.rig.calibration.left
    assert none.limit is not None
    assert half.limit is not None
    assert none.limit.p95_mm < 0.1 < half.limit.median_mm
    assert none.limit.share is None


def test_a_thermal_quantity_has_the_share_that_can_be_nominated_beside_it() -> None:
    quantity = replace(QUANTITIES["netd"], values=(0.05, 400.0))
    low, high = measure(Bench(load_rig(find_rig(None)), [Knowing([])], [1], 1), quantity)
    assert low.limit is not None
    assert high.limit is not None
    assert low.limit.share == pytest.approx(1.0)
    assert high.limit.share == pytest.approx(0.0, abs=0.01)


def test_the_command_writes_the_same_figures_and_numbers_each_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = [
        "scene",
        "sensitivity",
        "--quantity",
        "overlap",
        "--detector",
        "thesis",
        "--seeds",
        "1",
        "--first",
        "2",
    ]
    for folder in ("one", "two"):
        assert main([*said, "--out", str(tmp_path / folder)]) == 0
    assert "overlap 0.2: found of " in capsys.readouterr().out
    names = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert names == ["measured.md", "overlap.svg", "points.csv"]
    for name in names:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    with (tmp_path / "one" / "points.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["value"]) for row in rows] == list(QUANTITIES["overlap"].values)
    assert all(int(row["found"]) <= int(row["visible"]) <= 4 for row in rows)
    assert "thesis (version 1); cameras of `emulated.toml`; members 2 to 2" in (
        tmp_path / "one" / "measured.md"
    ).read_text(encoding="utf-8")


def test_what_was_not_measured_is_said_so(tmp_path: Path) -> None:
    quantity = QUANTITIES["netd"]
    nothing = Measured(0.05, 0, {"a": Tally()}, None)
    missed = Measured(0.2, 4, {"a": Tally()}, replace(LIMIT, share=1.0))
    write_numbers(tmp_path, [quantity], {"netd": [nothing, missed]}, "Made with nothing.")
    page = (tmp_path / "measured.md").read_text(encoding="utf-8")
    assert "| 0.05 | 0 of 0 | 0 | not measured | not measured | not measured |" in page
    assert "| 0.2 | 0 of 4 | 0 | not measured | 0.010, 0.030 | 100 % |" in page
    assert (tmp_path / "points.csv").read_text(encoding="utf-8").splitlines()[0] == ",".join(
        COLUMNS
    )
    assert "not measured" in figure_of(quantity, [nothing])


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


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--quantity", "contrats"], 'did you mean "contrast"'),
        (["--detector", "thesys"], "thesys"),
        (["--rig", "no-such-rig"], "no-such-rig"),
    ],
)
def test_wrong_use_is_explained(
    arguments: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["scene", "sensitivity", *arguments, "--out", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err


def test_more_detectors_than_a_figure_shows_are_refused_before_any_is_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    five = [word for name in available([]) for word in ("--detector", name)]
    assert len(five) == 10
    assert main(["scene", "sensitivity", *five, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr()
    assert "a figure shows 4 detectors at most, 5 are asked for: thesis, fused," in said.err
    assert said.out == ""


def test_frame_sets_without_an_answer_are_told_apart_from_nothing_found(tmp_path: Path) -> None:
    failed = Measured(0.2, 8, {"a": Tally((0.3,), 0, 1), "b": Tally()}, LIMIT)
    write_numbers(tmp_path, [QUANTITIES["tilt"]], {"tilt": [failed]}, "Made with nothing.")
    page = (tmp_path / "measured.md").read_text(encoding="utf-8")
    assert (
        "| 0.2 | 1 of 8 (without an answer on 1) | 0 | 0.30, 0.30 | 0 of 8 | 0 | not measured |"
        in page
    )


def test_a_scene_that_cannot_stand_before_the_cameras_is_told() -> None:
    quantity = replace(QUANTITIES["range"], values=(3.0,))
    with pytest.raises(
        ConfigError,
        match=(
            r"range 3 can't be set up for member 0: .* stands behind the board .*; choose others by"
            r" --first"
        ),
    ):
        list(measure(Bench(load_rig(find_rig(None)), [], [0], 1), quantity))


def test_no_scenes_at_all_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["scene", "sensitivity", "--seeds", "0"])
    assert stopped.value.code == 2
    assert "--seeds: '0' is not a whole number of 1 or more" in capsys.readouterr().err


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    points = [Measured(1.0, 4, {"a": Tally((0.2,))}, LIMIT)]
    with pytest.raises(ConfigError, match="can't be written"):
        write_figure(tmp_path / "file", QUANTITIES["range"], points)


def test_tallies_add() -> None:
    assert Tally((1.0,), 1, 0) + Tally((2.0, 3.0), 0, 1) == Tally((1.0, 2.0, 3.0), 1, 1)


@dataclass(slots=True)
class Knowing:
    """Gives set points, off by ``error_mm``, and counts how often it is asked; with ``breaks`` it
    fails instead.
    """

    ends_mm: list[Any]
    error_mm: float = 0.0
    breaks: bool = False
    name: str = "knowing"
    told: list[Calibration] = field(default_factory=list)

    version = "7"

    @property
    def parameters(self) -> Mapping[str, Any]:
        return {}

    def detect(self, frames: Frames, calibration: Calibration) -> Detection:
        assert frames.left.shape == (1024, 1360)
        self.told.append(calibration)
        if self.breaks:
            raise RuntimeError("no")
        return Detection(
            tuple(Teat(np.add(end, (0.0, self.error_mm, 0.0))) for end in self.ends_mm)
        )

"""A search for failures: it finds more of them than chance, tells no rate by them, and a failure can
be kept as a case of a recording.
"""

from __future__ import annotations

import json
import sys
import tomllib
from itertools import count, islice
from pathlib import Path

import numpy as np
import pytest

from bench.campaign.chunk import ASIDE, Rows, SceneRow, TeatRow
from bench.campaign.search import (
    Evaluate,
    NothingFitsError,
    Tried,
    distinct,
    grade_mm,
    search,
)
from bench.record.recording import Recording
from bench.scoring.errors import Floats
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.commands import Said, teatbench

PARAMETERS, SCENES, LIMIT_MM = 30, 60, 5.0


def rarely_failing(member: int) -> Evaluate:
    """A detector that fails near four places, each of six parameters of thirty: on 1 % of scenes."""
    chance = np.random.default_rng([member, 5])
    places = [(chance.choice(PARAMETERS, 6, replace=False), chance.random(6)) for _ in range(4)]

    def evaluate(point: Floats) -> Tried | None:
        if point[0] + point[1] > 1.7:  # can't be set up
            return None
        near = min(float(np.sqrt(np.mean((point[at] - to) ** 2))) for at, to in places)
        grade = LIMIT_MM * 0.15 / max(near, 1e-6)
        return Tried(point, grade, failed=grade > LIMIT_MM)

    return evaluate


@pytest.mark.slow
def test_a_search_finds_several_times_as_many_distinct_failures_as_chance() -> None:
    found = chance = 0
    for member in range(10):
        evaluate = rarely_failing(member)
        for seed in range(3):
            tried = list(search(evaluate, PARAMETERS, SCENES, seed))
            draw = np.random.default_rng([seed, *b"random"])
            points = (evaluate(draw.random(PARAMETERS)) for _ in count())
            evenly = list(islice(filter(None, points), SCENES))
            assert len(tried) == len(evenly) == SCENES
            found += len(distinct(tried))
            chance += len(distinct(evenly))
    assert chance > 0
    assert found >= 5 * chance  # 8 times; by climbing alone 2


def test_a_search_is_the_same_each_time_and_ends_where_nothing_can_be_set_up() -> None:
    once, again = (
        [one.point.tolist() for one in search(rarely_failing(1), PARAMETERS, 20, 4)]
        for _ in range(2)
    )
    assert once == again
    with pytest.raises(NothingFitsError):
        list(search(lambda _: None, 3, 5, 0))


def test_failures_beside_each_other_count_once() -> None:
    at = [Tried(np.full(4, place), 9.0, failed=True) for place in (0.1, 0.2, 0.5, 0.4)]
    assert distinct([*at, Tried(np.full(4, 0.9), 1.0, failed=False)], 0.2) == [at[0], at[2]]


def test_the_grade_rises_towards_a_failure_and_is_above_the_limit_on_one() -> None:
    def grade(
        failure: str = "", missed: int = 0, max_mm: float | None = 1.0, sd: float = 0.5
    ) -> float:
        row = SceneRow("ideal", 0, "d", 4, 0, 4 - missed, missed, 0, 0, max_mm, max_mm, failure, "")
        teat = TeatRow("ideal", 0, "d", 1, "found", 0.0, 0.0, 1.0, sd, 0.0, 0.0)
        got, failed = grade_mm(Rows((row,), (teat,)), "d", LIMIT_MM)
        assert failed == bool(failure)
        assert (got > LIMIT_MM) == failed
        return got

    rising = [
        *(grade(), grade(max_mm=3.0), grade(sd=4.0), grade(sd=90.0)),
        *(grade("error", max_mm=6.0), grade("missed", 1), grade("missed", 2)),
        grade("failure", 4, None),
    ]
    assert rising == sorted(rising)


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A search's folder, and a rig whose cameras are so small that the thesis's detector fails."""
    from bench.cli.main import main

    folder = tmp_path_factory.mktemp("search")
    rig, out = write_small_rig(folder), folder / "found"
    words = ["--family", "overlapping", "--scenes", "5", "--rate-scenes", "3", "--rig", str(rig)]
    assert main(["campaign", "search", *words, "--detector", "thesis", "--out", str(out)]) == 0
    return out, rig


@pytest.mark.slow
def test_hits_and_rates_stand_apart(found: tuple[Path, Path]) -> None:
    table = tomllib.loads((found[0] / "search.toml").read_text(encoding="utf-8"))
    (hits,), (rate,), failures = table["hits"], table["rates"], table["failures"]
    assert (hits["scenes"], rate["scenes"]) == (5, 3)
    assert len(failures) == hits["distinct"] > 0
    assert rate["low"] < rate["value"] <= rate["high"] <= 1.0
    first = failures[0]
    assert first["failure"] not in ("", ASIDE)
    assert 200.0 <= first["values"]["touching_y_mm"] <= 270.0
    assert set(first["point"]) == set(first["values"])


@pytest.mark.slow
def test_a_failure_is_kept_as_a_case(found: tuple[Path, Path], tmp_path: Path, said: Said) -> None:
    out, rig = found
    kept = tmp_path / "kept"
    wrote = said(0, "campaign keep {} 1 --into {} --name side-by-side", out, kept)
    assert wrote.out == f"side-by-side in {kept}\n"
    recording = Recording(kept)
    assert recording.frames == ("side-by-side",)
    assert [row.situation for row in recording.truth["side-by-side"]] == ["overlapping"] * 4
    told = (kept / "calibration.toml").read_text(encoding="utf-8")
    assert told == (rig.parent / "calibration.toml").read_text(encoding="utf-8")
    again = said(2, "campaign keep {} 1 --into {} --name side-by-side", out, kept)
    assert "there is such a frame already; give another --name" in again.err
    (kept / "calibration.toml").write_text("another", encoding="utf-8")
    assert "has another calibration" in said(2, "campaign keep {} 1 --into {}", out, kept).err
    assert Recording(kept).frames == ("side-by-side",)


PROGRAM = """
import json, sys
print(json.dumps({"ready": True}), flush=True)
for line in sys.stdin:
    print(json.dumps({"frame": json.loads(line)["frame"], "teats": ANSWER}), flush=True)
"""


@pytest.mark.slow
def test_the_gate_holds_a_kept_case(found: tuple[Path, Path], tmp_path: Path, said: Said) -> None:
    """A version that finds all visible ends, then one that finds none."""
    kept = tmp_path / "kept"
    said(0, "campaign keep {} 1 --into {} --name case", found[0], kept)
    ends = [{"world_mm": row.xyz_mm} for row in Recording(kept).truth["case"] if row.visible]
    runs: list[Path] = []
    for version, answer in (("old", ends), ("new", [])):
        folder = tmp_path / version
        folder.mkdir()
        program = PROGRAM.replace("ANSWER", json.dumps(answer))
        (folder / "program.py").write_text(program, encoding="utf-8")
        command = json.dumps([sys.executable, "program.py"])
        (folder / "mine.toml").write_text(f"command = {command}\n", encoding="utf-8")
        out = folder / "runs"
        # one scene shows no requirement
        assert teatbench("score {} --detector {} --out {}", kept, folder / "mine.toml", out) != 0
        runs += (folder / "runs").iterdir()
    told = said(1, "compare {} {} --gate", *runs).out
    assert "case passed and now fails: 3 missed" in " ".join(told.split())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "name", "why"),
    [(99, "new", "no failure 99 (there: 1 to"), (1, "a:b", "any file system takes")],
)
def test_what_can_not_be_kept_writes_nothing(
    number: int, name: str, why: str, found: tuple[Path, Path], tmp_path: Path, said: Said
) -> None:
    kept = tmp_path / "kept"
    wrote = said(2, f"campaign keep {{}} {number} --into {{}} --name {name}", found[0], kept)
    assert why in wrote.err
    assert not kept.exists()


def test_what_can_not_be_searched_is_refused(found: tuple[Path, Path], said: Said) -> None:
    out, _ = found
    assert "has a search already" in said(2, "campaign search --out {}", out).err
    both = said(2, "campaign search --detector fused --detector thesis --out {}", out / "new")
    assert "a search is for one detector, not 2" in both.err
    assert not (out / "new").exists()
    assert "no search is there" in said(2, "campaign keep {} 1 --into {}", out.parent, out).err

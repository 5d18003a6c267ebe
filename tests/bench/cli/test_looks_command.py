"""The ledger of looks, as `teatbench compare` writes and reads it."""

from __future__ import annotations

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from bench.record.check import check_record
from bench.record.schema import DATABASE
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.commands import Said, teatbench

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Three runs of one family's members, one scene each."""
    found, folder = {}, tmp_path_factory.mktemp("looks")
    rig = write_small_rig(folder)
    for number, name in enumerate("abc"):
        scenes, out = folder / f"scenes-{name}", folder / name
        how = "scene record --situation ideal --seeds 1 --rig {} --first {} --out {}"
        teatbench(how, rig, number, scenes)
        teatbench("score {} --out {} --detector fused", scenes, out)
        (found[name],) = out.iterdir()
    return found


@pytest.fixture
def runs(kept: dict[str, Path], tmp_path: Path) -> dict[str, Path]:
    """Copies of them, to be looked at."""
    return {name: shutil.copytree(run, tmp_path / name) for name, run in kept.items()}


def ledger(run: Path) -> dict[str, Any]:
    with closing(sqlite3.connect(run / DATABASE)) as db:
        rows = db.execute("SELECT key, value FROM facts WHERE key LIKE 'look %'").fetchall()
    return {key: json.loads(value) for key, value in rows}


def looked(said: Said, *folders: Path, code: int = 0) -> Any:
    (one,) = json.loads(said(code, "compare {} --together --json", list(folders)).out)["together"]
    return one


def verdict_on_false_teats(one: Any) -> tuple[str, str]:
    (found,) = [d for d in one["decisions"] if d["rule"].startswith("at most 0")]
    return found["verdict"], found["sentence"]


def test_a_look_is_written_into_every_run_once_and_the_records_stay_whole(
    runs: dict[str, Path], said: Said
) -> None:
    before = check_record(runs["a"]).head
    first = looked(said, runs["a"], runs["b"])
    assert first["looks"]["reliability"] == {
        "planned": 1, "own": [1, 1], "pooled": [], "left_out": [], "apart": 1,
    }  # fmt: skip
    (key,) = ledger(runs["a"])
    assert ledger(runs["a"]) == ledger(runs["b"])
    entry = ledger(runs["a"])[key]
    assert sorted(entry["runs"].values()) == ["a", "b"]
    assert entry["poses"]["reliability"] == 2
    assert looked(said, runs["b"], runs["a"]) == first  # the same data: no further look
    assert list(ledger(runs["a"])) == [key]
    for name in "ab":
        assert check_record(runs[name]).whole
    after = check_record(runs["a"])
    assert (after.head.digest, after.unlooked) == (before.digest, before)
    text = said(0, "store check {} --digest {}", runs["a"], before.wall_digest).out
    assert f"digest before 1 look of 'compare': {before.wall_digest}\n" in text
    text = said(0, "compare {} {} --together", runs["a"], runs["b"]).out
    assert "A further look: 2 came before it" in text


def test_what_grows_is_a_further_look_and_what_is_left_out_is_found(
    runs: dict[str, Path], said: Said
) -> None:
    looked(said, runs["a"], runs["b"])
    every = looked(said, runs["a"], runs["b"], runs["c"])
    assert every["looks"]["reliability"]["pooled"] == [2]
    assert verdict_on_false_teats(every)[0] == "met"
    verdict, sentence = verdict_on_false_teats(looked(said, runs["a"], runs["c"]))
    assert verdict == "inconclusive"
    assert "had also b: judge them all" in sentence
    # the look at the first two is what it was when it was taken
    again = looked(said, runs["a"], runs["b"])
    assert verdict_on_false_teats(again)[0] == "met"


def test_it_is_found_by_the_run_not_by_its_folder(
    runs: dict[str, Path], said: Said, tmp_path: Path
) -> None:
    looked(said, runs["a"], runs["b"])
    moved = runs["b"].rename(tmp_path / "elsewhere")
    shutil.rmtree(runs["a"])
    assert verdict_on_false_teats(looked(said, moved, runs["c"]))[0] == "inconclusive"


@pytest.mark.parametrize(
    ("edit", "says"),
    [
        ("DELETE FROM facts WHERE key LIKE 'look %'", "is missing"),
        ("UPDATE facts SET value = replace(value, '2', '1') WHERE key LIKE 'look %'", "as written"),
    ],
)
def test_a_ledger_that_was_edited_is_refused(
    runs: dict[str, Path], said: Said, edit: str, says: str
) -> None:
    looked(said, runs["a"], runs["b"])
    with closing(sqlite3.connect(runs["b"] / DATABASE)) as db:
        db.execute(edit)
        db.commit()
    refused = said(2, "compare {} {} --together", runs["b"], runs["c"]).err
    assert "fact 'look " in refused
    assert says in refused


def test_a_look_that_cannot_be_written_gives_no_verdict(runs: dict[str, Path], said: Said) -> None:
    with closing(sqlite3.connect(runs["b"] / DATABASE)) as db:
        db.execute("CREATE TRIGGER kept BEFORE INSERT ON facts BEGIN SELECT RAISE(FAIL, 'no'); END")
        db.commit()
    refused = said(2, "compare {} {} --together", runs["a"], runs["b"])
    assert "the look can't be written into" in refused.err
    assert not refused.out


def test_runs_of_different_scripts_are_pooled_only_where_asked(
    runs: dict[str, Path], said: Said, tmp_path: Path
) -> None:
    scenes, out = tmp_path / "other", tmp_path / "out"
    rig = write_small_rig(tmp_path)
    teatbench("scene record --situation low_contrast --seeds 1 --rig {} --out {}", rig, scenes)
    teatbench("score {} --out {} --detector fused", scenes, out)
    (other,) = out.iterdir()
    refused = said(2, "compare {} {} --together", runs["a"], other).err
    assert "different scripts" in refused
    assert "--across-scripts" in refused
    alone = said(2, "compare {} {} --across-scripts", runs["a"], other).err
    assert "use --together" in alone
    told = said(0, "compare {} {} --together --across-scripts", runs["a"], other).out
    assert "OF DIFFERENT SCRIPTS" in told


def test_a_comparison_is_a_look_too_and_the_same_frames_are_the_same_one(
    runs: dict[str, Path], said: Said, tmp_path: Path
) -> None:
    copy = shutil.copytree(runs["a"], tmp_path / "copy")
    for _ in range(2):
        said(0, "compare {} {} --gate", runs["a"], copy)
    (entry,) = ledger(runs["a"]).values()
    assert (entry["kind"], entry["after"]) == ("gate", [])

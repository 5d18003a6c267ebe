"""A run whose folder was damaged in any way: no command ends in a traceback, and none gives a
verdict as if nothing were wrong.
"""

from __future__ import annotations

import json
import random
import shutil
import sqlite3
import tomllib
from collections.abc import Callable
from contextlib import closing, nullcontext
from pathlib import Path

import pytest
from junitparser import Error, JUnitXml

import bench
from bench import DamagedError, write_report
from bench.api.records import DAMAGED
from bench.cli.main import main
from bench.console.watching import listed, reported
from bench.record.check import NOT_AS_WRITTEN, PRINTED
from bench.record.reader import read_run
from bench.record.schema import DATABASE
from bench.results.status import read_status
from bench.run.events import RunState
from tests.bench.commands import Output, Said, teatbench, words
from tests.bench.killed_runs import Silent, start
from tests.bench.operated_runs import files
from tests.bench.record.test_record import Damage, flipped, sql
from tests.bench.small_run import KEPT
from tests.conftest import ROOT
from tests.examples import few
from tests.undrawn import bare

pytestmark = pytest.mark.slow

OF_A_TRIAL = ("frames", "touches", "truth", "found", "scores", "detections")
EXPORTS = ("csv", "parquet", "mcap")
FRAME = Path("frames") / "001-place-1"


def written(name: Path | str, change: Callable[[bytes], bytes]) -> Damage:
    """A file with other bytes."""
    return lambda run: (run / name).write_bytes(change((run / name).read_bytes()))


def printed(text: str) -> Damage:
    """The last report's run.json."""

    def write(run: Path) -> None:
        (run / PRINTED).parent.mkdir()
        (run / PRINTED).write_text(text, encoding="utf-8")

    return write


def a_folder_for_a_picture(run: Path) -> None:
    (run / FRAME / "right.png").unlink()
    (run / FRAME / "right.png").mkdir()


OF_ROWS = tomllib.loads((ROOT / "tests/data/damages.toml").read_text(encoding="utf-8"))
DAMAGES: dict[str, Damage] = {
    **{
        f"all of {table} removed": sql(f"DELETE FROM {table}")
        for table in (*OF_A_TRIAL, "trials", "files", "facts", "events", "chain")
    },
    **{
        f"first of {table} removed": sql(f"DELETE FROM {table} WHERE rowid = 1")
        for table in (*OF_A_TRIAL, "bath", "sessions")
    },
    "a trial removed with all its rows": sql(
        *(f"DELETE FROM {table} WHERE trial = '002-again-1'" for table in OF_A_TRIAL),
        "DELETE FROM trials WHERE number = 2",
    ),
    **{
        f"{table}.{column} is {value}": sql(
            f"UPDATE {table} SET {column} = {value} WHERE rowid = 1"
        )
        for table, column, value in OF_ROWS["values"]
    },
    **{
        f"fact {key} is {value}": sql(f"UPDATE facts SET value = '{value}' WHERE key = '{key}'")
        for key, value in OF_ROWS["facts"]
    },
    **{f"schema {number}": sql(f"PRAGMA user_version = {number}") for number in (2, 1, 99)},
    **{
        f"{name}, {what}": written(name, change)
        for name in ("script.toml", "calibration.toml", "rig.toml")
        for what, change in (
            ("empty", lambda _: b""),
            ("cut", lambda data: data[: len(data) // 2]),
            ("not UTF-8", lambda data: data + b"\xff"),
            ("a digit changed", lambda data: data.replace(b"0", b"1", 1)),
        )
    },
}
OF_THE_FOLDER: dict[str, Damage] = {  # what a figure shows is as it was, or can't be read
    "no database": lambda run: (run / DATABASE).unlink(),
    "an empty database": written(DATABASE, lambda _: b""),
    "half a database": written(DATABASE, lambda data: data[: len(data) // 2]),
    "a database of zeros": written(DATABASE, lambda data: bytes(len(data))),
    **{
        f"{name}, {what}": written(FRAME / name, change)
        for name in ("left.png", "thermal_radiometric.png")
        for what, change in (
            ("empty", lambda _: b""),
            ("cut", lambda data: data[: len(data) // 2]),
            ("only a signature", lambda data: data[:8]),
            ("a bit flipped", lambda data: flipped(data, len(data) // 2, 1)),
            ("no picture", lambda _: b"hello"),
        )
    },
    "a lost picture": lambda run: (run / FRAME / "right.png").unlink(),
    "all pictures lost": lambda run: shutil.rmtree(run / "frames"),
    "a folder for a picture": a_folder_for_a_picture,
    **{
        f"the last report's run.json is {text}": printed(text)
        for text in (
            "",
            "{",
            "[]",
            '{"chain": 1}',
            '{"chain": {"links": 1}}',
            '{"chain": {"links": 1, "wall_digest": []}}',
        )
    },
}
DAMAGES |= OF_THE_FOLDER
# three of ten in each run, with each turn of the commands below; all of them weekly
EACH_RUN = [
    pytest.param(what, marks=() if place % 10 in (0, 2, 6) else pytest.mark.weekly)
    for place, what in enumerate(DAMAGES)
]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return Path(shutil.copytree(KEPT, tmp_path / "run"))


@pytest.fixture
def whole(tmp_path: Path) -> Path:
    return Path(shutil.copytree(KEPT, tmp_path / "whole"))


def reading(run: Path, whole: Path, out: Path) -> dict[str, list[str]]:
    """Every command that makes something of a run's record."""
    exports = {
        kind: words(f"store export {{}} --format {kind} --out {{}}", run, out / kind)
        for kind in EXPORTS
    }
    compare = words("compare {} {} --gate", whole, run)
    return exports | {
        "compare": [*compare, "--out", str(out / "compared")],
        "compare --json": [*compare, "--json"],
        "compare --together": [*compare, "--together"],
        "report --baseline": words("report {} --baseline {} --no-pdf", whole, run),
        "report": words("report {} --no-pdf", run),
        "resume": words("resume {}", run),
    }


def test_what_is_whole_is_taken_by_every_command(
    run: Path, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Else nothing below would mean anything. The kept run is finished, and its rig lies elsewhere:
    it isn't resumed; a gate finds the same answers in both.
    """
    for name, command in reading(run, whole, tmp_path / "out").items():
        assert main(command) == (2 if name == "resume" else 0), name
        assert NOT_AS_WRITTEN not in "".join(capsys.readouterr())
    assert not list(tmp_path.rglob(DAMAGED))


@pytest.mark.parametrize("what", EACH_RUN)
def test_a_damaged_run_is_refused_or_marked_as_damaged(
    run: Path, whole: Path, tmp_path: Path, what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    DAMAGES[what](run)
    assert teatbench("store check {}", run) in (1, 2)
    no_traceback(capsys)
    out, turn = tmp_path / "out", list(DAMAGES).index(what) // 2
    # each refuses by the same check; they take turns
    for name, command in list(reading(run, whole, out).items())[turn % 3 :: 3]:
        assert main(command) == 2, name
        note = no_traceback(capsys)
        assert not note.out, f"{name} gave something out"
        assert note.err.startswith((f"teatbench: {NOT_AS_WRITTEN}", f"teatbench: {run}")), name
    assert not out.exists()
    assert not (run / "report" / "index.html").exists()
    asked = reading(run, whole, out)
    # they take turns: a report takes its time, and writes its own run.json anew
    others = [name for name in asked if name != "report"]
    for name in (others[turn % len(others)], "report") if turn % 2 else ("report",):
        # figures take most of a report: every ninth damage is seen as far as they are made
        with bare() if what in OF_THE_FOLDER or turn % 9 else nullcontext():
            code = main([*asked[name], "--despite-damage"])
        note = no_traceback(capsys)
        if code == 0:
            assert name in EXPORTS, f"{name} gave a verdict"
        else:
            assert code in (2, 3, 4), f"{name} gave a verdict"
        assert code == 2 or NOT_AS_WRITTEN in note.err, name
    assert_told(out, run / "report", whole / "report")


def no_traceback(capsys: pytest.CaptureFixture[str]) -> Output:
    note = Output(*capsys.readouterr())
    assert "Traceback" not in note.err
    assert "internal error" not in note.err
    return note


def assert_told(out: Path, *reports: Path) -> None:
    """Nothing that was written can be taken for what was made of a whole record."""
    for kind in EXPORTS:
        files = list((out / kind).glob("*"))
        assert not files or (out / kind / DAMAGED) in files
    for page in [*(report / "index.html" for report in reports), out / "compared" / "index.html"]:
        if page.exists():
            text = page.read_text(encoding="utf-8")
            assert f'<p class="alarm">{NOT_AS_WRITTEN}' in text
            assert '<span class="word-text">met' not in text
    for report in reports:
        if (report / "index.html").exists():
            made = json.loads((report / "run.json").read_text(encoding="utf-8"))
            assert made["damage"]
            assert made["verdict"] == "inconclusive"
            assert "<failure" not in (report / "junit.xml").read_text(encoding="utf-8")
            rows = (report / "trials.csv").read_text(encoding="utf-8").splitlines()[1:]
            assert all(NOT_AS_WRITTEN in row for row in rows)


def test_an_export_that_fails_amid_its_tables_leaves_none(
    run: Path, tmp_path: Path, said: Said
) -> None:
    sql("UPDATE trials SET captured_s = 'noon'")(run)
    said(2, "store export {} --format parquet --out {} --despite-damage", run, tmp_path / "out")
    assert not [*tmp_path.glob("out/*")]


@pytest.mark.weekly
def test_a_stopped_run_goes_on_despite_damage_and_stays_damaged(tmp_path: Path, said: Said) -> None:
    class Stopping(Silent):
        def trial(self, done: int, total: int, name: str) -> None:
            if done == 1:
                raise KeyboardInterrupt

    files(tmp_path)
    run, ending = start(tmp_path, progress=Stopping())
    assert ending is RunState.ABORTED
    sql("UPDATE detections SET wall_seconds = 0.001")(run)
    refused = f"{NOT_AS_WRITTEN}, and is refused. {run.name}: table detections, row 1"
    assert refused in said(2, "resume {}", run).err
    assert len(read_run(run).trials) == 1
    note = said(4, "resume {} --despite-damage", run)
    assert note.err.count(f"{NOT_AS_WRITTEN}. ") == 2, "before and after all else"
    assert "Verdict: no verdict" in note.out
    assert (read_run(run).ending, len(read_run(run).trials)) == ("finished", 3)
    assert_told(tmp_path, run / "report")
    said(1, "store check {}", run)


def test_a_refused_report_withdraws_the_one_before(run: Path, tmp_path: Path, said: Said) -> None:
    report, summary = run / "report", tmp_path / "summary.md"
    assert teatbench("report {} --no-pdf", run) in (0, 1, 4)
    (report / "report.pdf").write_bytes(b"%PDF of before")
    printed = json.loads((run / PRINTED).read_text(encoding="utf-8"))
    assert read_status(run).word != "no verdict"
    sql("UPDATE detections SET wall_seconds = 0.001")(run)
    assert read_status(run).word == "no verdict", "the console says so before any report"
    said(2, "report {} --no-pdf --summary {}", run, summary)
    assert {one.name for one in report.iterdir() if one.is_file()} == {"junit.xml", "run.json"}
    (case,) = [case for suite in JUnitXml.fromfile(str(report / "junit.xml")) for case in suite]
    assert isinstance(case.result[0], Error)
    assert NOT_AS_WRITTEN in str(case.result[0].message)
    now = json.loads((run / PRINTED).read_text(encoding="utf-8"))
    assert now["chain"] == printed["chain"], "by which the damage is found again"
    assert (now["verdict"], now["judgements"], now["trials"]) == ("inconclusive", [], [])
    assert set(now["status"]["verdicts"].values()) == {"no verdict"}
    assert now["status"]["word"] == "no verdict"
    assert now["damage"]
    assert NOT_AS_WRITTEN in summary.read_text(encoding="utf-8")
    with pytest.raises(DamagedError):
        write_report(run)


def test_no_list_leads_to_a_report_of_before_the_damage(run: Path) -> None:
    def listed_so() -> set[bool]:
        (card,), (one,) = listed(run.parent), bench.list_runs(run.parent).runs
        return {card["report"], bool(one.report), reported(run)}

    assert listed_so() == {False}
    write_report(run)
    assert listed_so() == {True}
    sql("UPDATE detections SET wall_seconds = 0.001")(run)
    assert listed_so() == {False}, "its page says what it said before"
    teatbench("report {} --no-pdf --despite-damage", run)
    assert listed_so() == {True}, "its page says that it is damaged"
    teatbench("report {} --no-pdf", run)
    assert listed_so() == {False}, "it is withdrawn"


def test_a_report_of_a_record_that_was_cut_off_does_not_make_it_whole(
    run: Path, said: Said
) -> None:
    """The new report may not name the chain as it is now: the next check would find nothing."""
    said(0, "report {} --no-pdf", run)
    printed = json.loads((run / PRINTED).read_text(encoding="utf-8"))["chain"]
    cut = "(SELECT number FROM chain WHERE wall_covers LIKE '%wall_ended%')"
    sql(
        "DELETE FROM facts WHERE key IN ('ending', 'retries', 'wall_ended')",
        f"DELETE FROM chain WHERE number >= {cut} - 3",
        "DELETE FROM events WHERE kind = 'end'",
    )(run)
    why = f"the chain doesn't pass through the digest of {PRINTED.as_posix()}"
    for _ in range(2):
        assert why in said(2, "report {} --no-pdf", run).err
        assert teatbench("report {} --no-pdf --despite-damage", run) in (3, 4)
        assert json.loads((run / PRINTED).read_text(encoding="utf-8"))["chain"] == printed


@pytest.mark.parametrize("seed", few(range(4), 4))
def test_a_bit_flipped_anywhere_in_the_database_changes_nothing_unseen(
    run: Path, tmp_path: Path, seed: int, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where the check finds nothing, all rows are the same: the bit lay where nothing is stored."""
    chance, data, before = random.Random(seed), (run / DATABASE).read_bytes(), dumped(run)
    for _ in range(25):
        at, bit = chance.randrange(len(data)), 1 << chance.randrange(8)
        (run / DATABASE).write_bytes(flipped(data, at, bit))
        code = teatbench("store export {} --format csv --out {}", run, tmp_path / "csv")
        no_traceback(capsys)
        assert code == 2 or (code == 0 and dumped(run) == before), f"bit {bit} of byte {at}"


def dumped(run: Path) -> list[str]:
    with closing(sqlite3.connect(run / DATABASE)) as db:
        return [line for line in db.iterdump() if line.startswith("INSERT")]

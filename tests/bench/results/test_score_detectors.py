"""Scoring several detectors at once, one of them in a process of its own that fails: the record,
the table, and what is left behind.
"""

from __future__ import annotations

import csv
import html
import io
import json
import shutil
import signal
import struct
import sys
import zlib
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pytest

import bench
from bench.record.reader import RunRecord, read_run
from bench.report.tables import score_table
from bench.results.verdicts import Latency, failures_text, judge, latency_of, stored_rules
from bench.scoring.decisions import Verdict
from tests.bench.commands import Said, teatbench, words
from tests.bench.forked import begin
from tests.bench.small_recording import ENDS_MM, write_recording
from tests.bench.small_run import written_anew
from tests.plain_text import plain_text
from tests.waiting import PATIENCE_S, alive, within

pytestmark = pytest.mark.slow

PROGRAM = f"""
import json, sys
print(json.dumps({{"ready": True}}), flush=True)
for line in sys.stdin:
    asked = json.loads(line)
    number = int(asked["frame"])
    if number == 3:
        print("no cheese", file=sys.stderr, flush=True)
        sys.exit(9)
    ends = {ENDS_MM}
    if number == 2:
        ends[0][0] += 3
        ends.append([0, 0, 0])
    teats = [{{"world_mm": end, "covariance_mm2": None}} for end in ends]
    print(json.dumps({{"frame": asked["frame"], "teats": teats, "hidden": 0}}), flush=True)
"""


@dataclass(frozen=True)
class Scored:
    code: int
    run: RunRecord
    said: str


SCORE = "score {} --out {}"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("recordings") / "five")


@pytest.fixture(scope="module")
def scored(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Scored:
    folder = tmp_path_factory.mktemp("scored")
    (folder / "program.py").write_text(PROGRAM, encoding="utf-8")
    text = (
        f'name = "mine"\nversion = "3"\ncommand = [{json.dumps(sys.executable)},'
        ' "program.py"]\ntime_limit_s = 60\n'
    )
    (folder / "mine.toml").write_text(text, encoding="utf-8")
    with redirect_stdout(io.StringIO()) as said:
        detectors = ("--detector", folder / "mine.toml", "--detector", "thesis")
        code = teatbench(f"{SCORE} {{}}", recording, folder / "runs", detectors)
    (run,) = (folder / "runs").iterdir()
    return Scored(code, read_run(run), said.getvalue())


def test_every_frame_has_its_answer_and_its_outcome(scored: Scored) -> None:
    all_rows = [row for trial in scored.run.trials for row in trial.detections]
    rows = [row for row in all_rows if row["detector"] == "mine"]
    outcomes = ["answered", "answered", "failure", "answered", "answered"]
    assert [row["outcome"] for row in rows] == outcomes
    assert [row["cold"] for row in rows] == [1, 0, 0, 1, 0], "each process has a first call"
    assert [row["wall_start_up_s"] is not None for row in rows] == [True, False, False, True, False]
    assert rows[2]["reason"] == "the detector failed: it ended with exit code 9"
    assert rows[2]["wall_stderr"] == "no cheese"
    item = scored.run.facts["items"]["mine"]
    assert item["version"] == "3"
    assert "program.py" in item["configuration"]
    assert "files_sha256" in item["configuration"]


def test_where_the_benchs_own_eyes_see_no_end_the_first_screen_says_so(scored: Scored) -> None:
    """The detector's misses stand, for nothing shows them to be another's; but not without it."""
    text = plain_text(scored.run.folder / "report" / "index.html")
    page = " ".join(text.split())
    unseen = "Cameras not checked: whether the cameras show the known ends where they are"
    measured = "(0 of 4 visible ends measured in 2 poses)"
    assert f"{unseen} {measured}, so an error may be theirs." in page
    assert f"{unseen} {measured}. " in page, "among the truth's figures"
    held = "held against the sizes of 15 pictures and the places of 10 visible ends"
    assert f"The calibration was {held}." in page
    assert scored.code == 1


def test_latency_leaves_first_calls_and_failures_out(scored: Scored) -> None:
    mine = latency_of(scored.run, "mine")
    assert (len(mine.seconds), len(mine.cold_s), dict(mine.unanswered)) == (2, 2, {"failure": 1})
    assert mine.start_up_s is not None
    thesis = latency_of(scored.run, "thesis")
    assert (len(thesis.seconds), len(thesis.cold_s), thesis.start_up_s) == (4, 1, None)
    assert latency_of(scored.run, "nobody") == Latency()
    assert (Latency().percentile_s(99), failures_text(Latency())) == (None, "none")
    of_mine, _ = judge(scored.run, stored_rules(scored.run.folder))
    assert {d.n for d in of_mine.decisions if d.unit == "s"} == {2}


def test_the_table_says_it_all(scored: Scored) -> None:
    table = score_table(scored.run)
    assert table in scored.said
    cells = {
        (c[1], c[2]): c
        for line in table.splitlines()
        if line.startswith("| ") and len(c := [x.strip() for x in line.split("|")]) > 3
    }
    calm, windy, whole = (cells[situation, "mine"] for situation in ("calm", "windy", "all"))
    # frame 2: one end 3 mm off, one false end; frame 3 fails, so frame 4 is the new process's
    # first: its count goes on
    assert calm[3:7] == ["2", "4 of 4", "1", "0.75, 3.00, 3.00"]
    assert windy[3:7] == ["3", "4 of 6", "0", "0.00, 0.00, 0.00"]
    assert whole[3:7] == ["5", "8 of 10", "1", "0.38, 3.00, 3.00"]
    assert windy[8] == "1 failure"
    assert cells["all", "thesis"][4:7] == ["0 of 10", "0", "not measured"]
    assert "the first call of each process (cold)" in table
    assert "mine: first call " in table


def test_the_report_and_the_exports_say_it_too(scored: Scored, tmp_path: Path) -> None:
    page = (scored.run.folder / "report" / "index.html").read_text(encoding="utf-8")
    for note in ("mine wrote to its standard error: no cheese", "1 failure", "stand apart"):
        assert note in page
    with (scored.run.folder / "report" / "trials.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["detector"] == "mine"]
    assert [row["outcome"] for row in rows].count("failure") == 1
    assert [row["cold"] for row in rows] == ["1", "0", "0", "1", "0"]
    copy = Path(shutil.copytree(scored.run.folder, tmp_path / "copy"))  # without the detector
    rules = (copy / "rules.toml").read_text(encoding="utf-8")
    (copy / "rules.toml").write_text(rules.replace('["thesis"]', '["elsewhere"]'), encoding="utf-8")
    assert teatbench("report {}", written_anew(copy)) in (0, 1, 4)


def test_without_truth_there_is_no_table(recording: Path, tmp_path: Path, said: Said) -> None:
    bare = Path(shutil.copytree(recording, tmp_path / "bare"))
    (bare / "truth.csv").unlink()
    note = said(4, SCORE, bare, tmp_path / "runs").out
    assert "There is no truth, so nothing was scored." in note
    page = plain_text(next((tmp_path / "runs").glob("*/report/index.html")))
    assert "poses have no truth: they show nothing of how well a detector finds teats." in page
    assert "success rate of" not in page


def test_detect_tells_outcomes_and_first_calls(recording: Path, tmp_path: Path, said: Said) -> None:
    (tmp_path / "program.py").write_text(PROGRAM, encoding="utf-8")
    command = f"exec:{sys.executable} {tmp_path / 'program.py'}"
    note = said(0, "detect {} --json --detector {}", recording, command).out
    lines = [json.loads(line) for line in note.strip().splitlines()]
    assert [line["detector"] for line in lines] == ["exec-program"] * 5
    assert [line.get("outcome") for line in lines] == [None, None, "failure", None, None]
    assert [line.get("cold", False) for line in lines] == [True, False, False, True, False]


def test_a_detector_that_crashes_is_no_bad_detector(
    recording: Path, tmp_path: Path, said: Said
) -> None:
    program = "import sys\nsys.exit('cannot find model.bin')"
    (tmp_path / "crasher.py").write_text(program, encoding="utf-8")
    command = f"exec:{sys.executable} {tmp_path / 'crasher.py'}"
    runs = tmp_path / "runs"
    note = " ".join(said(4, f"{SCORE} --detector {{}}", recording, runs, command).out.split())
    why = "the detector failed: it ended with exit code 1 before it was ready."
    last = 'it is switched off for the rest of the run. Its last words: "cannot find model.bin".'
    assert f"exec-crasher did not answer on 5 of 5 frame sets: {why}" in note
    assert last in note
    assert "First find out why the detector did not answer" in note
    assert "has to become better" not in note
    beside = said(
        1, f"{SCORE} --detector {{}} --detector fused", recording, tmp_path / "two", command
    )
    both = " ".join(beside.out.split())
    assert "Next: exec-crasher: First find out why the detector did not answer" in both
    assert "poses such as these" not in both
    (run,) = runs.iterdir()
    (judgement,) = judge(read_run(run), stored_rules(run))
    assert {decision.verdict for decision in judgement.decisions} == {Verdict.NOT_MEASURED}
    page = html.unescape((run / "report" / "index.html").read_text(encoding="utf-8"))
    assert page.index("did not answer on 5 of 5 frame sets") < page.index('id="results"')
    listed = said(0, "runs {}", runs).out
    (row,) = (line for line in listed.splitlines() if "exec-crasher" in line and "│" in line)
    assert row.count("not measured") == 3, "found, false, largest error"
    assert "%" not in listed
    (one,) = bench.list_runs(runs).runs
    assert one.results[-1].text == "It gave no answer that was scored."
    rates = page[page.index("Rates, detector exec-crasher") :][:4000]
    assert "100 %" not in rates.partition("no time-out")[0]


def test_of_several_reasons_the_one_that_came_most_is_told(
    recording: Path, tmp_path: Path, said: Said
) -> None:
    odd = "if number == 1:\n        print('junk', flush=True)\n    if number > 2:"
    (tmp_path / "mine.py").write_text(PROGRAM.replace("if number == 3:", odd), encoding="utf-8")
    command = f"exec:{sys.executable} {tmp_path / 'mine.py'}"
    out = said(1, f"{SCORE} --detector {{}}", recording, tmp_path / "runs", command).out
    why = "for 2 reasons, most often (3 times): the detector failed: it ended with exit code 9."
    assert f"did not answer on 4 of 5 frame sets, {why}" in " ".join(out.split())


def test_nothing_is_met_by_silence(recording: Path, tmp_path: Path, said: Said) -> None:
    silent_once = PROGRAM.replace("if number == 2:", "if False:")
    command = f"command = [{json.dumps(sys.executable)}, 'mine.py']\n"
    (tmp_path / "mine.toml").write_text(command, encoding="utf-8")
    (tmp_path / "mine.py").write_text(silent_once, encoding="utf-8")
    runs, mine = tmp_path / "runs", tmp_path / "mine.toml"
    note = " ".join(said(4, f"{SCORE} --detector {{}}", recording, runs, mine).out.split())
    why = 'the detector failed: it ended with exit code 9. Its last words: "no cheese".'
    assert f"mine did not answer on 1 of 5 frame sets: {why}" in note
    (run,) = runs.iterdir()
    (judgement,) = judge(read_run(run), stored_rules(run))
    (false,) = (decision for decision in judgement.decisions if "false" in decision.name)
    assert (false.measured, false.verdict) == (0.0, Verdict.INCONCLUSIVE)
    assert "did not answer on 1 of 5 frame sets" in false.sentence
    assert Verdict.MET not in {decision.verdict for decision in judgement.decisions}


def test_a_score_that_fails_leaves_no_half_a_run(
    recording: Path, tmp_path: Path, said: Said
) -> None:
    odd = Path(shutil.copytree(recording, tmp_path / "odd"))
    last = sorted((odd / "frames").iterdir())[-1] / "right.png"
    header = struct.pack(">IIBBBBB", 60000, 60000, 8, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(bytes(9))), (b"IEND", b"")]
    packed = [
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    ]
    last.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(packed))
    why = f"{last}: is not an image that can be read"
    assert why in said(2, SCORE, odd, tmp_path / "runs").err
    assert not (tmp_path / "runs").exists()
    assert why in said(0, "detect {}", odd).out


@pytest.mark.skipif(
    sys.platform != "linux", reason="sends a POSIX signal, and looks for processes in /proc"
)
def test_ctrl_c_while_a_program_is_silent_ends_both(recording: Path, tmp_path: Path) -> None:
    silent = (
        f"import os, time\nopen({str(tmp_path / 'pid')!r},"
        " 'w').write(str(os.getpid()))\nprint('{\"ready\": true}', flush=True)\n"
    )
    (tmp_path / "silent.py").write_text(
        f"{silent}open({str(tmp_path / 'up')!r}, 'w')\ntime.sleep(600)", encoding="utf-8"
    )
    program = f"exec:{sys.executable} {tmp_path / 'silent.py'}"
    with begin(words(f"{SCORE} --detector {{}}", recording, tmp_path / "runs", program)) as bench:
        within((tmp_path / "up").is_file, "it is up")
        bench.send_signal(signal.SIGINT)
        said, _ = bench.communicate(timeout=PATIENCE_S)
    assert "Traceback" not in said
    assert bench.returncode == 3, said
    pid = int((tmp_path / "pid").read_text(encoding="ascii"))
    within(lambda: not alive(pid), "the program has ended")

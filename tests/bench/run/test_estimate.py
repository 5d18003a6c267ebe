"""What runs took is compared with what was expected, and makes the next estimate better."""

from __future__ import annotations

import io
import json
import re
import shutil
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.record.reader import RunRecord
from bench.rig.loading import LoadedRig, find_rig, load_rig
from bench.rig.model import Operator
from bench.run.estimate import (
    ASSUMED,
    FILE,
    LOOKS_BACK,
    estimate,
    estimate_text,
    figures,
    needs,
    read_durations,
    took,
    write_durations,
)
from bench.script.model import LoadedScript, find_script, load_script
from tests.bench.operated_runs import SCRIPT, files, run_of


@dataclass(frozen=True)
class Heated:
    rig: LoadedRig
    script: LoadedScript
    folder: Path
    said: str

    @property
    def run(self) -> RunRecord:
        return run_of(self.folder)


@pytest.fixture(scope="module")
def heated(tmp_path_factory: pytest.TempPathFactory) -> Heated:
    """A run of some minutes: it heats by 5 K, and each prompt takes half a minute."""
    folder, said = tmp_path_factory.mktemp("heated"), io.StringIO()
    script = SCRIPT.replace("window_s = 2.0", "window_s = 600.0")
    arguments = files(folder, emulation="prompt_s = 30.0", script=script)
    rig_file = folder / "rig.toml"
    text = rig_file.read_text(encoding="utf-8").replace(
        "bath_start_c = 33.0", "bath_start_c = 28.0"
    )
    rig_file.write_text(text, encoding="utf-8")
    with redirect_stdout(said):
        assert main([*arguments, "--events", str(folder / "events.jsonl")]) in (0, 1, 4)
    return Heated(load_rig(rig_file), load_script(folder / "script.toml"), folder, said.getvalue())


@pytest.mark.weekly
@pytest.mark.slow
def test_a_run_teaches_how_long_the_next_takes(heated: Heated) -> None:
    rig, script, run, folder = heated.rig, heated.script, heated.run, heated.folder / "runs"
    spent = took(run)
    first, second = (
        estimate(rig, script, {**ASSUMED, **known}).total_s
        for known in ({}, read_durations(folder, rig))
    )
    assert abs(second - spent["total_s"]) < 0.5 * abs(first - spent["total_s"])
    measured = figures(run, rig, script, spent)
    assert measured["touch"] == pytest.approx(30.0, abs=2.0), (
        "a prompt takes the emulated operator so long"
    )
    assert measured["start"] > 0.0
    assert measured["detecting"] > 0.0
    assert read_durations(folder, rig) == pytest.approx(measured)


@pytest.mark.weekly
@pytest.mark.slow
def test_an_emulated_run_takes_as_long_as_estimated_and_says_what_is_left_all_the_while(
    heated: Heated,
) -> None:
    """Of what is emulated nothing is assumed: hands take what the rig file says, and the bath is
    simulated, as by a dry run.
    """
    run, expected = heated.run, needs(heated.rig, heated.script).time
    spent, minutes = took(run), round(expected.total_s / 60)
    assert expected.total_s == pytest.approx(spent["total_s"], rel=0.05)
    assert expected.settling_s == pytest.approx(spent["settling_s"], rel=0.05)
    said, took_min = heated.said, f"{spent['total_s'] / 60:.0f}"
    left = f"3 trials, about {minutes} min left of the bench's time."
    assert said.startswith(f"{left} Run folder: {run.folder}\n")
    assert f"It took {took_min} min of the bench's time; {minutes} min had been expected." in said
    lines = list(map(json.loads, (heated.folder / "events.jsonl").read_bytes().splitlines()))
    doing = [line for line in lines if line["what"] == "doing" and line["t_s"] is not None]
    after = [line for line in doing if "left" not in line]
    assert after == doing[-len(after) :], "from the first second on"
    ends = ["going to safe", "all instruments are safe", "writing the report"]
    assert [line["text"] for line in after] == ends
    doing = doing[: -len(after)]
    for line in doing:
        left_min = int(re.sub("less than a", "about 0", line["left"]).split()[1])
        due_min = (spent["total_s"] - line["t_s"]) / 60
        assert left_min == pytest.approx(due_min, abs=0.1 * minutes), line
    bath = "waiting for the bath: "
    waiting = [line["text"].removeprefix(bath) for line in doing if line["text"].startswith(bath)]
    assert waiting[1].endswith("degC, needs 33 ± 0.15")
    assert any(text.startswith("stable for 4 of 10 min") for text in waiting)
    assert any(re.fullmatch(r"stable for \d of 10 min; .*K.*, needs .*", text) for text in waiting)


def test_the_newest_runs_count_most_and_rigs_are_kept_apart(tmp_path: Path) -> None:
    rig = load_rig(find_rig(None))
    expected = estimate(rig, load_script(find_script(None)))
    for name, new in (("1-first", {"touch": 10.0}), ("2-second", {"touch": 20.0, "heating": 0.4})):
        write_durations(tmp_path / name, rig, expected, {"total_s": 5.0}, new)
    assert read_durations(tmp_path, rig) == {"touch": 15.0, "heating": 0.4}
    for name, text in (
        ("3-broken", "[1"),
        ("4-other", json.dumps({"rig": "another", "figures": {"touch": 99.0}})),
        ("5-odd", "{}"),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name / FILE).write_text(text, encoding="utf-8")
    assert read_durations(tmp_path, rig) == {"touch": 15.0, "heating": 0.4}
    for number in range(2 * LOOKS_BACK):  # however many runs of others came since
        shutil.copytree(tmp_path / "4-other", tmp_path / f"6-other-{number}")
    assert read_durations(tmp_path, rig) == {"touch": 15.0, "heating": 0.4}
    kept = json.loads((tmp_path / "1-first" / FILE).read_text(encoding="utf-8"))
    assert kept["rig"] == f"{rig.rig.name}, operator emulator:"
    assert kept["expected_s"]["total_s"] == expected.total_s


@pytest.mark.slow
def test_needs_by_hand() -> None:
    rig, script = load_rig(find_rig(None)), load_script(find_script(None))
    by_hand = replace(rig, rig=rig.rig.model_copy(update={"operator": Operator(url="console:")}))
    first, by_then = (needs(by_hand, script, measured).time for measured in (None, {"touch": 16.0}))
    usual = estimate(rig, script)
    assert (first.set_ups_s, first.touches_s) == (usual.set_ups_s, usual.touches_s)
    assert (usual.preparing_s, usual.detecting_s) == (20.0 + (1 + 5 + 1) * 8.0, 18 * 2.0)
    twice_s = first.preparing_s + (1 + 5 + 1) * 8.0  # homing, and the checks of the arm
    assert by_then == replace(first, touches_s=2.0 * first.touches_s, preparing_s=twice_s)
    assert needs(rig, script).prompts == 1 + 5 + 1 + 18 * (1 + 4) == 97, "one request a teat end"
    plane = load_script(find_script("plane-map"))
    assert needs(rig, plane).prompts < len(plane.planned), "carried: most trials ask nobody"
    assert needs(by_hand, plane).time.touches_s == pytest.approx(7 * 3 * 8.0), (
        "the first, before every 26th further one, and the last"
    )
    took_20_min = "It took 20 min of the bench's time; 74 min had been expected."
    assert estimate_text(usual, {"total_s": 1200.0}) == took_20_min
    assert set(ASSUMED) >= {"heating", "touch", "set-up", "placing"}

"""A trial as often as the operator wants it, the time left by what trials took so far, and poses on
the emulated rig as planned.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from bench.record.reader import RunRecord, read_run
from bench.record.writer import Store
from bench.rig.loading import LoadedRig, load_rig
from bench.run.context import RunContext
from bench.run.events import RunState
from bench.run.start import run_queue
from bench.run.trial import Attempts, choose_truth
from bench.script.model import LoadedScript, find_script, load_script
from bench.script.planned_trials import PlannedTrial
from instruments.clock import VirtualClock
from instruments.errors import LinkError
from instruments.operators.operator import DONE, Answer, NextTrial, Request
from instruments.stage.driver import OwnStage
from instruments.world.phantom import PIVOT_MM
from tests.bench.killed_runs import Silent, start
from tests.bench.operated_runs import files, shipped_rig

PLANNED = load_script(find_script(None)).planned[:5]


class Context:
    """What of a run's context is used: notes what the operator is told, and the events."""

    def __init__(self, folder: Path) -> None:
        self.clock = VirtualClock()
        self.store = Store.create(folder / "run", {})
        self.script = SimpleNamespace(planned=PLANNED)
        self.states = SimpleNamespace(away_s=0.0)
        self.trials: list[tuple[int, int, float | None]] = []
        self.said: list[str] = []
        self.warned: list[str] = []
        self.events = SimpleNamespace(warn=self.warned.append)

    def ask(self, request: Request) -> Answer:
        assert isinstance(request, NextTrial)
        self.trials.append((request.number, request.of, request.left_s()))
        return DONE

    def event(self, kind: str, text: str) -> None:
        self.said.append(f"{kind} {text}")


@pytest.fixture
def note(tmp_path: Path) -> Iterator[Context]:
    context = Context(tmp_path)
    with closing(context.store):
        yield context


def attempts(
    note: Context, once: Callable[[PlannedTrial], None], each_s: float | None = None
) -> Attempts:
    return Attempts(cast(RunContext, note), once, each_s=each_s)


@pytest.mark.parametrize(
    ("takes_s", "expected_s", "left_s"),
    [
        ([3600.0, 60.0, 120.0, 60.0, 60.0], None, [None, None, 180.0, 180.0, 80.0]),
        ([60.0] * 5, 100.0, [500.0, 400.0, 180.0, 120.0, 60.0]),
    ],
    ids=["the first waits for the bath to heat up", "until then by what was expected"],
)
def test_the_time_left_is_told_from_the_third_trial_on(
    takes_s: list[float], expected_s: float | None, left_s: list[float | None], note: Context
) -> None:
    takes = iter(takes_s)
    all_of = attempts(note, lambda _: note.clock.sleep(next(takes)), expected_s)
    for trial in PLANNED:
        all_of.run(trial)
    assert note.trials == [(number, 5, left) for number, left in enumerate(left_s, 1)]


def test_time_that_was_no_work_is_kept_out_of_the_time_left(note: Context) -> None:
    """A pause, or a suspension: it says nothing of the trials to come."""

    def once(_: PlannedTrial) -> None:
        note.clock.sleep(60.0)
        note.clock.sleep(1000.0)
        note.states.away_s += 1000.0

    all_of = attempts(note, once)
    for trial in PLANNED:
        all_of.run(trial)
    assert [left_s for _, _, left_s in note.trials[2:]] == [180.0, 120.0, 60.0]


SCRIPT = """title = "poses"
detectors = ["thesis"]

[bath]
set_point_c = 33.0
window_s = 2.0
slope_k_per_min = 10.0

[[requirements]]
kind = "bath_in_band"
name = "bath"
band_k = 0.15

[[trials]]
name = "one"
situation = "poses"
layout = "mine.toml"
set_up = "Two teats."
poses = [{ x_mm = 10.0, y_mm = -5.0 }, { x_mm = -3.0, z_mm = 12.0, yaw_deg = 20.0 }]
"""
LAYOUT = """about = "two"
[[teats]]
name = "LF"
base_mm = [-200.0, 250.0]
[[teats]]
name = "RF"
base_mm = [-150.0, 240.0]
length_mm = 120.0
"""
STANDING_MM = np.array([[-200.0, 250.0, 135.0], [-150.0, 240.0, 120.0]])


def script(folder: Path, more: str = "") -> LoadedScript:
    (folder / "mine.toml").write_text(LAYOUT, encoding="utf-8")
    (folder / "poses.toml").write_text(SCRIPT + more, encoding="utf-8")
    return load_script(folder / "poses.toml")


def rig(folder: Path) -> LoadedRig:
    """The emulated rig, its bath warm."""
    return load_rig(shipped_rig(folder, emulation="bath_start_c = 33.0"))


def run(rig: LoadedRig, loaded: LoadedScript, out: Path) -> RunRecord:
    ((folder, ending),) = run_queue(rig, [loaded], out, Silent())
    assert ending is RunState.FINISHED
    return read_run(folder)


def exact_mm(record: RunRecord) -> list[np.ndarray]:
    return [
        np.array([json.loads(row["exact_mm"]) for row in trial.truth]) for trial in record.trials
    ]


def turned(points_mm: np.ndarray, deg: float) -> np.ndarray:
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    pivot = np.array([*PIVOT_MM, 0.0])
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray((points_mm - pivot) @ turn + pivot)


@pytest.mark.slow
def test_the_phantom_stands_where_the_script_says_reached_from_the_sides_that_are_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stage of two axes leaves height and turn to the operator."""
    went: list[tuple[float, float]] = []
    begin = OwnStage.begin_move

    def noted(self: OwnStage, x_mm: float, y_mm: float, **more: float | None) -> None:
        went.append((x_mm, y_mm))
        begin(self, x_mm, y_mm, **more)

    monkeypatch.setattr(OwnStage, "begin_move", noted)
    loaded = script(tmp_path, 'approach = ["+x", "-y"]\napproach_mm = 4.0\n')
    record = run(rig(tmp_path), loaded, tmp_path / "runs")
    to = [(-140.0, -142.5), (-153.0, -137.5)]  # the reference place is (-150, -137.5)
    expected = [place for x, y in to for place in ((x + 4.0, y), (x, y), (x, y - 4.0), (x, y))]
    assert went == expected
    moved = turned(STANDING_MM, 20.0) + np.array([-3.0, 0.0, 12.0])
    wanted = [STANDING_MM + np.array([10.0, -5.0, 0.0])] * 2 + [moved] * 2
    assert np.array(exact_mm(record)) == pytest.approx(np.array(wanted), abs=0.05)
    assert [trial.pose for trial in record.trials] == ["one-1", "one-1", "one-2", "one-2"]
    assert "stage" in record.facts["identities"]
    assert (record.folder / "mine.toml").read_text(encoding="utf-8") == LAYOUT
    kept = record.facts["pose set"]
    sides = "each reached from +x, -y (4 mm away)"
    assert kept["chosen"] == [f"one: 2 poses as written; layout mine.toml; {sides}."]
    pose = ["003-one-2-1", "one-2", 1, -3.0, 0.0, 12.0, pytest.approx(20.0), "+x"]
    assert kept["poses"][2] == pose


def test_a_new_installation_compiles_before_anything_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Later it would take longer than a bench may hang that heats."""
    done = list[str]()

    def opened(*_: object, **__: object) -> None:
        done.append("opened")
        raise LinkError("arm", "no answer")

    monkeypatch.setattr("bench.run.start.import_module", done.append)
    monkeypatch.setattr("bench.run.start.open_instruments", opened)
    files(tmp_path)
    assert start(tmp_path)[1] is RunState.FAULTED
    assert done == ["detector.outline.kernels", "opened"]


def test_an_arm_that_touches_by_itself_has_its_time() -> None:
    """A guardian takes a bench that is "going on" for 10 s for hung."""
    said = list[object]()
    ctx: Any = SimpleNamespace(
        check=lambda: said.append("checked"),
        long=lambda what, at_most_s: said.append((what, at_most_s)),
        script=SimpleNamespace(
            script=SimpleNamespace(truth=SimpleNamespace(mode="touch", readings=1))
        ),
        devices=SimpleNamespace(arm=SimpleNamespace(touches=True), stage=None),
        rig=SimpleNamespace(rig=SimpleNamespace(arm=None, stage=None)),
        **dict.fromkeys(("ask", "tip", "clock")),
    )
    choose_truth(ctx, lambda *_: None).toucher.check()
    assert said == ["checked", ("touching by itself", 600.0)]

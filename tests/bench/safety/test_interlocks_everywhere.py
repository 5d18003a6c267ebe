"""Through every wait, move, capture and prompt of a run in real time the interlocks are looked at
once a second, and a trip acts at once.

The bench is at it all the while: nobody answers the prompt, the camera takes its time, the stage is
on its way.
"""

from __future__ import annotations

import json
import shlex
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.cli.main import main
from bench.record.reader import RunRecord, read_run
from bench.results.status import read_status
from tests.bench.commands import teatbench
from tests.bench.real_rig import RealRig, real_rig

if sys.platform == "win32":
    pytest.skip("forks benches", allow_module_level=True)

from tests.bench.marked_bench import MARK, MarkedBench, marked_bench
from tests.waiting import PATIENCE_S, within

pytestmark = pytest.mark.slow

LASTS_S = 4.0  # each step goes on at least so long before anything happens
# a look a second, seen on a machine that is busy; one that the step stops comes LASTS_S late
GAP_S = 3.5


@dataclass(frozen=True)
class Step:
    """How the bench gets into a step that lasts."""

    mark: str
    words: str
    more: tuple[tuple[str, Any], ...] = ()


STEPS = {
    "wait": Step("settling", f"{MARK}settling", (("window_s", 600.0),)),
    "move": Step("moving", f"{MARK}moving", (("stage", True),)),
    "capture": Step("capturing long", f"{MARK}capturing long"),
    "prompt": Step("", "Enter when it stands"),
}


@dataclass(frozen=True)
class Outcome:
    """``safe_after_s`` from the trouble to standby, as the plant saw it."""

    name: str
    safe_after_s: float
    still_at_it: bool
    stage_still: bool
    run: RunRecord
    latch: dict[str, Any]
    said: str


def trip_in(
    name: str, folder: Path, recording: Path, then: Callable[[RealRig], None] = lambda _: None
) -> Outcome:
    """``then``: what is done with the rig, which is latched."""
    step = STEPS[name]
    with (
        real_rig(folder, recording, **dict(step.more)) as rig,
        marked_bench(rig, step.mark) as running,
    ):
        running.wait_for("on its peg")
        running.enter()
        if name == "capture":
            running.wait_for("Enter when it stands")
            running.enter()
        running.wait_for(step.words)
        time.sleep(LASTS_S)
        seconds = overheat(rig, running)
        still_at_it, stage_still = running.process.exitcode is None, stands(rig)  # in this order
        running.process.join(PATIENCE_S)
        assert running.process.exitcode == 3, running.said
        latch = json.loads((rig.folder / "lab.tripped.json").read_text(encoding="utf-8"))
        then(rig)
        return Outcome(
            name, seconds, still_at_it, stage_still, read_run(rig.run_folder()), latch, running.said
        )


def overheat(rig: RealRig, running: MarkedBench) -> float:
    """Make the bath too hot; how long until the heater is off."""
    plant = rig.twin.world.plant
    assert plant.running, running.said
    with rig.twin.world.lock:
        plant.bath_c = 39.0
    start = time.monotonic()
    running.until(lambda: not plant.running, "made safe")
    return time.monotonic() - start


def stands(rig: RealRig) -> bool:
    """Whether the stage has come to a stand, a moment after the trip."""
    time.sleep(1.0)
    stage = rig.twin.stage
    assert stage is not None
    before = stage.position_mm()
    time.sleep(0.3)
    return bool(np.allclose(before, stage.position_mm()))


def test_a_trip_in_any_step_acts_at_once_and_is_latched(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:

    def acknowledged(rig: RealRig) -> None:
        """Once the bath has cooled, and no earlier; nobody pressed Enter."""
        acknowledge = ["bath", "acknowledge", str(rig.rig_path)]
        assert shlex.join(["teatbench", *acknowledge]) in read_status(rig.run_folder()).next[-1]
        assert main(acknowledge) == 3
        assert "has to cool below 36 degC" in capsys.readouterr().err
        with rig.twin.world.lock:
            plant = rig.twin.world.plant
            plant.bath_c = plant.pv_c = 33.0
            plant.acknowledge()
        # the sensor has its lag
        within(lambda: main(acknowledge) == 0, "acknowledged")
        assert not rig.rig_path.with_name("lab.tripped.json").exists()
        assert main(acknowledge) == 0
        assert "acknowledge" not in read_status(rig.run_folder()).next[-1]
        assert "nothing is latched" in capsys.readouterr().out

    with ThreadPoolExecutor(3) as pool:
        beside = [one for one in STEPS if one != "prompt"]
        jobs = [pool.submit(trip_in, name, tmp_path / name, recording) for name in beside]
        prompted = trip_in("prompt", tmp_path / "prompt", recording, acknowledged)
        outcomes = [*(job.result() for job in jobs), prompted]
    assert "No answer is needed any more" in prompted.said
    for outcome in outcomes:
        assert outcome.safe_after_s < 3.0 + 5.0, (
            f"{outcome.name}: sensor's lag, a second, and a busy machine"
        )
        assert outcome.stage_still, outcome.name
        assert outcome.run.ending == "faulted", outcome.name
        trip = outcome.run.facts["trip"]
        assert trip["rule"] == outcome.latch["rule"] == "over-temperature", outcome.name
        assert "heater is in standby" in trip["done"], outcome.name
        assert "interlock over-temperature" in outcome.said, "shown to the operator"
        assert trip["then"] in outcome.said.replace("\n", " "), "with what to do"
        assert trip["values"][-1]["safety_c"] > 37.0, "with what led to it"
        looked_s = outcome.run.bath[outcome.run.bath[:, 0] <= trip["t_s"], 0]
        assert len(looked_s) >= LASTS_S, outcome.name
        assert float(np.max(np.diff(looked_s))) < GAP_S, f"{outcome.name}: a look every second"
        assert float(np.median(np.diff(looked_s))) == pytest.approx(1.0, abs=0.1), outcome.name
    assert all(outcome.still_at_it for outcome in outcomes if outcome.name == "capture"), (
        "the main thread was still at it"
    )
    move = next(outcome for outcome in outcomes if outcome.name == "move")
    assert "stage is held" in move.run.facts["trip"]["done"]
    again = tmp_path / "move"
    files = again / "short.toml", again / "lab.toml", tmp_path / "elsewhere"
    assert teatbench("run {} --rig {} --out {}", *files) == 3
    assert "teatbench bath acknowledge" in capsys.readouterr().err
    assert not files[2].exists(), "another folder is no way round"

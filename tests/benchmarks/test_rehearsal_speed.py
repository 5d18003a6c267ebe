"""What a dry run of a thousand trials takes: the script gone through on emulators, with the frames
of twelve.
"""

from __future__ import annotations

import time
from pathlib import Path

from pytest_benchmark.fixture import BenchmarkFixture

from bench.dry_run.rehearsal import rehearse
from bench.rig.loading import find_rig, load_rig
from bench.script.model import load_script
from tests.benchmarks.figures import beside_fixed

SCRIPT = """
SCRIPT = {"title": "A thousand", "detectors": ["thesis"], "bath": {"set_point_c": 33.0}}
SCRIPT["truth"] = {"mode": "carry", "registration": "first", "check_every": 100}
SCRIPT["requirements"] = [{"kind": "success", "name": "reliability", "rate": 0.95}]


def trials():
    grid = {"x_mm": [-96.0, 96.0], "y_mm": [-96.0, 96.0], "step_mm": [8.0, 4.8], "along": "y"}
    yield {"name": "p", "situation": "ideal", "layout": "single", "set_up": "One teat.", "grid": grid}
"""


def test_a_thousand_carried_trials(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    (tmp_path / "thousand.py").write_text(SCRIPT, encoding="utf-8")
    rig, script = load_rig(find_rig("lab.example")), load_script(tmp_path / "thousand.py")
    assert len(script.planned) == 1025
    begun_s = time.process_time()
    done = benchmark.pedantic(rehearse, (rig, script, ()), rounds=1)
    beside_fixed(benchmark, "rehearsal of 1025 trials", time.process_time() - begun_s, "8")
    assert done.trials == 1025

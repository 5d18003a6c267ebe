"""A trial script in Python: its generator says which trials there are."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.cli.main import main
from bench.config import ConfigError
from bench.script.model import LoadedScript, load_script
from tests.bench.operated_runs import files, run_of

PYTHON = """
SCRIPT = {
    "title": "Made",
    "detectors": ["thesis"],
    "bath": {"set_point_c": 33.0, "window_s": 2.0, "slope_k_per_min": 10.0, "teat_slope_k_per_min": 10.0},
    "requirements": [{"kind": "bath_in_band", "name": "bath", "band_k": 0.5}],
}


def trials():
    for number in range(2):
        pose = {"x_mm": 10.0 * number}
        yield {"name": f"step-{number}", "situation": "ideal", "layout": "table-5-1", "set_up": "As told.", "poses": [pose, {"y_mm": -3.5}]}
"""


def written(folder: Path, text: str) -> Path:
    path = folder / "steps.py"
    path.write_text(text, encoding="utf-8")
    return path


def places(script: LoadedScript) -> list[tuple[float, float]]:
    return [(one.pose.x_mm, one.pose.y_mm) for one in script.planned]


def test_its_trials_are_those_of_a_toml_script(tmp_path: Path) -> None:
    script = load_script(written(tmp_path, PYTHON))
    assert script.name == "steps"
    ids = "001-step-0-1-1 002-step-0-2-1 003-step-1-1-1 004-step-1-2-1"
    assert [one.id for one in script.planned] == ids.split()
    assert places(script) == [(0, 0), (0, -3.5), (10, 0), (0, -3.5)]
    again = tmp_path / "again.toml"
    again.write_text(script.text, encoding="utf-8")
    assert load_script(again).script == script.script


def test_numbers_of_numpy_are_numbers(tmp_path: Path) -> None:
    text = PYTHON
    for old, new in {
        "for number in range(2):": "import numpy\n    for number in numpy.linspace(0, 1, 2):",
        'f"step-{number}"': 'f"step-{number:.0f}"',
        "-3.5": "numpy.int64(-3)",
    }.items():
        text = text.replace(old, new)
    script = load_script(written(tmp_path, text))
    assert places(script) == [(0, 0), (0, -3), (10, 0), (0, -3)]


@pytest.mark.slow
def test_a_run_keeps_the_file_and_what_it_gave(tmp_path: Path) -> None:
    arguments = files(tmp_path)
    path = written(tmp_path, PYTHON.replace("range(2)", "range(1)"))
    assert main([arguments[0], str(path), *arguments[2:]]) in (0, 1, 4)
    run = run_of(tmp_path)
    assert (run.ending, [trial.id for trial in run.trials]) == (
        "finished",
        ["001-step-0-1-1", "002-step-0-2-1"],
    )
    assert (run.folder / "steps.py").read_text(encoding="utf-8") == path.read_text(encoding="utf-8")
    assert load_script(run.folder / "script.toml").planned == load_script(path).planned


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("SCRIPT = {", r"steps\.py, line 1: SyntaxError"),
        ("x = 1", "has SCRIPT, a dictionary, and trials"),
        (PYTHON.replace("10.0 * number", "1 / number"), r"steps\.py, line \d+: ZeroDivisionError"),
        (PYTHON.replace('yield {"name"', 'yield 5, {"name"'), "trial 1 of trials.. is a tuple"),
        (
            PYTHON.replace("range(2)", "__import__('itertools').count()"),
            "gives more than 100000 trials; does it end",
        ),
        (PYTHON.replace('"situation"', '"sitution"'), 'unknown key; did you mean "situation"'),
        (PYTHON + "\nraise SystemExit(3)", "SystemExit: 3"),
        (
            PYTHON.replace("yield {", "print({").replace("]}\n", "]})\n"),
            r"steps\.py: trials.. gives a NoneType; it has to yield",
        ),
        (
            PYTHON.replace("10.0 * number", "object()"),
            r"trials\[1\]\.poses\[1\]\.x_mm is a object; it has to be text, a number",
        ),
    ],
    ids=[
        "syntax",
        "nothing in it",
        "an error of its own",
        "no table",
        "endless",
        "a wrong key",
        "leaves",
        "no generator",
        "no value",
    ],
)
def test_what_is_wrong_is_reported_with_its_place(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=words):
        load_script(written(tmp_path, text))

"""The examples in docs/examples that draw scenes: each run as it stands, on small cameras."""

from __future__ import annotations

import ast
import csv
import importlib
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
import yaml
from pycocotools.coco import COCO
from scipy.ndimage import binary_dilation

import bench
from bench.cli.main import parser
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.small_recording import write_recording
from tests.conftest import ROOT

EXAMPLES = ROOT / "docs" / "examples"
MOST_LINES = 150


@pytest.fixture(autouse=True)
def found(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Examples import each other by name, as a program beside them does."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if (EXAMPLES / f"{name}.py").exists():
            del sys.modules[name]


def example(name: str) -> ModuleType:
    return importlib.import_module(name)


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> str:
    return str(write_small_rig(tmp_path_factory.mktemp("rig")))


OURS = ("bench", "detector", "instruments", "reports", "textfiles")
# the pages of the thesis are about its own cameras
OF_THE_THESIS = "detector.calibration.thesis_rig"


def test_every_example_imports_what_is_promised_alone() -> None:
    found = [
        (path.name, node.module, one.name)
        for path in EXAMPLES.glob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module and node.module != OF_THE_THESIS
        for one in node.names
        if node.module.partition(".")[0] in OURS
    ]
    assert len(found) > 50
    promised: dict[str, set[str]] = {
        one: {*importlib.import_module(one).__all__}
        for one in ("detector", "instruments", "bench.testing")
    }
    assert [one for one in found if one[2] not in promised.get(one[1], set())] == []


def test_every_example_is_short() -> None:
    files = [path for path in EXAMPLES.iterdir() if path.suffix in (".py", ".ipynb", ".yml")]
    lengths = {path.name: len(path.read_text(encoding="utf-8").splitlines()) for path in files}
    assert {name: count for name, count in lengths.items() if count > MOST_LINES} == {}


WRONG = {
    "coco.py": "4 words needed.*python docs/examples/coco.py ideal 0 20 train",
    "herd.py 1 1 no/herd.csv": ".*No such file or directory: 'no.herd.csv'",
}


@pytest.mark.slow
@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_argument_ends_an_example_as_a_command(words: str) -> None:
    command = [sys.executable, *words.split()]
    alone = subprocess.run(command, cwd=EXAMPLES, capture_output=True, text=True, check=False)
    assert re.match(f"2 teatbench: {WRONG[words]}", f"{alone.returncode} {alone.stderr}", re.DOTALL)


@pytest.mark.slow
def test_another_seed_is_another_herd(tmp_path: Path) -> None:
    cow = example("herd").Cow
    ends = [cow(seed, 0).visit(8.0)[0].phantom.ends_mm for seed in (1, 1, 2)]
    assert (ends[0] == ends[1]).all()
    assert (ends[0] != ends[2]).any()
    command = [sys.executable, "herd.py", "1", "0", str(tmp_path / "herd.csv"), "--seed", "two"]
    alone = subprocess.run(command, cwd=EXAMPLES, capture_output=True, text=True, check=False)
    assert "--seed: invalid int value: 'two'" in alone.stderr


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # pycocotools'
def test_masks_and_key_points_are_those_of_the_pictures(rig: str, tmp_path: Path) -> None:
    """Read by pycocotools. The apex is on the outline, and teats are unlike what is about them."""
    coco = example("coco").main("missing_or_hidden", 1, 2, tmp_path / "seen", rig)
    assert len(bench.Recording(tmp_path / "seen").frames) == 2
    labels = COCO(str(coco))
    assert labels.dataset["info"]["trained_on"] == {"missing_or_hidden": [[1, 2]]}
    flags = set()
    for image in labels.loadImgs(labels.getImgIds()):
        shot = bench.draw("missing_or_hidden", image["member"], rig=rig)
        picture = np.asarray(getattr(shot.frames, image["camera"]), dtype=float)
        assert picture.shape == (image["height"], image["width"])
        found = labels.loadAnns(labels.getAnnIds(imgIds=[image["id"]]))
        masks = np.array([labels.annToMask(one) for one in found]).astype(bool)
        assert masks.sum(axis=0).max() == 1
        for one, mask in zip(found, masks, strict=True):
            assert one["area"] == mask.sum()
            x, y, w, h = one["bbox"]
            assert mask[y : y + h, x : x + w].sum() == mask.sum()
            assert mask[y].any()
            assert mask[:, x + w - 1].any()
            column, row, seen = one["keypoints"][:3]
            flags.add(seen)
            if seen == 2:
                near = mask[max(round(row) - 2, 0) : round(row) + 3, round(column) - 2 :][:, :5]
                assert near.any()
                assert not near.all()
        every = masks.any(axis=0)
        if image["camera"] == "thermal":  # hot is black, and the picture is mirrored
            around = binary_dilation(every, iterations=9) & ~binary_dilation(every, iterations=3)
            assert picture[every].mean() < picture[around].mean() - 30.0
    assert flags == {1, 2}


@pytest.mark.weekly
def test_a_cows_history_beats_her_last_visit(rig: str, tmp_path: Path) -> None:
    said = example("herd").main(2, 8, tmp_path / "herd.csv", rig=rig)
    rows = [*csv.DictReader((tmp_path / "herd.csv").read_text(encoding="utf-8").splitlines())]
    own, last = (
        np.array([float(row[key]) for row in rows if row[key]]) for key in ("error_mm", "last_mm")
    )
    assert said.startswith(f"{len(rows)} unseen ends, {len(own)} predicted: {np.median(own):.1f}")
    assert len(own) >= 5
    assert np.median(own) < np.median(last)


@pytest.mark.slow
def test_errors_grow_with_noise(rig: str, tmp_path: Path) -> None:
    study = example("sensitivity")
    study.QUANTITIES["noise"] = study.QUANTITIES["noise"]._replace(values=(0, 16))
    plain, noisy = study.main("noise", ["fused"], 1, tmp_path, rig)
    assert 3 <= plain["found"] <= plain["visible"] == 4
    assert not noisy["found"] or noisy["median_mm"] > plain["median_mm"]
    assert (tmp_path / "noise.svg").read_text(encoding="utf-8").rstrip().endswith("</svg>")
    with (tmp_path / "noise.csv").open(encoding="utf-8") as file:
        assert [row["value"] for row in csv.DictReader(file)] == ["0", "16"]
    for name, quantity in study.QUANTITIES.items():
        changed = quantity.scene(bench.member("ideal", 0), quantity.values[-1])
        assert (changed != bench.member("ideal", 0)) == (not quantity.perturbation), name


@pytest.mark.slow
def test_failing_scenes_are_counted(rig: str, capsys: pytest.CaptureFixture[str]) -> None:
    """No time goes to what is too near a known failure."""
    found = example("failing_scenes").main("thesis", ("rod",), 2.0, rig=rig)
    failed, tried, distinct = map(int, re.findall(r"\d+(?= failing| distinct|,)", found)[:3])
    assert 5 < distinct == failed <= tried
    assert capsys.readouterr().out.count("Scene(") == distinct


@pytest.mark.weekly
def test_the_learned_detector_finds_ends_that_it_was_not_trained_on() -> None:
    learned = example("learned_detector").Learned()
    assert learned.trained_on["ideal"] == ((0, 19),)
    errors: list[float] = []
    with bench.open_detector(learned) as opened:
        for family in ("ideal", "non_vertical"):
            shot = bench.draw(family, 7000)
            score = bench.score(bench.detect(opened, shot), shot, limit_mm=10.0)
            assert score.counts.false == 0
            errors += list(score.radial_mm)
    assert sum(one < 10.0 for one in errors) >= 7


@pytest.mark.weekly
def test_its_training_makes_networks_that_answer(tmp_path: Path) -> None:
    """It needs jax and onnx, which nothing else does."""
    training, learned = example("learned_training"), example("learned_detector")
    training.main(["ideal"], 1, tmp_path, 2)
    one = learned.Learned(tmp_path)
    assert one.trained_on == {"ideal": ((0, 0),)}
    shot = bench.draw("ideal", 1)
    assert bench.detect(one, shot).outcome.value == "answered"


@pytest.mark.slow
def test_the_notebook_plots_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(mpl.rcParams, "backend", "agg")
    bench.score_recording(write_recording(tmp_path / "recorded"), ["thesis"])
    book = json.loads((EXAMPLES / "run.ipynb").read_text(encoding="utf-8"))
    names: dict[str, Any] = {}
    for cell in book["cells"]:
        assert not cell.get("outputs")
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert names["axes"][0].get_lines()
    names["plt"].close("all")


def test_the_nightly_jobs_commands_are_commands() -> None:
    """Its lines of teatbench and pytest are read as they would be there."""
    job = yaml.safe_load((EXAMPLES / "nightly.yml").read_text(encoding="utf-8"))
    runs = [step.get("run", "") for step in job["jobs"]["scenes"]["steps"]]
    lines = [one for one in "\n".join(runs).splitlines() if one.startswith(("teatbench", "pytest"))]
    assert len(lines) == 3
    for program, *words in map(shlex.split, lines):
        if program == "teatbench":
            assert parser().parse_args(words).command
        else:
            options = {word for word in words if word.startswith("--")}
            text = (ROOT / "bench" / "testing" / "plugin.py").read_text(encoding="utf-8")
            assert all(f'"{one}"' in text for one in options - {"--hypothesis-seed"})

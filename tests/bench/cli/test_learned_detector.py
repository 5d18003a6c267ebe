"""The learned detector that `detectors new onnx` writes, run by `exec:` with ONNX Runtime on the
processor: it finds ends of scenes that it was not trained on, and is refused on those it was.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from bench.record.reader import read_run
from tests.bench.commands import Said, teatbench

MOST_BYTES = 300_000


@pytest.mark.slow
def test_it_finds_ends_that_it_was_not_trained_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    monkeypatch.chdir(tmp_path)
    written = said(0, "detectors new onnx --name mine --out .").out
    assert "pip install onnxruntime" in written
    tried = said(0, "detectors try mine.toml").out
    assert "detector mine on cpu, frame ideal-0020" in tried  # 0 to 19 are of its training
    assert "; 4 can be seen" in tried
    names = ["mine.find.onnx", "mine.place.onnx"]
    assert all(Path(name).stat().st_size < MOST_BYTES for name in names)
    find = onnxruntime.InferenceSession(names[0], providers=["CPUExecutionProvider"])
    trained = json.loads(find.get_modelmeta().custom_metadata_map["trained_on"])
    assert trained["ideal"] == [[0, 19]]
    mine = ["--detector", f'exec:"{sys.executable}" mine.py {" ".join(names)}']
    held_out = "scene record --seeds 1 --first 7000 --out held --situation"
    for family in ("ideal", "non_vertical"):
        said(0, f"{held_out} {family}")
    assert teatbench("score held {} --out runs", mine) in (0, 1, 4)  # 2 poses show no rate
    (folder,) = Path("runs").iterdir()
    run = read_run(folder)
    found = [trial.scores["exec-mine"] for trial in run.trials]
    errors = [mm for score in found for mm in score.match.distances_mm]
    assert sum(len(trial.truth) for trial in run.trials) == 8
    assert np.count_nonzero(np.array(errors) < 10.0) >= 7
    rows = [row for trial in run.trials for row in trial.detections]
    assert [row["cold"] for row in rows] == [1, 0]
    assert [row["wall_start_up_s"] is not None for row in rows] == [True, False]
    item = run.facts["items"]["exec-mine"]
    assert item["device"] == "cpu"
    assert json.loads(item["configuration"])["files_sha256"].keys() >= set(names)
    refused = said(2, "campaign run --family ideal --scenes 2 --first 19 --out c {}", mine).err
    assert "detector exec-mine says that it was trained on ideal 19" in refused

"""`console` and `run --console` at the terminal."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from bench.record.reader import read_run
from tests.bench.commands import Said
from tests.bench.console import served
from tests.bench.forked import begin
from tests.bench.operated_runs import files, folder_with_runs
from tests.bench.small_run import SCRIPT


def test_without_its_libraries_it_says_what_to_install(
    said: Said, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "uvicorn", None)
    assert "pip install 'teatbench[console]'" in said(2, "console --runs {}", tmp_path).err


def test_an_address_that_is_not_to_be_had_is_named(said: Said, tmp_path: Path) -> None:
    err = said(2, "console --runs {} --no-open --listen 203.0.113.7", tmp_path).err
    assert "can't listen on 203.0.113.7" in err
    assert "not all of them" in said(2, "console --runs {} --listen 0.0.0.0", tmp_path).err


@pytest.mark.slow
def test_a_run_of_a_rig_in_virtual_time_takes_its_real_time_beside_a_console(
    tmp_path: Path,
) -> None:
    said, _ = begin([*files(tmp_path, script=SCRIPT), "--console"]).communicate(timeout=280)
    assert "console http://127.0.0.1:" in said
    (run,) = folder_with_runs(tmp_path)
    assert read_run(run).facts["asked"]["realtime"] is True
    assert not (run / "console").exists()  # gone at the run's end


@pytest.mark.slow
def test_started_from_the_page_a_run_outlives_its_console(tmp_path: Path) -> None:
    files(tmp_path, script=SCRIPT)
    one = served.serve(tmp_path / "runs", tmp_path)
    try:
        assert one.ask("/choices").body["rigs"][-2:] == ["emulated-depth", "rig.toml"]
        wrong = one.ask("/start", {"rig": "../rig.toml", "script": "script.toml"})
        assert (wrong.status, "there is no rig" in wrong.body["error"]) == (422, True)
        chosen = {"rig": "rig.toml", "script": "script.toml", "detectors": []}
        far = SCRIPT.replace("x_mm = 12.0", "x_mm = 900.0")
        (tmp_path / "far.toml").write_text(far, encoding="utf-8")
        dry = one.ask("/dry-run", {**chosen, "script": "far.toml"}).body
        assert dry["exit_code"] == 2, dry
        findings = {(found["trial"], found["kind"]) for found in dry["found"]["findings"]}
        assert ("place", "view") in findings
        assert {trial for trial, _ in findings} == {"place"}
        name = one.ask("/start", chosen).body["run"]
    finally:
        served.end(one)
    run = tmp_path / "runs" / name
    served.eventually(lambda: (run / "report" / "run.json").is_file())
    assert read_run(run).ending == "finished"

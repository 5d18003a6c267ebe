"""Imports against the contracts of pyproject.toml: a wrong one is found, and by the right contract.
That there is none says `lint-imports`, in `.ci/run`.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

PACKAGES = ("bench", "detector", "instruments", "reports", "textfiles")
WRONG = {
    "bench/scoring/matching.py": ("bench.cli.main", "Rooms of the bench"),
    "bench/results/comparison.py": ("bench.run.engine", "Rooms of the bench"),
    "bench/cli/store.py": ("bench.results.comparison", "Commands are written on what is promised"),
    "instruments/stage/driver.py": (
        "instruments.stage.emulator",
        "A driver imports no emulator, no world and nothing that listens",
    ),
    "detector/geometry.py": ("instruments.clock", "Three pillars, one roof"),
    "bench/campaign/pool.py": ("bench.campaign.run", "No circle: neither of rooms nor of files"),
}


@pytest.mark.slow
def test_wrong_imports_are_found(tmp_path: Path) -> None:
    for name in PACKAGES:
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for path, (wanted, _) in WRONG.items():
        with (tmp_path / path).open("a", encoding="utf-8") as file:
            file.write(f"\nimport {wanted}\n")
    program = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    done = subprocess.run(
        [sys.executable, "-c", program, "--no-cache"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == 1
    said = " ".join(done.stdout.split())
    for path, (wanted, contract) in WRONG.items():
        assert f"{contract} BROKEN" in said
        room, wrong = path.removesuffix(".py").replace("/", ".").rsplit(".", 1)
        within = f".{wrong} -> {wanted.removeprefix(room)} (1 import)"
        assert f"{room}.{wrong} -> {wanted} (l." in said or within in said, said

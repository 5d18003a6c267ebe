"""Imports against the contracts of pyproject.toml: a wrong one is found, and by the right contract."""

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
}


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("house")
    for name in PACKAGES:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    return folder


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    program = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    return subprocess.run(
        [sys.executable, "-c", program, "--no-cache"],
        cwd=folder,
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
    )


@pytest.mark.slow
def test_the_house_keeps_its_contracts(copy: Path) -> None:
    done = lint(copy)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_wrong_imports_are_found(copy: Path) -> None:
    for path, (wanted, _) in WRONG.items():
        with (copy / path).open("a", encoding="utf-8") as file:
            file.write(f"\nimport {wanted}\n")
    done = lint(copy)
    assert done.returncode == 1
    said = " ".join(done.stdout.split())
    for path, (wanted, contract) in WRONG.items():
        assert f"{contract} BROKEN" in said
        wrong = path.removesuffix(".py").replace("/", ".")
        assert f"{wrong} -> {wanted} (l." in said, said

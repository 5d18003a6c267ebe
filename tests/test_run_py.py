"""run.py: what it says when the machine isn't ready, and that a second call costs nothing."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.conftest import ROOT


@pytest.fixture
def run_py(tmp_path: Path) -> ModuleType:
    """The script as a module, in a copy of the project's folder that has no .venv."""
    for name in ("run.py", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    shutil.copytree(ROOT / "locks", tmp_path / "locks")
    spec = importlib.util.spec_from_file_location("run_py", tmp_path / "run.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def fake_python(run_py: ModuleType, text: str) -> None:
    """Put a shell script where .venv's interpreter would be."""
    path: Path = run_py.python()
    path.parent.mkdir(parents=True)
    path.write_text(f"#!/bin/sh\n{text}\n", encoding="utf-8")
    path.chmod(0o755)


def test_it_uses_the_standard_library_only() -> None:
    text = (ROOT / "run.py").read_text(encoding="utf-8")
    modules = {
        line.split()[1].split(".")[0]
        for line in text.split("\n")
        if line.startswith(("import ", "from "))
    }
    assert modules <= sys.stdlib_module_names


def test_an_old_python_is_reported(
    run_py: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(run_py, "NEEDED", (99, 0))
    assert run_py.main(["demo"]) == 2
    assert "Python 99.0 or newer is needed" in capsys.readouterr().err


def test_without_a_job_it_says_what_there_is(
    run_py: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_py.main([]) == 2
    assert run_py.main(["--help"]) == 0
    assert "run.py demo" in capsys.readouterr().out


@pytest.mark.skipif(os.name == "nt", reason="stands a shell script in for Python")
@pytest.mark.parametrize(
    ("says", "hint"),
    [
        ("NewConnectionError: Failed to establish a new connection", "HTTPS_PROXY"),
        ("ERROR: No matching distribution found for numpy>=2.0", "CPython 3.11, 3.12 or 3.13"),
    ],
)
def test_a_failing_pip_gets_a_hint(
    run_py: ModuleType, capsys: pytest.CaptureFixture[str], says: str, hint: str
) -> None:
    fake_python(run_py, f'case "$*" in *install*) echo "{says}"; exit 1;; esac')
    assert run_py.main(["demo"]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert hint in error


def test_a_folder_that_cannot_hold_an_environment(
    run_py: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / ".venv").write_text("in the way", encoding="utf-8")
    assert run_py.main(["demo"]) == 2
    assert "can't be made" in capsys.readouterr().err


@pytest.mark.skipif(os.name == "nt", reason="stands a shell script in for Python")
@pytest.mark.parametrize(("code", "expected"), [(0, 0), (1, 0), (4, 0), (2, 2), (3, 3)])
def test_demo_gives_0_when_the_bench_did_its_work(
    run_py: ModuleType, code: int, expected: int
) -> None:
    fake_python(run_py, f'case "$*" in *bench.cli*) exit {code};; esac')
    assert run_py.main(["demo"]) == expected


def test_byte_code_is_kept_even_where_python_is_told_to_keep_none(
    run_py: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    assert run_py.call([sys.executable, "-c", "import sys; sys.exit(sys.dont_write_bytecode)"]) == 0


@pytest.mark.skipif(os.name == "nt", reason="stands a shell script in for Python")
@pytest.mark.parametrize(
    ("given", "called"),
    [
        ([], "run demo --open"),
        (["--no-open", "--seed", "2"], "run demo --seed 2"),
        (["plane-map"], "run --open plane-map"),
    ],
)
def test_demo_runs_the_script_demo_and_opens_its_report(
    run_py: ModuleType, tmp_path: Path, given: list[str], called: str
) -> None:
    log = tmp_path / "calls"
    fake_python(run_py, f'echo "$*" >> "{log}"')
    assert run_py.main(["demo", *given]) == 0
    assert log.read_text(encoding="utf-8").splitlines()[-1] == f"-m bench.cli {called}"


@pytest.mark.skipif(os.name == "nt", reason="stands a shell script in for Python")
def test_a_second_call_installs_nothing(run_py: ModuleType, tmp_path: Path) -> None:
    log = tmp_path / "calls"
    fake_python(run_py, f'echo "$*" >> "{log}"')
    assert run_py.main(["test", "-q"]) == 0
    assert "pip install" in log.read_text(encoding="utf-8")
    log.unlink()
    assert run_py.main(["demo"]) == 0, "which needs nothing that the tests don't"
    assert "pip install" not in log.read_text(encoding="utf-8")
    log.unlink()
    start = time.perf_counter()
    done = subprocess.run([sys.executable, str(tmp_path / "run.py"), "test", "-q"], check=False)
    assert done.returncode == 0
    assert log.read_text(encoding="utf-8") == " ".join(
        ["-m", "pytest", *run_py.PYTEST_OPTIONS, "-q\n"]
    ), f"{time.perf_counter() - start:.2f} s"


@pytest.mark.skipif(os.name == "nt", reason="stands a shell script in for Python")
@pytest.mark.parametrize("changed", ["pyproject.toml", "locks/test.txt"])
def test_other_dependencies_are_installed_anew(
    run_py: ModuleType, tmp_path: Path, changed: str
) -> None:
    log = tmp_path / "calls"
    fake_python(run_py, f'echo "$*" >> "{log}"')
    run_py.main(["install"])
    log.unlink()
    (tmp_path / changed).write_text("# other\n", encoding="utf-8")
    run_py.main(["install"])
    said = log.read_text(encoding="utf-8")
    newer, loops, first, then = (line for line in said.splitlines() if "pip install" in line)
    assert loops.endswith(f"--require-hashes --requirement {tmp_path / '.venv' / 'loops.txt'}")
    assert newer.endswith(f"--require-hashes --requirement {tmp_path / 'locks' / 'pip.txt'}")
    assert first.endswith(f"--require-hashes --requirement {tmp_path / 'locks' / 'test.txt'}")
    assert then.endswith(f"--no-deps --no-build-isolation --editable {tmp_path}")
    assert "-m pytest" not in said


@pytest.mark.skipif(os.name == "nt", reason="stands a shell script in for Python")
def test_where_no_newer_pip_can_be_had_the_old_one_installs(
    run_py: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "calls"
    fake_python(run_py, f'echo "$*" >> "{log}"; case "$*" in *pip.txt*) echo lost; exit 1;; esac')
    assert run_py.main(["install"]) == 0
    assert "test.txt" in log.read_text(encoding="utf-8")
    assert not capsys.readouterr().err


@pytest.mark.skipif(os.name == "nt", reason="stands a shell script in for Python")
def test_loops_are_compiled_while_the_rest_is_installed(run_py: ModuleType, tmp_path: Path) -> None:
    """Where they can't be, the install is none the worse: whoever needs them compiles them."""
    log = tmp_path / "calls"
    fake_python(run_py, f'echo "$*" >> "{log}"; case "$*" in *kernels*) exit 1;; esac')
    assert run_py.main(["install"]) == 0
    said = log.read_text(encoding="utf-8")
    assert sorted(re.findall("import (.*kernels)", said)) == sorted(run_py.COMPILED)
    assert all(importlib.util.find_spec(module) for module in run_py.COMPILED)
    first = pinned((tmp_path / ".venv" / "loops.txt").read_text(encoding="utf-8"))
    whole = pinned((ROOT / "locks" / "test.txt").read_text(encoding="utf-8"))
    assert {name for name, _ in first} == set(run_py.LOOPS)
    assert first == {one: hashes for one, hashes in whole.items() if one[0] in run_py.LOOPS}


BARE = """\
import sys
from importlib.machinery import PathFinder
module, *there = sys.argv[1:]
class Bare:
    def find_spec(name, path=None, target=None):
        spec = None if path or name in there else PathFinder.find_spec(name)
        if spec and "site-packages" in (spec.origin or ""):
            raise ModuleNotFoundError(f"{name} comes later", name=name)
sys.meta_path.insert(0, Bare)
__import__(module)
"""


@pytest.mark.slow
def test_the_first_loops_need_no_package_that_comes_later(run_py: ModuleType) -> None:
    asked = [sys.executable, "-c", BARE, run_py.COMPILED[0], *run_py.LOOPS]
    done = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr


@pytest.mark.parametrize("newer", [True, False])
def test_a_new_environment_gets_a_pip_of_today_or_pythons_own(
    run_py: ModuleType, monkeypatch: pytest.MonkeyPatch, newer: bool
) -> None:
    own = list[bool]()

    class Builder:
        def __init__(self, *, clear: bool = False, with_pip: bool = False) -> None:
            own.append(with_pip)

        def create(self, folder: Path) -> None:
            assert folder == run_py.VENV

    def works(arguments: list[str], interpreter: str = "") -> bool:
        return newer or interpreter != sys.executable

    monkeypatch.setattr(run_py.venv, "EnvBuilder", Builder)
    monkeypatch.setattr(run_py, "works", works)
    assert run_py.make_venv() == 0
    assert own == ([False] if newer else [False, True])


def pinned(text: str) -> dict[tuple[str, str], int]:
    """How many hashes each package and version has in a file that uv wrote."""
    found: dict[tuple[str, str], int] = {}
    for entry in re.split(r"(?m)^(?=[A-Za-z])", text):
        if name := re.match(r"([\w.-]+)==([\w.]+)", entry):
            found[canonicalize_name(name[1]), name[2]] = len(
                re.findall(r"--hash=sha256:[0-9a-f]{64}\b", entry)
            )
    return found


@pytest.mark.parametrize(
    ("lock", "extras"),
    [
        ("constraints.txt", None),
        ("locks/run.txt", ()),
        ("locks/test.txt", ("test",)),
        ("locks/ci.txt", ("test", "genicam", "docs")),
    ],
)
def test_each_dependency_is_locked_to_a_version_that_it_allows(
    lock: str, extras: tuple[str, ...] | None
) -> None:
    """The command at the top of each file brings it up to date, constraints.txt first."""
    locked = pinned((ROOT / lock).read_text(encoding="utf-8"))
    known = pinned((ROOT / "constraints.txt").read_text(encoding="utf-8"))
    assert locked.keys() <= known.keys()
    assert lock == "constraints.txt" or all(locked.values()), "without a hash"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    ours = project["project"]
    every = ours["optional-dependencies"]
    wanted = [*ours["dependencies"], *project["build-system"]["requires"]]
    wanted += [text for extra in (every if extras is None else extras) for text in every[extra]]
    for text in wanted:
        needed = Requirement(text)
        versions = [version for name, version in locked if name == canonicalize_name(needed.name)]
        assert versions, f"{text} is not in {lock}"
        assert all(needed.specifier.contains(version) for version in versions), (
            f"{text}: {lock} has {versions}"
        )

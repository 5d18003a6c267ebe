"""docs/ci.md does what it says: its script judges a change, and both services are given what that
script writes.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.bench.small_recording import ENDS_MM, write_recording
from tests.conftest import ROOT

PAGE = (ROOT / "docs" / "ci.md").read_text(encoding="utf-8")
(SCRIPT,) = re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)
GITHUB, GITLAB = (
    yaml.safe_load(text) for text in re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
)
DETECTOR = """import json, sys
print(json.dumps({{"ready": True}}), flush=True)
for line in sys.stdin:
    teats = [{{"world_mm": [x + {off_mm}, y, z]}} for x, y, z in {ends}]
    print(json.dumps({{"frame": json.loads(line)["frame"], "teats": teats}}), flush=True)
"""


def sh(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    names = {
        "GIT_AUTHOR_NAME": "a",
        "GIT_AUTHOR_EMAIL": "a@b",
        "GIT_COMMITTER_NAME": "a",
        "GIT_COMMITTER_EMAIL": "a@b",
    }
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, **names, "PATH": path}
    return subprocess.run(
        ["bash", "-c", command],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        encoding="utf-8",
    )


@pytest.mark.skipif(os.name == "nt", reason="the services' machines of the page are Linux")
@pytest.mark.parametrize(("off_mm", "gate"), [(0.0, 4), (12.0, 1)])
def test_the_script_tells_a_worse_detector_from_one_that_few_poses_cannot_judge(
    off_mm: float, gate: int, tmp_path: Path
) -> None:
    """A recording of five poses: an equal detector is inconclusive there, as the page says."""
    write_recording(tmp_path / "recordings" / "lab")
    (tmp_path / "score.sh").write_text(SCRIPT, encoding="utf-8")
    (tmp_path / "detector.toml").write_text(
        f'command = [{json.dumps(sys.executable)}, "detector.py"]\n', encoding="utf-8"
    )
    (tmp_path / "detector.py").write_text(
        DETECTOR.format(off_mm=0.0, ends=ENDS_MM), encoding="utf-8"
    )
    assert (
        sh("git init -q -b main && git add . && git commit -q -m before", tmp_path).returncode == 0
    )
    (tmp_path / "detector.py").write_text(
        DETECTOR.format(off_mm=off_mm, ends=ENDS_MM) + "# changed\n", encoding="utf-8"
    )
    assert sh("git checkout -q -b change && git commit -q -a -m after", tmp_path).returncode == 0
    (tmp_path / "before").mkdir()  # what a job left behind is in nobody's way
    done = sh("bash score.sh main", tmp_path)
    assert done.returncode == gate, done.stdout + done.stderr
    assert (tmp_path / "difference" / "index.html").is_file()
    (github,) = (
        step["with"] for step in GITHUB["jobs"]["score"]["steps"] if "junit" in step.get("uses", "")
    )
    for pattern in (github["report_paths"], GITLAB["score"]["artifacts"]["reports"]["junit"]):
        (junit,) = tmp_path.glob(pattern)
        assert "<testcase" in junit.read_text(encoding="utf-8")
    assert sh("bash score.sh no-such-branch", tmp_path).returncode not in (0, 1, 4)


def test_both_services_run_that_script_on_the_locked_versions() -> None:
    steps = [step["run"] for step in GITHUB["jobs"]["score"]["steps"] if "run" in step]
    for lines in ("\n".join(steps).splitlines(), GITLAB["score"]["script"]):
        assert lines[-1].startswith("bash score.sh ")
        assert any("pip install -c bench/constraints.txt ./bench" in line for line in lines)


@pytest.mark.skipif(os.name == "nt", reason="runs bash")
def test_the_projects_own_ci_checks_before_it_tests_and_needs_the_shared_folder(
    tmp_path: Path,
) -> None:
    text = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    steps = (
        "ruff check",
        "ruff format --check",
        "-m mypy",
        "lint-imports",
        "\npython3 run.py test\n",
    )
    places = [text.index(step) for step in steps]
    assert places == sorted(places)
    for name in ("run", "weekly"):
        (tmp_path / "project" / ".ci").mkdir(parents=True, exist_ok=True)
        (tmp_path / "project" / ".ci" / name).write_bytes((ROOT / ".ci" / name).read_bytes())
        done = sh(f"bash .ci/{name}", tmp_path / "project")
        assert done.returncode == 2
        assert "../shared/data is missing" in done.stderr

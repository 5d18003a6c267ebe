"""docs/scoring.md's script judges a change; both services are given what it writes."""

from __future__ import annotations

import json
import os
import re
import shutil
import socketserver
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.bench.commands import teatbench
from tests.bench.forked import begin
from tests.bench.small_recording import ENDS_MM, write_recording
from tests.conftest import ROOT

CI = ROOT / "docs" / "ci"
SCRIPT = (CI / "score.sh").read_text(encoding="utf-8")
GITHUB, GITLAB = (
    yaml.safe_load((CI / f"{name}.yml").read_text(encoding="utf-8"))
    for name in ("github", "gitlab")
)
DETECTOR = """import json, sys
print(json.dumps({{"ready": True}}), flush=True)
for line in sys.stdin:
    teats = [{{"world_mm": [x + {off_mm}, y, z]}} for x, y, z in {ends}]
    print(json.dumps({{"frame": json.loads(line)["frame"], "teats": teats}}), flush=True)
"""


# the command: the test runs it, in a process that need not load the bench anew
PROGRAM = f"""#!{sys.executable}
import json, os, socket, sys
with socket.create_connection(("127.0.0.1", int(os.environ["TEATBENCH_AT"]))) as wire:
    wire.sendall(json.dumps([os.getcwd(), sys.argv[1:]]).encode() + b"\\n")
    code, said = json.loads(wire.makefile().read())
sys.stdout.write(said)
sys.exit(code)
"""


class Teatbench(socketserver.StreamRequestHandler):
    """Runs the words that a `PROGRAM` has got."""

    def handle(self) -> None:
        cwd, words = json.loads(self.rfile.readline())
        with begin(words, cwd=Path(cwd)) as command:
            said, _ = command.communicate()
        self.wfile.write(json.dumps([command.returncode, said]).encode())


@pytest.fixture
def at(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Where a `PROGRAM` finds the test."""
    with socketserver.TCPServer(("127.0.0.1", 0), Teatbench) as server:
        monkeypatch.setenv("TEATBENCH_AT", str(server.server_address[1]))
        serving = threading.Thread(target=server.serve_forever, args=(0.02,))
        serving.start()
        yield
        server.shutdown()
        serving.join()


def sh(command: str, folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {f"GIT_{who}_NAME": "a" for who in ("AUTHOR", "COMMITTER")}
    environment |= {f"GIT_{who}_EMAIL": "a@b" for who in ("AUTHOR", "COMMITTER")}
    path = os.pathsep.join(
        (str(folder / "bin"), str(Path(sys.executable).parent), os.environ["PATH"])
    )
    environment = {**os.environ, **environment, "PATH": path}
    return subprocess.run(
        ["bash", "-c", command],
        cwd=folder,
        env=environment,
        capture_output=True,
        check=False,
        encoding="utf-8",
    )


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="the services' machines of the page are Linux")
@pytest.mark.usefixtures("at")
def test_the_script_tells_a_worse_detector_from_one_with_the_same_answers(tmp_path: Path) -> None:
    write_recording(tmp_path / "recordings" / "lab")
    (tmp_path / "bin").mkdir()
    before, after = (DETECTOR.format(off_mm=off, ends=ENDS_MM) for off in (0.0, 12.0))
    declared = f'command = [{json.dumps(sys.executable)}, "detector.py"]\n'
    for name, text in (
        ("score.sh", SCRIPT),
        ("detector.toml", declared),
        ("detector.py", before),
        ("bin/teatbench", PROGRAM),
    ):
        (tmp_path / name).write_text(text, encoding="utf-8")
    (tmp_path / "bin" / "teatbench").chmod(0o755)
    began = sh("git init -q -b main && git add . && git commit -q -m before", tmp_path)
    (tmp_path / "detector.py").write_text(after, encoding="utf-8")
    changed = sh("git checkout -q -b change && git commit -q -a -m after", tmp_path)
    assert (began.returncode, changed.returncode) == (0, 0)
    (tmp_path / "before").mkdir()  # what a job left behind is in nobody's way
    done = sh("bash score.sh main", tmp_path)
    assert done.returncode == 1, done.stdout + done.stderr
    assert (tmp_path / "difference" / "index.html").is_file()
    (github,) = (
        step["with"] for step in GITHUB["jobs"]["score"]["steps"] if "junit" in step.get("uses", "")
    )
    for pattern in (github["report_paths"], GITLAB["score"]["artifacts"]["reports"]["junit"]):
        (junit,) = tmp_path.glob(pattern)
        assert "<testcase" in junit.read_text(encoding="utf-8")
    (old,) = (tmp_path / "old").iterdir()
    assert teatbench("compare {} {} --gate", old, shutil.copytree(old, tmp_path / "equal")) == 0
    assert sh("bash score.sh no-such-branch", tmp_path).returncode not in (0, 1, 4)
    left = ("old", "new", "difference", "summary.md")  # what the job before wrote is no result
    assert not [name for name in left if (tmp_path / name).exists()]


def test_all_services_run_that_script_in_the_image_of_the_locked_versions() -> None:
    job = GITHUB["jobs"]["score"]
    steps = [step["run"] for step in job["steps"] if "run" in step]
    jenkins = (CI / "Jenkinsfile").read_text(encoding="utf-8")
    for image in (job["container"]["image"], GITLAB["score"]["image"], jenkins):
        assert "TEATBENCH_IMAGE" in image
    for lines in (steps, GITLAB["score"]["script"], re.findall(r"sh '(.*)'", jenkins)):
        assert lines[-1].startswith("bash score.sh ")
    [junit] = re.findall(r"junit testResults: '(.*?)'", jenkins)
    assert junit == GITLAB["score"]["artifacts"]["reports"]["junit"]
    docker = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    installing = re.findall(r"bin/pip install --no-cache-dir (.*?)(?: \\)?$", docker, re.MULTILINE)
    assert installing == [
        "--require-hashes -r /src/locks/run.txt",
        "--no-deps --no-build-isolation /src",
    ]
    left_out = (ROOT / ".dockerignore").read_text(encoding="utf-8").split()
    assert not {"bench", "docs", "locks", "README.md", "pyproject.toml"} & {*left_out}
    packages = re.findall(r"--no-install-recommends (.*?) \\", docker)
    assert packages == ["python3 python3-venv git ca-certificates"]


def test_the_projects_own_ci_checks_before_it_tests_and_says_what_it_left_out() -> None:
    text = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    steps = ("ruff check", "ruff format --check", "-m mypy", "lint-imports", "mkdocs build")
    places = [text.index(step) for step in (*steps, "\npython3 run.py test\n", "$left_out")]
    assert places == sorted(places)
    for name in ("run", "weekly"):
        text = (ROOT / ".ci" / name).read_text(encoding="utf-8")
        assert "exit 2" not in text
        assert text.count("left_out") == 4

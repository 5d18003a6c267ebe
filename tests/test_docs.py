"""Commands of all pages run, in their order, in a folder where what they name is there, and their
TOML is loaded as what it is. A block that can't run has its reason in the page, above it:
``<!-- not run: why -->``. The README's links, first commands and exit codes are right.
"""

from __future__ import annotations

import re
import shlex
import shutil
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from bench.campaign.plan import Job, read_plan
from bench.cli.arguments import EXIT_CODES
from bench.cli.main import main, parser
from bench.config import read_config
from bench.record.check import check_record
from bench.rig.loading import RIGS, load_rig
from bench.rig.scripted_answers import load_answers
from bench.run.trial import TrialRun
from bench.script.detectors import DetectorFile
from bench.script.model import TRIALS, load_script
from bench.script.phantom import load_layout
from bench.toml import toml_text
from detector import registry
from detector.geometry import Motion
from instruments.bath.profile import SHIPPED, load_profile
from instruments.drivers.entry_points import EMULATORS, GROUPS
from tests.bench import operated_runs, small_run
from tests.bench.calibrate.arm_terminal import at_terminal
from tests.bench.calibrate.board_pictures import (
    BOARD_TOML,
    HEATED,
    HEATED_TOML,
    LEFT,
    THERMAL,
    THERMAL_FROM_LEFT,
    picture,
    poses,
    write_image,
    write_pairs,
)
from tests.bench.calibrate.touched import write_touched
from tests.bench.campaign.small_campaign import Here
from tests.bench.small_cameras import smaller
from tests.bench.small_recording import write_recording
from tests.conftest import ROOT

pytestmark = pytest.mark.slow

# their exit code may be a verdict
MAY_JUDGE = {"run", "resume", "score", "compare", "calibrate cameras"}
AT_A_TERMINAL = {"arm home", "arm frame", "arm read", "arm verify"}
# pages whose commands take the longest run weekly; the program knows their words in each run
LONG = ("calibration.md", "campaigns.md", "detectors.md", "index.md", "record.md")
# what a page names and its reader has, and what stands in for it here; whatever fits, in this order
STAND_INS = {
    r"plane-map --dry-run": "short.toml --rig my-rig.toml --dry-run",
    r"/dev/ttyUSB0": "emulator:",
    r"--page$": "--page --seconds 0.1",
    r"opencv:http://\S+": "my-rig.toml --seconds 0.1",
    r"resume runs/\S+": "resume runs/stopped",
    r"runs/20261120-\S+": "runs/kept",
    r"\b(RUN|MONDAY|TUESDAY)\b": "runs/scored",
    r"5ab3…": "DIGEST",
    r"run six-situations(?!.*--rig)": "run short.toml --rig my-rig.toml",
    r"six-situations|my-script": "short.toml",
    r"record --situation overlapping": "record --rig my-rig.toml --situation overlapping",
    r"--seeds 3 --out \S+": "--seeds 1 --out recordings/few",
    r"sheet --out": "sheet --rig my-rig.toml --situation ideal --out",
    r"--seeds (5|6|8|200)": "--seeds 1",
    r"--scenes 400": "--scenes 1 --workers 1 --rig my-rig.toml",
    r"thermal PICTURES": "thermal heated-pictures",
    r"PICTURES": "pictures",
}


@dataclass(frozen=True)
class Block:
    """A fenced block of a page; ``not_run`` is the reason why it can't run, empty where it can."""

    page: str
    line: int
    language: str
    text: str
    not_run: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"

    @property
    def commands(self) -> list[str]:
        """The lines that call the program."""
        lines = self.text.splitlines() if self.language in ("", "sh") else []
        return [line for line in lines if line.startswith("teatbench ")]


FENCED = re.compile(
    r"(?:^<!-- not run: ([^>]+) -->\n)?^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE
)
BLOCKS = [
    Block(page.name, text.count("\n", 0, found.start(3)), found[2], found[3], found[1] or "")
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
    for text in [page.read_text(encoding="utf-8")]
    for found in FENCED.finditer(text)
]
COMMANDS = [(str(block), line) for block in BLOCKS for line in block.commands]
RUN_HERE = [block for block in BLOCKS if not block.not_run]
TOML = [block for block in RUN_HERE if block.language == "toml"]


def words_of(line: str) -> list[str]:
    return shlex.split(line, comments=True)[1:]


@pytest.mark.parametrize(("where", "line"), COMMANDS)
def test_the_program_knows_the_command(
    where: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        parser().parse_args(words_of(line))
    except SystemExit:
        pytest.fail(f"{where}: {line}\n{capsys.readouterr().err}")


def test_drawings_are_read_in_a_terminal_too() -> None:
    drawn = [block for block in BLOCKS if "-->" in block.text]
    assert len(drawn) > 5
    for block in drawn:
        assert block.text.isascii(), block
        assert max(map(len, block.text.splitlines())) <= 78, block


README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_readmes_first_two_commands_are_those_of_ci_and_its_exit_codes_those_of_help() -> None:
    first = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)[0].split("\n")[:2]
    assert first == ["python3 run.py demo", "python3 run.py test"]
    ci = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "python3 run.py demo" in ci
    assert "\npython3 run.py test\n" in ci
    note = re.search(r"Exit codes: (.*?)\.\n", README, re.DOTALL)
    assert note is not None
    assert " ".join(EXIT_CODES.split()) == f"exit codes: {note[1]}"


def test_links_of_the_readme_lead_somewhere() -> None:
    for target in re.findall(r"\]\(([^)]+)\)", README):
        assert target.startswith("https://") or (ROOT / target).exists(), target


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A reader's folder: a rig, a script, a recording, pictures of boards, runs."""
    folder = tmp_path_factory.mktemp("desk")
    operated_runs.files(
        folder,
        script=small_run.SCRIPT,
        stage=operated_runs.STAGE,
        check_point=operated_runs.CHECK_POINT,
        emulation="faults = []",
        whole=True,
    )
    # calibration.toml is what the reader makes
    delivered = (folder / "calibration.toml").rename(folder / "as-delivered.toml")
    # cameras so small that a scene takes a tenth of the time
    text = smaller(delivered.read_text(encoding="utf-8"))
    delivered.write_text(text, encoding="utf-8")
    rig = (folder / "rig.toml").read_text(encoding="utf-8")
    (folder / "my-rig.toml").write_text(
        rig.replace("calibration.toml", "as-delivered.toml"), encoding="utf-8"
    )
    (folder / "script.toml").rename(folder / "short.toml")
    stopped = TrialRun.run

    def ctrl_c(trial_run: TrialRun, trial: Any) -> None:
        if trial.number > 1:
            raise KeyboardInterrupt
        stopped(trial_run, trial)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrialRun, "run", ctrl_c)
        given = [str(folder / name) for name in ("short.toml", "my-rig.toml", "runs")]
        assert main(["run", given[0], "--rig", given[1], "--out", given[2]]) == 3
    (run,) = (folder / "runs").iterdir()
    run.rename(folder / "runs" / "stopped")
    write_recording(folder / "recordings" / "mine")
    scoring = ["score", str(folder / "recordings" / "mine"), "--out", str(folder / "scored")]
    assert main([*scoring, "--detector", "fused", "--detector", "thesis"]) in (0, 1, 4)
    (run,) = (folder / "scored").iterdir()
    run.rename(folder / "runs" / "scored")
    shutil.copytree(ROOT / "tests/bench/record/kept/schema-5", folder / "runs" / "kept")
    (folder / "my-board.toml").write_text(BOARD_TOML, encoding="utf-8")
    (folder / "my-heated.toml").write_text(HEATED_TOML, encoding="utf-8")
    write_pairs(folder / "pictures", 12)
    for number, pose in enumerate(poses(10, 3, HEATED, 0.3)):
        for name, camera, motion in (
            ("left", LEFT, Motion.identity()),
            ("thermal", THERMAL, THERMAL_FROM_LEFT),
        ):
            image = picture(camera, motion @ pose, number, board=HEATED, pitch_mm=HEATED.pitch_mm)
            write_image(folder / "heated-pictures" / name / f"{number:02d}.png", image)
    write_touched(folder / "points.csv")
    return folder


class Hereabouts(Here):
    """In the place of a campaign's processes, each of which loads the bench anew."""

    def __init__(self, job: Job, *_: object, **__: object) -> None:
        super().__init__(job)

    def close(self) -> None: ...


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=pytest.mark.weekly if page in LONG else ())
        for page in sorted({block.page for block in RUN_HERE if block.commands})
    ],
)
def test_the_commands_of_a_page_run_in_their_order(
    page: str, desk: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(desk)
    monkeypatch.setattr("bench.campaign.pool.LocalPool", Hereabouts)
    for block in RUN_HERE:
        for line in block.commands if block.page == page else ():
            code, said = ran(line, desk, capsys)
            verdict = {words_of(line)[0], " ".join(words_of(line)[:2])} & MAY_JUDGE
            assert code in ((0, 1, 4) if verdict else (0,)), f"{block}: {line}\n{said}"
            assert "Traceback" not in said, f"{block}: {line}\n{said}"
            assert said.strip(), f"{block}: {line}"


def ran(line: str, desk: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    """The exit code of a page's line with what stands in for its names, and what it said."""
    for name, here in STAND_INS.items():
        line = re.sub(name, here, line)
    if "DIGEST" in line:
        line = line.replace("DIGEST", check_record(desk / "runs" / "kept").head.wall_digest)
    words = [
        path
        for word in words_of(line)
        for path in (sorted(map(str, desk.glob(word))) if "*" in word else [word])
    ]
    if "--capture" in words:  # never written over; each line of a page is another's
        Path(words[words.index("--capture") + 1]).unlink(missing_ok=True)
    if " ".join(words[:2]) in AT_A_TERMINAL:
        with at_terminal(words, cwd=desk) as terminal:
            return terminal.press_enter_to_the_end(), terminal.text
    code = main(words)
    note = capsys.readouterr()
    return code, note.out + note.err


def rig_of(text: str, folder: Path) -> object:
    shutil.copy(RIGS / "calibration.toml", folder)
    base = "emulated.toml" if "emulation" in tomllib.loads(text) else "lab.example.toml"
    return load_rig(with_tables(RIGS / base, text, folder))


def script_of(text: str, folder: Path) -> object:
    return load_script(with_tables(TRIALS / "six-situations.toml", text, folder))


def with_tables(base: Path, text: str, folder: Path) -> Path:
    """The file with the tables of ``text`` in the place of its own."""
    whole = tomllib.loads(base.read_text(encoding="utf-8"))
    for key, value in tomllib.loads(text).items():
        whole[key] = {**whole.get(key, {}), **value} if isinstance(value, dict) else value
    return written(toml_text(whole), folder)


def written(text: str, folder: Path) -> Path:
    path = folder / "example.toml"
    path.write_text(text, encoding="utf-8")
    return path


def models_of(text: str, folder: Path) -> object:
    """Behind the profile of a family that has the rows it names."""
    family = (SHIPPED / "julabo-ascii.toml").read_text(encoding="utf-8")
    return load_profile(written(f"{family}\n{text}", folder))


def entry_point_of(text: str, folder: Path) -> object:
    groups = tomllib.loads(text)["project"]["entry-points"]
    known = {registry.GROUP, *GROUPS.values(), *EMULATORS.values()}
    return {*groups} <= known


LOADED: dict[str, Callable[[str, Path], object]] = {  # by a key that only such a file has
    "arm": rig_of,
    "cameras": rig_of,
    "emulation": rig_of,
    "requirements": script_of,
    "trials": script_of,
    "truth": script_of,
    "teats": lambda text, folder: load_layout(written(text, folder)),
    "envelope": lambda text, folder: load_layout(written(text, folder)),
    "families": lambda text, folder: read_plan(written(text, folder)),
    "command": lambda text, folder: read_config(written(text, folder), DetectorFile),
    "answers": lambda text, folder: load_answers(written(text, folder)),
    "project": entry_point_of,
    "models": models_of,
    "comms_loss": lambda text, folder: load_profile(written(text, folder)),
}


@pytest.mark.parametrize("block", TOML, ids=str)
def test_each_example_of_a_file_is_loaded_as_what_it_is(block: Block, tmp_path: Path) -> None:
    (load,) = {LOADED[key] for key in tomllib.loads(block.text) if key in LOADED}
    assert load(block.text, tmp_path)


def test_pages_that_the_program_names_are_there() -> None:
    named = {
        page
        for folder in ("bench", "detector", "instruments", "reports", "textfiles")
        for path in sorted((ROOT / folder).rglob("*"))
        if path.suffix in {".py", ".toml"}
        for page in re.findall(r"docs/[\w/-]+\.md", path.read_text(encoding="utf-8"))
    }
    assert len(named) > 5
    assert [page for page in sorted(named) if not (ROOT / page).is_file()] == []

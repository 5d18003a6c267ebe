"""What is promised to Python programs: names and signatures as they were, the page as it runs, and
all of it by one import.
"""

from __future__ import annotations

import dataclasses
import importlib
import inspect
import json
import math
import os
import re
import shlex
import shutil
import sqlite3
import subprocess
import sys
import tomllib
import zipfile
from contextlib import closing
from pathlib import Path
from typing import Any, Literal, cast, get_args, get_origin

import numpy as np
import pytest

import bench
import instruments
from _teatbench_packages import installed_over
from bench.arguments import _hints, fits, lent
from bench.record.schema import make_tables
from bench.rig.loading import RIGS
from detector.outline import kernels
from detector.protocol import Detection
from detector.registry import PluginDetector
from tests.bench.small_cameras import write_calibration
from tests.conftest import ROOT
from tests.undrawn import NO_FIGURE

PAGE = ROOT / "docs" / "api.md"
KEPT = Path(__file__).parent / "data" / "promised.json"
MODULES = ("bench", "detector", "instruments", "bench.testing", "bench.testing.conformance")
ROWS = ("TrialRow", "TouchRow", "TruthOfTeat", "DetectionRow", "FoundRow", "BathRow", "EventRow")
TYPES = {"TEXT": "str", "REAL": "float", "INTEGER": "int"}


def on_page() -> dict[str, set[str]]:
    """The names in the page's table, by the module that has them."""
    text = PAGE.read_text(encoding="utf-8").split("## What is promised")[1]
    found: dict[str, set[str]] = {}
    for module, names in re.findall(r"^\| `([\w.]+)`[^|]*\| (.*) \|$", text, re.MULTILINE):
        found.setdefault(module, set()).update(re.findall(r"`(\w+)`", names))
    return found


def shape(thing: Any) -> Any:
    """Parameters of a function, fields and public methods of a class."""
    if inspect.isfunction(thing):
        return parameters(thing)
    if not inspect.isclass(thing):
        return type(thing).__name__
    found: dict[str, Any] = {}
    if dataclasses.is_dataclass(thing):
        found["fields"] = [field.name for field in dataclasses.fields(thing)]
    for name, member in vars(thing).items():
        if name.startswith("_"):
            continue
        if inspect.isfunction(member):
            found[name] = parameters(member)
        elif isinstance(member, property):
            found[name] = "property"
    return found


def parameters(function: Any) -> list[str]:
    """``name``, ``name=`` with a default, ``*name`` by keyword alone."""
    return [
        "*" * (one.kind is one.KEYWORD_ONLY) + one.name + "=" * (one.default is not one.empty)
        for one in inspect.signature(function).parameters.values()
    ]


def promised() -> dict[str, Any]:
    return {
        module: {
            name: shape(getattr(importlib.import_module(module), name)) for name in sorted(names)
        }
        for module, names in on_page().items()
    }


HIDES_A_FILE = "{} hides teatbench's package {!r}: give that file another name"
HIDES_A_FOLDER = "{} hides teatbench's package {!r}: give that folder another name"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "program", "says"),
    [
        ("detector.py", "own.py", HIDES_A_FILE),
        ("detector.py", "test_own.py", HIDES_A_FILE),
        ("instruments/__init__.py", "own.py", HIDES_A_FOLDER),
        ("instruments/__init__.py", "-m bench.cli check", HIDES_A_FOLDER),
        ("reports.py", "-m bench.cli --version", HIDES_A_FILE),
    ],
)
def test_what_hides_a_package_of_the_bench_is_named(
    name: str, program: str, says: str, tmp_path: Path
) -> None:
    hiding = tmp_path / name
    hiding.parent.mkdir(exist_ok=True)
    hiding.write_text("from detector.protocol import Detection\n", encoding="utf-8")
    own = "from bench.testing import check\n"
    for one in ("own.py", "test_own.py"):
        (tmp_path / one).write_text(own, encoding="utf-8")
    said = ran_in(tmp_path, program)
    package = Path(name).parts[0].removesuffix(".py")
    assert says.format(tmp_path / Path(name).parts[0], package) in said
    assert "Traceback" not in said or "own.py" in program


@pytest.mark.slow
def test_a_session_of_a_project_with_a_file_of_that_name_goes_on(tmp_path: Path) -> None:
    """Its file isn't even loaded, which may be a program."""
    (tmp_path / "bench.py").write_text("raise SystemExit('it ran')\n", encoding="utf-8")
    (tmp_path / "test_theirs.py").write_text("def test_it(): pass\n", encoding="utf-8")
    (tmp_path / "conftest.py").write_text(
        "import _teatbench\n"
        "def pytest_configure(config): config.pluginmanager.register(_teatbench.plugin)\n",
        encoding="utf-8",
    )
    said = ran_in(tmp_path, "test_theirs.py -p no:teatbench")
    assert "1 passed" in said
    assert f"teatbench's plug-in is left out: {tmp_path / 'bench.py'} hides" in said
    given = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert given["entry-points"]["pytest11"] == {"teatbench": "_teatbench:plugin"}
    assert given["scripts"] == {"teatbench": "_teatbench:main"}


@pytest.mark.slow
def test_files_that_pip_wrote_over_those_of_the_bench_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """InstrumentKit has a package `instruments` too."""
    theirs = tmp_path / "instrumentkit-0.6.0.dist-info"
    theirs.mkdir()
    (theirs / "METADATA").write_text("Name: instrumentkit\nVersion: 0.6.0\n", encoding="utf-8")
    (theirs / "RECORD").write_text("instruments/__init__.py,,\n", encoding="utf-8")
    (tmp_path / "instruments").mkdir()
    (tmp_path / "instruments" / "__init__.py").touch()
    assert not installed_over()
    monkeypatch.syspath_prepend(tmp_path)
    says = "instrumentkit has files in teatbench's package 'instruments': give teatbench an"
    assert installed_over().startswith(says)


def ran_in(folder: Path, program: str) -> str:
    """What Python says of a program, a module or tests, with the project on its path."""
    how = ("-m", "pytest", "-p", "no:cacheprovider") if program.startswith("test") else ()
    done = subprocess.run(
        [sys.executable, *how, *program.split()],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout + done.stderr


def test_names_and_signatures_are_as_they_were() -> None:
    """``python -m tests.test_api`` writes them down anew, for a change that is meant."""
    assert promised() == json.loads(KEPT.read_text(encoding="utf-8"))


@pytest.mark.parametrize("module", MODULES)
def test_what_a_package_exports_is_what_the_page_promises(module: str) -> None:
    there = importlib.import_module(module)
    if hasattr(there, "__all__"):
        assert {*there.__all__} == on_page()[module]
        assert {*there.__all__} <= {*dir(there)}  # which a notebook completes
    for name in on_page()[module]:
        assert getattr(there, name).__doc__, f"{module}.{name} says nothing of itself"
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = there.nothing


HEAVY = {"numpy", "cv2", "pydantic", "typing", "pytest", "hypothesis"}


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("bench", HEAVY),
        ("bench.cli.terminal", {"scipy.special"}),
        ("bench.api.runs", {"scipy.special"}),
        ("bench.api.loading", {"bench.run", "bench.results", "bench.rig.opening", "pymodbus"}),
        ("bench.api.planning", {"bench.run.engine", "bench.rig.opening", "pymodbus"}),
        (
            "bench.api.dry_runs",
            {"bench.api.runs", "bench.results.comparison", "numba", "jinja2", "pymodbus"},
        ),
    ],
)
def test_an_import_loads_nothing_heavy(module: str, heavy: set[str]) -> None:
    code = f"import {module}, sys; print(sorted({heavy} & {{*sys.modules}}))"
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert said.stdout == "[]\n"


def test_an_import_builds_no_model_of_a_file_that_is_not_read_yet() -> None:
    """Of a capture, a prompt, an arm or its verification."""
    code = """
import gc
import bench.api.dry_runs
from pydantic import BaseModel, TypeAdapter
rooms = "instruments.captures", "instruments.operators", "instruments.microscribe", "bench.rig.arm_files"
for one in gc.get_objects():
    made = type(one) is TypeAdapter and one.pydantic_complete
    if made or type(one) is type(BaseModel) and one.__pydantic_complete__ and one.__module__.startswith(rooms):
        print(one)
"""
    given: dict[str, Any] = {"capture_output": True, "text": True, "check": True, "cwd": ROOT}
    assert subprocess.run([sys.executable, "-c", code], **given).stdout == ""


FUNCTIONS = {
    f"{module}.{name}": one
    for module in ("bench", "bench.testing")
    for name in sorted(on_page()[module])
    if inspect.isfunction(one := getattr(importlib.import_module(module), name))
}
ALL = [getattr(package, name) for package in (bench, instruments) for name in package.__all__]
OURS = tuple(one for one in ALL if inspect.isclass(one) and issubclass(one, Exception))
NO_SENTENCE = "has no attribute|takes|argument|NoneType|expected|unpack|index|operand"


@pytest.mark.parametrize("name", FUNCTIONS)
def test_arguments_of_a_wrong_kind_are_refused_by_name(name: str) -> None:
    """Neither a thing, nor NaN, nor a text with a zero byte, nor an array for one of a few, nor None
    where it isn't said, for whatever it takes.
    """
    function = FUNCTIONS[name]
    for one, hint in _hints(vars(function)["__wrapped__"]).items():
        array = [np.zeros(2)] if get_origin(hint) is Literal else []
        nothing = [] if type(None) in get_args(hint) else [None]
        for wrong in (object(), math.nan, "a\0b", *array, *nothing):
            parameters = inspect.signature(function).parameters
            many, ahead = parameters[one].kind == 2, [""] * [*parameters].index(one)  # *arguments
            with pytest.raises(bench.ConfigError, match=rf"^{one} is .*, not \S"):
                function(*ahead, wrong) if many else function(**{one: wrong})


@pytest.mark.parametrize("name", FUNCTIONS)
def test_what_is_of_the_right_kind_and_not_there_is_an_error_of_ours(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A path that leads nowhere, a word that nobody knows, an empty list, a number below 0."""
    monkeypatch.chdir(tmp_path)
    function, given = FUNCTIONS[name], dict[str, Any]()
    for argument, shape in inspect.signature(function).parameters.items():
        hint = _hints(vars(function)["__wrapped__"])[argument]
        wrong: tuple[object, ...] = ("no/such", [], {}, -1, 1.0, True)
        fitting = [one for one in wrong if fits(one, hint)]
        if fitting and shape.kind is not shape.VAR_POSITIONAL:
            given[argument] = fitting[0]
        elif shape.default is shape.empty and shape.kind is not shape.VAR_POSITIONAL:
            return  # needs what another call gives
    said = "it did it"
    try:
        found = function(**given)
        list(getattr(found, "gen", ()))
    except OURS as error:
        said = str(error)
    assert len(said.split()) > 2, said
    assert not re.search(NO_SENTENCE, said)
    assert not [*tmp_path.rglob("*")]


BOARD = bench.find_board("chessboard-9x6-40")[0]
VIEWS = {"views": bench.BoardViews(BOARD, {"left": {}}, {"left": (1, 1)}, ())}
PART = bench.read_part(ROOT / "bench" / "rigs" / "calibration.toml").part
DRAWN = {"rig": "emulated", "folder": "o", "seed": 1}
# verbs with their arguments, of which the last is wrong
WRONG: list[tuple[str, dict[str, Any]]] = [
    *(("run_script", {name: wrong}) for name, wrong in (("seed", -1), ("speed", 0), ("speed", -1))),
    ("run_queue", {"scripts": []}), ("check_script", {"seed": -1}), ("open_bath", {"url": "COM1", "profile": "no"}),
    ("run_queue", {"scripts": ["demo", "demo"], "record": "o"}), ("draw", {"scene": "ideal", "number": -1}),
    ("score_recording", {"recording": "D", "detectors": []}), ("calibrate_pair", {**VIEWS, "model": "k1 k9"}),
    ("calibrate_pair", VIEWS), ("find_views", {"pictures": {}, "board": BOARD, "max_views": 0}),
    ("record_boards", {**DRAWN, "board": BOARD, "poses": 1, "cameras": ["middle"]}),
    ("record_scenes", {**DRAWN, "names": ["ideal"], "seeds": [-1]}), ("calibrate_stage", {"rig": "emulated", "teat": 0}),
    *((f"compare_{key}", {name: ["D"], **wrong}) for key, name in (("runs", "runs"), ("campaigns", "folders"))
      for wrong in cast(list[dict[str, Any]], [{name: []}, {"confidence": 2}, {"confidence": 0}, {"margin_mm": -1}])),
    ("compare_campaigns", {"folders": ["D"], "margin_rate": 2}), ("show_scenes", {"folder": "D", "names": []}),
    ("judge_together", {"runs": []}), ("write_comparison", {"folder": "o", "found": []}),
    ("write_opencv", {"part": PART, "path": "no/a"}), ("write_bouguet", {"part": PART, "path": "no/a"}),
    ("write_calibration", {"found": PART, "out": "D"}), ("open_stage", {"url": "socket://h:1", "axes": "XQ"}),
    ("open_stage", {"url": "socket://h:1", "dialect": "gbrl"}), ("run_campaign", {"out": "o", "plan": {"familes": 1}}),
    ("open_bath", {"profile": "julabo-presto", "url": "there"}), ("open_bath", {"profile": "julabo-presto", "url": "emulator:x"}),
    ("open_stage", {"url": "emulator:x"}), ("run_script", {"events": "no/such"}), ("run_script", {"notify": ["nonsense://x"]}),
    ("write_rig", {"out": "o", "tables": {"bath": {"profil": "x"}}}), ("write_rig", {"out": "o", "tables": {"cameras.left": {"url": "4"}}}),
    ("run_campaign", {"plan": {}, "out": "o", "workers": -1}), ("read_foreign", {"files": ["F"], "kind": "matlap"}),
    ("open_detector", {"detector": PluginDetector}), ("plan_poses", {"failures": -1}), ("plan_poses", {"shift_mm": 1.0}), ("plan_poses", {"u_mm": 1.0}), ("read_rows", {"folder": "D", "kind": int}), ("pack_run", {"run": "D", "out": "o", "licence": "mine"}),
]  # fmt: skip


@pytest.mark.parametrize(("verb", "given"), WRONG)
def test_wrong_arguments_are_refused_by_name_and_nothing_is_made(
    verb: str, given: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "D").mkdir()
    name, wrong = [*given.items()][-1]
    word = next(iter(wrong), name) if isinstance(wrong, dict) else f"{name}|{re.escape(str(wrong))}"
    with pytest.raises(bench.ConfigError, match=rf"^`?({word})\b|\b({word})\b"):
        list(getattr(found := getattr(bench, verb)(**given), "gen", found))
    assert [*tmp_path.rglob("*")] == [tmp_path / "D"]


class Annotated:
    """A detector whose annotations are for type checkers alone, as those of a package are."""

    name, version, parameters = "annotated", "1", dict[str, Any]()

    def detect(self, frames: Any, calibration: Any) -> Detection:
        return Detection(())


vars(Annotated)["detect"].__annotations__.update(frames="Frames", calibration="np.nothing")


@pytest.mark.parametrize("of_package", [True, False])
def test_a_detectors_annotations_need_not_be_known(of_package: bool) -> None:
    own: Any = Annotated()
    if of_package:
        own = PluginDetector("annotated", "1", {}, own, {})
    with lent(own, "detector") as detector:  # as `open_detector` gives one by its name
        assert detector.detect(cast(Any, None), cast(Any, None)).teats == ()
    for name in FUNCTIONS:  # which are held against theirs
        function = vars(FUNCTIONS[name])["__wrapped__"]
        assert {*function.__annotations__} - {"return"} == {*_hints(function)}


@pytest.mark.parametrize("name", ROWS)
def test_rows_are_the_tables_columns_with_their_types(name: str) -> None:
    row = getattr(bench, name)
    with closing(sqlite3.connect(":memory:")) as db:
        make_tables(db)
        columns = db.execute(f"PRAGMA table_info({row.table})").fetchall()
    by_column = {
        column: TYPES[kind] + ("" if needed or key else " | None")
        for _, column, kind, needed, _, key in columns
    }
    assert {field.name: field.type for field in dataclasses.fields(row)} == by_column


class Installed:
    """The wheel in a folder of its own, and what is run with it alone, in an empty folder."""

    def __init__(self, site: Path, here: Path) -> None:
        self.site, self.here = site, here

    def pip(self, *what: str) -> None:
        """As a person types it, but with what this machine has."""
        quiet = ("install", "-q", "--no-deps", "--no-index", "--no-build-isolation")
        self(sys.executable, "-m", "pip", *quiet, "--target", str(self.site), *what)

    def __call__(self, *words: str, code: int = 0) -> str:
        path = os.pathsep.join([str(self.site / "bin"), os.environ["PATH"]])
        done = subprocess.run(
            words,
            cwd=self.here,
            env={**os.environ, "PYTHONPATH": str(self.site), "PATH": path},
            capture_output=True,
            text=True,
            check=False,
            timeout=1200,
        )
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    [found] = folder.iterdir()
    return found


@pytest.fixture(scope="module")
def site(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the wheel is installed."""
    folder = tmp_path_factory.mktemp("installed")
    found = folder / "site"
    Installed(found, folder).pip(str(wheel))
    # what numba has compiled of the same file: to do it again takes twenty seconds of a processor
    own = Path(kernels.__file__)
    installed = found / own.relative_to(ROOT)
    shutil.copystat(own, installed)
    for kept in (own.parent / "__pycache__").glob("*.nb[ci]"):
        shutil.copy2(kept, installed.parent / "__pycache__")
    write_calibration(found / RIGS.relative_to(ROOT))  # cameras with fewer pixels
    return found


@pytest.fixture
def installed(site: Path, tmp_path: Path) -> Installed:
    return Installed(site, tmp_path)


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.slow
def test_the_page_runs_from_the_wheel_in_an_empty_folder(installed: Installed) -> None:
    [script] = blocks(PAGE, "toml")
    code = blocks(PAGE, "python")
    gate = "set_point_c = 33.0\n"
    assert gate in script
    (installed.here / "my-script.toml").write_text(
        script.replace(gate, f"{gate}window_s = 60.0\n"), encoding="utf-8"
    )
    # figures take most of the time, and nothing here looks at one
    undrawn = f"import reports.figures.drawing as drawing\ndrawing.draw = lambda _: {NO_FIGURE!r}"
    seen = """
import json
print(json.dumps([bench.__file__, score.success, found.verdict, result.rates[0].scenes]))
"""
    said = installed(sys.executable, "-c", "\n".join([undrawn, *code, seen])).splitlines()
    place, *rest = json.loads(said[-1])
    assert Path(place).is_relative_to(installed.site)
    assert rest == [True, "met", 4]
    imports = {line for block in code for line in block.splitlines() if "import" in line}
    assert imports == {"import bench"}


@pytest.mark.weekly
def test_a_driver_of_each_kind_from_an_empty_folder(installed: Installed) -> None:
    page = ROOT / "docs" / "drivers.md"
    project, rig = blocks(page, "toml")
    files = {"pyproject.toml": project, "lab.toml": rig}
    files["lab_drivers.py"] = "\n\n".join(blocks(page, "python"))
    for name, text in files.items():
        (installed.here / name).write_text(text, encoding="utf-8")
    commands: list[list[str]] = []
    for line in "".join(blocks(page, "sh")).splitlines():
        program, *words = shlex.split(line)
        if program == "pip":
            installed.pip(*words[1:])
        elif program == "python3":
            installed(sys.executable, *words)
        else:
            commands.append(words)
    assert commands.pop(0) == ["plugin"]
    own = [one for one in installed("teatbench", "plugin").splitlines() if "lab_drivers:" in one]
    assert [one.endswith("with an emulator") for one in own] == [True] * 4
    assert all(words[0] in ("plugin", "check") for words in commands)
    in_turn = "import sys, json; from bench.cli.main import main"
    in_turn += "; sys.exit(any(list(map(main, json.loads(sys.argv[1])))))"
    said = installed(sys.executable, "-c", in_turn, json.dumps(commands))
    assert not re.search("failed|not checked|FAULT", said), said


@pytest.mark.weekly
@pytest.mark.timeout(1800)
def test_the_plug_in_with_a_failing_detector_from_an_empty_folder(installed: Installed) -> None:
    """The page's programs and commands in their order; what stands for a lab's own is made first."""
    page, here = ROOT / "docs" / "testing.md", installed.here
    saved = re.findall(
        r"Save this as `(\S+)`:\n\n```python\n(.*?)```", page.read_text("utf-8"), re.S
    )
    blind = """import json, sys
print(json.dumps({"ready": True}), flush=True)
for line in sys.stdin:
    print(json.dumps({"frame": json.loads(line)["frame"], "teats": []}), flush=True)
"""
    declared = f"command = {json.dumps([sys.executable, 'blind.py'])}\n"
    for name, text in (*saved, ("blind.py", blind), ("detector.toml", declared)):
        (here / name).write_text(text, encoding="utf-8")
    for name, to in (("emulated.toml", "my-rig.toml"), ("calibration.toml", "")):
        shutil.copy(installed.site / RIGS.relative_to(ROOT) / name, here / to)
    ends, said = {"test_detector.py": 1, "fused": 0, "detector.toml": 0}, ""
    quiet = ("-p", "no:cacheprovider", "-p", "no:xdist", "--hypothesis-seed=1")
    for line in "".join(blocks(page, "sh")).splitlines():
        program, *words = shlex.split(line)
        done = "-m", program, *quiet, *words
        said += installed(sys.executable, *done, code=ends.pop(words[-1]))
    assert re.search(r"thesis .* in Scene\(.*\n\d+ of \d+ scenes one step away", said)
    keep = re.search(r"Keep it: teatbench (campaign keep \S+ --into \S+)", said)
    assert keep
    installed("teatbench", *keep[1].split())
    assert [*here.glob("recordings/kept/frames/*")]
    [pasted] = here.glob("found/*/test_scene.py")
    assert "thesis" in installed(sys.executable, "-m", "pytest", "-q", str(pasted), code=1)


@pytest.mark.slow
def test_the_wheel_has_types_pages_and_licences(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {"_teatbench.py", "_teatbench_packages.py"} <= {*names}
    for package in ("bench", "detector", "instruments", "reports", "textfiles"):
        assert f"{package}/py.typed" in names
    pages = {f"bench/docs/{path.name}" for path in (ROOT / "docs").glob("*.md")}
    assert pages <= {*names}
    assert any(name.endswith("licenses/bench/console/static/uPlot.LICENSE.txt") for name in names)
    kept = subprocess.run(
        ["git", "ls-files", "bench", "detector", "instruments", "reports", "textfiles"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert {*kept} <= {*names}


if __name__ == "__main__":
    KEPT.write_text(json.dumps(promised(), indent=1) + "\n", encoding="utf-8")

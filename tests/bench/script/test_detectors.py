"""What a person names becomes a detector, or a sentence that says why not."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

from bench.config import ConfigError
from bench.record.reader import read_run
from bench.rig.loading import find_rig, load_rig
from bench.script.detectors import check_named, declared, make_detectors, taken_apart
from bench.script.model import TRIALS, load_script
from detector.external import ExternalDetector
from detector.external.process import ENVIRONMENT, MARK, UTF8
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.commands import Said
from tests.detector.children import NO_TEATS, answering, ask

COMMAND = f"command = [{json.dumps(sys.executable)}, 'x.py']\n"


def write(folder: Path, texts: Mapping[str, str]) -> None:
    """These files in ``folder``, by name."""
    for name, text in texts.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")


def test_names_commands_and_files_are_all_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    barn, far = 'about = "of the barn"', 'name = "other"\nversion = "9"\ntime_limit_s = 2'
    files = {"detectors/barn.toml": f"{barn}\n{COMMAND}", "far.toml": f"{far}\n{COMMAND}"}
    write(tmp_path, files | {"my detector.py": ""})
    quoted = f'exec:"{sys.executable}" "my detector.py" --fast'
    made = make_detectors(["thesis", quoted, "far.toml", "barn", "thesis"])
    assert [detector.name for detector in made] == ["thesis", "exec-my-detector", "other", "barn"]
    assert made[1].parameters["command"] == [sys.executable, "my detector.py", "--fast"]
    assert "my detector.py" in made[1].parameters["files_sha256"]
    assert (made[2].version, made[2].parameters["limits"]["answer_s"]) == ("9", 2.0)
    assert declared() == {"barn": "of the barn"}
    (serve,) = make_detectors([f"exec:{sys.executable} -m detector.external.serve thesis"])
    assert serve.name == "exec-serve"


def test_commands_are_taken_apart_as_each_system_writes_them() -> None:
    posix = taken_apart(r"python 'my detector.py' a\ b", windows=False)
    assert posix == ["python", "my detector.py", "a b"]
    windows = taken_apart(r'"C:\Program Files\x.exe" C:\my\det.py', windows=True)
    assert windows == [r"C:\Program Files\x.exe", r"C:\my\det.py"]


@pytest.mark.slow
def test_it_is_not_scored_on_what_it_was_trained_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    """Refused by name before anything is run or written; the record names its device."""
    monkeypatch.chdir(tmp_path)
    trained = {"ideal": [[0, 3]], "overlapping": [9], "six-situations": [1]}
    ready = f'say({{"ready": True, "device": "CUDA:0 some board", "trained_on": {trained}}})'
    Path("learned.py").write_text(answering(NO_TEATS, ready), encoding="utf-8")
    learned = ["--detector", f'exec:"{sys.executable}" learned.py']
    rig = write_small_rig(tmp_path)
    for first, family in ((3, "ideal"), (4, "dim_light")):
        record = f"scene record --situation {family} --seeds 2 --first {first} --out {family}"
        said(0, f"{record} --rig {{}}", rig)
    refused = said(2, "score ideal {} --out runs", learned).err
    assert "detector exec-learned says that it was trained on ideal 3 (1 of the 2 asked" in refused
    plan = "campaign run --scenes 20 --workers 1 --out campaign --rig {} {} --family"
    assert "on ideal 2, 3 (2 of the 20" in said(2, f"{plan} ideal --first 2", rig, learned).err
    assert "on overlapping 9 (" in said(2, f"{plan} overlapping", rig, learned).err
    for how in ("", "--dry-run"):
        refused = said(2, f"run six-situations --rig {{}} {how} {{}}", rig, learned).err
        assert "trained on six-situations 1 (1 of the 1" in refused
    assert not Path("runs").exists()
    assert not [*Path("campaign").rglob("*.toml")]
    said(1, "score dim_light {} --out runs", learned)
    (folder,) = Path("runs").iterdir()
    item = read_run(folder).facts["items"]["exec-learned"]
    assert item["device"] == "CUDA:0 some board"
    assert json.loads(item["trained on"])["overlapping"] == [[9, 9]]
    assert "CUDA:0 some board" in (folder / "report" / "index.html").read_text(encoding="utf-8")


def test_its_version_follows_its_files(tmp_path: Path) -> None:
    versions = set()
    for text in ("a", "b", "a"):
        write(tmp_path, {"mine.toml": COMMAND, "x.py": text})
        versions.add(make_detectors(["mine.toml"], tmp_path)[0].version)
    assert len(versions) == 2


@pytest.mark.parametrize(
    ("name", "note"),
    [
        ("thesys", 'did you mean "thesis"'),
        ("exec:", "needs a command"),
        ("exec:'half", "can't be taken apart"),
        ("exec:/no/such/program --x", "no program '/no/such/program'"),
        ("none.toml", "can't be read"),
        ("bad.toml", 'unknown key; did you mean "command"'),
        ("lost.toml", "no program 'no-such-program-at-all'"),
        ("thesis.toml", '"thesis" is the name of a detector that ships'),
        ("name.toml", "name"),
        ("one.toml two.toml", 'two detectors are called "same"'),
    ],
)
def test_what_cannot_be_used_is_reported(tmp_path: Path, name: str, note: str) -> None:
    files = {
        "bad.toml": "comand = ['x']",
        "lost.toml": "command = ['no-such-program-at-all']",
        "thesis.toml": COMMAND,
        "name.toml": f'name = "../up"\n{COMMAND}',
    }
    write(tmp_path, files | dict.fromkeys(("one.toml", "two.toml"), f'name = "same"\n{COMMAND}'))
    names = [name] if name.startswith("exec:") else name.split()
    with pytest.raises(ConfigError, match=re.escape(note)):
        make_detectors(names, tmp_path)


def test_a_script_names_them_as_a_command_does(tmp_path: Path) -> None:
    text = (TRIALS / "six-situations.toml").read_text(encoding="utf-8")
    text = text.replace('["thesis"]', '["thesis", "mine.toml", "exec:x"]')
    write(tmp_path, {"trials.toml": text, "mine.toml": COMMAND})
    script = load_script(tmp_path / "trials.toml")
    (mine,) = make_detectors(script.script.detectors[1:2], script.path.parent)
    assert isinstance(mine, ExternalDetector)
    write(tmp_path, {"trials.toml": text.replace('"thesis", ', '"thesys", ')})
    with pytest.raises(ConfigError, match=r"no detector 'thesys'; did you mean \"thesis\""):
        load_script(tmp_path / "trials.toml")
    check_named(["exec:whatever", "what/ever.toml"])


def test_the_list_tells_a_faulty_file_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path, {"detectors/bad.toml": "command = 5"})
    listed = said(0, "detectors").out
    assert "bad: BROKEN: " in listed
    assert "thesis: " in listed


@pytest.mark.slow
def test_a_program_sees_the_variables_of_the_list_and_those_that_its_file_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"LAB_TOKEN": "secret", "LAB_MODEL": "heavy", "LANG": "C.UTF-8"}.items():
        monkeypatch.setenv(name, value)
    says = 'say({"frame": asked["frame"], "teats": [], "reason": json.dumps(dict(os.environ))})'
    command = f"command = [{sys.executable!r}, 'mine.py']\nenvironment = "
    files = {"mine.py": answering(says), "plain.toml": f"{command}[]"}
    files["more.toml"] = f"{command}['LAB_MODEL', 'NOT_THERE']"
    write(tmp_path, files | {"wrong.toml": f"{command}['A=B']"})
    seen = {}
    for detector in make_detectors(["plain.toml", "more.toml"], tmp_path):
        assert isinstance(detector, ExternalDetector)
        try:
            seen[detector.name] = json.loads(
                str(ask(detector, load_rig(find_rig(None)).calibration).reason)
            )
        finally:
            detector.close()
    assert seen["plain"]["LANG"] == "C.UTF-8"
    assert seen["plain"]["PATH"] == os.environ["PATH"]
    assert set(seen["plain"]) <= {*ENVIRONMENT, *UTF8, MARK}
    assert seen["plain"]["PYTHONUTF8"] == "1", "lines are UTF-8 on every system"
    assert seen["more"].keys() - seen["plain"].keys() == {"LAB_MODEL"}
    assert seen["more"]["LAB_MODEL"] == "heavy"
    with pytest.raises(ConfigError, match=r"environment\[1\]"):
        make_detectors(["wrong.toml"], tmp_path)

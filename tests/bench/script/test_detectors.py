"""What a person names becomes a detector, or a sentence that says why not."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from bench.cli.main import main
from bench.config import ConfigError
from bench.record.reader import read_run
from bench.rig.loading import find_rig, load_rig
from bench.script.detectors import check_named, declared, make_detectors, taken_apart
from bench.script.model import TRIALS, load_script
from detector.external import ExternalDetector
from detector.external.process import ENVIRONMENT, MARK
from tests.bench.campaign.small_campaign import write_small_rig
from tests.bench.commands import Said
from tests.detector.children import NO_TEATS, answering, ask

COMMAND = f"command = [{json.dumps(sys.executable)}, 'x.py']\n"


def test_names_commands_and_files_are_all_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "detectors").mkdir()
    (tmp_path / "detectors" / "barn.toml").write_text(
        f'about = "of the barn"\n{COMMAND}', encoding="utf-8"
    )
    (tmp_path / "far.toml").write_text(
        f'name = "other"\nversion = "9"\ntime_limit_s = 2\n{COMMAND}', encoding="utf-8"
    )
    (tmp_path / "my detector.py").write_text("", encoding="utf-8")
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
    assert taken_apart(r"python 'my detector.py' a\ b", windows=False) == [
        "python",
        "my detector.py",
        "a b",
    ]
    assert taken_apart(r'"C:\Program Files\x.exe" C:\my\det.py', windows=True) == [
        r"C:\Program Files\x.exe",
        r"C:\my\det.py",
    ]


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
    study = "scene sensitivity --quantity contrast --seeds 5 --out study --rig {} {}"
    assert "on ideal 0, 1, 2, 3 (4 of the 5" in said(2, study, rig, learned).err
    for how in ("", "--dry-run"):
        refused = said(2, f"run six-situations --rig {{}} {how} {{}}", rig, learned).err
        assert "trained on six-situations 1 (1 of the 1" in refused
    assert not Path("runs").exists()
    assert not [*Path("campaign").rglob("*.toml"), *Path("study").rglob("*.toml")]
    said(1, "score dim_light {} --out runs", learned)
    (folder,) = Path("runs").iterdir()
    item = read_run(folder).facts["items"]["exec-learned"]
    assert item["device"] == "CUDA:0 some board"
    assert json.loads(item["trained on"])["overlapping"] == [[9, 9]]
    assert "CUDA:0 some board" in (folder / "report" / "index.html").read_text(encoding="utf-8")


def test_its_version_follows_its_files(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(COMMAND, encoding="utf-8")
    versions = set()
    for text in ("a", "b", "a"):
        (tmp_path / "x.py").write_text(text, encoding="utf-8")
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
    ],
)
def test_what_cannot_be_used_is_reported(tmp_path: Path, name: str, note: str) -> None:
    for file, text in {
        "bad.toml": "comand = ['x']",
        "lost.toml": "command = ['no-such-program-at-all']",
        "thesis.toml": COMMAND,
        "name.toml": f'name = "../up"\n{COMMAND}',
    }.items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        make_detectors([name], tmp_path)
    assert note in str(caught.value)


def test_two_of_one_name_are_refused(tmp_path: Path) -> None:
    for file in ("one.toml", "two.toml"):
        (tmp_path / file).write_text(f'name = "same"\n{COMMAND}', encoding="utf-8")
    with pytest.raises(ConfigError, match='two detectors are called "same"'):
        make_detectors(["one.toml", "two.toml"], tmp_path)


def test_a_script_names_them_as_a_command_does(tmp_path: Path) -> None:
    text = (
        (TRIALS / "six-situations.toml")
        .read_text(encoding="utf-8")
        .replace('["thesis"]', '["thesis", "mine.toml", "exec:x"]')
    )
    (tmp_path / "trials.toml").write_text(text, encoding="utf-8")
    (tmp_path / "mine.toml").write_text(COMMAND, encoding="utf-8")
    script = load_script(tmp_path / "trials.toml")
    (mine,) = make_detectors(script.script.detectors[1:2], script.path.parent)
    assert isinstance(mine, ExternalDetector)
    (tmp_path / "trials.toml").write_text(
        text.replace('"thesis", ', '"thesys", '), encoding="utf-8"
    )
    with pytest.raises(ConfigError, match=r"no detector 'thesys'; did you mean \"thesis\""):
        load_script(tmp_path / "trials.toml")
    check_named(["exec:whatever", "what/ever.toml"])


def test_the_list_tells_a_faulty_file_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "detectors").mkdir()
    (tmp_path / "detectors" / "bad.toml").write_text("command = 5", encoding="utf-8")
    assert main(["detectors"]) == 0
    said = capsys.readouterr().out
    assert "bad: BROKEN: " in said
    assert "thesis: " in said


def test_a_program_sees_the_variables_of_the_list_and_those_that_its_file_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LAB_TOKEN", "secret")
    monkeypatch.setenv("LAB_MODEL", "heavy")
    monkeypatch.setenv("LANG", "C.UTF-8")
    says = 'say({"frame": asked["frame"], "teats": [], "reason": json.dumps(dict(os.environ))})'
    (tmp_path / "mine.py").write_text(answering(says), encoding="utf-8")
    command = f"command = [{sys.executable!r}, 'mine.py']\n"
    (tmp_path / "plain.toml").write_text(command, encoding="utf-8")
    (tmp_path / "more.toml").write_text(
        f"{command}environment = ['LAB_MODEL', 'NOT_THERE']\n", encoding="utf-8"
    )
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
    assert set(seen["plain"]) <= {*ENVIRONMENT, MARK}
    assert seen["more"].keys() - seen["plain"].keys() == {"LAB_MODEL"}
    assert seen["more"]["LAB_MODEL"] == "heavy"
    (tmp_path / "wrong.toml").write_text(f"{command}environment = ['A=B']\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"environment\[1\]"):
        make_detectors(["wrong.toml"], tmp_path)

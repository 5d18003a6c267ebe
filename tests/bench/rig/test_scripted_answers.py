"""Scripts of answers as files: both forms say the same, and a wrong one is told with its place
before anything is opened.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.config import ConfigError
from bench.rig.loading import load_rig
from bench.rig.scripted_answers import load_answers
from instruments.errors import ProtocolError
from instruments.operators.operator import CheckPoint, Finish, Homing, OperatorSkip, Touch
from tests.bench.test_config import rig_with as emulated_rig

TOML = """
[otherwise]
homing = "go"
"check point" = "go"

[[answers]]
to = "touch"
answer = ""
times = 3

[[answers]]
to = "touch"
says = "teat 2 of 4"
answer = "skip the teat came off"
"""

TEXT = """
# the same, line by line
otherwise homing: go
otherwise check point: go

touch: go x3
touch (teat 2 of 4): skip the teat came off
"""


def test_an_answer_is_for_all_touches_of_a_teat_end(tmp_path: Path) -> None:
    path = tmp_path / "answers.txt"
    text = "touch: go\ntouch (teat 2 of 4): go\ntouch (press 3 of 3): skip it is loose\n"
    path.write_text(text, encoding="utf-8")
    who = load_answers(path)
    for teat, number in ((1, 1), (1, 2), (1, 3), (2, 1), (2, 2)):
        who.ask(Touch(teat, 4, number, 3))
    with pytest.raises(ProtocolError, match="the first is 'skip it is loose'"):
        who.ask(Finish())
    with pytest.raises(OperatorSkip, match="it is loose"):
        who.ask(Touch(2, 4, 3, 3))
    who.ask(Finish())


@pytest.mark.parametrize(("name", "text"), [("answers.toml", TOML), ("answers.txt", TEXT)])
def test_both_forms_say_the_same(name: str, text: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    shown: list[str] = []
    who = load_answers(path, shown.append)
    who.ask(Homing("On its peg."))
    for touch in (1, 2):
        who.ask(CheckPoint(touch, 2))
    for teat in (1, 2, 1):
        who.ask(Touch(teat, 4))
    with pytest.raises(ProtocolError, match=f"{name} has no answer to this prompt"):
        who.ask(Touch(3, 4))
    with pytest.raises(OperatorSkip, match="the teat came off"):
        who.ask(Touch(2, 4))
    who.ask(Finish())
    assert shown[0] == "On its peg. > go"


TOUCH = '[[answers]]\nto = "touch"\n'
WRONG_KIND = ("a.toml:2", "'tuch' is not allowed", 'did you mean "touch"')
KINDS = ("a.txt:3: ", 'no prompt is of the kind "tuch"', 'did you mean "touch"')


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.toml", TOUCH.replace("ou", "u") + 'answer = "go"', WRONG_KIND),
        ("a.toml", TOUCH + 'answer = "skip"\n', ("a skipped trial needs a reason",)),
        ("a.toml", TOUCH + 'ansver = "go"\n', ("a.toml:3", 'did you mean "answer"')),
        ("a.toml", '[otherwise]\nhoming = "skip it"\n', ("a.toml:", 'there are "go", "abort"')),
        (
            "a.toml",
            TOUCH + 'answer = "go"\ntimes = 0\n',
            ("a.toml:4", "greater than or equal to 1"),
        ),
        ("a.txt", "homing: go\n\ntuch: go\n", KINDS),
        ("a.txt", "touch\n", ("a.txt:1: ", 'a line is "KIND: ANSWER"')),
        ("a.txt", "touch: skip\n", ("a.txt:1: ", "a skipped trial needs a reason")),
        (
            "a.txt",
            "otherwise touch: go x4\n",
            ("a.txt:1: ", "leave the words in brackets and the times out"),
        ),
        ("a.txt", "otherwise homing: 3\n", ("a.txt:1: ", "Not understood: '3'")),
    ],
)
def test_a_wrong_file_is_reported_with_its_place(
    name: str, text: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_answers(tmp_path / name)
    for word in words:
        assert word in str(error.value)


def rig_with(url: str, folder: Path) -> Path:
    table = '[operator]\nurl = "{}"'
    return emulated_rig(folder, {table.format("emulator:"): table.format(url)})


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("script:nowhere.toml", "no such file beside the rig file"),
        (
            "person:",
            'allowed: "console:", "browser:", "emulator:", "script:ANSWERS.toml", "script:ANSWERS.txt"',
        ),
        ("script:wrong.txt", "wrong.txt:1: "),
    ],
)
def test_a_rig_s_operator_is_checked_when_it_is_read(url: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "wrong.txt").write_text("hello\n", encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_rig(rig_with(url, tmp_path))
    assert words in str(error.value)

"""Reads a script of answers for an operator: a TOML file, or a text file with a line for each
answer.

# a text file
otherwise homing: go
otherwise touch: go
check point: go x5
set up (overlapping): skip the plate is cracked
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

from pydantic import Field, field_validator, model_validator

from bench.config import ConfigError, FileFault, FileTable, did_you_mean, read_config, read_text
from instruments.operators.operator import Kind
from instruments.operators.prompted import KINDS, ScriptedAnswer, ScriptedAnswers, check_answer

LINE = re.compile(
    r"(?P<otherwise>otherwise\s+)?(?P<to>[a-z"
    r" ]+?)\s*(\((?P<says>[^)]*)\))?\s*:\s*(?P<answer>.*?)(\s+x(?P<times>[1-9]\d*))?$"
)
FORM = (
    'a line is "KIND: ANSWER", "KIND (WORDS OF THE PROMPT): ANSWER", "KIND: ANSWER x5" or'
    ' "otherwise KIND: ANSWER"'
)


class AnswerTable(FileTable):
    to: Kind
    answer: str
    says: str = ""
    times: Annotated[int, Field(ge=1, le=100_000)] = 1

    @model_validator(mode="after")
    def _fits(self) -> AnswerTable:
        check_answer(self.to, self.answer)
        return self


class AnswerFile(FileTable):
    answers: tuple[AnswerTable, ...] = ()
    otherwise: dict[Kind, str] = Field(default_factory=dict)

    @field_validator("otherwise")
    @classmethod
    def _fit(cls, table: dict[Kind, str]) -> dict[Kind, str]:
        for kind, answer in table.items():
            check_answer(kind, answer)
        return table


def load_answers(path: Path, show: Callable[[str], None] = lambda _: None) -> ScriptedAnswers:
    """The answers at ``path``; ``show`` gets each prompt and answer. Raises ConfigError."""
    if path.suffix.lower() == ".toml":
        read = read_config(path, AnswerFile)
        listed = [
            ScriptedAnswer(**table.model_dump(), where=f"answer {n}")
            for n, table in enumerate(read.answers, 1)
        ]
        return ScriptedAnswers(listed, read.otherwise, path.name, show=show)
    answers: list[ScriptedAnswer] = []
    otherwise: dict[Kind, str] = {}
    text = read_text(path)
    for number, line in enumerate(text.split("\n"), 1):
        words = line.strip()
        if words and not words.startswith("#"):
            try:
                _take(words, f"line {number}", answers, otherwise)
            except ValueError as error:
                fault = FileFault(number, line.index(words), len(words), str(error))
                raise ConfigError(path, [fault], text) from error
    return ScriptedAnswers(answers, otherwise, path.name, show=show)


def _take(
    words: str, where: str, answers: list[ScriptedAnswer], otherwise: dict[Kind, str]
) -> None:
    """Add what a line says. Raises ValueError for one that says nothing."""
    parts = LINE.match(words)
    if not parts:
        raise ValueError(f"not understood: {FORM}")
    kind = next((kind for kind in KINDS if kind == parts["to"]), None)
    if kind is None:
        raise ValueError(
            f'no prompt is of the kind "{parts["to"]}"{did_you_mean(parts["to"], KINDS) or "."}'
            f" There are: {', '.join(KINDS)}"
        )
    check_answer(kind, parts["answer"])
    if not parts["otherwise"]:
        says, times = parts["says"] or "", int(parts["times"] or 1)
        answers.append(ScriptedAnswer(kind, parts["answer"], says, times, where))
        return
    if parts["says"] or parts["times"]:
        raise ValueError(
            '"otherwise" is for all prompts of a kind: leave the words in brackets and the'
            " times out"
        )
    otherwise[kind] = parts["answer"]

"""Prompts and answers as files between a run and a console in another process.

In the run's folder `console/prompt.json` is the last prompt, replaced as a whole, and
`console/answers/7.json` the answer to prompt 7. An answer is created, never replaced: of two that
are given at once, by a browser, the terminal or the bench, only the first exists. The bench answers
a prompt that needs no answer any more. Neither process waits for the other.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, TypeAdapter

from instruments.clock import wall_time
from instruments.operators import operator as op
from textfiles.whole import in_turn, replace_whole, sync

FOLDER, PROMPT, ANSWERS = "console", "prompt.json", "answers"
LONGEST = 1 << 20  # bytes of a file
LONGEST_NUMBER = 16  # digits
TERMINAL, BENCH = "the terminal", "the bench"  # who answered, beside names of browsers


class NotOpenError(Exception):
    """No prompt of this number is open. The text is for the person who answered."""


class AlreadyAnsweredError(NotOpenError):
    """Another answer came first; ``by`` gave it."""

    def __init__(self, number: int, by: str) -> None:
        self.by = by
        super().__init__(f"prompt {number} was already answered by {by}")


@dataclass(frozen=True, slots=True)
class Reply:
    """``words`` as they would be typed, from ``by``."""

    number: int
    words: str
    by: str
    wall_time: str


class Mailbox:
    """The run's end. ``folder`` is the run's; numbers go on from those of an earlier session, whose
    open prompt that is no longer waited for.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder / FOLDER
        (self._folder / ANSWERS).mkdir(parents=True, exist_ok=True)
        names = [path.stem for path in (self._folder / ANSWERS).glob("*.json")]
        said = [int(name) for name in names if name.isdecimal() and len(name) < LONGEST_NUMBER]
        last = read_prompt(folder)
        self._number = max([0, *said, int(last["number"]) if last else 0])
        self._prompt: dict[str, Any] = {}
        if last and last["open"]:
            self._show({**last, "open": False, "by": BENCH})

    def open(self, prompt: op.Prompt) -> None:
        """Publish ``prompt``. Raises OSError."""
        self._number += 1
        self._prompt = {
            **asdict(prompt),
            "number": self._number,
            "in_trial": prompt.in_trial,
            "explained": prompt.explained(),
            "wall_time": wall_time().isoformat(timespec="milliseconds"),
        }
        self._show({**self._prompt, "open": True, "by": ""})

    def answer(self) -> Reply | None:
        """The answer to the open prompt, None while there is none."""
        return read_answer(self._folder.parent, self._number)

    def close(self, words: str, by: str) -> Reply:
        """Close the prompt: ``by`` answered ``words``. Returns the answer that holds, which may be
        another one that came first. Raises OSError.
        """
        try:
            given = _create(self._folder.parent, self._number, words, by)
        except AlreadyAnsweredError:
            given = self.answer() or Reply(self._number, words, by, "")
        self._show({**self._prompt, "open": False, "by": given.by})
        return given

    def _show(self, prompt: Mapping[str, Any]) -> None:
        replace_whole(self._folder / PROMPT, json.dumps(prompt, ensure_ascii=False).encode())


class _PromptFile(BaseModel):
    """`PROMPT` as the run writes it; further keys are for the browser."""

    model_config = ConfigDict(strict=True, extra="allow", defer_build=True)

    number: int
    open: bool
    by: str
    kind: op.Kind
    text: str
    progress: str
    hidden_to: int
    pedal: bool
    enough: bool


def _read(path: Path) -> bytes:
    """A small file. Raises OSError, and ValueError for a large one."""
    with in_turn(lambda: path.open("rb")) as file:
        data = file.read(LONGEST + 1)
    if len(data) > LONGEST:
        raise ValueError(f"{path} has more than {LONGEST} bytes")
    return data


def read_prompt(folder: Path) -> dict[str, Any] | None:
    """The last prompt of the run in ``folder``, None for a file that is not as it writes them;
    ``open`` says whether it waits for an answer.
    """
    try:
        return _PromptFile.model_validate_json(_read(folder / FOLDER / PROMPT)).model_dump()
    except (OSError, ValueError):
        return None


def read_answer(folder: Path, number: int) -> Reply | None:
    """The answer to prompt ``number``, None where there is none."""
    try:
        data = _read(folder / FOLDER / ANSWERS / f"{number}.json")
        return TypeAdapter(Reply).validate_json(data, strict=True)
    except (OSError, ValueError):
        return None


def give_answer(folder: Path, number: int, words: str, by: str) -> Reply:
    """Answer prompt ``number`` of the run in ``folder``, durable on return. Raises
    AlreadyAnsweredError, NotOpenError, ValueError for a wrong answer, OSError.
    """
    if earlier := read_answer(folder, number):
        raise AlreadyAnsweredError(number, earlier.by)
    prompt = read_prompt(folder)
    if prompt is None or prompt["number"] != number or not prompt["open"]:
        raise NotOpenError(f"prompt {number} is not open")
    fields = ("kind", "text", "progress", "hidden_to", "pedal", "enough")
    op.check_words(words, op.Prompt(**{name: prompt[name] for name in fields}))
    return _create(folder, number, words, by)


def _create(folder: Path, number: int, words: str, by: str) -> Reply:
    """Written whole under another name, then linked to its own, which fails where it exists; where
    there are no links its own is taken by an empty file, which is no answer yet.
    """
    given = Reply(number, words, by, wall_time().isoformat(timespec="milliseconds"))
    place = folder / FOLDER / ANSWERS / f"{number}.json"
    part = place.with_name(f"{number}.{os.getpid()}-{os.urandom(4).hex()}.part")
    data = json.dumps(asdict(given), ensure_ascii=False).encode()
    try:
        with part.open("xb") as file:
            file.write(data)
            file.flush()
            sync(file.fileno())
        try:
            os.link(part, place)
        except FileExistsError:
            raise
        except OSError:  # FAT and many a network's folder have no links
            place.open("xb").close()
            part.replace(place)
    except FileExistsError:
        there = read_answer(folder, number)
        raise AlreadyAnsweredError(number, there.by if there else "another client") from None
    finally:
        with suppress(OSError):
            part.unlink()
    return given

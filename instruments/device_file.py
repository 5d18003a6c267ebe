"""Reads the TOML file that describes a device (a bath's profile, an arm's own numbers) into its
model, and reports all its faults at once.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import BaseModel, ValidationError

from textfiles.documents import read_toml
from textfiles.text import TextError, shown, text_of

Keys = tuple[str | int, ...]
Model = TypeVar("Model", bound=BaseModel)


class DeviceFileError(ValueError):
    """A file that describes no device: its ``path``, and its ``faults`` as (keys, message)."""

    def __init__(self, path: Path, faults: Sequence[tuple[Keys, str]]) -> None:
        self.path = path
        self.faults = tuple(faults)
        said = (": ".join(filter(None, (".".join(map(str, at)), what))) for at, what in faults)
        super().__init__(f"{path}: {'; '.join(said)}")


class FaultsError(ValueError):
    """Faults that a model's own check of the whole has found: (keys, message) each."""

    def __init__(self, faults: list[tuple[Keys, str]]) -> None:
        self.faults = faults
        super().__init__("; ".join(message for _, message in faults))


def read_device(path: Path, model_of: Callable[[Mapping[str, Any]], type[Model]]) -> Model:
    """The file as the frozen model that its content chooses. Raises DeviceFileError, OSError."""
    try:
        return cast(Model, _model(text_of(path), model_of))  # which the cache's type leaves open
    except TextError as error:
        raise DeviceFileError(path, [((), str(error))]) from error
    except ValidationError as error:
        raise DeviceFileError(path, list(faults_of(error))) from error


@lru_cache(maxsize=64)  # each part of a command reads its rig's, and none changes it
def _model(text: str, model_of: Callable[[Mapping[str, Any]], type[BaseModel]]) -> BaseModel:
    content = read_toml(text)
    return model_of(content).model_validate_json(json.dumps(content, default=str), strict=True)


def faults_of(error: ValidationError) -> Iterator[tuple[Keys, str]]:
    for detail in error.errors():
        cause, kind = detail.get("ctx", {}).get("error"), detail["type"]
        if isinstance(cause, FaultsError):
            yield from cause.faults
            continue
        message = detail["msg"].removeprefix("Value error, ")
        if kind in ("unexpected_keyword_argument", "extra_forbidden"):
            message = "unknown key"
        given = kind != "missing" and detail["loc"]
        found = f" (found {shown(detail['input']):.60})" if given else ""
        yield detail["loc"], f"{message[0].lower()}{message[1:]}{found}"

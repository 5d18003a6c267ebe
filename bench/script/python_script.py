"""A trial script as a Python file: `SCRIPT`, what stands above the trials, and `trials()`, a
generator of the tables of `[[trials]]`.

The file is run once, before anything is opened, and what it gives becomes the TOML of a script,
which the run keeps beside the file itself. It decides which trials there are, and nothing else:
instruments, safety and time are the engine's.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from bench.config import ConfigError, read_text
from bench.toml import toml_text

ENDING = ".py"
MOST = 100_000
HEADING = "Made by {}, which lies beside this file."


def script_text(path: Path) -> str:
    """The TOML of the script at ``path``: its text, or what its Python gives. Raises ConfigError
    that names file and line.
    """
    text = read_text(path)
    if path.suffix != ENDING:
        return text
    names: dict[str, Any] = {"__name__": "trial_script", "__file__": str(path)}
    try:
        exec(compile(text, str(path), "exec"), names)  # noqa: S102 - the file that the user asked to be run
        head, made = names.get("SCRIPT"), names.get("trials")
        if not isinstance(head, Mapping) or not callable(made):
            raise ConfigError.plain(
                f"{path}: a script in Python has SCRIPT, a dictionary, and trials(), a generator of"
                " dictionaries"
            )
        return toml_text(
            _plain({**head, "trials": list(_tables(path, made()))}, path), HEADING.format(path.name)
        )
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:  # anyone's code: it may fail in any way
        raise ConfigError.plain(
            f"{path}{_line_of(path, error)}: {type(error).__name__}: {error}"
        ) from error


def _tables(path: Path, made: Any) -> Iterator[Mapping[str, Any]]:
    """Its trials. Raises ConfigError for what is none, and where they don't end."""
    if not isinstance(made, Iterable):
        raise ConfigError.plain(
            f"{path}: trials() gives a {type(made).__name__}; it has to yield dictionaries"
        )
    number = 0
    for number, table in enumerate(islice(made, MOST + 1), 1):
        if not isinstance(table, Mapping):
            raise ConfigError.plain(
                f"{path}: trial {number} of trials() is a {type(table).__name__}; each is a"
                " dictionary"
            )
        yield table
    if number > MOST:
        raise ConfigError.plain(f"{path}: trials() gives more than {MOST} trials; does it end?")


def _plain(value: Any, path: Path, at: str = "") -> Any:
    """``value`` as TOML has it; numpy's numbers and arrays become Python's. Raises ConfigError for
    what TOML has no words for.
    """
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {
            str(name): _plain(one, path, f"{at}.{name}" if at else str(name))
            for name, one in value.items()
        }
    if isinstance(value, list | tuple):
        return [_plain(one, path, f"{at}[{number}]") for number, one in enumerate(value, 1)]
    if value is None or isinstance(value, str | int | float):
        return value
    raise ConfigError.plain(
        f"{path}: {at} is a {type(value).__name__}; it has to be text, a number, true or false, a"
        " list or a table"
    )


def _line_of(path: Path, error: BaseException) -> str:
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f", line {error.lineno}"
    lines = [
        frame.lineno
        for frame in traceback.extract_tb(error.__traceback__)
        if frame.filename == str(path)
    ]
    return f", line {lines[-1]}" if lines else ""

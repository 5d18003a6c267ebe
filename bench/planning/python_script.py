"""A trial script as a Python file: `SCRIPT`, what stands above the trials, and `trials()`, a generator of the tables of `[[trials]]`.

The file is run once, before anything is opened, and what it gives becomes the TOML of a script, which the run keeps beside the file
itself. It decides which trials there are, and nothing else: instruments, safety and time are the engine's.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from bench.arm.toml_text import toml_text
from bench.config import ConfigError, read_text

ENDING = ".py"
MOST = 100_000
HEADING = "Made by {}, which lies beside this file."


def script_text(path: Path) -> str:
    """The TOML of the script at ``path``: its text, or what its Python gives. Raises ConfigError that names file and line."""
    text = read_text(path)
    if path.suffix != ENDING:
        return text
    names: dict[str, Any] = {"__name__": "trial_script", "__file__": str(path)}
    try:
        exec(compile(text, str(path), "exec"), names)  # noqa: S102 - the file that the user asked to be run
        head, made = names.get("SCRIPT"), names.get("trials")
        if not isinstance(head, Mapping) or not callable(made):
            raise ConfigError.plain(f"{path}: a script in Python has SCRIPT, a dictionary, and trials(), a generator of dictionaries")
        return toml_text({**head, "trials": list(_tables(path, made()))}, HEADING.format(path.name))
    except ConfigError:
        raise
    except (Exception, SystemExit) as error:  # anyone's code: it may fail in any way
        raise ConfigError.plain(f"{path}{_line_of(path, error)}: {type(error).__name__}: {error}") from error


def _tables(path: Path, made: Any) -> Iterator[Mapping[str, Any]]:
    """Its trials. Raises ConfigError for what is none, and where they don't end."""
    number = 0
    for number, table in enumerate(islice(made, MOST + 1), 1):
        if not isinstance(table, Mapping):
            raise ConfigError.plain(f"{path}: trial {number} of trials() is a {type(table).__name__}; each is a dictionary")
        yield table
    if number > MOST:
        raise ConfigError.plain(f"{path}: trials() gives more than {MOST} trials; does it end?")


def _line_of(path: Path, error: BaseException) -> str:
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return f", line {error.lineno}"
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f", line {lines[-1]}" if lines else ""

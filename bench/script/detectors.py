"""From what a person names to detectors: a registered name, ``exec:COMMAND``, or a file that
declares a program (docs/detectors.md).

``detectors/NAME.toml`` beside where the bench is called can be named by NAME alone. Nothing is
started here.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated

from pydantic import Field, StringConstraints

from bench.config import ConfigError, FileTable, Positive, did_you_mean, read_config, several
from detector import registry
from detector.calibration import Calibration
from detector.external import ExternalDetector, ProcessLimits
from detector.protocol import Detector, DetectorProcess, TrainedOn
from instruments.clock import stopwatch_s
from instruments.drivers.entry_points import loading

EXEC, FILE = "exec:", ".toml"
DECLARED = Path("detectors")
_DEFAULT = ProcessLimits()
NEVER_GIVES_UP = {"restarts": sys.maxsize, "in_a_row": sys.maxsize}


class DetectorFile(FileTable):
    """A program that is a detector. The command is run in the file's folder."""

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,60}$")] = ""
    about: str = ""
    version: str = ""
    command: Annotated[tuple[str, ...], Field(min_length=1)]
    environment: tuple[
        Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][A-Za-z0-9_()]*$")], ...
    ] = ()
    start_limit_s: Positive = _DEFAULT.start_s
    time_limit_s: Positive = _DEFAULT.answer_s
    memory_limit_mib: Positive = _DEFAULT.memory_mib or 1024.0
    restarts: Annotated[int, Field(ge=0, le=1000)] = _DEFAULT.restarts
    faults_in_a_row: Annotated[int, Field(ge=1, le=100)] = _DEFAULT.in_a_row


def make_detectors(
    names: Sequence[str | Detector], folder: Path = Path(), *, gives_up: bool = True
) -> list[Detector]:
    """The detectors of these names, files from ``folder``, and those that are made already; without
    ``gives_up`` a program is restarted after any number of faults. Raises ConfigError.
    """
    given = several("detectors", names)
    named = dict.fromkeys(one for one in given if isinstance(one, str))
    made = [_make(name, folder, gives_up) for name in named]
    made += [one for one in given if not isinstance(one, str)]
    for detector in made:
        if not isinstance(getattr(detector, "name", None), str):
            what = f"the detector {type(detector).__name__} has no `name`, by which a run lists it"
            raise ConfigError.plain(f"{what}. Give it that attribute, a text.")
        if sum(other.name == detector.name for other in made) > 1:
            raise ConfigError.plain(
                f'two detectors are called "{detector.name}". Give one a file with a name of its'
                " own."
            )
    return made


@contextmanager
def introduced(
    detectors: Sequence[Detector],
    scenes: Mapping[str, Collection[int]],
    calibration: Calibration | None = None,
) -> Iterator[None]:
    """Start those that are programs, and close them in the end. Raises ConfigError where one says
    that it was trained on some of ``scenes`` (families and members, scripts and seeds), or refuses
    the rig of ``calibration``.
    """
    served = [detector for detector in detectors if isinstance(detector, DetectorProcess)]
    try:
        for detector in served:
            detector.introduce()
        faults = [*_trained_on(detectors, scenes), *refusals(detectors, calibration)]
        if faults:
            raise ConfigError.plain("\n".join(faults))
        yield
    finally:
        for detector in served:
            detector.close()


def refusals(detectors: Sequence[Detector], calibration: Calibration | None) -> Iterator[str]:
    """Which of them can't be used with the rig of ``calibration``, and why."""
    for detector in detectors:
        refuses = getattr(detector, "refuses", None)
        if calibration is not None and callable(refuses) and (why := refuses(calibration)):
            yield f"detector {detector.name} can't be used with this rig: {why}"


def _trained_on(
    detectors: Sequence[Detector], scenes: Mapping[str, Collection[int]]
) -> Iterator[str]:
    for detector in detectors:
        trained: TrainedOn = getattr(detector, "trained_on", {})
        for name in sorted(scenes.keys() & trained.keys()):
            spans = trained[name]
            seen = sorted(n for n in scenes[name] if any(low <= n <= high for low, high in spans))
            if seen:
                many = f"{len(seen)} of the {len(scenes[name])} asked for"
                yield (
                    f"detector {detector.name} says that it was trained on {name} {_listed(seen)}"
                    f" ({many}): a score on these says nothing. Score it on others, whose members"
                    " or seeds it has not seen."
                )


def _listed(numbers: Sequence[object]) -> str:
    """At most three, and the last."""
    few = numbers if len(numbers) < 5 else [*numbers[:3], "…", numbers[-1]]
    return ", ".join(map(str, few))


def check_named(names: Iterable[str]) -> None:
    """Raises ValueError for a name that isn't there; commands and files aren't looked into."""
    for name in names:
        if name in registry.SHIPPED or name.startswith(EXEC) or name.endswith(FILE):
            continue
        known = list(registry.available())
        if name in known or (DECLARED / f"{name}{FILE}").is_file():
            continue
        hint = did_you_mean(name, known)
        if Path(name).is_file():
            hint = f"; to run that file, write {EXEC}COMMAND"
        raise ValueError(
            f"no detector {name!r}{hint} (there are: {', '.join(known)}; or {EXEC}COMMAND, or a"
            f" {FILE} file)"
        )


def declared() -> dict[str, str]:
    """Name -> one line, of the files in ``detectors``; a faulty file's says so."""
    found: dict[str, str] = {}
    for path in sorted(DECLARED.glob(f"*{FILE}")):
        try:
            found[path.stem] = read_config(path, DetectorFile).about or f"declared in {path}"
        except ConfigError as error:
            found[path.stem] = f"BROKEN: {error}"
    return found


def _make(name: str, folder: Path, gives_up: bool) -> Detector:
    if name.endswith(FILE) and not name.startswith(EXEC):
        return _of_file(folder / name, gives_up)
    if not name.startswith(EXEC):
        try:
            check_named((name,))
        except ValueError as error:
            raise ConfigError.plain(str(error)) from error
        known = name in registry.SHIPPED or name in registry.available()
        if not known:
            return _of_file(DECLARED / f"{name}{FILE}", gives_up)
        try:
            with loading(f"detector {name}"):
                return registry.create(name)
        except ImportError as error:
            raise ConfigError.plain(f"detector {name!r} can't be used: {error}") from error
    try:
        command = taken_apart(name.removeprefix(EXEC), windows=os.name == "nt")
    except ValueError as error:
        raise ConfigError.plain(f"{name}: the command can't be taken apart: {error}") from error
    if not command:
        raise ConfigError.plain(f"{EXEC} needs a command, such as {EXEC}python3 my_detector.py")
    _find_program(command[0], Path())
    # named after the first file behind the program, else the module after -m, else the program
    files = (Path(part).stem for part in command[1:] if Path(part).is_file())
    modules = (part.rpartition(".")[2] for flag, part in pairwise(command) if flag == "-m")
    called = [*files, *modules, Path(command[0]).stem][0]
    limits = _DEFAULT if gives_up else replace(_DEFAULT, **NEVER_GIVES_UP)
    return ExternalDetector(f"exec-{_plain(called)}", command, stopwatch_s, limits=limits)


def _plain(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "-", name)


def taken_apart(text: str, *, windows: bool) -> list[str]:
    """A command's words; a backslash is a letter on Windows. Raises ValueError."""
    words = shlex.split(text, posix=not windows)
    return [re.sub(r"""(?s)^(["'])(.*)\1\Z""", r"\2", word) if windows else word for word in words]


def _of_file(path: Path, gives_up: bool) -> Detector:
    given = read_config(path, DetectorFile)
    folder = path.resolve().parent
    _find_program(given.command[0], folder)
    name = given.name or _plain(path.stem)
    if name in registry.available():
        raise ConfigError.plain(
            f'{path}: "{name}" is the name of a detector that ships. Give yours another: name ='
            ' "…".'
        )
    limits = ProcessLimits(
        given.start_limit_s,
        given.time_limit_s,
        given.memory_limit_mib,
        given.restarts,
        given.faults_in_a_row,
    )
    return ExternalDetector(
        name,
        given.command,
        stopwatch_s,
        folder=folder,
        limits=limits if gives_up else replace(limits, **NEVER_GIVES_UP),
        version=given.version or None,
        environment=given.environment,
    )


def _find_program(program: str, folder: Path) -> None:
    if shutil.which(program) or shutil.which(str(folder / program)):
        return
    raise ConfigError.plain(
        f"{program!r} may not be run: make it executable, or name what runs it, as in python3"
        f" {program}"
        if (folder / program).is_file()
        else f"no program {program!r} is there that can be run: compile it, give its path, or look"
        " at the environment's PATH"
    )

"""Files that people write: read, checked whole, and explained when wrong.

`read_config` gives a pydantic model or one `ConfigError` that lists every fault with file, line, a
caret under the place, what is allowed and what may have been meant. TOML is read without
places, so `find_places` reads the lines once more: headers, keys and how far a value reaches. What
it can't place (an inline table's inside) falls to the key around it.
"""

from __future__ import annotations

import json
import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from detector.calibration import Calibration, CalibrationError, load_calibration
from textfiles.bounds import Bounds
from textfiles.documents import DocumentError, read_toml
from textfiles.text import TextError, plural, text_of
from textfiles.text import did_you_mean as did_you_mean
from textfiles.text import short as short
from textfiles.whole import new_folders, refusal, replace_whole

_HEADER = re.compile(r"\s*(\[\[?)\s*([^\[\]=]+?)\s*\]\]?\s*(#.*)?$")
_KEY = re.compile(
    r"""\s*((?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*')(?:\s*\.\s*(?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*'))*)\s*=\s*"""
)
# strings and comments whole, what opens and closes, and line ends
_TOKENS = re.compile(
    r""""{3}(?:\\.|[^\\])*?"{3,5}|'{3}.*?'{3,5}|"(?:\\.|[^"\\\n])*"|'[^'\n]*'|#[^\n]*|[\[\]{}\n]""",
    re.DOTALL,
)

KeyPath = tuple[str | int, ...]


@dataclass(frozen=True, slots=True)
class FilePlace:
    """``line`` from 1; where key and value are, in columns from 0."""

    line: int
    key_start: int
    key_end: int
    value_start: int


def find_places(text: str) -> Mapping[KeyPath, FilePlace]:
    """The place of each table header and key in ``text``, which must be valid TOML."""
    places: dict[KeyPath, FilePlace] = {(): FilePlace(1, 0, 0, 0)}
    table: KeyPath = ()
    counts: dict[KeyPath, int] = {}
    for number, line in _logical_lines(text):
        header = _HEADER.match(line)
        if header:
            table = _open_table(_split(header[2]), is_array=header[1] == "[[", counts=counts)
            place = FilePlace(number, header.start(2), header.end(2), header.start(2))
            places.setdefault(table, place)
            if isinstance(table[-1], int):
                places.setdefault(table[:-1], place)
        elif key := _KEY.match(line):
            path = table + _split(key[1])
            places[path] = FilePlace(number, key.start(1), key.end(1), key.end())
    return places


def nearest(places: Mapping[KeyPath, FilePlace], path: KeyPath) -> tuple[FilePlace, bool]:
    """The place of ``path``, or of what holds it; True when it is the exact one."""
    for length in range(len(path), -1, -1):
        if path[:length] in places:
            return places[path[:length]], length == len(path)
    return places[()], False


def _split(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in dotted.split("."))


def _open_table(names: tuple[str, ...], *, is_array: bool, counts: dict[KeyPath, int]) -> KeyPath:
    path: KeyPath = ()
    for name in names[:-1]:
        path = (*path, name)
        if path in counts:
            path = (*path, counts[path])
    path = (*path, names[-1])
    if is_array:
        counts[path] = counts.get(path, -1) + 1
        return (*path, counts[path])
    return path


def _logical_lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines on which a header or key may start: none inside a long string or array."""
    lines, number, depth = text.split("\n"), 1, 0
    yield 1, lines[0]
    for token in _TOKENS.finditer(text):
        number += token[0].count("\n")
        depth += (token[0] in "[{") - (token[0] in "]}")
        if token[0] == "\n" and depth == 0:
            yield number, lines[number - 1]


class FileTable(BaseModel):
    """A table that a person writes: no unknown keys, finite numbers, no changes."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        arbitrary_types_allowed=True,
        allow_inf_nan=False,
        defer_build=True,  # few of all tables are read by one command
    )


Model = TypeVar("Model", bound=BaseModel)
Item = TypeVar("Item")
SHOWN = 120  # characters of a line of the file, in a message about it


@dataclass(frozen=True, slots=True)
class FileFault:
    """One fault of a file: ``line`` from 1, the caret's ``column`` and ``width``, 0 where no place
    in the line is to blame, as of a key that is missing at the top.
    """

    line: int
    column: int
    width: int
    message: str


class ConfigError(Exception):
    """A file or an argument is wrong. Lists all faults; the command exits with 2."""

    def __init__(self, path: Path | None, faults: Sequence[FileFault], text: str = "") -> None:
        self.path = path
        self.faults = tuple(faults)
        super().__init__("\n".join(_rendered(path, self.faults, text.split("\n"))))

    @classmethod
    def plain(cls, message: str) -> Self:
        """A fault that has no place in a file."""
        return cls(None, [FileFault(0, 0, 0, message)])


class UnwrittenError(ConfigError):
    """The file ``place`` can't be written: ``text`` is what it was to hold."""

    def __init__(self, place: Path, text: str, why: str) -> None:
        super().__init__(None, [FileFault(0, 0, 0, why)])
        self.place, self.text = place, text


class ArgumentError(ConfigError, ValueError):
    """A value that can't be: to programs a ConfigError, within a model of a file its fault."""


def beside(folder: Path, holds: str, bare: str = "runs") -> str:
    """What to say of a ``folder`` that isn't there: which one beside it was meant, that ``holds``
    this, and the newest three; a bare name's are in ``bare``.
    """
    where = folder.parent if len(folder.parts) > 1 else Path(bare)
    known = sorted((path.parent.name for path in where.glob(f"*/{holds}")), reverse=True)
    near = did_you_mean(folder.name, [*known, "latest"]) or "."
    return f"{near} {where} has {', '.join(known[:3])}." if known else near


@contextmanager
def wrong_use() -> Iterator[None]:
    """Turn a ValueError of a room without ConfigError into one."""
    try:
        yield
    except ValueError as error:
        raise ArgumentError.plain(str(error)) from error


def check_within(bounds: Bounds, **arguments: object) -> None:
    """Raises ConfigError that names the argument beyond ``bounds``; None is one left out."""
    for name, value in arguments.items():
        if value is not None and not bounds.has(value):
            raise ConfigError.plain(f"{name} is {value!r}, not {bounds.what}")


def several(name: str, values: Iterable[Item], least: int = 0) -> tuple[Item, ...]:
    """What a list holds. Raises ConfigError that names the argument for one thing, or too few."""
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise ConfigError.plain(f"{name} is {short(repr(values))}, not a list")
    if len(found := tuple(values)) < least:
        raise ConfigError.plain(f"{name} has {len(found)} items, not {least} or more")
    return found


def all_of(*reads: Callable[[list[Any]], Any]) -> list[Any]:
    """What each makes of what those before it made, else None; raises ConfigError for all."""
    found, faults = list[Any](), dict[str, ConfigError]()
    for read in reads:
        try:
            found.append(read(found))
        except ConfigError as error:
            found, faults = [*found, None], faults | {str(error): error}
    if len(faults) > 1:
        raise ConfigError.plain("\n".join(faults))
    for one in faults.values():
        raise one
    return found


def read_config(path: Path, model: type[Model], *, stored: bool = False) -> Model:
    """The file as ``model``; ``stored`` in a run that was done. Raises ConfigError."""
    return parse_config(path, read_text(path), model, stored=stored)


def parse_config(path: Path, text: str, model: type[Model], *, stored: bool = False) -> Model:
    """``text`` as ``model``, as if it stood at ``path``; text isn't taken for a number, nor 1 for
    true. Raises ConfigError with all its faults.
    """
    table = toml_table(path, text)
    try:
        # its strict mode has lists
        whole = json.dumps(table, default=lambda date: date.isoformat())
        context = {"folder": path.parent, "stored": stored}
        return model.model_validate_json(whole, strict=not stored, context=context)
    except ValidationError as error:
        found = [
            (_key_of(detail, table), _message(detail, model), detail["type"] == "extra_forbidden")
            for detail in error.errors()
            # not that a list is too short whose wrong items, left out, have faults of their own
            if not (
                detail["type"] == "too_short"
                and isinstance(detail["input"], list)
                and len(detail["input"]) >= int(detail.get("ctx", {}).get("min_length") or 0)
            )
        ]
        raise located(path, text, found) from error


def checked(model: type[Model], table: Any) -> Model:
    """Arguments as ``model``. Raises ConfigError that names each one with a fault."""
    try:
        return model.model_validate(table)
    except ValidationError as error:
        faults = (f"{_dotted(_key_of(f, table))}: {_message(f, model)}" for f in error.errors())
        raise ConfigError.plain("; ".join(faults)) from error


def read_text(path: Path) -> str:
    """The text of ``path``, UTF-8 or UTF-16. Raises ConfigError when it can't be read."""
    try:
        return text_of(path)
    except TextError as error:
        raise ConfigError.plain(f"{path} {error}.") from error
    except (OSError, ValueError) as error:  # ValueError: a name with a zero byte
        why = getattr(error, "strerror", None) or error
        raise ConfigError.plain(f"{path} can't be read: {why}{_near(path, error)}") from error


def read_bytes(path: Path) -> bytes:
    """The bytes of ``path``. Raises ConfigError when it can't be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise ConfigError.plain(f"{path} can't be read: {error.strerror or error}") from error


def _near(path: Path, error: Exception) -> str:
    """Where a file was looked for that isn't there, and what may have been meant."""
    folder = path.resolve().parent
    if not isinstance(error, FileNotFoundError):
        return ""
    if not folder.is_dir():
        return f" (there is no folder {folder})"
    near = did_you_mean(path.stem, sorted(one.stem for one in folder.glob("*.*")))
    return f" (in {folder}{near})"


def toml_of(path: Path) -> dict[str, Any]:
    """The table of a TOML file as it stands. Raises ConfigError."""
    return toml_table(path, read_text(path))


def toml_table(path: Path, text: str) -> dict[str, Any]:
    """As `toml_of`, of ``text`` as if it stood at ``path``."""
    try:
        return read_toml(text)
    except DocumentError as error:
        line, column = error.line or text.count("\n") + 1, error.column or 1
        raise ConfigError(path, [FileFault(line, column - 1, 1, str(error))], text) from error


def located(path: Path, text: str, found: Iterable[tuple[KeyPath, str, bool]]) -> ConfigError:
    """For faults by key path; the flag says that the key is wrong, not its value."""
    places = find_places(text)
    lines = text.split("\n")
    faults = []
    for key_path, message, at_key in found:
        place, exact = nearest(places, key_path)
        start, width = place.key_start, place.key_end - place.key_start
        if exact and not at_key and place.value_start > place.key_start:
            start = place.value_start
            width = len(lines[place.line - 1][start:].split("  #")[0].rstrip())
        text_of = f"{_dotted(key_path)}: {message}"
        at_top = place is places[()]
        faults.append(FileFault(place.line, start, 0 if at_top else max(1, width), text_of))
    return ConfigError(path, sorted(faults, key=lambda fault: (fault.line, fault.column)), text)


@contextmanager
def writing(place: Path) -> Iterator[None]:
    """Raises ConfigError where ``place`` can't be written."""
    try:
        yield
    except OSError as error:
        why = refusal(error, "Name another place.")
        raise ConfigError.plain(f"{place}: can't be written: {why}") from error


def write_file(place: Path, text: str) -> None:
    """Write what a person worked for, whole or not at all. Raises UnwrittenError."""
    try:
        with writing(place), new_folders(place.parent):
            replace_whole(place, text.encode("utf-8"), synced=True)
    except ConfigError as error:
        raise UnwrittenError(place, text, str(error)) from error.__cause__


def _rendered(path: Path | None, faults: Sequence[FileFault], lines: Sequence[str]) -> list[str]:
    if path is None:
        return [fault.message for fault in faults]
    out = [f"{path}: {plural(len(faults), 'fault')}"]
    for fault in faults:
        out.append(f"{path}:{fault.line}: {short(fault.message, 2000)}")
        if fault.width and 0 < fault.line <= len(lines):
            line = lines[fault.line - 1]  # a long one around its column only
            start = max(0, fault.column - SHOWN // 2) if len(line) > SHOWN else 0
            before, after = "..." if start else "", "..." if len(line) > start + SHOWN else ""
            shown = f"{before}{line[start : start + SHOWN]}{after}"
            column = fault.column - start + len(before)
            carets = "^" * min(fault.width, max(1, len(shown) - column))
            out += [f"  {fault.line:4} | {shown}", f"       | {' ' * column}{carets}"]
    return out


def _dotted(path: KeyPath) -> str:
    text = ""
    for part in path:
        text += f"[{part + 1}]" if isinstance(part, int) else f"{'.' if text else ''}{short(part)}"
    return text or "the file"


def _message(detail: ErrorDetails, model: type[BaseModel]) -> str:
    path, kind, context = detail["loc"], detail["type"], detail.get("ctx", {})
    if kind == "extra_forbidden":
        known = sorted(_fields_at(model, path[:-1]))
        near = _elsewhere(model, path) or did_you_mean(str(path[-1]), known)
        return f"unknown key{near} (allowed here: {', '.join(known)})"
    if kind in ("missing", "union_tag_not_found"):
        return "is missing"
    if kind in ("literal_error", "enum", "union_tag_invalid"):
        found = context.get("tag", detail["input"])
        words = re.findall(r"'([^']*)'", str(context.get("expected_tags") or context["expected"]))
        near = did_you_mean(str(found), words)
        return f"{short(repr(found))} is not allowed{near} (allowed: {', '.join(words)})"
    message = detail["msg"].removeprefix("Value error, ")
    return f"{message[0].lower()}{message[1:]} (found {short(repr(detail['input']))})"


def _elsewhere(model: type[BaseModel], path: Sequence[str | int]) -> str:
    """Where the unknown key at the end of ``path`` belongs; empty where no table has it."""
    key = path[-1]
    places = ["the top of the file"] if key in model.model_fields else []
    for name, field in model.model_fields.items():
        if any(key in one.model_fields for one in _models_in(field.annotation)):
            many = typing.get_origin(field.annotation) is tuple
            places.append(f"[[{name}]]" if many else f"[{name}]")
    return f"; it belongs to {' or '.join(places)}" if places else ""


def _key_of(detail: ErrorDetails, table: Any) -> KeyPath:
    """What the fault is about: of a table of a wrong kind, its key ``kind``."""
    path: KeyPath = detail["loc"]
    kept: list[str | int] = []
    for index, part in enumerate(path):
        there = range(len(table)) if isinstance(table, list) else table
        inside = isinstance(table, list | dict) and part in there
        if inside:
            table = table[part]
        if inside or index == len(path) - 1:
            kept.append(part)
    kind = ("kind",) if detail["type"].startswith("union_tag") else ()
    return (*kept, *kind)


def _fields_at(model: type[BaseModel], path: Sequence[str | int]) -> set[str]:
    """Names allowed in the table at ``path`` of ``model``; tags of a union are passed over."""
    models = [model]
    for part in (part for part in path if isinstance(part, str)):
        deeper = [
            found
            for one in models
            if part in one.model_fields
            for found in _models_in(one.model_fields[part].annotation)
        ]
        kinds = ((one, one.model_fields.get("kind")) for one in models)
        tagged = [one for one, kind in kinds if kind and part in typing.get_args(kind.annotation)]
        models = deeper or tagged or models
    return {field.alias or name for one in models for name, field in one.model_fields.items()}


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [found for inner in typing.get_args(annotation) for found in _models_in(inner)]


Millimetres = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Point = tuple[Millimetres, Millimetres, Millimetres]
Radians = Annotated[float, Field(ge=-7, le=7, allow_inf_nan=False)]


def read_calibration(path: Path, *, doubtful: bool = False) -> Calibration:
    """The calibration at ``path``. Raises ConfigError that shows each fault in its place, as
    `load_calibration` says.
    """
    try:
        return load_calibration(path, doubtful=doubtful)
    except CalibrationError as error:
        found = [(fault.key, fault.message, False) for fault in error.faults]
        raise located(path, read_text(path), found) from error

"""Files of other calibration programs as plain values: YAML, OpenCV's FileStorage (YAML, XML or
JSON), and MATLAB's .mat, read by a process of its own.

Whatever is wrong is a ConfigError. Aliases count as often as they are named: 487 bytes of them fill
the memory. The one who reads a value asks for its kind by `numbers` and `whole`.
"""

from __future__ import annotations

import math
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml

from bench.config import ConfigError, read_text, short
from detector.geometry import Array
from textfiles.documents import DEEPEST, DocumentError, read_json, refuse_unusable

MOST_VALUES = 100_000  # of a YAML file, each alias counted as what it stands for
MOST_CHARACTERS = 2_000_000
MOST_NUMBERS = 1000  # in one matrix
MAT_TIMEOUT_S = 60.0
_BRACKETS = re.compile(r"[\[\]{}]")
MATRIX = "tag:yaml.org,2002:opencv-"


@dataclass(frozen=True, slots=True)
class ForeignFile:
    """A file's values by name; what is asked of them is refused by its name."""

    path: Path
    values: Mapping[str, Any]

    def refusal(self, name: str, why: str) -> ConfigError:
        return ConfigError.plain(f"{self.path}: {name} {why}")

    def first(self, *names: str) -> tuple[str, Any]:
        """The first of these names that is there, with its value; ``names[0]`` and None."""
        found = next((name for name in names if self.values.get(name) is not None), names[0])
        return found, self.values.get(found)

    def table(self, name: str) -> ForeignFile:
        """The table of that name. Raises ConfigError."""
        found = self.values.get(name)
        if not isinstance(found, Mapping):
            raise self.refusal(name, "is missing" if found is None else "must be a table")
        return ForeignFile(self.path, found)

    def numbers(self, name: str, *counts: int, value: Any = None) -> Array:
        """The finite numbers of ``name``, row by row; ``counts``: how many. Raises ConfigError."""
        given = self.values.get(name) if value is None else value
        if given is None:
            raise self.refusal(name, "is missing")
        found = [self._number(name, at, one) for at, one in enumerate(self._flat(name, given), 1)]
        if counts and len(found) not in counts:
            wanted = " or ".join(map(str, counts))
            raise self.refusal(name, f"has {len(found)} numbers; {wanted} are wanted")
        return np.array(found, dtype=np.float64)

    def whole(self, name: str, *counts: int, value: Any = None) -> tuple[int, ...]:
        """As `numbers`, of whole ones."""
        found = self.numbers(name, *counts, value=value)
        if wrong := [one for one in found.tolist() if one != round(one)]:
            raise self.refusal(name, f"must be whole numbers, has {wrong[0]:g}")
        return tuple(int(one) for one in found)

    def word(self, name: str) -> str:
        """The text of ``name``; empty where it isn't there. Raises ConfigError."""
        given = self.values.get(name)
        if given is None or isinstance(given, str):
            return (given or "").strip()
        raise self.refusal(name, f"must be a text, is {short(repr(given))}")

    def _flat(self, name: str, given: Any) -> Sequence[Any]:
        if isinstance(given, Mapping):
            rows, columns = (given.get(key) for key in ("rows", "cols"))
            data = given.get("data")
            if not isinstance(data, list):
                raise self.refusal(name, "must be numbers, or a matrix of rows, cols and data")
            flat = self._flat(name, data)
            if isinstance(rows, int) and isinstance(columns, int) and len(flat) != rows * columns:
                raise self.refusal(name, f"has {len(flat)} numbers for {rows} x {columns}")
            return flat
        found: list[Any] = []
        left = [given]
        while left:
            one = left.pop()
            if isinstance(one, list):
                left += reversed(one)
            else:
                found.append(one)
            if len(found) + len(left) > MOST_NUMBERS:
                raise self.refusal(name, f"has more than {MOST_NUMBERS} numbers")
        return found

    def _number(self, name: str, at: int, given: Any) -> float:
        try:
            if isinstance(given, bool) or not isinstance(given, int | float | str):
                raise ValueError
            value = float(given)
        except (ValueError, OverflowError):
            raise self.refusal(name, f"must be numbers, has {short(repr(given))}") from None
        if not math.isfinite(value):
            raise self.refusal(name, f"must be finite numbers, number {at} is {given}")
        return value


def read_yaml(path: Path) -> ForeignFile:
    """A YAML file's table. Raises ConfigError."""
    return ForeignFile(path, _table(path, _yaml(path, read_text(path))))


def read_storage(path: Path) -> ForeignFile:
    """OpenCV's FileStorage: YAML, XML or JSON. Raises ConfigError."""
    text = read_text(path).lstrip("\ufeff \n")
    if text.startswith("<"):
        return ForeignFile(path, _xml(path, text))
    if text.startswith("{"):
        try:
            return ForeignFile(path, _table(path, read_json(text)))
        except DocumentError as error:
            raise ConfigError.plain(f"{path}:{error.line}: {error}") from error
    if text.startswith("%YAML"):  # "%YAML:1.0" is OpenCV's own spelling
        text = "#" + text
    return ForeignFile(path, _table(path, _yaml(path, text)))


def _table(path: Path, found: Any) -> Mapping[str, Any]:
    if not isinstance(found, Mapping):
        what = "nothing" if found is None else f"{short(repr(found))}"
        raise ConfigError.plain(f"{path}: must be a table of names and values, is {what}")
    return {str(name): value for name, value in found.items()}


class _Loader(yaml.SafeLoader):
    """Plain values; a name that is there twice, or merged in, is refused."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if twice := [name for name in names if names.count(name) > 1 or name == "<<"]:
            what = f"{short(repr(twice[0]))} is there twice, or merges other tables in"
            raise yaml.constructor.ConstructorError(None, None, what, node.start_mark)
        return super().construct_mapping(node, deep)


_Loader.add_multi_constructor(MATRIX, lambda loader, _, node: loader.construct_mapping(node, True))


def _yaml(path: Path, text: str) -> Any:
    if len(text) > MOST_CHARACTERS:
        raise ConfigError.plain(f"{path}: has {len(text)} characters; is it a calibration?")
    try:
        depth = 0  # of brackets in brackets, of which the library takes minutes
        for bracket in _BRACKETS.findall(text):
            depth = max(0, depth + (1 if bracket in "[{" else -1))
            if depth > DEEPEST:
                raise RecursionError
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
            if node is None:
                return None
            _refuse_bomb(node)
            found = loader.construct_document(node)
        finally:
            loader.dispose()
        refuse_unusable(found, "YAML")
    except RecursionError:
        raise ConfigError.plain(f"{path}: not YAML: lists in lists without end") from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        why = error.problem or error.context
        raise ConfigError.plain(f"{path}:{line}: not YAML: {short(str(why))}") from error
    # a library's errors for values that it can't make (a month 13) are of every kind
    except Exception as error:
        raise ConfigError.plain(f"{path}: not YAML: {short(str(error))}") from error
    return found


def _refuse_bomb(root: yaml.Node) -> None:
    """Raise ValueError where aliases stand for more than `MOST_VALUES`, or for themselves."""
    sizes: dict[int, int] = {}
    left: list[tuple[yaml.Node, bool]] = [(root, False)]
    while left:
        node, done = left.pop()
        parts = [] if isinstance(node, yaml.ScalarNode) else node.value
        if isinstance(node, yaml.MappingNode):
            parts = [part for pair in parts for part in pair]
        if done:
            sizes[id(node)] = 1 + sum(sizes[id(part)] for part in parts)
            if sizes[id(node)] < 1 or sizes[id(node)] > MOST_VALUES:
                raise ValueError(f"its aliases stand for more than {MOST_VALUES} values")
            continue
        if id(node) in sizes:
            if sizes[id(node)] < 0:
                raise ValueError("an alias stands for what it is in")
            continue
        sizes[id(node)] = -MOST_VALUES * MOST_VALUES  # under way
        left += [(node, True), *((part, False) for part in parts)]


def _xml(path: Path, text: str) -> Mapping[str, Any]:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ConfigError.plain(f"{path}: declares entities, which no FileStorage has")
    try:
        root = ElementTree.fromstring(text)  # noqa: S314 - without a DOCTYPE there are no entities
        found = {child.tag: _xml_value(child) for child in root}
        refuse_unusable(found, "XML")
    except RecursionError:
        raise ConfigError.plain(f"{path}: not XML: elements in elements without end") from None
    except (ElementTree.ParseError, DocumentError, ValueError) as error:
        raise ConfigError.plain(f"{path}: not XML: {error}") from error
    return found


def _xml_value(element: ElementTree.Element) -> Any:
    """An element as FileStorage's YAML has it; numbers in a text are a list of words."""
    children = list(element)
    if children and all(child.tag == "_" for child in children):
        return [_xml_value(child) for child in children]
    if children:
        found = {child.tag: _xml_value(child) for child in children}
        for name in ("rows", "cols"):
            found |= {name: int(found[name])} if str(found.get(name)).isdecimal() else {}
        data = found.get("data")
        return found | {"data": [data]} if isinstance(data, str) else found
    words = (element.text or "").split()
    return words if len(words) > 1 else (words or [""])[0]


def read_mat(path: Path) -> ForeignFile:
    """The numbers, texts and structures of a .mat file. Raises ConfigError.

    By a process of its own: of damaged files the library has died with SIGSEGV.
    """
    if not path.is_file():
        raise ConfigError.plain(f"{path}: no such file")
    command = [sys.executable, "-X", "utf8", "-m", "bench.calibrate.mat_values", str(path)]
    try:
        done = subprocess.run(  # noqa: S603 - a command of our own
            command, capture_output=True, timeout=MAT_TIMEOUT_S, check=False
        )
    except subprocess.TimeoutExpired:
        why = f"reading it took more than {MAT_TIMEOUT_S:g} s"
        raise ConfigError.plain(f"{path}: can't be read as a .mat file: {why}") from None
    said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
    if done.returncode:
        why = said or f"the library died of it ({done.returncode})"
        raise ConfigError.plain(
            f"{path}: can't be read as a .mat file (version 7 or older): {short(why)}"
        )
    try:
        return ForeignFile(path, _table(path, read_json(done.stdout)))
    except DocumentError as error:
        raise ConfigError.plain(f"{path}: can't be read as a .mat file: {error}") from error

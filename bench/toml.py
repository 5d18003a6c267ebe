"""Values to TOML text, as far as the bench writes it: the standard library only reads."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from typing import Any

WIDTH = 120


def toml_text(table: Mapping[str, Any], heading: str = "") -> str:
    """``table`` as TOML under ``heading``; None is left out, tables follow plain keys."""
    lines = [f"# {line}" for line in heading.split("\n")] if heading else []
    return "\n".join([*lines, *_lines(table, ())]) + "\n"


def _lines(table: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    given = {key: value for key, value in table.items() if value is not None}
    lines = [f"{key} = {value_text(value)}" for key, value in given.items() if not _tables(value)]
    for key, value in given.items():
        here = (*path, key)
        if isinstance(value, Mapping):
            lines += ["", f"[{'.'.join(here)}]", *_lines(value, here)]
        elif _tables(value):
            for one in value:
                lines += ["", f"[[{'.'.join(here)}]]", *_lines(one, here)]
    return lines


def _tables(value: Any) -> bool:
    first = next(iter(value), None) if isinstance(value, list | tuple) else value
    return isinstance(first, Mapping)


def value_text(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, datetime):
        return value.isoformat(timespec="seconds")
    if isinstance(value, str):
        # TOML's basic strings have JSON's escapes
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {value_text(one)}' for key, one in value.items())} }}"
    items = [value_text(item) for item in value]
    flat = f"[{', '.join(items)}]"
    return flat if len(flat) <= WIDTH else "[\n" + "".join(f"  {item},\n" for item in items) + "]"

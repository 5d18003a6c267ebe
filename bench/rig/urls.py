"""Checks URLs and file names of a rig file; opens nothing."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from pydantic import ValidationInfo

from bench.config import did_you_mean
from instruments.bath.connection import ALLOWED, LineError, parse_line
from instruments.drivers.entry_points import EMULATORS, GROUPS, Kind, available, plugin_url
from instruments.points import ALLOWED as ALLOWED_POINTS
from instruments.points import points_url
from instruments.port_settings import PortSettings, with_lines

EMULATED, CONSOLE, BROWSER, SCRIPT = "emulator:", "console:", "browser:", "script:"
PEOPLE = (CONSOLE, BROWSER)  # a person answers, in real time
ELSEWHERE = "emulator://"  # the operator of another process, which emulates the whole rig


def is_emulated(url: str) -> bool:
    """Whether ``url`` is of an emulator in this process: the bench's own, or a plug-in's."""
    found = None if url == EMULATED else plugin_url(url)
    return url == EMULATED or (found is not None and found.emulated)


def plugged(url: str, kind: Kind) -> bool:
    """Whether ``url`` names a plug-in. Raises ValueError for one that isn't installed."""
    found = plugin_url(url)
    if found is None:
        return False
    group = (EMULATORS if found.emulated else GROUPS)[kind]
    if found.name not in (there := available(group)):
        if found.emulated and found.name in available(GROUPS[kind]):
            raise ValueError(f"the plug-in {found.name!r} has no emulator (entry point of {group})")
        near, known = did_you_mean(found.name, there), ", ".join(there) or "none"
        raise ValueError(
            f"no plug-in {found.name!r} is installed{near} (entry points of {group}: {known})"
        )
    return True


def stage_url(url: str) -> str:
    """``url`` where it is a serial link or a plug-in. Raises ValueError."""
    return url if plugged(url, "stage") else serial_url(url)


def serial_url(url: str) -> str:
    """``url`` where it is a serial link's. Raises ValueError that says what is allowed."""
    if url == EMULATED or re.fullmatch(r"socket://[^/:]+:\d+", url):
        return url
    if re.fullmatch(r"(rfc2217://[^/:]+:\d+|/dev/[^\s?]+|COM\d+)(\?.*)?", url):
        with_lines(url, PortSettings())
        return url
    raise ValueError(
        'not a link; allowed: "emulator:", "/dev/ttyUSB0", "COM5", "socket://host:port",'
        ' "rfc2217://host:port"; a serial port also with "?dtr=off&rts=off"'
    )


def arm_url(url: str) -> str:
    """``url`` where it is a serial link or points of another arm. Raises ValueError."""
    if points_url(url) or plugged(url, "arm"):
        return url
    try:
        return serial_url(url)
    except ValueError as error:
        raise ValueError(f"{error}; of an arm of another make {ALLOWED_POINTS}") from error


def bath_url(url: str) -> str:
    """``url`` where it is a bath's. Raises ValueError that says what is allowed."""
    if plugged(url, "bath"):
        return url
    try:
        if url != EMULATED:
            parse_line(url)
    except LineError as error:
        raise ValueError(str(error).replace(ALLOWED, f'"{EMULATED}", {ALLOWED}')) from error
    return url


def relay_url(url: str) -> str:
    if url.startswith("plugin:"):
        raise ValueError("a relay is no plug-in: a bath's plug-in has its pump in it")
    return url and bath_url(url)


def operator_url(url: str, info: ValidationInfo) -> str:
    if url.startswith(SCRIPT):
        beside(url.removeprefix(SCRIPT), info)
    elif url not in (EMULATED, *PEOPLE) and not re.match(rf"{ELSEWHERE}[^/:]+:\d+$", url):
        near = did_you_mean(url, (EMULATED, *PEOPLE, SCRIPT))
        allowed = (*PEOPLE, EMULATED, f"{SCRIPT}ANSWERS.toml", f"{SCRIPT}ANSWERS.txt")
        there = ", ".join(f'"{one}"' for one in (*allowed, f"{ELSEWHERE}host:port"))
        raise ValueError(f"not an operator{near} (allowed: {there})")
    return url


def is_there(path: Path) -> bool:
    """Whether there is such a file. Raises ValueError for a name that no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise ValueError(f"can't be the name of a file: {why}") from error


def beside(name: str, info: ValidationInfo) -> str:
    folder: Any = (info.context or {}).get("folder")
    if folder is not None and not is_there(Path(folder) / name):
        raise ValueError(f"no such file beside the rig file ({Path(folder) / name})")
    return name


def a_name(name: str, info: ValidationInfo) -> str:
    """A file's name, whether it is there already or not."""
    is_there(Path((info.context or {}).get("folder") or ".") / name)
    return name


def beside_if_named(name: str, info: ValidationInfo) -> str:
    return beside(name, info) if name else name

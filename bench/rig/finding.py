"""Finds what stands at ports and addresses, for a new rig file; and writes that file.

Nothing that is sent moves, heats or changes a setting. In this order, so that a byte of one is not
a command of another, and what has answered is asked nothing else:

- "?", the status query of Grbl, grblHAL and FluidNC, which is no part of a line there. A
  MicroScribe is not signed on yet; Marlin and Zaber have not seen a line's end; baths know no "?".
- The sign-on and the identity (MicroScribe). For Marlin that is more of an unknown line, for Zaber
  a line without its "/".
- M115, who it is (Marlin), behind a line's end: an unknown line to Zaber and to baths that speak
  lines; to Modbus bytes without a checksum.
- "/get pos" (Zaber): unknown to the baths.
- Reads (baths).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from serial.tools import list_ports

from bench.config import ConfigError, did_you_mean, parse_config, read_text, write_file
from bench.rig.loading import MISSING, PLACES, TO_COPY
from bench.rig.model import ArmTable, BathTable, Rig, camera_url
from bench.rig.opening import open_instruments, rig_of
from bench.rig.urls import bath_url, serial_url
from bench.toml import value_text
from instruments.bath.profile import load_profile, profile_names
from instruments.clock import Clock, RealClock, wall_time
from instruments.drivers.entry_points import PluginUrl
from instruments.errors import InstrumentError, ProtocolError
from instruments.link import Link
from instruments.stage import marlin
from instruments.stage.connection import BOOT_S
from instruments.stage.protocol import STATUS_QUERY, Decoder, Message, Status, Welcome

ZABER_ASKED = b"/get pos\n"  # of all devices of a chain
_ZABER_SAID = re.compile(rb"@(\d\d) 0 OK (?:IDLE|BUSY) \S\S ([-\d ]+)")
TALKS_S, TALK_BYTES = 1.0, 200
LISTEN_S = 2.5  # a board that the port's opening resets says its welcome within this


@dataclass(frozen=True, slots=True)
class FoundInstrument:
    """What answered at ``url``, as who: a bath's profiles, a stage's dialect, a Zaber's devices."""

    kind: str
    url: str
    who: str
    profiles: tuple[str, ...] = ()
    dialect: str = "grbl"
    devices: tuple[str, ...] = ()

    def driver_url(self, **keys: str) -> str:
        """Its url in a rig file: of a Zaber its plug-in's, with ``keys`` of that (docs/rig.md)."""
        return PluginUrl("zaber", keys).at(self.url) if self.dialect == "zaber" else self.url


def ports() -> Iterator[tuple[str, str]]:
    """Each serial port of this machine, and what its adapter is called."""
    for port in sorted(list_ports.comports()):
        yield port.device, port.description if port.description != "n/a" else "no name"


def find_instruments(
    urls: Collection[str] = (), report: Callable[[str], None] = lambda _: None
) -> Iterator[FoundInstrument]:
    """What answers at ``urls``, or at all serial ports of this machine, one by one, without moving
    or heating anything; ``report`` gets what is asked of whom.
    """
    with closing(RealClock()) as clock:
        for url, adapter in dict.fromkeys(urls, "").items() or ports():
            report(f"{url}: {adapter or 'asked for'}")
            if one := probe(url, clock, lambda text: report(f"  {text}")):
                yield one
            else:
                report(f"{url}: nothing that is known")


def probe(url: str, clock: Clock, report: Callable[[str], None]) -> FoundInstrument | None:
    """What answers at ``url``; None where nothing that is known does, or it can't be opened."""
    if _is(serial_url, url):
        for look in (_stage, _arm, _marlin_or_zaber):
            report(f"{url}: {look.__name__.strip('_').replace('_', ' ')}?")
            try:
                if found := look(url, clock):
                    return found
            except InstrumentError as error:
                report(f"{url}: {error}")
    if not _is(bath_url, url):
        return None
    if _talks(url, clock):
        report(f"{url}: it talks without being asked, which no bath does")
        return None
    fitting: dict[str, str] = {}
    for name in profile_names():
        report(f"{url}: bath, {name}?")
        if who := _bath(url, name, clock):
            fitting[name] = who
    if not fitting:
        return None
    return FoundInstrument("bath", url, next(iter(fitting.values())), tuple(fitting))


def _talks(url: str, clock: Clock) -> bool:
    """Whether something sends much within `TALKS_S` without being asked."""
    try:
        with closing(Link(url, clock, who="bath")) as link:
            return len(link.drain(0.2, at_most_s=TALKS_S)) > TALK_BYTES
    except ProtocolError:
        return True
    except InstrumentError:  # it can't be opened so; a profile may know how
        return False


def _is(check: Callable[[str], str], url: str) -> bool:
    try:
        return bool(check(url))
    except ValueError:
        return False


def _stage(url: str, clock: Clock) -> FoundInstrument | None:
    """Listens for a welcome, and asks for the status, which needs no line and changes nothing."""
    with closing(Link(url, clock, who="stage")) as link:
        decoder, who, start_s = Decoder(), "", clock.now()
        until_s = start_s + LISTEN_S
        while clock.now() < until_s:
            link.write(STATUS_QUERY)
            for answer in decoder.feed(link.drain(0.2, at_most_s=0.4)):
                if isinstance(answer, Welcome):
                    who = f"{answer.dialect} {answer.version}"
                elif isinstance(answer, Status):
                    axes = answer.mpos_mm or answer.wpos_mm or ()
                    return FoundInstrument(
                        "stage", url, f"{who or 'GRBL'}, {len(axes)} axes, {answer.name}"
                    )
                elif isinstance(answer, Message):  # FluidNC's start takes long with a network
                    until_s = min(start_s + BOOT_S, clock.now() + LISTEN_S)
    return None


def _marlin_or_zaber(url: str, clock: Clock) -> FoundInstrument | None:
    """Asks Marlin who it is, as long as a board takes to start, and Zaber where its axes are."""
    with closing(Link(url, clock, who="stage")) as link:
        decoder, until_s = Decoder(marlin.parse), clock.now() + LISTEN_S
        while clock.now() < until_s:
            link.write(b"\nM115\n")
            for answer in decoder.feed(link.drain(0.2, at_most_s=0.6)):
                if isinstance(answer, Message) and answer.text.startswith("FIRMWARE_NAME:Marlin"):
                    who = answer.text.removeprefix("FIRMWARE_NAME:").partition(" (")[0]
                    return FoundInstrument("stage", url, who, dialect="marlin")
        link.write(ZABER_ASKED)
        devices = tuple(
            f"{int(device)}.{axis}"
            for device, places in _ZABER_SAID.findall(link.drain(0.3, at_most_s=0.6))
            for axis in range(1, 1 + len(places.split()))
        )
    if not devices:
        return None
    who = f"Zaber, device and axis {', '.join(devices)}"
    return FoundInstrument("stage", url, who, dialect="zaber", devices=devices)


def _arm(url: str, clock: Clock) -> FoundInstrument | None:
    rig = rig_of(arm=ArmTable.model_construct(url=url))
    with open_instruments(rig, ("arm",), clock) as devices:
        try:
            identity = asdict(devices.arm.sign_on())
        except InstrumentError:
            return None
    named = (identity[key] for key in ("product", "model", "serial_number"))
    return FoundInstrument("arm", url, " ".join(map(str, named)))


def _bath(url: str, name: str, clock: Clock) -> str:
    """Who answers by that profile with a temperature that makes sense; "" for none."""
    rig = rig_of(load_profile(name), bath=BathTable(url=url, profile=name))
    try:
        with open_instruments(rig, ("bath",), clock) as devices:
            reading = devices.bath.read()
            known = devices.bath.identity
            said = [str(known[key]) for key in ("model", "version", "firmware") if known.get(key)]
    except InstrumentError:
        return ""
    return f"{' '.join(said) or 'it'}, at {reading.temp_c:.2f} degC"


# The file

_TABLE = re.compile(r"\[([\w.]+)\]")
_KEY = re.compile(r"(\w+) = .*?(?:\s+# (.*))?")
KEPT = ("cameras", "cameras.checks", "limits")  # all of their keys have defaults
USUAL: Mapping[str, Mapping[str, object]] = {  # of what a rig file has to say
    "": {"name": "my rig", "calibration": "calibration.toml"},
    "operator": {"url": "console:"},
}


def write_rig(
    out: Path | str, tables: Mapping[str, Mapping[str, Any]], about: Sequence[str] = ()
) -> tuple[str, ...]:
    """Write a rig file with these values by table ("bath"; "": what is above all tables) and key,
    its other keys as comments with their meaning, ``about`` at its head. Gives the tables whose url
    is marked, to be filled in: of arm, bath and the pair of cameras. Raises ConfigError.
    """
    if not tables:
        raise ConfigError.plain(f"`tables` is empty. To begin with an example, copy {TO_COPY}.")
    usual = {**USUAL, **({} if "bath" in tables else {"bath": {"profile": "julabo-presto"}})}
    given = {one: {**usual.get(one, {}), **tables.get(one, {})} for one in {**usual, **tables}}
    for name, table in given.items():
        if name.startswith("cameras.") and "url" in table:
            try:
                camera_url(str(table["url"]))
            except ValueError as error:
                raise ConfigError.plain(f"{name}.url: {table['url']}: {error}") from error
    whole = "cameras" in given and given["cameras"].get("url")
    missing = [name for name in PLACES if "url" not in given.get(name, {})]
    missing = [name for name in missing if not (whole and name.startswith("cameras."))]
    for name in missing:
        given.setdefault(name, {})["url"] = PLACES[name]
    head = (f"Written on {wall_time():%Y-%m-%d}.", *about, *(f"No url: {one}" for one in missing))
    text = _rig_text(read_text(TO_COPY), given, missing, head)
    parse_config(Path(out), text, Rig)
    write_file(Path(out), text)
    return tuple(missing)


def _rig_text(
    example: str,
    given: Mapping[str, Mapping[str, object]],
    missing: Collection[str],
    head: Sequence[str],
) -> str:
    """The ``example`` with what is ``given``. Raises ConfigError for a key that it hasn't."""
    lines, table = [f"# {line}".rstrip() for line in head], ""
    unused = {(name, key): None for name, own in given.items() for key in own}
    there = dict[str, None]()
    for line in example.splitlines():
        if line.startswith("#"):
            continue
        if head_line := _TABLE.match(line):
            table = head_line[1]
        own = given.get(table, {})
        off = "" if own or table in KEPT else "# "
        if key := _KEY.fullmatch(line):
            there[f"{table}.{key[1]}".lstrip(".")] = None
            if key[1] in own:
                del unused[table, key[1]]
                marked = key[1] == "url" and table in missing
                said = ". ".join(filter(None, (MISSING if marked else "", key[2])))
                line = f"{key[1]} = {value_text(own[key[1]])}".ljust(31)
                line += f" # {said}" if said else ""
            else:
                off = "# "
        lines.append(f"{off}{line}" if line else "")
    for name, each in unused:
        near = did_you_mean(f"{name}.{each}".lstrip("."), there)
        raise ConfigError.plain(f"a rig file has no key {each!r} in {name or 'its top'!r}{near}")
    return "\n".join(lines) + "\n"

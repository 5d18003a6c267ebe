"""`init`: a rig file from what stands at the ports, what this machine lists, and some questions."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Collection, Mapping
from datetime import date

import bench
from bench import FoundInstrument
from bench.cli.arguments import CODES, refuse_existing, say
from bench.config import ConfigError
from textfiles.text import in_command

# standard uncertainty by model, mm, as the maker states it
MODELS = {"3DX": 0.23, "3DL": 0.64, "3D": 0.38}
AXES = ("XY", "XYZ", "XYA", "XYZA")
Ask = Callable[[str, str], str]


def init(given: argparse.Namespace) -> int:
    refuse_existing(given.out, replace=given.replace)
    found = _found(given.port)
    cameras = dict(one for one in bench.list_cameras() if one[0] != "genicam:")
    for url, name in cameras.items():
        print(f"{url}: camera, {name}")

    def ask(question: str, default: str) -> str:
        if given.yes:
            return default
        print(f"{question} [{default or 'none'}] ", end="", flush=True)
        return sys.stdin.readline().strip() or default

    name = ask("What is the rig called?", "udder lab")
    values: dict[str, dict[str, object]] = {"": {"name": name}}
    for kind in _ABOUT:
        if one := _chosen(kind, [each for each in found if each.kind == kind], ask):
            about_it = _ABOUT[kind](one, ask)
            values |= {kind: {"url": one.url, **about_it}} if about_it else {}
    values |= _cameras(cameras, ask)
    about = ["By 'teatbench init'. What was found:"]
    about += [f"  {one.url}: {one.kind}, {one.who}" for one in found]
    about += [f"  {url}: camera, {name}" for url, name in cameras.items()]
    about += [f"Next: teatbench check {in_command(given.out.name)}, then 'teatbench help lab'."]
    for name in bench.write_rig(given.out, values, about):
        say(f"not found: {name}; its url is marked in the file")
    print(f"Written: {given.out}. Next: teatbench check {in_command(given.out)}")
    return CODES.met


def _found(urls: list[str] | None) -> list[FoundInstrument]:
    """What answers, printed line by line."""
    found, asked = [], list[str]()

    def report(text: str) -> None:
        asked.append(text)
        say(text)

    for one in bench.find_instruments(urls or (), report):
        say(f"{one.url}: {one.kind}, {one.who}")
        found.append(one)
    if not asked:
        say("no serial port on this machine; --port names an address on the network")
    return found


def _chosen(kind: str, there: list[FoundInstrument], ask: Ask) -> FoundInstrument | None:
    if len(there) < 2:
        return there[0] if there else None
    urls = ", ".join(one.url for one in there)
    answer = ask(f"Which is the {kind}: {urls}?", there[0].url)
    known = {one.url: one for one in there}
    return known[_one_of(f"the {kind}", answer, known)]


def _arm(found: FoundInstrument, ask: Ask) -> Mapping[str, object]:
    known = next((one for one in MODELS if one.removeprefix("3") in found.who.split()), "3DX")
    model = _one_of("the model", ask(f"Which MicroScribe ({', '.join(MODELS)})?", known), MODELS)
    return {"accuracy_mm": MODELS[model], "accuracy_source": f"maker's data sheet, {model}"}


def _bath(found: FoundInstrument, ask: Ask) -> Mapping[str, object]:
    profiles, answer = found.profiles, found.profiles[0]
    if len(profiles) > 1:
        fits = ", ".join(profiles)
        answer = ask(f"{found.url} answers by several profiles ({fits}): which is it?", answer)
    tested = ask("On which day was the bath's own cut-out tested (2026-11-20)?", "")
    profile = _one_of("the profile", answer, profiles)
    values = {"profile": profile, "cut_out_tested": _day(tested)}
    if not bench.bath_profile(profile).number_unit.known:
        same = "did the bath's display and 'teatbench bath read' show the same, in degC"
        values["unit_confirmed"] = _day(ask(f"On which day {same} (2026-11-20)?", ""))
    return values


def _day(answer: str) -> str:
    try:
        return date.fromisoformat(answer).isoformat() if answer else ""
    except ValueError:
        raise ConfigError.plain(f"{answer!r} is no day; write it as 2026-11-20") from None


def _stage(found: FoundInstrument, ask: Ask) -> Mapping[str, object]:
    answer = ask(f"What does the stage move ({', '.join(AXES)})?", AXES[0])
    axes = _one_of("the axes", answer.upper(), AXES)
    values: dict[str, object] = {"axes": axes}
    if found.dialect == "zaber":
        devices = ask(
            f"Which device and axis moves {', '.join(axes)} (there are"
            f" {', '.join(found.devices)})?",
            ", ".join(found.devices[: len(axes)]),
        )
        scales = ask("How many microsteps per mm, or degree, has each, by its data sheet?", "")
        if not scales:  # a guess would move it wrongly
            say(f"left out: {found.url}; a Zaber stage needs its microsteps per mm")
            return {}
        _figures("microsteps per mm", scales, "20997.4, 20997.4")
        named = [one.strip().replace(" ", ".") for one in devices.split(",")]
        keys = {"devices": ",".join(named), "microsteps": scales.replace(" ", "")}
        values["url"] = found.driver_url(**keys, axes=axes)
    else:
        values["dialect"] = found.dialect
    if found.dialect != "grbl":  # places are positive
        there = ask("Where does it stand as the layouts say, x and y in mm?", "150.0, 137.5")
        values["reference_mm"] = _figures("a place", there, "150.0, 137.5")
    return values


def _figures(what: str, answer: str, example: str) -> list[float]:
    try:
        return [float(one) for one in answer.split(",")]
    except ValueError:
        raise ConfigError.plain(f"{answer!r} is no list of {what}; write {example}") from None


_ABOUT = {"arm": _arm, "bath": _bath, "stage": _stage}


def _cameras(there: Mapping[str, str], ask: Ask) -> dict[str, dict[str, object]]:
    """Ask which camera is which: no camera reports its place."""
    values: dict[str, dict[str, object]] = {}
    for name in ("left", "right", "thermal"):
        listed = f" ({', '.join(there)}, or another url)" if there else " (its url)"
        if url := ask(f"Which is the {name} camera{listed}?", ""):
            values[f"cameras.{name}"] = {"url": url}
    profiles = bench.thermal_profiles()
    asked = f"Does it deliver temperatures ({', '.join(profiles)})?"
    if "cameras.thermal" in values and (profile := ask(asked, "")):
        known = _one_of("the radiometric profile", profile, profiles)
        values["cameras.thermal"]["radiometric"] = {"profile": known}
    return values


def _one_of(what: str, answer: str, known: Collection[str]) -> str:
    """``answer``. Raises ConfigError where it is none of the known ones."""
    if answer not in known:
        raise ConfigError.plain(f"{what} {answer!r} is not one of {', '.join(known)}")
    return answer

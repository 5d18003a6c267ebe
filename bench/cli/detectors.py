"""`detectors`: which there are; `new` writes one to begin with, `try` asks one about a frame and
says what is wrong with its answer.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import shutil
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import bench
from bench.cli.arguments import CODES, complain, print_json, print_values
from bench.config import ConfigError, read_calibration, writing
from bench.files import write_together
from detector import Outcome
from textfiles.text import in_command

if TYPE_CHECKING:
    from detector import Detector, Teat

# whose first member that the detector was not trained on is shown where no recording is named
SITUATION = "ideal"
# how the file of each language's skeleton ends
SKELETONS = {"python": ".py", "javascript": ".js", "cpp": ".cpp"}
COMPILED = "c++ -O2 -std=c++17 -o {name} {name}.cpp"


def listed(given: argparse.Namespace) -> None:
    found = bench.detectors()
    print_values({"detectors": found} if given.json else found, as_json=given.json)


def new(given: argparse.Namespace) -> None:
    import detector
    from bench.toml import toml_text

    name = given.name
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,60}", name):
        raise ConfigError.plain(f"--name {name}: letters, digits, - and _ only")
    skeletons = Path(detector.__file__).parent / "external" / "skeletons"
    end = SKELETONS[given.language]
    files = program, file = given.out / f"{name}{end}", given.out / f"{name}.toml"
    if there := [path for path in files if path.exists()]:
        raise ConfigError.plain(f"{there[0]} is there already. Give another --name.")
    names = ("python", "py") if os.name == "nt" else ("python3", "python")  # hold elsewhere
    python = next((one for one in names if shutil.which(one)), sys.executable)
    commands = {"python": [python, program.name], "javascript": ["node", program.name]}
    command, about = commands.get(given.language, [f"./{name}"]), f"a skeleton: {given.language}"
    limits = dict.fromkeys(("start_limit_s", "time_limit_s"), 30.0)
    table = {"about": f"{name}, {about}", "command": command, **limits}
    heading = "A detector of your own; all keys: teatbench help detectors. The command runs here."
    if given.language == "cpp":
        heading += f"\nCompile it first: {COMPILED.format(name=name)}"
    skeleton = (skeletons / f"detector{end}").read_bytes()
    table_text = toml_text(table, heading).encode("utf-8")
    with writing(given.out):
        write_together(given.out, [(program.name, skeleton), (file.name, table_text)])
    word = name if name in bench.detectors() else file
    print(*(f"written: {path}" for path in files), sep="\n")
    if given.language == "cpp":
        print(f"compile: cd {given.out} && {COMPILED.format(name=name)}")
    elif given.language == "javascript" and not shutil.which("node"):
        print("node was not found: install Node.js")
    print(f"try it:  teatbench detectors try {in_command(word)}")


def detect(given: argparse.Namespace) -> int:
    answered = False
    for line, text in bench.detect_recording(given.recording, given.detector or ["thesis"]):
        print_json(line) if given.json else print(text, flush=True)
        answered = answered or "outcome" not in line
    if not answered:
        why = "'teatbench detectors try' says what is wrong with a detector"
        return complain(f"no frame had an answer: {why}", CODES.fault)
    return CODES.met


def try_out(given: argparse.Namespace) -> int:
    """Ask twice about one frame: what answers once may not read on."""
    from bench.cli.terminal import working

    recording = bench.Recording(given.recording) if given.recording else None
    calibration = (
        read_calibration(recording.calibration_path) if recording else bench.load_rig().calibration
    )
    with (
        bench.open_detector(given.word, calibration) as detector,
        working("asking the detector about a frame"),
    ):
        if recording:
            truth = recording.truth.get(frame := recording.frames[0], ())
            shot = bench.Shot(recording.load(frame), calibration, truth)
        else:
            frame = f"{SITUATION}-{(member := _unseen(detector)):04d}"
            shot = bench.draw(SITUATION, member)
        answers = [bench.detect(detector, shot)]
        if not _fault(answers[0]):
            answers.append(bench.detect(detector, shot))
        device = getattr(detector, "device", "")
    where = given.recording or f"the simulated situation {SITUATION}"
    on = f" on {device}" if device else ""
    print(f"detector {answers[0].detector}{on}, frame {frame} of {where}")
    for number, answer in enumerate(answers, 1):
        if why := _fault(answer):
            for line in answer.stderr.splitlines():
                print(f"  standard error: {line}")
            sys.stdout.flush()
            asked = "" if number == 1 else ", the second time that it was asked"
            complain(f"no answer{asked}: {why}.", CODES.not_met)
            text = Path(__file__).with_name("cures.toml").read_text(encoding="utf-8")
            cure = next((cure for words, cure in tomllib.loads(text).items() if words in why), "")
            otherwise = "'teatbench help detectors' has what is asked for"
            complain(f"what to do: {cure or otherwise}", CODES.not_met)
            return CODES.not_met
    first, again = answers
    started = f", started in {first.start_up_s:.2f} s" if first.start_up_s is not None else ""
    print(f"answered in {first.seconds:.3f} s, again in {again.seconds:.3f} s{started}")
    found = first.detection
    visible = f"; {sum(row.visible for row in shot.truth)} can be seen" if shot.truth else ""
    print(f"teats found: {len(found.teats)}, said to be hidden: {found.hidden}{visible}")
    for number, teat in enumerate(found.teats, 1):
        print(f"  {number}: {', '.join(f'{v:.1f}' for v in teat.world_mm)} mm", end="")
        print(_nearest(teat, shot.truth))
    if found.reason:
        print(f"its reason: {found.reason}")
    word = in_command(given.word)
    print(f"The format is right. Score it: teatbench score RECORDING --detector {word}")
    return CODES.met


def _unseen(detector: Detector) -> int:
    """The first member that it doesn't say it was trained on."""
    if introduce := getattr(detector, "introduce", None):
        introduce()
    member = 0
    for first, last in sorted(getattr(detector, "trained_on", {}).get(SITUATION, ())):
        member = last + 1 if first <= member <= last else member
    return member


def _fault(answer: bench.Answer) -> str:
    """Why it is no answer; empty where it is one."""
    if answer.outcome is Outcome.ANSWERED:
        return ""
    return (answer.detection.reason or "").removeprefix("the detector failed: ")


def _nearest(teat: Teat, truth: Sequence[bench.TruthRow]) -> str:
    """How far the nearest true end is."""
    if not truth:
        return ""
    away, name = min((math.dist(teat.world_mm, row.xyz_mm), row.teat) for row in truth)
    return f"; {away:.1f} mm from the end of teat {name}"

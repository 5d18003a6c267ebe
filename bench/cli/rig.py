"""The rig without a run: `check` and `emulate`; `rigs`; `replay-wire`, the far end of a capture;
and `scene sheet|record|boards`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import bench
from bench.cli.arguments import (
    CODES,
    complain,
    print_json,
    print_values,
    refuse_existing,
    say,
)
from bench.cli.terminal import working
from bench.files import write_synced
from textfiles.text import plural


def check(given: argparse.Namespace) -> int:
    rig = bench.load_rig(given.rig)
    say(*bench.rig_notes(rig))
    code = CODES.wrong_use if rig.unfilled() else CODES.met
    for name, fault, lines in bench.check_rig(rig, given.capture):
        found = "not checked" if rig.unfilled(name) else "FAULT" if fault else "ok"
        code = CODES.fault if found == "FAULT" else code
        say(f"{name}: {found}", *(f"  {line}" for line in lines))
    return code


def emulate(given: argparse.Namespace) -> None:
    base, shown = given.port_base, dict[str, str]()
    valid = f"while it runs with --port-base {base}" if base else "while this runs"
    how = {"pty": given.pty, "paced": given.paced, "port_base": base}
    loaded = bench.load_rig(given.rig)
    with suppress(KeyboardInterrupt), bench.serve_rig(loaded, host=given.listen, **how) as rig:
        while True:
            urls = dict(rig.urls)
            for name, url in urls.items():
                # a pty comes back under another name after the instrument hung up
                if shown.get(name) != url:
                    print(f"{name} {url}", flush=True)
            if given.write_rig and shown != urls:
                text = rig.rig_file(f"Written by 'teatbench emulate', and good {valid}.")
                write_synced(given.write_rig, text.encode("utf-8"))
                print(f"written: {given.write_rig}; good {valid}", flush=True)
            if not shown:
                print(f"page {rig.page_url}", flush=True)
            shown = urls
            time.sleep(0.5)


def rigs(given: argparse.Namespace) -> None:
    to_copy = bench.load_rig("lab.example").path
    if given.json:
        print_json({"rigs": bench.rigs(), "to_copy": str(to_copy)})
        return
    names = dict.fromkeys(bench.rigs(), "")
    print_values(names | {"for a real rig": f"copy {to_copy}, where every key is explained"})


def replay_wire(given: argparse.Namespace) -> int:
    """The far end of a capture, until Ctrl-C or, for ``--once``, its end."""
    how = {"host": given.listen, "fast": given.fast, "again": not given.once}
    with bench.replay_wire(given.file, given.link, **how) as replay:
        if replay.capture.cut:
            complain(f"{given.file}: the last line is cut, and left out", CODES.met)
        for name, url in replay.urls.items():
            print(f"{name} {url}", flush=True)
        shown, going = 0, True
        while going:
            try:
                time.sleep(0.05)
                going = not (given.once and replay.finished)
            except KeyboardInterrupt:  # the way to end it
                going = False
            for one in replay.mismatches[shown:]:
                print(f"{given.file}:{one.line}: {one.link}: {one.sentence}", flush=True)
                shown += 1
        unplayed = replay.unplayed if given.once else []
        print("".join(f"{what}\n" for what in unplayed), end="", flush=True)
    return CODES.not_met if shown or unplayed else CODES.met


def _members(given: argparse.Namespace) -> range:
    return range(given.first, given.first + given.seeds)


def sheet(given: argparse.Namespace) -> None:
    refuse_existing(given.out, replace=True)
    rig = bench.load_rig(given.rig)
    with working("rendering the scenes"):
        bench.write_sheet(rig, given.situation, _members(given), given.out, given.seed)
    print(given.out)


def boards(given: argparse.Namespace) -> int:
    (board, _), watching = bench.find_board(given.board), given.camera or ["left", "right"]
    rig = bench.load_rig(given.rig)
    asked = board, watching, given.poses, given.out, given.seed
    frames = bench.record_boards(rig, *asked, warmer_k=given.warmer_k)
    return _shown(frames, given.out, given.poses)


def record(given: argparse.Namespace) -> int:
    asked = given.situation, _members(given), given.out, given.seed, given.perturb
    frames = bench.record_scenes(bench.load_rig(given.rig), *asked)
    families = {*given.situation} or bench.families()
    return _shown(frames, given.out, len(families) * given.seeds)


def _shown(frames: Iterator[str], out: Path, total: int) -> int:
    written = 0
    with working("rendering the scenes") as report:
        report(0, total)
        for frame in frames:
            print(frame, flush=True)
            written += 1
            report(written, total)
    print(f"{plural(written, 'frame')} in {out}")
    return CODES.met

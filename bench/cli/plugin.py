"""`plugin` and `plugin check`: drivers of other packages, by entry point."""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict

from bench.cli.arguments import CODES, print_values
from instruments.drivers.entry_points import EMULATORS, GROUPS, KINDS, available


def listed(_: argparse.Namespace) -> None:
    found = {}
    for kind in KINDS:
        emulated = available(EMULATORS[kind])
        for name, source in available(GROUPS[kind]).items():
            found[f"{kind} {name}"] = source + (", with an emulator" if name in emulated else "")
    print_values(found or {"none": "no package here has a driver (teatbench help drivers)"})


def check(given: argparse.Namespace) -> int:
    from bench.testing.plugins import check_driver, find_driver

    kind, url = find_driver(given.name, given.kind)
    lines = []
    for one in check_driver(kind, url, works=given.works):
        lines.append(asdict(one))
        if not given.json:
            why = f": {one.why}" if one.why else ""
            print(f"{one.outcome:<12}{one.check}{why}", flush=True)
    if given.json:
        print(json.dumps({"kind": kind, "checks": lines}))
    return CODES.not_met if any(one["outcome"] == "failed" for one in lines) else CODES.met

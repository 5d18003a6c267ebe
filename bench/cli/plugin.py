"""`plugin` and `plugin check`: drivers of other packages, by entry point."""

from __future__ import annotations

import argparse
from dataclasses import asdict

from bench.cli.arguments import CODES, in_switches, print_json, print_values
from bench.testing import check_driver, drivers


def listed(_: argparse.Namespace) -> None:
    print_values(drivers() or {"none": "no package here has a driver (teatbench help drivers)"})


def check(given: argparse.Namespace) -> int:
    found = []
    for one in check_driver(given.name, given.kind, works=given.works):
        found.append(one)
        if not given.json:
            why = f": {in_switches(one.why, given)}" if one.why else ""
            print(f"{one.outcome:<12}{one.check}{why}", flush=True)
    if given.json:
        name = given.name.removeprefix("plugin:").partition("?")[0]
        kind = given.kind or next(k for k, n in map(str.split, drivers()) if n == name)
        print_json({"kind": kind, "checks": [asdict(one) for one in found]})
    return CODES.not_met if any(one.outcome == "failed" for one in found) else CODES.met

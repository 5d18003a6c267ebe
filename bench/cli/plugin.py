"""`plugin` and `plugin check`: drivers of other packages, by entry point."""

from __future__ import annotations

import argparse
from dataclasses import asdict

from bench.cli.arguments import CODES, json_of, print_values
from bench.config import ConfigError
from instruments.drivers.entry_points import EMULATORS, GROUPS, KINDS, Kind, available, plugin_url


def listed(_: argparse.Namespace) -> None:
    found = {}
    for kind in KINDS:
        emulated = available(EMULATORS[kind])
        for name, source in available(GROUPS[kind]).items():
            found[f"{kind} {name}"] = source + (", with an emulator" if name in emulated else "")
    print_values(found or {"none": "no package here has a driver (teatbench help drivers)"})


def check(given: argparse.Namespace) -> int:
    from contextlib import closing

    from bench.rig.opening import emulated_world
    from bench.testing.conformance import conform
    from bench.testing.plugins import subject_of
    from instruments.clock import RealClock
    from instruments.errors import LimitError

    url = plugin_url(given.name if given.name.startswith("plugin:") else f"plugin:{given.name}")
    kinds = [kind for kind in KINDS if url and url.name in available(GROUPS[kind])]
    kinds = [kind for kind in kinds if given.kind in (None, kind)]
    if url is None or len(kinds) != 1:
        found = (
            f"several: name one by --kind ({', '.join(kinds)})" if kinds else "none is installed"
        )
        raise ConfigError.plain(
            f"the driver {given.name!r}: {found}. 'teatbench plugin' lists them"
        )
    kind: Kind = kinds[0]
    failed = 0
    lines = []
    try:
        with closing(RealClock()) as clock, emulated_world(clock) as world:
            made = lambda: subject_of(kind, url, clock, world, works=given.works)  # noqa: E731
            for one in conform(made):
                failed += one.outcome == "failed"
                lines.append(asdict(one))
                if not given.json:
                    why = f": {one.why}" if one.why else ""
                    print(f"{one.outcome:<12}{one.check}{why}", flush=True)
    except LimitError as error:
        raise ConfigError.plain(str(error)) from error
    if given.json:
        print(json_of({"kind": kind, "checks": lines}))
    return CODES.not_met if failed else CODES.met

"""`arm read`, `frame` and `verify`: a measuring arm, no rig file, and a person who touches."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path
from typing import Any

import bench
from bench.cli.alone import arm_at
from bench.cli.arguments import CODES, code_of, complain, in_switches, mm, print_json, say
from textfiles.text import sentence


def read(given: argparse.Namespace) -> None:
    how = {"frame": given.frame, "homed": given.homed, **arm_at(given)}
    found = bench.read_arm(given.port, given.packets, **how)
    line: dict[str, Any] = {"serial_number": found.serial_number, "tip_mm": found.tip_mm.tolist()}
    if found.world_mm is not None:
        line["world_mm"] = found.world_mm.tolist()
    line |= {
        "spread_mm": found.spread_mm,
        "axis": None if found.axis is None else found.axis.tolist(),
        "packets": found.packets,
        "counts": found.counts,
    }
    if given.json:
        print_json(line)
        return
    say(f"arm {found.serial_number}")
    spread = f", spread {found.spread_mm:.2f} mm over {found.packets} packets"
    say(f"tip {mm(found.tip_mm)} in the arm's frame{spread if found.packets > 1 else ''}")
    if found.world_mm is not None and found.frame is not None:
        say(f"    {mm(found.world_mm)} in the world (frame of {found.frame.made:%Y-%m-%d})")


def frame(given: argparse.Namespace) -> int:
    checks = [*given.check, *[None] * given.plane_checks]
    found = bench.touch_frame(given.port, checks, homed=given.homed, **arm_at(given))
    for name, residual in found.residuals_mm.items():
        say(f"{name}: {residual:.2f} mm off")
    if found.residual_mm is not None and found.residual_mm > given.residual_limit_mm:
        return complain(
            f"a check point is {found.residual_mm:.2f} mm off, limit"
            f" {given.residual_limit_mm:g} mm; nothing was written. Is the arm clamped fast, homed,"
            " and is the plane flat? Touch all points again.",
            CODES.not_met,
        )
    bench.write_arm_file(found, given.out)
    if found.residual_mm is None:
        say("No check point was touched, so nothing is known of how good this frame is.")
    say(f'Written: {given.out}. Name it in the rig file: [arm] frame = "{given.out.name}"')
    return CODES.met


def _written_ns(path: Path) -> int:
    """When it was written, ns since 1970; 0 where it isn't there."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def verify(given: argparse.Namespace) -> int:
    keys = (field.name for field in fields(bench.VerificationPlan))
    plan = bench.VerificationPlan(**{key: getattr(given, key) for key in keys})
    how = {"script": given.script, "accuracy_mm": given.accuracy_mm, "homed": given.homed}
    how["unfinished"] = kept = given.out.with_suffix(".unfinished.toml")
    before_ns = _written_ns(kept)
    warn = lambda text: say(in_switches(text, given))  # noqa: E731
    try:
        found = bench.verify_arm(given.port, plan, warn=warn, **how, **arm_at(given))
    except BaseException:
        if _written_ns(kept) != before_ns:
            given.left = f"{given.out} was not written. Give the command again"
        raise
    bench.write_arm_file(found, given.out)
    seen, limits = found.verification, found.limits
    say(f"Articulated location error {seen.location_mm:.2f} mm, limit {limits.location_mm:.2f} mm")
    if seen.length_mm is not None:
        say(
            f"Largest error of the calibrated length {seen.length_mm:.2f} mm, limit"
            f" {limits.length_mm:.2f} mm"
        )
    for text in found.contradictions:
        say(sentence(text))
    for check in found.checks:
        low, high = (found.u_mm * ratio for ratio in check.ratio_interval)
        say(
            f"The {check.name} show an arm of u = {found.u_mm * check.ratio:.2f} mm"
            f" ({low:.2f} to {high:.2f}, {check.df} degrees of freedom); --accuracy-mm"
            f" {found.u_mm:g} is {'too small' if check in found.refuted else 'not refuted'}"
        )
    say(f'Written: {given.out}. Name it in the rig file: [arm] verification = "{given.out.name}"')
    for fault in (*found.broken, *found.gaps):
        complain(f"not verified: {fault}", CODES.not_met)
    return code_of(found.verdict)

"""`arm read`, `watch`, `home`, `frame` and `verify`: one MicroScribe alone, no rig file."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import fields
from typing import Any

import numpy as np

import bench
from bench.calibrate.arm import (
    ArmSession,
    VerificationPlan,
    limits_of,
    mm,
    open_arm,
    read_touch,
    today,
    touch_frame,
)
from bench.calibrate.arm import verify as verify_arm
from bench.calibrate.simulated_arm import Step
from bench.cli.arguments import CODES, complain, print_json
from bench.config import ConfigError
from bench.results.stated_arm import (
    check_verification,
    contradictions,
    length_limit_mm,
    location_limit_mm,
    stated_fact,
)
from bench.rig.arm_files import (
    LengthTest,
    VerificationLimits,
    frame_text,
    load_frame,
    verification_text,
    write_file,
)
from bench.rig.model import Arm
from bench.scoring.stated_u import refuted
from instruments.points import points_url


@contextmanager
def _homed(given: argparse.Namespace, length_mm: float | None = None) -> Iterator[ArmSession]:
    """The arm, its homing confirmed. Raises ConfigError without a terminal to confirm it at."""
    if not given.homed and not sys.stdin.isatty():
        raise ConfigError.plain(
            "no positions before homing is confirmed, and there is no terminal to confirm it at."
            " Give --homed where the stylus was on its peg when the arm was last switched on, or"
            " the arm was homed since: otherwise positions are wrong, with no sign of it."
        )
    with open_arm(given.port, given.baud, given.answer_s, given.capture, length_mm) as session:
        session.confirm_homing(homed=given.homed)
        yield session


def read(given: argparse.Namespace) -> None:
    frame = load_frame(given.frame) if given.frame else None
    with _homed(given) as session:
        serial_number = session.arm.identity.serial_number
        if frame:
            frame = load_frame(given.frame, serial_number=serial_number)
        if session.arm.pedals:
            reading = session.arm.read(given.packets)
        else:
            step = Step("point", 0, "Touch the point that is to be read.")
            reading = read_touch(session, step)
    line: dict[str, Any] = {"serial_number": serial_number, "tip_mm": reading.tip_mm.tolist()}
    if frame:
        line["world_mm"] = frame.world_from_arm.apply(reading.tip_mm).tolist()
    line |= {
        "spread_mm": reading.spread_mm,
        "axis": None if reading.axis is None else reading.axis.tolist(),
        "packets": reading.n,
        "counts": reading.evidence,
    }
    if given.json:
        print_json(line)
        return
    print(f"arm {serial_number}")
    spread = f", spread {reading.spread_mm:.2f} mm over {reading.n} packets"
    print(f"tip {mm(line['tip_mm'], 2)} in the arm's frame{spread if reading.n > 1 else ''}")
    if frame:
        print(f"    {mm(line['world_mm'], 2)} in the world (frame of {frame.made:%Y-%m-%d})")


def _refuse_points(session: ArmSession) -> None:
    """Raises ConfigError for points of another arm."""
    if not session.arm.pedals:
        does = "the software of another arm does that"
        raise ConfigError.plain(f"only a MicroScribe can be watched and homed: {does}")


def watch(given: argparse.Namespace) -> None:
    live = sys.stdout.isatty()
    with _homed(given) as session:
        _refuse_points(session)
        end_s = session.clock.now() + (given.seconds or math.inf)
        with suppress(KeyboardInterrupt), closing(bench.watch_arm(session.arm)) as views:
            for seen in views:
                each = (f"{one} {'DOWN' if down else 'up'}" for one, down in seen.pedals.items())
                (x, y, z), pedals = seen.tip_mm, ", ".join(each)
                print(
                    f"tip {x:8.2f} {y:8.2f} {z:8.2f} mm   pedals: {pedals:<22}"
                    f" {seen.packets_per_s:6.1f} packets/s   damaged: {seen.damaged}",
                    end="\r" if live else "\n",
                    flush=True,
                )
                if session.clock.now() >= end_s:
                    break
    if live:
        print(flush=True)


def home(given: argparse.Namespace) -> None:
    if not given.on_peg and not sys.stdin.isatty():
        raise ConfigError.plain(
            "homing with the stylus off its peg ruins every position. Put it there, and give"
            " --on-peg to say so."
        )
    with open_arm(given.port, given.baud, given.answer_s, given.capture) as session:
        _refuse_points(session)
        if not given.on_peg:
            session.ask(
                "Put the arm's stylus on its peg and let go of it. Anywhere else, homing makes"
                " every position wrong."
            )
        session.arm.home()
        reading = session.arm.read()
    print(
        f"Homed. The tip stands at {mm(reading.tip_mm, 2)} in the arm's frame. Leave the arm"
        " switched on."
    )


def frame(given: argparse.Namespace) -> int:
    with _homed(given) as session:
        checks = [*given.check, *[None] * given.plane_checks]
        found = touch_frame(session, checks, today())
    for name, residual in found.residuals_mm.items():
        print(f"{name}: {residual:.2f} mm off")
    if found.residual_mm is not None and found.residual_mm > given.residual_limit_mm:
        return complain(
            f"a check point is {found.residual_mm:.2f} mm off, limit"
            f" {given.residual_limit_mm:g} mm; nothing was written. Is the arm clamped fast, homed,"
            " and is the plane flat? Touch all points again.",
            CODES.not_met,
        )
    write_file(given.out, frame_text(found))
    if found.residual_mm is None:
        print("No check point was touched, so nothing is known of how good this frame is.")
    print(f'Written: {given.out}. Name it in the rig file: [arm] frame = "{given.out.name}"')
    return CODES.met


def verify(given: argparse.Namespace) -> int:
    rule = limits_of(given.script)
    needed = rule.length_limit_mm is not None or rule.dated_required
    if given.length_mm is None and needed:
        print("Without --length-mm no length is measured, and the arm can't be verified whole.")
    if given.accuracy_mm is None and points_url(given.port):
        raise ConfigError.plain(
            "--accuracy-mm is needed: the standard uncertainty of a point of this arm"
        )
    u_mm = given.accuracy_mm or Arm.model_fields["accuracy_mm"].default
    plan = VerificationPlan(
        **{field.name: getattr(given, field.name) for field in fields(VerificationPlan)}
    )
    with _homed(given, given.length_mm) as session:
        found = verify_arm(session, plan, today())
    stated = stated_fact(Arm.model_construct(url=given.port, accuracy_mm=u_mm))
    sizes = [test.n for test in found.locations]
    length_mm = length_limit_mm(rule, stated, found.lengths)
    if length_mm is None and rule.dated_required:  # none was measured, and one is asked for
        none = LengthTest("", np.zeros(3), np.zeros(3), 0.0)
        length_mm = length_limit_mm(rule, stated, [none])
    limits = VerificationLimits(location_limit_mm(rule, stated, sizes), length_mm)
    write_file(given.out, verification_text(found, limits))
    print(
        f"Articulated location error {found.location_mm:.2f} mm, limit {limits.location_mm:.2f} mm"
    )
    if found.length_mm is not None:
        print(
            f"Largest error of the calibrated length {found.length_mm:.2f} mm, limit"
            f" {limits.length_mm:.2f} mm"
        )
    for text in contradictions(rule, stated, (), found):
        print(f"{text[0].upper()}{text[1:]}.")
    checks = list(check_verification(stated, found))
    wrong = refuted(checks)
    for check in checks:
        low, high = (u_mm * ratio for ratio in check.ratio_interval)
        print(
            f"The {check.name} show an arm of u = {u_mm * check.ratio:.2f} mm"
            f" ({low:.2f} to {high:.2f}, {check.df} degrees of freedom); --accuracy-mm"
            f" {u_mm:g} is {'too small' if check in wrong else 'not refuted'}"
        )
    print(f'Written: {given.out}. Name it in the rig file: [arm] verification = "{given.out.name}"')
    broken = [*found.broken(limits), *(f"{one.name}: u is too small" for one in wrong)]
    gaps = found.gaps(limits)
    for fault in (*broken, *gaps):
        complain(f"not verified: {fault}", CODES.not_met)
    if broken:
        return CODES.not_met
    return CODES.inconclusive if gaps else CODES.met

"""The report's parts on the truth: the arm with its frame and checks, the measurand, uncertainty
budgets, the stage's registration, check touches, and what is in no count and why.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from bench.record.reader import RunRecord, TrialRecord, points_mm
from bench.report.tables import covariance_of, truth_known_mm
from bench.report.wording import Heading, key_values, listed, number, spanned, table, xyz
from bench.results.cameras_agree import (
    DEFAULT,
    DISPARITY,
    UNCHECKED_FACT,
    answers_of,
    cameras_of,
    shift_text,
    unchecked_of,
)
from bench.results.doubts import LOOKED_FACT
from bench.results.stated_arm import STATED_FACT, VERIFICATION_FACT, arm_checks, too_small
from bench.results.verdicts import age_of
from bench.rig.arm_files import LocationTest, Verification, from_dict
from bench.scoring.stated_u import LEVEL, level_of_each
from bench.script.model import CamerasRequirement, Rules
from bench.truth.arm_check import (
    AFTER,
    BEFORE,
    CHECK_FACT,
    location_of,
    moved_mm,
    new_touches,
    shift_mm,
)
from bench.truth.carrying import resumed
from bench.truth.joint import FRAME_FACT
from bench.truth.registration import Registration, registration_from_facts
from bench.truth.uncertainty import CHI2_95, TruthMethod
from detector.calibration import Calibration
from instruments.world.phantom import TEAT_END
from reports.page import Cell, Notes, Paragraph, Part, Table
from textfiles.text import capital, plural, sentence


def cameras_parts(run: RunRecord, rules: Rules, calibration: Calibration) -> Iterator[Part]:
    """The check of the cameras on known ends, and whether answers share their shift."""
    check = cameras_of(run)
    if looked := run.facts.get(LOOKED_FACT):
        yield Paragraph(f"{looked}.")
    if text := run.facts.get(UNCHECKED_FACT) or unchecked_of(run.counted, check):
        yield Paragraph(f"Cameras {text}.", tone="warn")
    if not check.ends:
        return
    asked = [r.limit_px for r in rules.requirements if isinstance(r, CamerasRequirement)]
    limit_px = min(asked, default=DEFAULT.limit_px)
    answers = {name: answers_of(run, name, calibration) for name in run.detectors}
    found = [("cameras", one) for one in check.offsets]
    found += [(f"answers of {name}", one) for name, one in answers.items() if one is not None]
    thermal = "" if check.thermal is None else f", {check.thermal} in the thermal picture"
    rows = []
    for who, off in found:
        worth = (off.mm, abs(off.value) * off.deg) if off.name == DISPARITY else ("", "")
        rows.append((who, off.name, off.value, off.uncertainty, off.poses, *worth))
    yield table("known_ends", rows, measured=check.measured, ends=check.ends, thermal=thermal)
    if text := check.unseen:
        yield Paragraph(sentence(text), tone="warn")
    for name, one in answers.items():
        if text := shift_text(check, one, limit_px):
            yield Paragraph(f"{name}: {text}.", tone="warn")


def arm_parts(run: RunRecord) -> Iterator[Part]:
    """Nothing for frames that came without an arm."""
    if "arm" not in run.facts.get("identities", {}):
        return
    yield _frame(run.facts.get(FRAME_FACT))
    if dated := run.facts.get(VERIFICATION_FACT):
        yield from _verification(run, from_dict(dated))
    else:
        missing = "The rig names no dated verification of the arm ('teatbench arm verify')."
        yield Paragraph(missing, tone="warn")
    yield _arm_checks(run)
    yield from _stated(run)


def _frame(fact: dict[str, Any] | None) -> Part:
    if fact is None:
        return Paragraph(
            "World frame: the arm's own (the rig names no table frame), so the arm must not be"
            " moved on the table."
        )
    residuals = ", ".join(f"{name} {value:.2f} mm" for name, value in fact["residuals_mm"].items())
    entries = {
        "file": fact["file"],
        "made": fact["made"],
        "arm": fact["serial_number"],
        "largest residual of a check point": number(fact["residual_mm"], "mm"),
        "residuals": residuals or None,
        "om, rad": listed(fact["om"], ".6f"),
        "T, mm": listed(fact["T"], ".3f"),
    }
    return key_values("World frame: the table, X_world = R(om) X_arm + T", entries)


def _verification(run: RunRecord, dated: Verification) -> Iterator[Part]:
    yield table(
        "arm_locations",
        [_location(test, None) for test in dated.locations],
        serial_number=dated.serial_number,
        made=dated.made,
        age_days=age_of(dated, run.facts).days,
    )
    if dated.gauge:
        yield Paragraph(f"Calibrated length: {dated.gauge}.")
    if not dated.lengths:
        yield Paragraph("No calibrated length was measured in it.", tone="warn")
        return
    lengths = [
        (t.where, t.calibrated_mm, t.calibrated_u_mm, t.measured_mm, t.error_mm)
        for t in dated.lengths
    ]
    largest, two_rms = number(dated.length_mm, "mm"), number(dated.length_two_rms_mm, "mm")
    yield table("arm_lengths", lengths, largest=largest, two_rms=two_rms)


def _arm_checks(run: RunRecord) -> Part:
    names = {when: CHECK_FACT.format(when) for when in (BEFORE, AFTER)}
    facts = {when: run.facts[name] for when, name in names.items() if name in run.facts}
    if not facts:
        return Paragraph(
            "The arm was not checked before and after the trials: the rig names no check point.",
            tone="warn",
        )
    tests = [location_of(fact, f"check point, {when} the trials") for when, fact in facts.items()]
    rows = [_location(*pair) for pair in zip(tests, map(shift_mm, facts.values()), strict=True)]
    note = ""
    if len(tests) == 2:
        before, after = facts.values()
        note = f"Between the two the check point moved by {moved_mm(before, after):.2f} mm."
        if new_touches(after) < tests[1].n:
            note += " One touch afterwards showed it: those before count."
    return table("arm_checks", rows, note=note)


def _stated(run: RunRecord) -> Iterator[Part]:
    """The arm's stated uncertainty, and each check of it; nothing of a run that kept none."""
    if (stated := run.facts.get(STATED_FACT)) is None:
        return
    u_mm, df, checks = stated["u_mm"], stated["df"], arm_checks(run.facts)
    entries = {
        "standard uncertainty of a position, along each axis": f"{u_mm:g} mm",
        "source": stated["source"] or "not named in the rig file ([arm] accuracy_source)",
        "degrees of freedom": f"{df:g}" if df else "not stated: taken as exact",
        "rounding, beside it": f"{stated['resolution_mm']:.3f} mm",
    }
    yield key_values("The arm's uncertainty, as the rig file states it", entries)
    if not checks:
        yield Paragraph("No touch and no length checks it.", tone="warn")
        return
    level = level_of_each(checks)
    rows = []
    for check in checks:
        span = spanned([u_mm * ratio for ratio in check.ratio_interval])
        wrong = Cell("too small", "bad") if check.p_value < level else Cell("not refuted", "good")
        figures = (check.squares, check.limit(level), f"{check.p_value:.2g}")
        rows.append((check.name, check.df, u_mm * check.ratio, span, *figures, wrong))
    yield table("stated_arm", rows, level=100 * LEVEL)
    if wrong_u := too_small(run.facts):
        text = f"{capital(wrong_u)}: no error is accepted by this guard band."
        yield Paragraph(text, tone="bad")


def _location(test: LocationTest, shift: float | None) -> tuple[object, ...]:
    mm = (test.largest_mm, test.two_sd_mm, test.sphere_mm)
    return test.where, test.n, *mm, test.swing_deg, shift


NO_TRUTH = "truth: "  # what bench.truth.touching's NoTruthError begins with


def truth_parts(run: RunRecord) -> Iterator[Part]:
    """Definition, budgets, registration and checks."""
    yield Paragraph(f"Measurand: {TEAT_END}")
    yield Paragraph(
        "An answer that triangulates silhouettes measures another point; this report does not"
        " correct for it.",
        tone="info",
    )
    ends = [row for trial in run.counted for row in trial.truth]
    for how in TruthMethod:
        budgets = [json.loads(row["budget"]) for row in ends if row["how"] == how and row["budget"]]
        if not budgets:
            continue
        worst = max(budgets, key=lambda budget: budget["u_mm"])
        lines = [(c["name"], c["u_mm"], c["source"]) for c in worst["components"]]
        lines.append(("combined, along one axis", worst["u_mm"], "root of the sum of squares"))
        yield table("truth_budget", lines, how=how, ends=len(budgets))
    if known := [row["u_mm"] for row in ends if row["u_mm"] is not None]:
        yield Paragraph(
            "Every decision's guard band is that of the largest uncertainty in the run: u ="
            f" {max(known):.3f} mm along an axis; in space, an end is known to"
            f" {truth_known_mm(run) or 0.0:.2f} mm in 95 %."
        )
    if (registration := registration_from_facts(run.facts)) is not None:
        yield from _registration(run, registration)
    if run.checks:
        states = (Cell("lost", "bad"), Cell("held", "good"))
        rows = [
            (
                *(row["number"], str(row["after_trial"]), str(row["teat"])),
                *(xyz(row), xyz(row, "carried_")),
                *(row["off_mm"], row["limit_mm"], states[bool(row["held"])]),
            )
            for row in run.checks
        ]
        yield table("check_touches", rows)
    if exact := [row for row in ends if row["exact_mm"]]:
        yield Paragraph(_truth_error(exact), tone="info")


def deviation_parts(run: RunRecord) -> Iterator[Part]:
    """What was not done as the script says, and what left the counts."""
    left_out = [_skipped(row["trial"], str(row["reason"])) for row in run.skipped]
    if left_out:
        yield Notes("Deviations from the script; what was skipped is in no count", tuple(left_out))
    why: dict[str, list[str]] = {}
    for trial in run.trials:
        if trial.invalid:
            why.setdefault(trial.invalid, []).append(trial.id)
    if why:
        text = tuple(f"{', '.join(trials)}: {reason}" for reason, trials in why.items())
        yield Notes("Trials whose truth was invalidated; they are in no count", text)
    state = resumed(run)
    if since := [*state.unconfirmed, *state.since]:
        yield Paragraph(
            f"{plural(len(since), 'trial', 'is')} confirmed by no check touch after them, and count"
            f" all the same: {', '.join(since)}.",
            tone="warn",
        )
    refused = tuple(
        f"{trial.id}, teat {row['teat']}: {row['refused']}"
        for trial in run.trials
        for row in trial.touches
        if row["refused"]
    )
    if refused:
        yield Notes("Touches that were refused and asked for again", refused)
    undone = run.facts.get("planned", 0) - run.done - len(run.skipped)
    if undone > 0:
        yield Paragraph(f"{plural(undone, 'trial', 'is')} not done, and in no count.", tone="warn")
    elif not (left_out or why or since or refused):
        yield Paragraph(
            "None: every trial of the script was done and counts, and no touch was refused."
        )


def _skipped(trial: str, reason: str) -> str:
    if reason.startswith(NO_TRUTH):
        return f"{trial} has no truth: {reason.removeprefix(NO_TRUTH)}"
    return f"{trial} was skipped by the operator: {reason}"


def trial_truth(trial: TrialRecord) -> Table | None:
    """The budget of each teat end of one trial; None where the truth came without."""
    rows = [(row, json.loads(row["budget"])) for row in trial.truth if row["budget"]]
    if not rows:
        return None
    names = [Heading(line["name"], "right", "mm") for line in rows[0][1]["components"]]
    lines = []
    for row, budget in rows:
        parts = (f"{line['u_mm']:.3f}" for line in budget["components"])
        lines.append((str(row["teat"]), str(row["how"]), *parts, budget["u_mm"]))
    return table("trial_truth", lines, more=names)


def _registration(run: RunRecord, found: Registration) -> Iterator[Part]:
    yield from (Paragraph(fault, tone="warn") for fault in found.faults)
    fits = found.comparison
    places = [json.loads(trial.head["stage_mm"]) for trial in run.trials if trial.head["stage_mm"]]
    target_mm = [found.target_error_mm(place) for place in places]
    expected = f"{found.expected_fre_mm:.2f} mm expected of touches as stated"
    entries = {
        "made": found.made.isoformat(timespec="seconds"),
        "stage": found.stage,
        "positions touched": f"{len(found.stations)}, teat {found.teat}",
        "residual of the rigid fit (FRE)": f"{fits.rigid.fre_mm:.2f} mm rms; {expected}",
        "target error (TRE) at the run's poses": spanned(target_mm, unit="mm"),
        "om, rad": listed(found.world_from_stage.om, ".6f"),
        "T, mm": listed(found.world_from_stage.T, ".3f"),
        "chance of these axes, if as stated": f"{found.p_value:.2g}",
    }
    yield key_values("Registration of the stage, X_world = R(om) X_stage + T", entries)
    held_out_mm = fits.held_out_mm
    models = [(f.model, f.fre_mm, held_out_mm[f.model], f.singular_values) for f in fits.fits]
    yield table("stage_fits", models)
    stated, so = found.stated, ", which the carry's uncertainty is made of."
    if found.doubted:
        so = "; what was found here is added, since it casts doubt on that."
    words = ("no", Cell("yes", "warn"))
    axes = [
        (d.name, 1e3 * d.value, 1e3 * d.u, d.value / d.u, words[bool(d.significant)])
        for d in found.diagnostics
    ]
    scale_u, squareness_u = 1000.0 * stated.scale_u, 1000.0 * stated.squareness_u_rad
    yield table("stage_axes", axes, scale_u=scale_u, squareness_u=squareness_u, so=so)


def _truth_error(rows: Sequence[Mapping[str, Any]]) -> str:
    """What the truth was off by, known on an emulated rig only."""
    off_mm = points_mm(rows) - [json.loads(row["exact_mm"]) for row in rows]
    stated = [
        (off, own)
        for off, row in zip(off_mm, rows, strict=True)
        if (own := covariance_of(row)) is not None
    ]
    held = ""
    if stated:
        off, own = map(np.array, zip(*stated, strict=True))
        inside = (off * np.linalg.solve(own, off[..., None])[..., 0]).sum(axis=1) <= CHI2_95
        held = f"; the stated 95 % regions hold {inside.sum()} of {len(inside)}"
    far = np.linalg.norm(off_mm, axis=1)
    return (
        f"Emulated rig: the scene's exact teat ends are kept aside. The truth is {far.mean():.2f}"
        f" mm from them on the mean, {far.max():.2f} mm at most ({plural(len(rows), 'end')}){held}."
        " Scores are against the measured truth, as in a laboratory."
    )

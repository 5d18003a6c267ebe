"""The report's parts on the truth: the arm with its frame and checks, the measurand, uncertainty
budgets, the stage's registration, check touches, and what is in no count and why.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from bench.record.reader import RunRecord, TrialRecord
from bench.report.tables import key_values
from bench.report.wording import number
from bench.results.verdicts import VERIFICATION_FACT, age_of
from bench.rig.arm_verification import LocationTest, Verification, from_dict
from bench.run.rows import FRAME_FACT
from bench.truth.arm_check import AFTER, BEFORE, CHECK_FACT, location_of, shift_mm
from bench.truth.carrying import counted, resumed
from bench.truth.registration import Registration
from bench.truth.registration_file import registration_from_facts
from bench.truth.uncertainty import CHI2_95, How
from instruments.teat_end import DEFINITION
from reports.parts import Cell, Column, Notes, Paragraph, Part, Table, columns

COLUMNS = columns(
    "divot | >touches",
    (
        ">largest deviation [mm] # from the mean of the touches: articulated location error,"
        " ASME B89.4.22"
    ),
    ">2 sd [mm]",
    ">least sphere [mm] # its diameter, the form of ISO 10360-12",
    ">swing [°] # largest angle between two stylus directions",
    ">shift [mm] # of the mean from the known place",
)


def arm_parts(run: RunRecord) -> Iterator[Part]:
    """Nothing for frames that came without an arm."""
    if "arm" not in run.facts.get("identities", {}):
        return
    yield _frame(run.facts.get(FRAME_FACT))
    dated = run.facts.get(VERIFICATION_FACT)
    if dated:
        yield from _verification(run, from_dict(dated))
    else:
        yield Paragraph(
            "The rig names no dated verification of the arm ('teatbench arm verify').", tone="warn"
        )
    yield from _arm_checks(run)


def _frame(fact: dict[str, Any] | None) -> Part:
    if fact is None:
        return Paragraph(
            "World frame: the arm's own (the rig names no table frame), so the arm must not be"
            " moved on the table."
        )
    residuals = ", ".join(f"{name} {value:.2f} mm" for name, value in fact["residuals_mm"].items())
    entries: list[tuple[str, object]] = [
        ("file", fact["file"]),
        ("made", fact["made"]),
        ("arm", fact["serial_number"]),
        (
            "largest residual of a check point",
            None if fact["residual_mm"] is None else number(fact["residual_mm"], "mm"),
        ),
        ("residuals", residuals or None),
        ("om, rad", ", ".join(f"{v:.6f}" for v in fact["om"])),
        ("T, mm", ", ".join(f"{v:.3f}" for v in fact["T"])),
    ]
    return key_values("World frame: the table, X_world = R(om) X_arm + T", entries)


def _verification(run: RunRecord, dated: Verification) -> Iterator[Part]:
    rows = tuple(_row(test, None) for test in dated.locations)
    caption = (
        f"Verification of arm {dated.serial_number} on {dated.made:%Y-%m-%d},"
        f" {age_of(dated, run.facts).days} days before the run"
    )
    yield Table(
        caption, COLUMNS, rows, "The tip in one divot at each distance while wrist and elbow swing."
    )
    if not dated.lengths:
        yield Paragraph("No calibrated length was measured in it.", tone="warn")
        return
    heads = columns("direction | >calibrated [mm] | >measured [mm] | >error [mm]")
    lengths = tuple(
        (t.where, f"{t.calibrated_mm:.3f}", f"{t.measured_mm:.2f}", f"{t.error_mm:+.2f}")
        for t in dated.lengths
    )
    note = (
        f"Largest error {number(dated.length_mm, 'mm')}; 2 rms"
        f" {number(dated.length_two_rms_mm, 'mm')}."
    )
    yield Table("A calibrated length, measured in several directions", heads, lengths, note)


def _arm_checks(run: RunRecord) -> Iterator[Part]:
    facts = {
        when: run.facts[CHECK_FACT.format(when)]
        for when in (BEFORE, AFTER)
        if CHECK_FACT.format(when) in run.facts
    }
    if not facts:
        yield Paragraph(
            "The arm was not checked before and after the trials: the rig names no check point.",
            tone="warn",
        )
        return
    rows = tuple(
        _row(location_of(fact, f"check point, {when} the trials"), shift_mm(fact))
        for when, fact in facts.items()
    )
    note = ""
    if len(facts) == 2:
        first, last = (location_of(fact, when).centre_mm for when, fact in facts.items())
        note = (
            "Between the two the check point moved by"
            f" {float(np.linalg.norm(last - first)):.2f} mm."
        )
    yield Table("The arm before and after the trials", COLUMNS, rows, note)


def _row(test: LocationTest, shift: float | None) -> tuple[str, ...]:
    figures = (
        f"{test.largest_mm:.2f}",
        f"{test.two_sd_mm:.2f}",
        f"{test.sphere_mm:.2f}",
        f"{test.swing_deg:.0f}",
    )
    return (test.where, str(test.n), *figures, "" if shift is None else f"{shift:.2f}")


NO_TRUTH = "truth: "  # what bench.truth.touching's NoTruthError begins with
U_NOTE = "standard uncertainties along one axis; the carry's is that of its worst direction"


def truth_parts(run: RunRecord) -> Iterator[Part]:
    """Definition, budgets, registration and checks."""
    yield Paragraph(f"Measurand: {DEFINITION}")
    yield Paragraph(
        "An answer that triangulates silhouettes measures another point; this report does not"
        " correct for it.",
        tone="info",
    )
    yield from _budgets(run)
    registration = registration_from_facts(run.facts)
    if registration is not None:
        yield from _registration(run, registration)
    yield from _check_touches(run)
    exact = _truth_error(run)
    if exact:
        yield Paragraph(exact, tone="info")


def deviation_parts(run: RunRecord) -> Iterator[Part]:
    """What was not done as the script says, and what left the counts."""
    left_out = [_skipped(row) for row in run.skipped]
    if left_out:
        yield Notes("Deviations from the script; what was skipped is in no count", tuple(left_out))
    why: dict[str, list[str]] = {}
    for trial in run.trials:
        if trial.invalid:
            why.setdefault(trial.invalid, []).append(trial.id)
    if why:
        told = tuple(f"{', '.join(trials)}: {reason}" for reason, trials in why.items())
        yield Notes("Trials whose truth was invalidated; they are in no count", told)
    state = resumed(run)
    since = [*state.unconfirmed, *state.since]
    if since:
        yield Paragraph(
            f"{counted(len(since))} confirmed by no check touch after them, and count all the same:"
            f" {', '.join(since)}.",
            tone="warn",
        )
    refused = [
        f"{trial.id}, teat {row['teat']}: {row['refused']}"
        for trial in run.trials
        for row in trial.touches
        if row["refused"]
    ]
    if refused:
        yield Notes("Touches that were refused and asked for again", tuple(refused))
    if not (left_out or why or since or refused):
        yield Paragraph(
            "None: every trial of the script was done and counts, and no touch was refused."
        )


def trial_truth(trial: TrialRecord) -> Table | None:
    """The budget of each teat end of one trial; None where the truth came without."""
    rows = [(row, json.loads(row["budget"])) for row in trial.truth if row["budget"]]
    if not rows:
        return None
    names = [line["name"] for line in rows[0][1]["components"]]
    heads = columns(
        "teat | truth", *(Column(name, "right", "mm") for name in names), ">combined [mm]"
    )
    table = [
        (
            str(row["teat"]),
            str(row["how"]),
            *(f"{line['u_mm']:.3f}" for line in budget["components"]),
            f"{budget['u_mm']:.3f}",
        )
        for row, budget in rows
    ]
    return Table(
        "Uncertainty of the truth",
        heads,
        tuple(table),
        f"Sources stand under Measurand and reference; {U_NOTE}.",
    )


def _skipped(row: Mapping[str, Any]) -> str:
    trial, reason = row["trial"], str(row["reason"])
    if reason.startswith(NO_TRUTH):
        return f"{trial} has no truth: {reason.removeprefix(NO_TRUTH)}"
    return f"{trial} was skipped by the operator: {reason}"


def _budgets(run: RunRecord) -> Iterator[Part]:
    counted_rows = [row for trial in run.counted for row in trial.truth]
    for how in How:
        budgets = [
            json.loads(row["budget"]) for row in counted_rows if row["how"] == how and row["budget"]
        ]
        if not budgets:
            continue
        worst = max(budgets, key=lambda budget: budget["u_mm"])
        lines = [(c["name"], f"{c['u_mm']:.3f}", c["source"]) for c in worst["components"]]
        lines.append(
            ("combined, along one axis", f"{worst['u_mm']:.3f}", "root of the sum of squares")
        )
        heads = columns("component | >u [mm] | source")
        caption = f"Uncertainty budget of the {how} truth: the worst of {len(budgets)} ends"
        yield Table(caption, heads, tuple(lines), f"Each trial has its own, per teat; {U_NOTE}.")
    known = [row["u_mm"] for row in counted_rows if row["u_mm"] is not None]
    if known:
        yield Paragraph(
            "Every decision's guard band is that of the largest uncertainty in the run: u ="
            f" {max(known):.3f} mm along an axis."
        )


def _registration(run: RunRecord, found: Registration) -> Iterator[Part]:
    for fault in found.faults:
        yield Paragraph(fault, tone="warn")
    fits, n = found.comparison, len(found.stations)
    entries: list[tuple[str, object]] = [
        ("made", found.made.isoformat(timespec="seconds")),
        ("stage", found.stage),
        ("positions touched", f"{n}, teat {found.teat}"),
        (
            "residual of the rigid fit (FRE)",
            (
                f"{fits.rigid.fre_mm:.2f} mm rms; {found.expected_fre_mm:.2f} mm expected of"
                " touches as stated"
            ),
        ),
        ("target error (TRE) at the run's poses", _target_errors(run, found)),
        ("om, rad", ", ".join(f"{v:.6f}" for v in found.world_from_stage.om)),
        ("T, mm", ", ".join(f"{v:.3f}" for v in found.world_from_stage.T)),
        ("chance of these axes, if as stated", f"{found.p_value:.2g}"),
    ]
    yield key_values("Registration of the stage, X_world = R(om) X_stage + T", entries)
    heads = columns("fit | >residual [mm] | >held out [mm] | >singular values")
    rows = [
        (
            f.model,
            f"{f.fre_mm:.3f}",
            number(fits.held_out_mm[f.model], "", 3),
            ", ".join(f"{v:.4f}" for v in f.singular_values),
        )
        for f in fits.fits
    ]
    note = (
        "The rigid fit carries. Where affine is much better, held out too, the stage's axes or the"
        " arm are off."
    )
    yield Table("Fits of the touched positions", heads, tuple(rows), note)
    yield _diagnostics(found)


def _diagnostics(found: Registration) -> Table:
    rows = [
        (
            d.name,
            f"{1e3 * d.value:+.2f}",
            f"{1e3 * d.u:.2f}",
            f"{d.value / d.u:+.1f}",
            Cell("yes", "warn") if d.significant else Cell("no"),
        )
        for d in found.diagnostics
    ]
    heads = columns(
        "axes | >off by [mm/m] | >u [mm/m] | >off by / u",
        "significant # beyond 2.58 u: touch noise explains it in one of 100 cases",
    )
    stated = found.stated
    note = (
        "Diagnostics, not corrections; squareness is in mrad. The rig file states u ="
        f" {1e3 * stated.scale_u:g} mm/m of scale and {1e3 * stated.squareness_u_rad:g} mrad of"
        " squareness"
    )
    more = (
        "; what was found here is added, since it casts doubt on that."
        if found.doubted
        else ", which the carry's uncertainty is made of."
    )
    return Table("The stage's axes", heads, tuple(rows), note + more)


def _target_errors(run: RunRecord, found: Registration) -> str | None:
    places = [json.loads(trial.head["stage_mm"]) for trial in run.trials if trial.head["stage_mm"]]
    if not places:
        return None
    errors = [found.target_error_mm(place) for place in places]
    return f"{min(errors):.2f} to {max(errors):.2f} mm"


def _check_touches(run: RunRecord) -> Iterator[Part]:
    if not run.checks:
        return
    heads = columns(
        ">check | after trial | teat | >touched x, y, z [mm] | >carried x, y, z [mm]",
        ">apart [mm] | >limit [mm] | carry",
    )
    rows = [
        (
            str(row["number"]),
            str(row["after_trial"]),
            str(row["teat"]),
            _xyz(row, ""),
            _xyz(row, "carried_"),
            f"{row['off_mm']:.2f}",
            f"{row['limit_mm']:g}",
            Cell("held", "good") if row["held"] else Cell("lost", "bad"),
        )
        for row in run.checks
    ]
    yield Table("Check touches of the carried truth", heads, tuple(rows))


def _xyz(row: Mapping[str, Any], prefix: str) -> str:
    return ", ".join(f"{row[f'{prefix}{axis}_mm']:.1f}" for axis in "xyz")


def _truth_error(run: RunRecord) -> str:
    """What the truth was off by, known on an emulated rig only."""
    rows = [row for trial in run.counted for row in trial.truth if row["exact_mm"]]
    if not rows:
        return ""
    distances = np.array([_off_mm(row) for row in rows])
    return (
        "Emulated rig: the scene's exact teat ends are kept aside. The truth is"
        f" {distances.mean():.2f} mm from them on the mean, {distances.max():.2f} mm at most"
        f" ({len(rows)} ends){_held(rows)}. Scores are against the measured truth, as in a"
        " laboratory."
    )


def _off_mm(row: Mapping[str, Any]) -> float:
    return float(
        np.linalg.norm(
            np.array([row["x_mm"], row["y_mm"], row["z_mm"]])
            - np.array(json.loads(row["exact_mm"]))
        )
    )


def _held(rows: Sequence[Mapping[str, Any]]) -> str:
    regions = [row for row in rows if row["covariance_mm2"]]
    inside = sum(_holds(row) for row in regions)
    return f"; the stated 95 % regions hold {inside} of {len(regions)}" if regions else ""


def _holds(row: Mapping[str, Any]) -> bool:
    off = np.array([row["x_mm"], row["y_mm"], row["z_mm"]]) - np.array(json.loads(row["exact_mm"]))
    return bool(off @ np.linalg.solve(np.array(json.loads(row["covariance_mm2"])), off) <= CHI2_95)

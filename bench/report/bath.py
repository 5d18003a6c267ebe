"""The report's parts on the bath: curve, captures, the teats' surface, interlocks, guardian."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.record.reader import RunRecord, TrialRecord
from bench.report import tables
from bench.report.wording import NOT_MEASURED, guardian_told, number
from bench.results.teat_temperature import Figures, Surface, surface
from bench.safety.interlocks import RULES
from bench.script.model import Rules, Script
from reports.figures import bath_curve
from reports.parts import Figure, Paragraph, Part, Table, columns

MOST_ROWS = 40  # of a table that has a row a capture
AROUND_S = 5.0  # readings so near to a capture are those of the capture


def bath_parts(run: RunRecord, rules: Rules) -> Iterator[Part]:
    """The section on bath and environment."""
    set_point = run.facts.get("set_point_c")
    if set_point is None or not len(run.bath):
        yield Paragraph("No bath belongs to recorded frames.", tone="muted")
        return
    captures = [t.head["captured_s"] for t in run.trials if t.head["captured_s"] is not None]
    band_k = rules.bath.leave_k if isinstance(rules, Script) else 0.15
    svg = bath_curve(
        run.bath[:, 0], run.bath[:, 1], set_point, band_k, captures, _stable_spans(run)
    )
    caption = "Bath temperature over the run's time; captures are marked"
    yield Figure(svg, caption, f"{len(run.bath)} readings, {len(captures)} captures", wide=True)
    temps = [t.head["bath_c"] for t in run.trials if t.head["bath_c"] is not None]
    entries: list[tuple[str, object]] = [
        ("set point", number(set_point, "°C")),
        ("readings", len(run.bath)),
    ]
    room = run.facts.get("bath figures", {}).get("room_c")
    entries.append(("room, of the rig file", None if room is None else number(room, "°C")))
    if temps:
        entries.append(("at the captures", f"{min(temps):.2f} to {max(temps):.2f} °C"))
    yield tables.key_values("Bath", entries)
    yield from _capture_parts(run)
    if isinstance(rules, Script) and captures:
        yield _stability_table(run, set_point, rules.bath.window_s)
    yield from _care_parts(run)


def surface_at(run: RunRecord, trial: TrialRecord) -> Surface | None:
    """The teats' surface at a trial's capture; None where nothing was read about then."""
    figures = run.facts.get("bath figures")
    if figures is None or trial.head["captured_s"] is None:
        return None
    bath, external = _readings(run, trial)
    return surface(bath, external, Figures(**figures))


def capture_told(run: RunRecord, trial: TrialRecord) -> str:
    """The bath at a trial's capture: value, range of the readings about then, and state."""
    told = number(trial.head["bath_c"], "°C")
    readings = _readings(run, trial)[0] if trial.head["captured_s"] is not None else []
    if readings:
        told += f" ({min(readings):.2f} to {max(readings):.2f} within {AROUND_S:g} s)"
    return f"{told}, {trial.head['bath_state']}" if trial.head["bath_state"] else told


def surface_told(found: Surface | None) -> str:
    """``32.68 ± 0.35 °C (plant model)``; twice the standard uncertainty."""
    return (
        NOT_MEASURED
        if found is None
        else f"{found.temp_c:.2f} ± {2 * found.u_k:.2f} °C ({found.how})"
    )


def _readings(run: RunRecord, trial: TrialRecord) -> tuple[list[float], list[float]]:
    """What bath and external sensor read about the capture."""
    near = np.abs(run.bath[:, 0] - trial.head["captured_s"]) <= AROUND_S
    external = run.external_c[near]
    return run.bath[near, 1].tolist(), external[np.isfinite(external)].tolist()


def _capture_parts(run: RunRecord) -> Iterator[Part]:
    found = {trial.id: surface_at(run, trial) for trial in run.trials}
    taken = [trial for trial in run.trials if trial.head["captured_s"] is not None]
    shown, left_out = _farthest(run, taken)
    rows = [_capture_row(run, trial, found[trial.id]) for trial in shown]
    if not rows:
        return
    heads = columns(
        "trial | >bath, mean [°C] | >least [°C] | >most [°C] | >external [°C] | state",
        ">teats' surface [°C]",
        ">± [K] # twice the standard uncertainty",
    )
    note = (
        f"Readings within {AROUND_S:g} s of each capture. The bath is not the stimulus: the teats'"
        f" surface is.{left_out}"
    )
    yield Table("Temperatures at the captures", heads, tuple(rows), note)
    last = next((surface for surface in reversed(found.values()) if surface), None)
    if last:
        budget = [(c.name, f"{c.u_k:.3f}", c.source) for c in last.components]
        budget.append(("combined", f"{last.u_k:.3f}", "root of the sum of squares"))
        title = f"Uncertainty budget of the teats' surface, by {last.how} (last capture)"
        yield Table(title, columns("component | >u [K] | source"), tuple(budget))


def _farthest(run: RunRecord, taken: Sequence[TrialRecord]) -> tuple[Sequence[TrialRecord], str]:
    """The captures that a table shows, of many those farthest from the set point, with a note."""
    if len(taken) <= MOST_ROWS:
        return taken, ""
    off = [abs((trial.head["bath_c"] or 0.0) - run.facts["set_point_c"]) for trial in taken]
    chosen = sorted(sorted(range(len(taken)), key=lambda k: -off[k])[:MOST_ROWS])
    return (
        [taken[k] for k in chosen],
        (
            f" The {MOST_ROWS} of {len(taken)} captures farthest from the set point; each trial has"
            " its own."
        ),
    )


def _stability_table(run: RunRecord, set_point_c: float, window_s: float) -> Table:
    """Stability over time at one place, uniformity between places (ASTM E2488)."""
    heads = columns(
        "trial | >readings | >mean from set point [K] | >half the range [K] | >slope [K/min]",
        ">teats' sensor, slope [K/min] | >bath to teats' sensor [K]",
    )
    shown, left_out = _farthest(
        run, [trial for trial in run.trials if trial.head["captured_s"] is not None]
    )
    rows = tuple(_stability_row(run, trial, set_point_c, window_s) for trial in shown)
    note = (
        "Stability is what varies in these readings at one place. Uniformity, from teat to teat"
        " and from root to tip, is not measured: there is one sensor at the teats at most; what it"
        f" may be is in the uncertainty of the teats' surface.{left_out}"
    )
    return Table(f"The {window_s:g} s before each capture", heads, rows, note)


def _stability_row(
    run: RunRecord, trial: TrialRecord, set_point_c: float, window_s: float
) -> tuple[str, ...]:
    end_s = trial.head["captured_s"]
    inside = (run.bath[:, 0] >= end_s - window_s) & (run.bath[:, 0] <= end_s)
    t_s, bath_c, teats_c = run.bath[inside, 0], run.bath[inside, 1], run.external_c[inside]
    told = np.isfinite(teats_c)
    away_k = float(np.mean(bath_c[told] - teats_c[told])) if told.any() else None
    figures = (
        float(np.mean(bath_c)) - set_point_c if len(bath_c) else None,
        float(np.ptp(bath_c)) / 2.0 if len(bath_c) else None,
        _slope_k_per_min(t_s, bath_c),
        _slope_k_per_min(t_s[told], teats_c[told]),
        away_k,
    )
    return (
        trial.id,
        str(len(bath_c)),
        *(NOT_MEASURED if figure is None else f"{figure:+.4f}" for figure in figures),
    )


def _slope_k_per_min(t_s: NDArray[np.float64], temp_c: NDArray[np.float64]) -> float | None:
    """Least squares; None below two readings."""
    return 60.0 * float(np.polyfit(t_s - t_s[0], temp_c, 1)[0]) if len(t_s) > 1 else None


def _capture_row(run: RunRecord, trial: TrialRecord, found: Surface | None) -> tuple[str, ...]:
    bath, external = _readings(run, trial)
    figures = [_mean(bath), min(bath, default=None), max(bath, default=None), _mean(external)]
    estimate = (
        (NOT_MEASURED, "") if found is None else (f"{found.temp_c:.2f}", f"{2 * found.u_k:.2f}")
    )
    return (
        trial.id,
        *(number(value) for value in figures),
        str(trial.head["bath_state"] or NOT_MEASURED),
        *estimate,
    )


def _care_parts(run: RunRecord) -> Iterator[Part]:
    """Interlocks, safe states, and who acted when the bench could not."""
    facts = run.facts
    if "safe states" not in facts:
        return  # a run of before, or one that never had the instruments
    entries: list[tuple[str, object]] = [
        (f"safe state, {name}", state) for name, state in facts["safe states"].items()
    ]
    entries += [
        ("pump", facts["pump"]),
        ("when the computer dies", COMMS_LOSS[facts["comms loss"]]),
        ("guardian", facts["guardian"]),
    ]
    if tested := facts.get("cut-out tested"):
        entries.append(("independent cut-out tested on", tested))
    yield tables.key_values("Care", entries)
    if run.guardian:
        yield Paragraph(guardian_told(run.guardian), tone="warn")
    inactive = set(facts["interlocks asleep"])
    trip = facts.get("trip", {})
    rows = [(r.name, r.trips, r.resets, _state(r.name, inactive, trip.get("rule"))) for r in RULES]
    heads = columns("interlock | trips | resets, once acknowledged | in this run")
    yield Table(
        "Interlocks",
        heads,
        tuple(rows),
        "None of this is a safety function; the bath's independent cut-out is.",
    )
    if trip:
        yield _trip_table(trip)


COMMS_LOSS = {
    "hold": (
        "the controller holds its last set point: the bath stays hot until the guardian or a person"
        " switches it off"
    ),
    "stop": "the controller stops by itself when it hears nothing",
    "safe_setpoint": "the controller goes to its own safe set point when it hears nothing",
    "unknown": "not known for this controller: take it that the bath stays hot",
}


def _state(name: str, inactive: set[str], tripped: str | None) -> str:
    if name == tripped:
        return "TRIPPED"
    return (
        "asleep: the controller doesn't tell what it needs" if name in inactive else "did not trip"
    )


def _trip_table(trip: dict[str, Any]) -> Table:
    values: Sequence[dict[str, Any]] = trip["values"]
    names = [
        "t_s",
        "temp_c",
        "external_c",
        "safety_c",
        "set_point_c",
        "power_percent",
        "running",
        "alarm",
    ]
    heads = columns(
        ">time [s] | >bath [°C] | >external [°C] | >safety [°C] | >set point [°C]",
        ">output [%] | >runs | >alarm",
    )
    rows = tuple(tuple(_cell(row.get(name)) for name in names) for row in values)
    return Table(
        f"Readings that led to the trip: {trip['rule']}",
        heads,
        rows,
        f"{trip['why']}. {'; '.join(trip['done'])}. {trip['then']}",
    )


def _cell(value: float | bool | None) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "" if value is None else f"{value:g}"


def _stable_spans(run: RunRecord) -> list[tuple[float, float]]:
    spans: list[tuple[float, float]] = []
    for t_s, state in zip(run.bath[:, 0].tolist(), run.bath_states, strict=True):
        if state == "stable":
            joined = spans and t_s - spans[-1][1] < 5.0
            start = spans.pop()[0] if joined else t_s
            spans.append((start, t_s))
    return spans


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None

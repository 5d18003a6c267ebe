"""The report's parts on the bath: curve, captures, the teats' surface, interlocks, guardian."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.record.reader import RunRecord, TrialRecord
from bench.report.wording import NOT_MEASURED, key_values, number, spanned, table
from bench.results.headline import guardian_text
from bench.results.teat_temperature import Surface, TemperatureInputs, surface
from bench.safety.interlocks import RULES
from bench.script.model import Rules, Script
from reports.figures.course import bath_curve, bath_sparkline
from reports.page import Figure, Fold, Paragraph, Part, Table
from textfiles.text import plural

MOST_ROWS = 40  # of a table that has a row a capture
AROUND_S = 5.0  # readings so near to a capture are those of the capture


def sparkline(run: RunRecord, rules: Rules) -> Iterator[Part]:
    """The bath's course in a line for the first page; nothing for recorded frames."""
    set_point, captured = run.facts.get("set_point_c"), _captured(run)
    if set_point is None or not len(run.bath):
        return
    svg = bath_sparkline(run.bath[:, 0], run.bath[:, 1], set_point, _band_k(rules))
    stable = sum(trial.head["bath_state"] == "stable" for trial in captured)
    caption = f"The bath; stable at {stable} of {len(captured)} captures"
    yield Figure(svg, caption, f"{plural(len(run.bath), 'reading')} about {set_point:g} °C")


def _captured(run: RunRecord) -> list[TrialRecord]:
    return [trial for trial in run.trials if trial.head["captured_s"] is not None]


def _band_k(rules: Rules) -> float:
    return rules.bath.leave_k if isinstance(rules, Script) else 0.15


def bath_parts(run: RunRecord, rules: Rules) -> Iterator[Part]:
    """The section on bath and environment."""
    set_point, captured = run.facts.get("set_point_c"), _captured(run)
    if set_point is None or not len(run.bath):
        yield Paragraph("No bath belongs to recorded frames.", tone="muted")
        return
    times_s, temps_c = run.bath[:, 0], run.bath[:, 1]
    captures = [trial.head["captured_s"] for trial in captured]
    spans: list[tuple[float, float]] = []
    for t_s, state in zip(times_s.tolist(), run.bath_states, strict=True):
        if state == "stable":
            joined = spans and t_s - spans[-1][1] < 5.0
            spans.append((spans.pop()[0] if joined else t_s, t_s))
    svg = bath_curve(times_s, temps_c, set_point, _band_k(rules), captures, spans)
    caption = "Bath temperature over the run's time; captures are marked"
    alt = f"{plural(len(run.bath), 'reading')}, {plural(len(captures), 'capture')}"
    yield Figure(svg, caption, alt, wide=True)
    temps = [t.head["bath_c"] for t in run.trials if t.head["bath_c"] is not None]
    room = run.facts.get("bath figures", {}).get("room_c")
    entries = {
        "set point": number(set_point, "°C"),
        "readings": len(run.bath),
        "room, of the rig file": number(room, "°C"),
    }
    if temps:
        entries["at the captures"] = spanned(temps, unit="°C")
    yield key_values("Bath", entries)
    if captured:
        shown = _farthest(run, captured)
        each = [*_capture_parts(run, *shown)]
        if isinstance(rules, Script):
            each.append(_stability_table(run, rules.bath.window_s, *shown))
        states = [str(trial.head["bath_state"]) for trial in captured]
        states_text = ", ".join(f"{states.count(one)} {one}" for one in dict.fromkeys(states))
        yield Paragraph(f"The bath at {plural(len(captured), 'capture')}: {states_text}.")
        yield Fold("Each capture: temperatures, stability and uncertainty", tuple(each))
    yield from _care_parts(run)


def surface_at(run: RunRecord, trial: TrialRecord) -> Surface | None:
    """The teats' surface at a trial's capture; None where nothing was read about then."""
    figures = run.facts.get("bath figures")
    if figures is None or trial.head["captured_s"] is None:
        return None
    return surface(*readings_at(run, trial), TemperatureInputs(**figures))


def capture_text(run: RunRecord, trial: TrialRecord) -> str:
    """The bath at a trial's capture: value, range of the readings about then, and state."""
    text = number(trial.head["bath_c"], "°C")
    if readings := readings_at(run, trial)[0]:
        text += f" ({spanned(readings)} within {AROUND_S:g} s)"
    return f"{text}, {trial.head['bath_state']}" if trial.head["bath_state"] else text


def surface_text(found: Surface | None) -> str:
    """``32.68 ± 0.35 °C (plant model)``; twice the standard uncertainty."""
    if found is None:
        return NOT_MEASURED
    return f"{found.temp_c:.2f} ± {2 * found.u_k:.2f} °C ({found.how})"


def readings_at(run: RunRecord, trial: TrialRecord) -> tuple[list[float], list[float]]:
    """What bath and external sensor read about the capture, if any."""
    if trial.head["captured_s"] is None:
        return [], []
    near = _own(run, trial, np.abs(run.bath[:, 0] - trial.head["captured_s"]) <= AROUND_S)
    external = run.external_c[near]
    return run.bath[near, 1].tolist(), external[np.isfinite(external)].tolist()


def _own(run: RunRecord, trial: TrialRecord, near: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Places of those ``near`` (n,) readings whose clock is that of the trial's session."""
    at = np.flatnonzero(near)
    if len(run.bath_sessions) != len(run.bath):
        return at
    session = trial.head.get("session", 1)
    return at[[run.bath_sessions[place] == session for place in at]] if len(at) else at


def _capture_parts(run: RunRecord, shown: Sequence[TrialRecord], left_out: str) -> Iterator[Part]:
    rows = []
    for trial in shown:
        bath, external = readings_at(run, trial)
        figures = (_mean(bath), min(bath, default=None), max(bath, default=None), _mean(external))
        found = surface_at(run, trial)
        estimate = (None, "") if found is None else (found.temp_c, 2 * found.u_k)
        rows.append((trial.id, *figures, trial.head["bath_state"] or None, *estimate))
    yield table("capture_temperatures", rows, around_s=AROUND_S, left_out=left_out)
    surfaces = (surface_at(run, trial) for trial in reversed(run.trials))
    if last := next((found for found in surfaces if found), None):
        budget = [(c.name, c.u_k, c.source) for c in last.components]
        budget.append(("combined", last.u_k, "root of the sum of squares"))
        yield table("surface_budget", budget, how=last.how)


def _farthest(run: RunRecord, taken: Sequence[TrialRecord]) -> tuple[Sequence[TrialRecord], str]:
    """The captures that a table shows, of many those farthest from the set point, with a note."""
    if len(taken) <= MOST_ROWS:
        return taken, ""
    off = [abs((trial.head["bath_c"] or 0.0) - run.facts["set_point_c"]) for trial in taken]
    chosen = sorted(sorted(range(len(taken)), key=lambda k: -off[k])[:MOST_ROWS])
    note = f" The {MOST_ROWS} of {len(taken)} captures farthest from the set point; each trial has"
    return [taken[k] for k in chosen], f"{note} its own."


def _stability_table(
    run: RunRecord, window_s: float, shown: Sequence[TrialRecord], left_out: str
) -> Table:
    """Stability over time at one place, uniformity between places (ASTM E2488)."""
    rows = []
    for trial in shown:
        end_s = trial.head["captured_s"]
        inside = _own(run, trial, (run.bath[:, 0] >= end_s - window_s) & (run.bath[:, 0] <= end_s))
        t_s, bath_c, teats_c = run.bath[inside, 0], run.bath[inside, 1], run.external_c[inside]
        text = np.isfinite(teats_c)
        mean_c = _mean(bath_c)
        off_k = None if mean_c is None else mean_c - run.facts["set_point_c"]
        half_k = np.ptp(bath_c) / 2.0 if len(bath_c) else None
        slopes = _k_per_min(t_s, bath_c), _k_per_min(t_s[text], teats_c[text])
        away_k = _mean(bath_c[text] - teats_c[text])
        rows.append((trial.id, len(bath_c), off_k, half_k, *slopes, away_k))
    return table("stability", rows, window_s=window_s, left_out=left_out)


def _k_per_min(t_s: NDArray[np.float64], temp_c: NDArray[np.float64]) -> float | None:
    """The slope, by least squares; None below two readings."""
    return 60.0 * float(np.polyfit(t_s - t_s[0], temp_c, 1)[0]) if len(t_s) > 1 else None


def _mean(values: Sequence[float] | NDArray[np.float64]) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _care_parts(run: RunRecord) -> Iterator[Part]:
    """Interlocks, safe states, and who acted when the bench could not."""
    facts = run.facts
    if "safe states" not in facts:
        return  # a run of before, or one that never had the instruments
    entries = {f"safe state, {name}": state for name, state in facts["safe states"].items()}
    entries["pump"] = facts["pump"]
    entries["when the computer dies"] = COMMS_LOSS[facts["comms loss"]]
    if seconds := facts.get(WATCHDOG_FACT):
        own = f"its own watchdog, set to {seconds:g} s in this run, stops it"
        entries["when the computer and the guardian die"] = own
    entries["guardian"] = facts["guardian"]
    if tested := facts.get("cut-out tested"):
        entries["independent cut-out tested on"] = tested
    yield key_values("Care", entries)
    for session, record in run.guardians.items():
        whose = f"Session {session}: " if run.sessions > 1 else ""
        yield Paragraph(f"{whose}{guardian_text(record)}", tone="warn")
    trip = facts.get("trip", {})
    asleep = "asleep: the controller doesn't report what it needs"
    states = dict.fromkeys(facts["interlocks asleep"], asleep)
    if trip:
        states[trip["rule"]] = "TRIPPED"
    rows = [(r.name, r.trips, r.resets, states.get(r.name, "did not trip")) for r in RULES]
    resting = sum(state == "did not trip" for *_, state in rows)
    yield Paragraph(f"{resting} of {len(rows)} interlocks were awake and did not trip.")
    listed = table("interlocks", rows)
    if trip:
        yield from (listed, _trip_table(trip))
    else:
        yield Fold("Interlocks, when they trip and how they reset", (listed,))


WATCHDOG_FACT = "watchdog"
COMMS_LOSS = {
    "hold": (
        "the controller holds its last set point: the bath stays hot until the guardian or a person"
        " switches it off"
    ),
    "stop": "the controller stops by itself when no messages come",
    "safe_setpoint": "the controller goes to its own safe set point when no messages come",
    "unknown": "not known for this controller: take it that the bath stays hot",
}
READINGS = (  # of the columns of the table of a trip
    *("t_s", "temp_c", "external_c", "safety_c"),
    *("set_point_c", "power_percent", "running", "alarm"),
)


def _trip_table(trip: dict[str, Any]) -> Table:
    words = {True: "yes", False: "no"}
    rows = (map(row.get, READINGS) for row in trip["values"])
    shown = [[words[one] if isinstance(one, bool) else one for one in row] for row in rows]
    done = "; ".join(trip["done"])
    return table("trip", shown, rule=trip["rule"], why=trip["why"], done=done, then=trip["then"])

"""The whole report of a run as a page: banner, requirements, results, accuracy, latency, bath, provenance, trials."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bench.config import read_config
from bench.exports import write_exports
from bench.latency import LATENCY_RULE, failures_told, latency_of
from bench.record import RunRecord, read_run
from bench.rig import read_calibration
from bench.scoring.rates import zero_failure_n
from bench.script import ErrorRequirement, Rules, Script, SuccessRequirement, TimeRequirement
from bench.store import RULES, SCRIPT
from bench.summary import tables
from bench.summary.arm import arm_parts
from bench.summary.bath import bath_parts
from bench.summary.poses import pose_parts
from bench.summary.trials import trial_id, trial_parts, trial_table
from bench.summary.truth import deviation_parts, truth_parts
from bench.summary.wording import headline, number
from bench.verdicts import Judgement, judge, scored
from detector.calibration import Calibration
from reports.figures import error_histogram, error_scatter, found_bars, latency_strip, per_axis_errors
from reports.page import Banner, Code, Column, Figure, Notes, Page, Paragraph, Part, Section, Table
from reports.render import write_report

REPORT = "report"


def write_run_report(folder: Path) -> tuple[Path, RunRecord, tuple[Judgement, ...]]:
    """(Re)write the report and the exports of the run in ``folder``; gives back the page's path. Raises ConfigError for no run."""
    run = read_run(folder)
    rules = stored_rules(folder)
    judgements = judge(run, rules) if any(trial.scores for trial in run.trials) else ()
    calibration = read_calibration(folder / "calibration.toml")
    page = build_page(run, rules, judgements, calibration, folder / REPORT)
    path = write_report(page, folder / REPORT)
    write_exports(run, judgements, folder / REPORT)
    return path, run, judgements


def stored_rules(folder: Path) -> Rules:
    """The script as the run used it, or the rules that a recording was scored by."""
    script = folder / SCRIPT
    return read_config(script, Script, stored=True) if script.is_file() else read_config(folder / RULES, Rules, stored=True)


def build_page(run: RunRecord, rules: Rules, judgements: Sequence[Judgement], calibration: Calibration, folder: Path) -> Page:
    """The page; the trials' pictures are written into ``folder``/images on the way."""
    verdict, why, then = headline(run, judgements)
    facts = run.facts
    poses = len({trial.pose for trial in run.counted})
    banner = Banner(
        kind=facts["kind"],
        verdict=verdict,
        tested=f"{facts['title']}: detector {', '.join(run.detectors)} on {len(run.counted)} frame sets of {poses} poses{_left_out(run)}.",
        sentence=why,
        confidence=_confidence(rules, poses),
        next_action=then,
    )
    sections = (
        Section("requirements", "Requirements", tuple(_requirement_parts(judgements, rules))),
        Section("results", "Results by situation", tuple(_result_parts(run, rules))),
        Section("accuracy", "Accuracy", tuple(_accuracy_parts(run, rules, calibration))),
        Section("poses", "Poses", tuple(pose_parts(run, rules.visible_within_mm))),
        Section("latency", "Time", tuple(_latency_parts(run, rules))),
        Section("environment", "Bath and environment", tuple(bath_parts(run, rules))),
        Section("deviations", "Deviations and exclusions", tuple(deviation_parts(run))),
        Section("reference", "Measurand and reference", (*truth_parts(run), *arm_parts(run))),
        Section("provenance", "Provenance", tuple(_provenance_parts(run))),
        Section("trial-list", "Trials", (trial_table(run),)),
    )
    return Page(
        title=str(facts["title"]),
        subtitle=str(facts.get("about", "")),
        banner=banner,
        sections=sections,
        trials=tuple(trial_parts(run, calibration, folder)),
        footer=(f"teatbench {facts['versions']['teatbench']}, run {run.folder.name}",),
    )


def _left_out(run: RunRecord) -> str:
    invalid = len(run.trials) - len(run.counted)
    return f"; {invalid} more have lost their truth (see Deviations)" if invalid else ""


def _confidence(rules: Rules, poses: int) -> str:
    claims = [(r.rate, r.confidence) for r in rules.requirements if isinstance(r, ErrorRequirement | SuccessRequirement)]
    if not claims:
        return f"{poses} poses."
    rate, confidence = claims[0]
    needed = zero_failure_n(rate, confidence)
    claim = f"{100 * rate:g} % of poses with {100 * confidence:g} % confidence"
    return f"{poses} poses were tried. Without a single failure, {needed} show {claim}."


def _requirement_parts(judgements: Sequence[Judgement], rules: Rules) -> Iterator[Part]:
    if not judgements:
        yield Paragraph("Nothing was scored, so no requirement was decided.", tone="warn")
        return
    yield from (tables.requirements(judgement, rules) for judgement in judgements)


def _result_parts(run: RunRecord, rules: Rules) -> Iterator[Part]:
    published = rules.published
    names = tables.situations(run)
    for detector in run.detectors:
        counts = [scored(run, detector, name).counts for name in names]
        theirs = [published[name].found if name in published else None for name in names]
        svg = found_bars(names, [c.matched for c in counts], [c.visible for c in counts], theirs, name=f"found-{detector}")
        alt = "; ".join(f"{n}: {c.matched} of {c.visible}" for n, c in zip(names, counts, strict=True))
        yield Figure(svg, f"Teats found by {detector}, beside the thesis's own count", alt or "not measured")
        yield tables.found_by_situation(run, detector, rules)
        yield tables.rates(scored(run, detector), detector)


def _accuracy_parts(run: RunRecord, rules: Rules, calibration: Calibration) -> Iterator[Part]:
    limit_mm = rules.visible_within_mm
    names = tables.situations(run)
    for detector in run.detectors:
        pool = scored(run, detector)
        yield from tables.errors(run, pool, detector, calibration)
        camera = pool.errors_mm @ calibration.world_from_right.inverse().R.T
        radial = np.linalg.norm(pool.errors_mm, axis=1)
        links = [f"#{trial_id(t)}" for t in run.counted if detector in t.scores for _ in t.scores[detector].errors_mm]
        lateral = np.copysign(np.hypot(camera[:, 0], camera[:, 1]), camera[:, 0])
        scatter = error_scatter(lateral, camera[:, 2], limit_mm, links=links, name=f"scatter-{detector}")
        yield Figure(scatter, f"Depth error against lateral error, {detector}; each point opens its trial", f"{len(radial)} points")
        histogram = error_histogram(radial, limit_mm, name=f"histogram-{detector}")
        within = f"{int((radial <= limit_mm).sum())} of {len(radial)} within the limit"
        yield Figure(histogram, f"Distance to the teat end, {detector}", within)
        strips = per_axis_errors(names, [scored(run, detector, n).errors_mm for n in names], limit_mm, name=f"axes-{detector}")
        yield Figure(strips, f"Errors along the world's axes by situation, {detector}", "strips of signed errors", wide=True)
    yield Paragraph(tables.depth_limit(run, calibration))


def _latency_parts(run: RunRecord, rules: Rules) -> Iterator[Part]:
    limits = sorted({r.limit_s for r in rules.requirements if isinstance(r, TimeRequirement)})
    rows = []
    for detector in run.detectors:
        times = latency_of(run, detector)
        seconds = times.seconds
        yield Figure(
            latency_strip(seconds, limits, name=f"latency-{detector}"), f"Detection time, {detector}", f"{len(seconds)} detections"
        )
        told = [times.median_s, times.p95_s, times.p99_s, max(seconds, default=None), max(times.cold_s, default=None), times.start_up_s]
        over = [f"{sum(s > edge for s in seconds)} of {len(seconds)}" for edge in (1.0, 2.0)]
        rows.append((detector, str(len(seconds)), *(number(value, digits=3) for value in told), *over, failures_told(times)))
    titles = ("median", "p95", "p99", "max", "first call (cold)", "start-up")
    columns = (
        Column("detector"),
        Column("n", "right"),
        *(Column(t, "right", "s") for t in titles),
        Column("above 1 s"),
        Column("above 2 s"),
        Column("no answer"),
    )
    note = f"Real time of the detector alone, on the machine named under Provenance. {LATENCY_RULE}"
    yield Table("Detection time", columns, tuple(rows), note)


def _provenance_parts(run: RunRecord) -> Iterator[Part]:
    facts = run.facts
    for name, identity in facts.get("identities", {}).items():
        yield tables.key_values(f"Instrument: {name}", list(identity.items()))
    for name, item in facts["items"].items():
        yield tables.key_values(f"Item under test: {name}", list(item.items()))
    yield tables.key_values(
        "Run",
        [
            ("folder", run.folder.name),
            ("ending", run.ending),
            ("started", facts["wall_started"]),
            ("ended", facts.get("wall_ended")),
            ("seed", facts.get("seed")),
            ("rig", facts.get("rig")),
            ("script", facts.get("script")),
            ("calibration SHA-256", facts["calibration_sha256"]),
            *((f"version, {name}", version) for name, version in facts["versions"].items()),
        ],
    )
    yield Code("The command that repeats it", str(facts["command"]))
    yield Notes("Events", tuple(_event(event) for event in run.events))


def _event(event: Mapping[str, Any]) -> str:
    time = "" if event["t_s"] is None else f"{event['t_s']:.0f} s: "
    return f"{time}{event['kind']}: {event['text']}"

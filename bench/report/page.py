"""The report of a run as a page, from the banner to the trials, and its provenance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import cast

import numpy as np

from bench.config import read_calibration
from bench.files import is_unreadable, sha256_of
from bench.record.check import NOT_AS_WRITTEN
from bench.record.reader import RunRecord, read_run
from bench.record.schema import RULES, SCRIPT
from bench.report import tables
from bench.report.accuracy import accuracy_tables, gage_parts, limit_parts
from bench.report.bath import bath_parts, sparkline
from bench.report.beside import drawn_beside
from bench.report.chapters import Chapters, page_of, sections
from bench.report.comparison import detectors_parts
from bench.report.growing import REPORT, TrialParts
from bench.report.spread import pose_parts, spread_parts
from bench.report.statements import note_on_statements
from bench.report.trials import (
    first_looks,
    first_trials,
    look_at,
    trial_id,
    trial_table,
    undecided_of,
    worst_trials,
)
from bench.report.truth import arm_parts, cameras_parts, deviation_parts, truth_parts
from bench.report.wording import id_of, key_values, table
from bench.results.cameras_agree import UNCHECKED_FACT
from bench.results.exports import write_exports
from bench.results.status import Reported, RunStatus, status_of
from bench.results.verdicts import (
    LATENCY_RULE,
    Judgement,
    failures_text,
    judge,
    latency_of,
    scored,
    scored_trials,
    stored_rules,
    truth_u_mm,
)
from bench.rig.frame_capture import FRAMES_FACT
from bench.scoring.guard_band import acceptance_limit_mm
from bench.scoring.rates import zero_failure_n
from bench.script.calibration_age import CALIBRATION_FACT
from bench.script.model import ErrorRequirement, Rules, SuccessRequirement, TimeRequirement
from detector.calibration import Calibration
from instruments.camera.settings import AUTOMATIC, UNSEEN_SIZE
from instruments.world.situations import spoken
from reports.figures.course import found_bars, latency_strip
from reports.figures.errors import error_histogram, error_scatter, per_axis_errors
from reports.figures.situations import error_strips, outcome_bars
from reports.frames import places_of
from reports.page import (
    Banner,
    Cell,
    Code,
    Figure,
    Fold,
    Highlights,
    Notes,
    Page,
    Paragraph,
    Part,
    Verdict,
)
from reports.render import in_page, write_report
from textfiles.text import in_command, plural
from textfiles.whole import is_full

PDF = "report.pdf"


def write_run_report(
    folder: Path,
    baseline: Iterable[Part] = (),
    damage: tuple[str, ...] = (),
    parts: TrialParts | None = None,
) -> Reported:
    """Write a run's report and exports, with what it says of a ``baseline``, and the ``parts`` that
    have grown with the run. Raises ConfigError, OSError.
    """
    run = read_run(folder, damage)
    try:
        rules = stored_rules(folder)
        judgements = judge(run, rules) if any(trial.scores for trial in run.trials) else ()
        calibration = read_calibration(folder / "calibration.toml", doubtful=True)
        status = status_of(run, judgements)
        with drawn_beside(parts.figures if parts else None) as finished:
            page = build_page(
                run, status, rules, judgements, calibration, folder / REPORT, baseline, parts
            )
            # by another reading of the run: it may not stand beside this one
            (folder / REPORT / PDF).unlink(missing_ok=True)
            listed = judgements or judge(run, rules)  # its requirements, where nothing was scored
            write_exports(run, status, listed, folder / REPORT)
            path = write_report(page, folder / REPORT, finished=finished)
        return Reported(folder, path, run, judgements, status)
    except OSError as error:
        if is_unreadable(error):
            raise
        cure = "Make room" if is_full(error) else "Remove the cause"
        why = f"{error.filename or folder / REPORT}: {error.strerror or error}. The run is kept."
        raise OSError(f"{why} {cure}, then: teatbench report {in_command(folder)}") from error


def build_page(
    run: RunRecord,
    status: RunStatus,
    rules: Rules,
    judgements: Sequence[Judgement],
    calibration: Calibration,
    folder: Path,
    baseline: Iterable[Part] = (),
    parts: TrialParts | None = None,
) -> Page:
    """The page; writes copies of frames into ``folder``/images."""
    nothing = "Nothing was scored, so no requirement was decided."
    requirements: tuple[Part, ...] = (Paragraph(nothing, tone="warn"),)
    if judgements:
        reasons = tuple(
            tables.requirements(j, rules, first=not at) for at, j in enumerate(judgements)
        )
        folded = Fold("Rules, counts, margins and reasons", reasons)
        requirements = (tables.scoreboard(judgements), folded)
    undecided = undecided_of(judgements)
    looked, count = first_trials(run, undecided), len(run.trials)
    few = in_page(count, len(run.detectors))
    pages = _pages(run, status, rules, calibration, baseline, first_looks(run, undecided))
    figures = _figures(run, rules, calibration) if run.trials and judgements else ()
    # what has figures first: they may be drawn while the rest is made
    drawn = [*figures]
    behind = {anchor: (title, sections(page)) for anchor, (title, page) in pages.items()}
    drawing = parts or TrialParts()
    made = (*drawing.of(run, calibration, folder, copied=None if few else looked),)
    if judgements:
        every = chain(requirements, *(parts for _, parts in behind.values()))
        statements = note_on_statements((*every,), rules, len(judgements))
        requirements = (requirements[0], replace(folded, parts=(*folded.parts, statements)))
    by_id = {part.id: part for part in made}
    looks = [look_at(*one, by_id[trial_id(one[0])], calibration) for one in looked.values()]
    alarm = f"{NOT_AS_WRITTEN}: no figure below holds."  # the verdict says what of it
    return page_of(
        str(run.facts["title"]),
        str(run.facts.get("about", "")),
        _banner(run, status, rules, several=len(judgements) > 1),
        {
            "requirements": ("Requirements", requirements),
            "looks": ("Where to look first", [Highlights(tuple(looks))] if looks else []),
            "figures": ("Figures", drawn if looks else []),
        },
        behind,
        {**ABOUT, "page-trials": f"all {count}: filter, sort, frames" if count else "none"},
        trials=made,
        trials_in="page-trials",
        detectors=tuple(run.detectors),
        worst=tuple(map(trial_id, worst_trials(run, undecided))),
        alarm=alarm if run.damage else "",
        footer=(f"teatbench {run.facts['versions']['teatbench']}, run {run.folder.name}",),
    )


def _pages(
    run: RunRecord,
    status: RunStatus,
    rules: Rules,
    calibration: Calibration,
    baseline: Iterable[Part],
    links: Part | None,
) -> Mapping[str, tuple[str, Chapters]]:
    """The pages behind the first one, by anchor: title, and chapters."""
    limit_mm = rules.visible_within_mm
    trials: Chapters = {
        "trial-list": ("All trials", (*([links] if links else []), trial_table(run))),
        "deviations": ("Deviations and exclusions", chain(deviation_parts(run), fault_parts(run))),
        "blamed": ("What went wrong where", tables.attribution_parts(run, calibration)),
    }
    accuracy: Chapters = {
        "results": ("Results by situation", _result_parts(run, rules)),
        "detectors": ("Detectors compared", detectors_parts(run)),
        "baseline": ("Against the baseline", baseline),
        "accuracy": ("Errors", _accuracy_parts(run, rules, calibration)),
        "poses": ("Poses", pose_parts(run, limit_mm)),
        "latency": ("Time", _latency_parts(run, rules)),
    }
    reference = chain(
        *(truth_parts(run), cameras_parts(run, rules, calibration)),
        gage_parts(run, limit_mm),
        *(arm_parts(run), record_parts(run)),
    )
    return {
        "page-trials": ("Trials", trials),
        "page-accuracy": ("Accuracy", accuracy),
        "page-truth": (
            "Truth and uncertainty",
            {"reference": ("Measurand and reference", reference)},
        ),
        "page-bath": (
            "Bath and interlocks",
            {"environment": ("Bath and environment", bath_parts(run, rules))},
        ),
        "page-provenance": (
            "Provenance",
            {"provenance": ("Who, with what, when", provenance_parts(run, status))},
        ),
    }


def _banner(run: RunRecord, status: RunStatus, rules: Rules, *, several: bool) -> Banner:
    facts = run.facts
    poses, invalid = len({trial.pose for trial in run.counted}), len(run.trials) - len(run.counted)
    left_out = f"; {invalid} more have lost their truth (see Deviations)" if invalid else ""
    each = status.verdicts.items() if status.decided and several else ()
    # where others were real
    mixed = ", ".join(facts.get("emulated", ()))
    emulated = f" Emulated, and so no measurement: {mixed}." if mixed else ""
    return Banner(
        kind=facts["kind"],
        verdict=cast(Verdict, status.word),
        tested=(
            f"{', '.join(run.detectors)} "
            f"on {plural(len(run.counted), 'frame set')} of {plural(poses, 'pose')}"
            f"{left_out}.{emulated}"
        ),
        sentence=status.why,
        confidence=_confidence(run, rules, poses, {*status.verdicts.values()}),
        next_action="\n".join(status.then),
        each=tuple((name, cast(Verdict, word)) for name, word in each),
        urgent=status.unsafe,
    )


ABOUT = {
    "page-accuracy": "errors, rates, poses, time",
    "page-truth": "what is measured, how well",
    "page-provenance": "item, versions, files, command",
}


def _confidence(run: RunRecord, rules: Rules, poses: int, words: set[str]) -> str:
    claims = [
        (r.rate, r.confidence)
        for r in rules.requirements
        if isinstance(r, ErrorRequirement | SuccessRequirement)
    ]
    if not claims:
        return f"{plural(poses, 'pose')}."
    rate, confidence = claims[0]
    needed = zero_failure_n(rate, confidence)
    sure = f"one-sided {100 * confidence:g} % confidence"
    if not poses:
        without = f"{needed} without a failure would show {100 * rate:g} % with {sure}."
        return f"No pose was tried; {without}"
    if not any(trial.truth for trial in run.counted):
        they = "it shows" if poses == 1 else "they show"
        none = f"{plural(poses, 'pose', 'has')} no truth"
        return f"{none}: {they} nothing of how well a detector finds teats."
    best = (1.0 - confidence) ** (1.0 / poses)
    many = plural(poses, "pose")
    if words == {"not met"}:  # what another detector shows depends on how many there are
        tried = plural(poses, "pose", "was")
        message = f"{tried} tried: what failed in them shows what is not met, however few they are."
    else:
        message = f"{many} without a failure would show a success rate of at least"
        message += f" {100 * best:.1f} %, with {sure}."
    if poses < needed and len(words) < 2:  # each of several says how many it misses
        message += f" To show {100 * rate:g} % takes {needed} poses without a failure."
    if (known_mm := tables.truth_known_mm(run)) is not None:
        message += f" The truth is known to {known_mm:.2f} mm in 95 %."
    if unchecked := run.facts.get(UNCHECKED_FACT):
        message += f" Cameras {unchecked}, so an error may be theirs."
    return message


def _result_parts(run: RunRecord, rules: Rules) -> Iterator[Part]:
    published = tables.published(rules)
    names = tables.situations(run)
    theirs = [published[name].found if name in published else None for name in names]
    called = [*map(spoken, names)]
    for detector, who in places_of(run.detectors).items():
        counts = [scored(run, detector, name).counts for name in names]
        found, visible = [c.matched for c in counts], [c.visible for c in counts]
        each = zip(called, found, visible, strict=True)
        alt = "; ".join(f"{name}: {k} of {n}" for name, k, n in each) or "not measured"
        name = f"found-{id_of(detector)}"
        svg = found_bars(called, found, visible, theirs, who=who, name=name)
        yield Figure(svg, f"Teats found by {detector}, beside the thesis's own count", alt)
        yield tables.rates(run, detector)
        listed = [tables.found_by_situation(run, detector, published)]
        if len(names) > 1:
            listed.append(tables.rates_by_situation(run, detector))
        yield Fold(f"Counts and rates of each situation, {detector}", tuple(listed))


def _figures(run: RunRecord, rules: Rules, calibration: Calibration) -> Iterator[Part]:
    """The first page's figures: errors, outcomes, depth against lateral error, and the bath."""
    limit_mm, names = rules.visible_within_mm, tables.situations(run)
    called = [*map(spoken, names)]
    pools = {of: [scored(run, of, name) for name in names] for of in run.detectors}
    errors = {
        detector: [np.linalg.norm(pool.errors_mm, axis=1) for pool in each]
        for detector, each in pools.items()
    }
    links = {detector: [_links(run, detector, name) for name in names] for detector in pools}
    every = np.concatenate([one for each in errors.values() for one in each])
    yield Figure(
        error_strips(called, errors, limit_mm, links=links),
        "Error of each teat end found; each point opens its trial",
        f"{int((every <= limit_mm).sum())} of {len(every)} teat ends within {limit_mm:g} mm",
    )
    outcomes = {
        detector: [(pool.counts.matched, pool.counts.missed, pool.counts.false) for pool in each]
        for detector, each in pools.items()
    }
    sums = {name: map(sum, zip(*each, strict=True)) for name, each in outcomes.items()}
    alt = "; ".join(f"{name}: {' · '.join(map(str, each))}" for name, each in sums.items())
    yield Figure(outcome_bars(called, outcomes), "Teats found · missed · false answers", alt)
    camera_from_world = calibration.world_from_right.inverse().R
    for detector, who in places_of(run.detectors).items():
        errors_mm = scored(run, detector).errors_mm
        camera = errors_mm @ camera_from_world.T
        lateral = np.copysign(np.hypot(camera[:, 0], camera[:, 1]), camera[:, 0])
        svg = error_scatter(
            *(lateral, camera[:, 2], limit_mm),
            accept_mm=_accepted_mm(run, rules, detector),
            links=_links(run, detector),
            who=who,
            name=f"scatter-{id_of(detector)}",
        )
        caption = f"Depth error against lateral error, {detector}"
        yield Figure(svg, caption, plural(len(errors_mm), "point"))
    yield from sparkline(run, rules)


def _links(run: RunRecord, detector: str, situation: str | None = None) -> list[str]:
    """The trial of each error, in the order of `scored`."""
    return [
        f"#{trial_id(trial)}"
        for trial in scored_trials(run, detector, situation)
        for _ in trial.scores[detector].errors_mm
    ]


def _accuracy_parts(run: RunRecord, rules: Rules, calibration: Calibration) -> Iterator[Part]:
    limit_mm = rules.visible_within_mm
    names = tables.situations(run)
    camera_from_world = calibration.world_from_right.inverse().R
    for detector, who in places_of(run.detectors).items():
        pool, name = scored(run, detector), id_of(detector)
        radial = np.linalg.norm(pool.errors_mm, axis=1)
        accept_mm = _accepted_mm(run, rules, detector)
        bars = f"histogram-{name}"
        svg = error_histogram(radial, limit_mm, accept_mm=accept_mm, who=who, name=bars)
        alt = f"{int((radial <= limit_mm).sum())} of {len(radial)} within the limit"
        yield Figure(svg, f"Distance to the teat end, {detector}", alt)
        errors = [scored(run, detector, situation).errors_mm for situation in names]
        called = [*map(spoken, names)]
        svg = per_axis_errors(called, errors, limit_mm, who=who, name=f"axes-{name}")
        caption = f"Errors along the world's axes by situation, {detector}"
        yield Figure(svg, caption, "strips of signed errors", wide=True)
        title = f"By axis, situation and teat in figures, and tolerance limits, {detector}"
        yield Fold(title, tuple(accuracy_tables(run, detector, limit_mm, camera_from_world)))
        yield from spread_parts(run, detector, limit_mm, camera_from_world)
    yield from limit_parts(run, calibration)


def _accepted_mm(run: RunRecord, rules: Rules, detector: str) -> float | None:
    """The acceptance limit of the error's requirement, where the figures show the same limit."""
    u_mm = truth_u_mm([run], scored(run, detector), detector)
    limits = [rule.limit_mm for rule in rules.requirements if isinstance(rule, ErrorRequirement)]
    if u_mm is None or rules.visible_within_mm not in limits:
        return None
    return acceptance_limit_mm(rules.visible_within_mm, u_mm)


def _latency_parts(run: RunRecord, rules: Rules) -> Iterator[Part]:
    limits = sorted({r.limit_s for r in rules.requirements if isinstance(r, TimeRequirement)})
    rows = []
    for detector, who in places_of(run.detectors).items():
        times = latency_of(run, detector)
        seconds = times.seconds
        svg = latency_strip(seconds, limits, who=who, name=f"latency-{id_of(detector)}")
        yield Figure(svg, f"Detection time, {detector}", f"{len(seconds)} detections")
        if times.starved:
            yield Paragraph(f"{detector}: {times.starved}", tone="warn")
        quantiles = (*map(times.percentile_s, (50, 95, 99)), max(seconds, default=None))
        first = (max(times.cold_s, default=None), times.start_up_s)
        over = [f"{sum(s > edge for s in seconds)} of {len(seconds)}" for edge in (1.0, 2.0)]
        rows.append((detector, len(seconds), *quantiles, *first, *over, failures_text(times)))
    yield table("times", rows, latency_rule=LATENCY_RULE)


ALLOWED = {  # what a camera's identity notes where the rig file allows it
    AUTOMATIC: "The rig file lets cameras adjust themselves (auto = true): trials may differ by it",
    UNSEEN_SIZE: "The rig file allows streams whose picture size may change unnoticed (try)",
}
FAULTS = {
    "camera faults": "Frames that were refused and taken again",
    "retries": "Asks that were repeated",
}
UNKNOWN_AGE = "Its age is not known, so it is not checked."
LONGEST_VALUE = 120  # of a list of names and values, in characters
MOST_EVENTS = 60  # at either end
FILES = {
    SCRIPT: "the trials and the rules, as used",
    RULES: "the rules, as used",
    "rig.toml": "the rig, as used",
    "calibration.toml": "the calibration, as used",
}
BESIDE = {
    "../run.sqlite": "every reading, touch, detection, score and event; its digest stands above",
    "trials.csv": "a line a trial and detector",
    "run.json": "facts, verdicts and scores",
    "junit.xml": "a test case a requirement",
}


def _configured(title: str, entries: Mapping[str, object]) -> Iterator[Part]:
    """Names and values; what is a program's configuration rather than a word is folded."""
    entries = {key.replace("_", " "): value for key, value in entries.items()}
    texts = {key: value if isinstance(value, str) else str(value) for key, value in entries.items()}
    raw = {key: text for key, text in texts.items() if len(text) > LONGEST_VALUE}
    yield key_values(title, {key: entries[key] for key in texts if key not in raw})
    if raw:
        codes = tuple(Code(key, text) for key, text in raw.items())
        yield Fold(f"Raw configuration: {title.partition(': ')[2]}", codes)


def provenance_parts(run: RunRecord, status: RunStatus) -> Iterator[Part]:
    """Who was tested, with what, when, and by which data."""
    facts, head = run.facts, run.head
    chain = {"record's digest": "none: the bench that wrote the record made no chain"}
    if head is not None and head.number:
        chain = {
            "record's chain": f"{head.number} links",
            "record's digest": head.wall_digest,
            "record's digest without real time (repeats with the seed)": head.digest,
            "whether the record is still so": f"teatbench store check {in_command(run.folder)}",
        }
    for name, item in facts["items"].items():
        yield from _configured(f"Item under test: {name}", item)
    at_end = {f"{one.name} at the end": one for one in status.instruments}
    entries = {
        "folder": run.folder.name,
        "state": status.state.value,
        "started": facts["wall_started"],
        "ended": facts.get("wall_ended"),
        **{name: one.text.removeprefix(f"{one.name}: ") for name, one in at_end.items()},
        **{name: facts.get(name) for name in ("seed", "rig", "script")},
        **{f"version, {name}": version for name, version in facts["versions"].items()},
        "bench's commit": facts.get("commit") or "not known",
        **chain,
    }
    yield key_values("Bench and run", entries)
    for name, identity in facts.get("identities", {}).items():
        yield from _configured(f"Instrument: {name}", identity)
    # each file that the run used, with its checksum now; frames are in the record's chain
    rows = [
        (Cell(name, href=f"../{name}"), what, Cell(sha256_of(run.folder / name), mono=True))
        for name, what in FILES.items()
        if (run.folder / name).is_file()
    ]
    frames = sum(len(trial.frames) for trial in run.trials)
    note = (
        f"At the start that of the calibration was {run.facts['calibration_sha256']}. The record"
        f" has the SHA-256 of every picture of frames and stages ({frames})."
    )
    yield table("files", rows, note=note)
    links = {
        what: Cell(path.removeprefix("../"), href=path)
        for path, what in BESIDE.items()
        if not path.startswith("..") or (run.folder / path.removeprefix("../")).is_file()
    }
    yield key_values("Raw data and exports", links)
    yield Code("The command that repeats it", str(facts["command"]))
    message = []
    for event in run.events:
        time = "" if event["t_s"] is None else f"{event['t_s']:.0f} s: "
        message.append(f"{time}{event['kind']}: {event['text']}")
    if (more := len(message) - 2 * MOST_EVENTS) > 0:
        message[MOST_EVENTS:-MOST_EVENTS] = [f"… {more} more, in run.sqlite …"]
    yield Notes("Events", tuple(message))


def fault_parts(run: RunRecord) -> Iterator[Part]:
    """Frames taken again, requests repeated, and what the rig file allows of cameras."""
    cameras = (run.facts.get("identities") or {}).get("cameras", {})
    for note, title in ALLOWED.items():
        if said := [f"{name}: {who}" for name, who in cameras.items() if note in str(who)]:
            yield Notes(title, tuple(said))
    for fact, title in FAULTS.items():
        if counts := sorted((run.facts.get(fact) or {}).items()):
            yield Notes(title, tuple(f"{name}: {plural(count, 'time')}" for name, count in counts))
    looked = Counter[str]()
    for fact in (fact for fact in run.facts if fact.startswith(FRAMES_FACT)):  # one a session
        looked.update(run.facts[fact])
    # a check that looked at nothing has found nothing
    texts = [
        f"{name}: {plural(count, 'picture')} looked at" if count else f"{name}: not checked"
        for name, count in sorted(looked.items())
    ]
    if texts:
        yield Notes("What the frames were checked for", tuple(texts))


def record_parts(run: RunRecord) -> Iterator[Part]:
    """Who calibrated the cameras, when and with what; nothing where the run has no record."""
    fact = run.facts.get(CALIBRATION_FACT)
    if fact is None:
        return
    if fact["made"] is None:
        emulated = fact["emulated"]
        how = "The emulated cameras are made from it." if emulated else UNKNOWN_AGE
        text = f"The calibration has no record of who made it, when and with what. {how}"
        yield Paragraph(text, tone="plain" if emulated else "warn")
        return
    entries = {
        "made": fact["made"],
        "age": f"{fact['age_days']} days on the day of the run",
        "by": fact["by"] or None,
        "with": fact["with_what"],
        **{f"{name} camera": who for name, who in fact["cameras"].items()},
    }
    yield key_values("Calibration", entries)

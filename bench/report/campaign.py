"""A campaign's page: how often each detector is right in each family, how far off it is, where its
failures lie, and its worst scenes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from math import ceil, floor
from pathlib import Path
from typing import Any

from bench.campaign.chunk import FALSE_SD_MM, WRONG_MM, WRONG_SD, Bench, SceneId
from bench.campaign.numbers import (
    FEWEST,
    MAPPED,
    WORST,
    FailureMap,
    FailureTrend,
    FamilyRate,
    Numbers,
    campaign_numbers,
)
from bench.campaign.plan import CampaignPlan
from bench.report.chapters import Chapters, page_of
from bench.report.scenes import draw_again, scene_parts
from bench.report.trials import look_at
from bench.report.wording import NOT_MEASURED, key_values, p_text, table
from bench.scoring.comparison import ALPHA
from bench.scoring.rates import percent
from instruments.world.situations import SITUATIONS, member, spoken
from reports.figures.situations import error_spreads, failure_map, rate_intervals
from reports.page import (
    Banner,
    Cell,
    Figure,
    Highlight,
    Highlights,
    Page,
    Paragraph,
    Part,
    Score,
    Scoreboard,
    TrialPart,
)
from reports.render import write_report
from textfiles.text import in_command, plural

REPORT = "report"
LOOKED_AT = 3  # drawn, and a typical one
ABOUT = {
    "rates": "each family's rate, interval, kinds of failures",
    "worst": "by name, with the command that draws each",
    "depends": "the parameters on which failures depend",
    "sure": "NEES, 95 % regions, ends that are sure and wrong",
    "made": "plan, program, detectors",
}
UNITS = ("mm", "deg", "rad", "k")


def write_campaign_page(
    folder: Path, plan: CampaignPlan, made_by: Mapping[str, str], bench: Bench
) -> Path:
    """Write the campaign's page; ``bench`` draws the scenes to look at. Raises OSError."""
    numbers = campaign_numbers(folder, plan, [one.name for one in bench.detectors])
    looked = _looked_at(folder, numbers, plan, bench)
    return write_report(campaign_page(folder, plan, made_by, numbers, *looked), folder / REPORT)


def campaign_page(
    folder: Path,
    plan: CampaignPlan,
    made_by: Mapping[str, str],
    numbers: Numbers,
    looks: tuple[Highlight, ...] = (),
    parts: tuple[TrialPart, ...] = (),
) -> Page:
    """What came out first, then where to look and the figures; the tables behind folds."""
    drawn = {part.heading: f"#{part.id}" for part in parts}
    asked = {"families": ", ".join(map(spoken, plan.families)), "seed": plan.seed}
    asked |= {"first member": plan.first, "limit": f"{plan.limit_mm:g} mm"}
    if plan.perturbations:
        done = ", ".join(f"{one.name} {one.amount:g}" for one in plan.perturbations)
        asked["perturbations"] = done
    aside = table("aside", numbers.aside.items())
    shown: Chapters = {
        "families": ("What each detector shows", [_scoreboard(numbers, plan)]),
        "aside": ("Scenes set aside", [aside] if numbers.aside else []),
        "looks": ("Where to look first", [Highlights(looks)] if looks else []),
        "figures": ("Figures", _figures(numbers, plan) if numbers.rates else []),
    }
    folded: Chapters = {
        "rates": ("Failures by family", [_rates(numbers, plan)]),
        "worst": ("Worst scenes", [_worst(numbers, folder, drawn)]),
        "depends": ("Failures and parameters", [_depends(numbers)]),
        "sure": ("How sure they are", [_sure(numbers)]),
        "made": ("Made with", [key_values("Plan and program", {**asked, **made_by})]),
    }
    return page_of(
        plan.title or "Campaign",
        "Simulated scenes, scored without instruments",
        _banner(folder, plan, numbers),
        shown,
        folded,
        ABOUT,
        trials=parts,
        trials_in="worst" if parts else "",
        trials_note="Truth is drawn as the cameras see it by the calibration that detectors got.",
        detectors=tuple(numbers.detectors),
        worst=tuple(part.id for part in parts[:LOOKED_AT]),
    )


def _banner(folder: Path, plan: CampaignPlan, numbers: Numbers) -> Banner:
    lines = []
    for name in numbers.detectors:
        rates = list(numbers.of(name).values())
        failures, scenes = sum(r.failures for r in rates), sum(r.scenes for r in rates)
        if not scenes:
            continue
        worst = max(rates, key=lambda one: one.failures / one.scenes if one.scenes else -1.0)
        line = f"{name} was right on {scenes - failures} of {plural(scenes, 'scene')}"
        if failures and failures < scenes and len(rates) > 1:
            line += f"; worst in {spoken(worst.family)} ({worst.failures} of {worst.scenes} failed)"
        lines.append(f"{line}.")
    if numbers.aside:
        lines.append(f"{plural(len(numbers.aside), 'scene')} set aside: the bench could not do it.")
    families = f"{len(numbers.families)} famil{'y' if len(numbers.families) == 1 else 'ies'}"
    most = plural(max((one.scenes for one in numbers.rates), default=0), "simulated scene")
    then = "Run it: nothing has been scored."
    if numbers.rates:
        then = (
            f"'teatbench campaign show {in_command(folder)} SCENE' draws any scene with truth and"
            " answers; tests with hypothesis look for simpler ones (teatbench help testing)."
        )
    return Banner(
        kind="emulated",
        verdict="no verdict",
        tested=f"{', '.join(numbers.detectors)} on {families} of up to {most}.",
        sentence="\n".join(lines) or "Nothing was scored.",
        confidence=(
            "A campaign has no requirement. A scene is right when every visible teat end is found"
            f" within {plan.limit_mm:g} mm and nothing false. Each family has its 95 % interval; a"
            " sum over families weighs them as the plan does."
        ),
        next_action=then,
    )


def _scoreboard(numbers: Numbers, plan: CampaignPlan) -> Scoreboard | Paragraph:
    if not numbers.rates:
        return Paragraph("No scene was scored.", "warn")
    rows: list[tuple[str, str, tuple[Score | None, ...]]] = []
    by_name = {name: numbers.of(name) for name in numbers.detectors}
    for family in numbers.families:
        rates = [each.get(family) for each in by_name.values()]
        scenes = max(one.scenes for one in rates if one)
        scores = tuple(_score(one, plan) if one and one.scenes else None for one in rates)
        rows.append((spoken(family), str(scenes), scores))
    hints = {spoken(name): SITUATIONS[name][0] for name in numbers.families}
    return Scoreboard(
        f"Scenes in which every visible teat end was found within {plan.limit_mm:g} mm and nothing"
        " false; the share shown with 97.5 % confidence (one-sided); teat ends found; false ones",
        numbers.detectors,
        tuple(rows),
        ("Family", "Scenes"),
        hints,
    )


def _score(one: FamilyRate, plan: CampaignPlan) -> Score:
    low, high = plan.interval(one.failures, one.scenes) or (0.0, 1.0)
    good = percent(1.0 - one.failures / one.scenes)
    # in per cent: never more than it is, or never less
    shown = f"at least {floor(1000.0 * (1.0 - high)) / 10:g} %"
    if one.failures == one.scenes:
        shown = f"at most {ceil(1000.0 * (1.0 - low)) / 10:g} %"
    ends = f"{one.found} of {one.visible} ends"
    if one.visible >= 1000:
        ends = f"{percent(one.found / one.visible)} of ends"
    others = {
        "false": one.false_teats,
        "without an answer": one.no_answer,
        "sure and wrong": one.sure_wrong,
    }
    words = (f"{count} {what}" for what, count in others.items() if count)
    return Score("no verdict", good, ", ".join([shown, ends, *words]))


def _figures(numbers: Numbers, plan: CampaignPlan) -> Iterator[Figure]:
    names = [spoken(name) for name in numbers.families]
    by_name = {name: numbers.of(name) for name in numbers.detectors}

    def rate(one: FamilyRate | None) -> tuple[float, float, float] | None:
        span = plan.interval(one.failures, one.scenes) if one else None
        return (one.failures / one.scenes, *span) if one and span else None

    def alt(figures: Mapping[str, Sequence[Any]], said: Callable[[Any], str]) -> str:
        return "; ".join(
            f"{name}, {family}: {NOT_MEASURED if one is None else said(one)}"
            for name, each in figures.items()
            for family, one in zip(names, each, strict=True)
        )

    rates = {name: [rate(of.get(f)) for f in numbers.families] for name, of in by_name.items()}
    yield Figure(
        rate_intervals(names, rates),
        "Failure rates with 95 % intervals, two-sided. Intervals that overlap much don't separate"
        " two detectors; 'teatbench campaign compare' does, scene by scene.",
        alt(rates, lambda one: percent(one[0])),
    )
    spreads = {
        name: [getattr(of.get(family), "spread_mm", None) for family in numbers.families]
        for name, of in by_name.items()
    }
    yield Figure(
        error_spreads(names, spreads, plan.limit_mm),
        "Each scene's largest error of a found teat end: median, the middle half (thick) and 90 %"
        " (thin).",
        alt(spreads, lambda one: f"median {one[2]:.2f} mm"),
    )
    for number, each in enumerate(numbers.maps, 1):
        yield _map_figure(each, number, plan)


def _map_figure(one: FailureMap, number: int, plan: CampaignPlan) -> Figure:
    first, second = one.parameters
    ranges = [_range(each, plan.first) for each in one.parameters]
    labels = (_label(first.name, ranges[0]), _label(second.name, ranges[1]))
    x, y = (known or (0.0, 1.0) for known in ranges)
    svg = failure_map(labels, (x, y), one.scenes, one.failures, name=f"failure-map-{number}")
    name = _spoken(second.name)
    chance = f" That of {name} may be chance." if second.p_value >= ALPHA else ""
    failed = sum(map(sum, one.failures))
    caption = (
        f"{first.detector}, {spoken(first.family)}: share of scenes that failed over the two"
        f" parameters on which failures depend most.{chance}"
    )
    alt = f"{caption} {failed} of {plural(sum(map(sum, one.scenes)), 'scene')} failed."
    return Figure(svg, caption, alt)


def _range(parameter: FailureTrend, first: int) -> tuple[float, float] | None:
    """The parameter's range, where all members have the same."""
    known = set()
    for seed in range(first, first + 40):
        found = member(parameter.family, seed)[1].get(parameter.name)
        if found:
            known.add((found.low, found.high))
    return known.pop() if len(known) == 1 else None


def _spoken(name: str) -> str:
    """``arm_y_mm_2`` as `arm y (mm), 2nd`."""
    words = name.split("_")
    again = words.pop() if words[-1].isdecimal() else ""
    unit = words.pop() if words[-1] in UNITS else ""
    text = " ".join(words)
    text += f", number {again}" if again else ""
    return f"{text} ({unit.replace('k', 'K')})" if unit else text


def _label(name: str, known: tuple[float, float] | None) -> str:
    return _spoken(name) if known else f"{_spoken(name).partition(' (')[0]}, share of its range"


def _looked_at(
    folder: Path, numbers: Numbers, plan: CampaignPlan, bench: Bench
) -> tuple[tuple[Highlight, ...], tuple[TrialPart, ...]]:
    """The worst scenes, each detector's in turn, and a typical one of the first, drawn again."""
    why: dict[SceneId, str] = {}
    several = len(numbers.detectors) > 1
    for nth, word in enumerate(("Worst", "Second worst", "Third worst")):
        for name, rows in numbers.worst.items():
            of = [SceneId(str(family), int(str(number))) for family, number, *_ in rows]
            new = [scene for scene in of if scene not in why]
            if len(of) > nth and new and len(why) < max(LOOKED_AT, len(numbers.detectors)):
                why[new[0]] = f"{word} of {name}" if several else word
    if numbers.typical and numbers.typical not in why:
        name = numbers.detectors[0]
        why[numbers.typical] = f"Typical of {name}" if several else "Typical"
    run, stated = draw_again(bench, list(why), folder, plan.title)
    parts = tuple(scene_parts(run, stated, folder / REPORT))
    looks = tuple(
        replace(look_at(trial, reason, part, stated), heading=trial.id)
        for trial, reason, part in zip(run.trials, why.values(), parts, strict=True)
    )
    return looks, parts


def _rates(numbers: Numbers, plan: CampaignPlan) -> Part:
    rows = []
    for rate in numbers.rates:
        span = plan.interval(rate.failures, rate.scenes)
        share = percent(rate.failures / rate.scenes) if rate.scenes else None
        between = span and f"{100 * span[0]:.2f} to {100 * span[1]:.2f} %"
        counts = (rate.no_answer, rate.false, rate.missed, rate.error)
        mm = (rate.spread_mm[2], rate.spread_mm[4]) if rate.spread_mm else (None, None)
        who = (spoken(rate.family), rate.detector, rate.scenes, rate.failures)
        rows.append((*who, share, between, *counts, *mm))
    if not rows:
        return Paragraph("No scene was scored.", "warn")
    how = "exact (Clopper and Pearson)"
    if plan.half_width:
        how = "a confidence sequence, which holds at every look"
    return table("families", rows, searchable=len(rows) > 10, how=how)


def _worst(numbers: Numbers, folder: Path, drawn: Mapping[str, str]) -> Part:
    rows = []
    for each in numbers.worst.values():
        for family, number, detector, failure, found, visible, false, sure, max_mm in each:
            name = SceneId(str(family), int(str(number))).name
            command = f"teatbench campaign show {in_command(folder)} {name}"
            counts = f"{found} of {visible}", false, sure, max_mm
            shown = Cell(name, href=drawn.get(name, ""))
            rows.append((shown, detector, failure, *counts, Cell(command, mono=True)))
    if not rows:
        return Paragraph("No scene failed.")
    return table("worst_scenes", rows, worst=WORST)


def _depends(numbers: Numbers) -> Part:
    shown: dict[tuple[str, str], list[FailureTrend]] = defaultdict(list)
    for one in numbers.parameters:
        if len(shown[one.family, one.detector]) < 2:
            shown[one.family, one.detector].append(one)
    rows = [
        (
            spoken(one.family),
            one.detector,
            _spoken(one.name),
            *(f"{percent(f / n)} of {n}" for f, n in one.quarters),
            p_text(one.p_value),
        )
        for each in shown.values()
        for one in each
    ]
    if not rows:
        return Paragraph(
            f"No family has {FEWEST} failures and {FEWEST} successes of one detector, from which"
            " their parameters could be compared."
        )
    return table("parameters", rows, searchable=len(rows) > 10, mapped=MAPPED)


def _sure(numbers: Numbers) -> Part:
    rows = []
    for one in numbers.rates:
        share = percent(one.inside / one.stated) if one.stated else None
        wrong = Cell(str(one.sure_wrong), "bad" if one.sure_wrong else "plain")
        figures = (one.found, one.stated, share, one.nees, wrong)
        rows.append((spoken(one.family), one.detector, *figures))
    limits: dict[str, Any] = {
        "wrong_mm": WRONG_MM,
        "wrong_sd": WRONG_SD,
        "false_sd_mm": FALSE_SD_MM,
    }
    return table("stated_sds", rows, searchable=len(rows) > 10, **limits)

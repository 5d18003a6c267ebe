"""The commands of campaigns: many simulated scenes, scored without instruments."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

import bench
from bench.cli.arguments import CODES, complain, print_json
from bench.config import ConfigError

# flag -> key of a plan, in its order
SAME = ("first", "seed", "rig", "calibration", "limit_mm", "chunk_scenes")
FLAGS = {"family": "families", "scenes": "scenes", "half_width": "half_width"}
FLAGS |= {"detector": "detectors", **{name: name for name in SAME}, "perturb": "perturbations"}


def run(given: argparse.Namespace) -> int:
    from bench.cli.terminal import working

    plan, how = _plan(given), {"workers": given.workers, "dask": given.dask}
    try:
        with working("campaign", pace="scenes") as shown:
            how |= {"progress": lambda status: shown(*_progress(status)), "say": shown.say}
            found = bench.run_campaign(plan, given.out, **how)
    except bench.PoolError as error:
        return complain(f"{error} The same command goes on where it stopped.", CODES.fault)
    return _print_result(given, found)


def _progress(status: Any) -> tuple[int, int, str]:
    """Done, of how many, and what failed."""
    failed = ", ".join(f"{name} {count}" for name, count in sorted(status.failures.items()))
    aside = f"; set aside {status.aside}" if status.aside else ""
    return status.done, status.planned, f"failures: {failed or 'none yet'}{aside}"


def show(given: argparse.Namespace) -> None:
    page, outcomes = bench.show_scenes(given.folder, given.scene)
    print(plain_table(["scene", "detector", "outcome"], [list(one) for one in outcomes]))
    print(f"Page: {page}")


def compare(given: argparse.Namespace) -> int:
    from bench.cli.store import print_comparisons
    from bench.cli.terminal import working

    names = ("margin_mm", "margin_rate", "confidence")
    how = {name: getattr(given, name) for name in names}
    with working("comparing the campaigns"):
        found = bench.compare_campaigns(given.folder, given.detector, **how)
    return print_comparisons(given, found)


def chunk(given: argparse.Namespace) -> int:
    plan = bench.make_plan(given.plan)
    if given.number is None:
        print(plan.chunk_count)
        return CODES.met
    try:
        aside = bench.run_chunk(plan, given.number, given.out or given.plan.parent, say=_say)
    except bench.PoolError as error:
        return complain(str(error), CODES.fault)
    name = plan.chunk(given.number).name
    print(f"{name}: {'was done before' if aside is None else 'done'}")
    return _aside(aside or {})


def query(given: argparse.Namespace) -> None:
    names, rows = bench.query_campaign(given.folder, given.sql)
    if given.json:
        objects = [dict(zip(names, row, strict=True)) for row in rows]
        print_json({"rows": objects}, default=str)
        return
    texts = [["" if value is None else str(value) for value in row] for row in rows]
    print(plain_table(names, texts))


def keep(given: argparse.Namespace) -> None:
    from bench.testing import keep as kept

    frame = kept(given.folder, given.into, given.name)
    print(f"{frame} in {given.into}")


def plain_table(names: list[str], rows: list[list[str]]) -> str:
    """Columns with two blanks between them."""
    widths = [max(map(len, column)) for column in zip(names, *rows, strict=True)]
    lines = (
        "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        for row in (names, *rows)
    )
    return "\n".join(lines)


def _plan(given: argparse.Namespace) -> bench.CampaignPlan:
    """Of the file, or of the flags. Raises ConfigError."""
    asked = ((key, getattr(given, flag)) for flag, key in FLAGS.items())
    flags = {key: value for key, value in asked if value not in (None, [])}
    if given.plan and flags:
        raise ConfigError.plain(
            f"{', '.join(flags)}: both a plan and flags say what is asked for; put it into"
            f" {given.plan}, or leave that out"
        )
    return bench.make_plan(given.plan or flags)


def _say(text: str) -> None:
    complain(text, CODES.met)


def _print_result(given: argparse.Namespace, result: bench.CampaignResult) -> int:
    from bench.scoring.rates import percent

    campaign, status = result.campaign, result.status
    digest, aside, page = result.digest, result.aside, result.page
    spans = list(zip(result.rates, (of or (None, None) for of in result.intervals), strict=True))
    if given.json:
        keys = (
            *("family", "detector", "scenes", "failures", "visible", "found", "false_teats"),
            *("sure_wrong", "stated", "inside", "nees"),
        )
        found: dict[str, Any] = {
            "digest": digest,
            "scenes": status.done,
            "set_aside": aside,
            "rates": [
                {**{key: getattr(rate, key) for key in keys}, "low": low, "high": high}
                for rate, (low, high) in spans
            ],
            "plan": str(campaign.folder / "plan.toml"),
            "report": str(page),
        }
        print_json(found)
    else:
        heads = ["family", "detector", "scenes", "failures", "rate", "95 % interval, two-sided"]
        rows = [
            [
                *(rate.family, rate.detector, str(rate.scenes), str(rate.failures)),
                percent(rate.failures / rate.scenes) if rate.scenes else "not measured",
                "" if low is None or high is None else f"{100 * low:.2f} to {100 * high:.2f} %",
            ]
            for rate, (low, high) in spans
        ]
        print(f"{plain_table(heads, rows)}\ndigest: {digest}\nReport: {page}")
    if result.unlike:
        return complain(result.unlike, CODES.fault)
    return _aside(aside)


def _aside(scenes: Mapping[str, str]) -> int:
    """Name what was set aside; gives back the exit code."""
    for name, why in scenes.items():
        complain(f"scene {name} was set aside: {why}", CODES.inconclusive)
    return CODES.inconclusive if scenes else CODES.met

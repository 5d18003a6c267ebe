"""The commands of campaigns: many simulated scenes, scored or searched without instruments."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from bench.cli.arguments import CODES, complain, json_of
from bench.config import ConfigError

if TYPE_CHECKING:
    from bench.api.campaigns import CampaignResult
    from bench.campaign.plan import CampaignPlan
    from bench.campaign.run import Status

# flag -> key of a plan, in its order
SAME = ("first", "seed", "rig", "calibration", "limit_mm", "chunk_scenes")
FLAGS = {"family": "families", "scenes": "scenes", "half_width": "half_width"}
FLAGS |= {"detector": "detectors", **{name: name for name in SAME}}


def run(given: argparse.Namespace) -> int:
    from bench import run_campaign

    plan, found = _plan(given), None
    with working_on("campaign") as how:
        found = run_campaign(plan, given.out, workers=given.workers, dask=given.dask, **how)
    return _print_result(given, found) if found else CODES.fault


@contextmanager
def working_on(what: str) -> Iterator[dict[str, Any]]:
    """Arguments of `run_campaign` that show on a bar how far it is. What stops it is printed."""
    from bench.campaign.pool import PoolError
    from bench.cli.terminal import working

    def progress(status: Status) -> tuple[int, int, str]:
        failed = ", ".join(f"{name} {count}" for name, count in sorted(status.failures.items()))
        aside = f"; set aside {status.aside}" if status.aside else ""
        return status.done, status.planned, f"failures: {failed or 'none yet'}{aside}"

    try:
        with working(what, pace="scenes") as shown:
            yield {"progress": lambda status: shown(*progress(status)), "say": shown.say}
    except KeyboardInterrupt:
        complain("interrupted; give the same command again to go on where it stopped", CODES.fault)
    except PoolError as error:
        complain(f"{error} The same command goes on where it stopped.", CODES.fault)


def show(given: argparse.Namespace) -> None:
    from bench.report.scenes import show_scenes

    page, outcomes = show_scenes(given.folder, given.scene)
    print(plain_table(["scene", "detector", "outcome"], [list(one) for one in outcomes]))
    print(f"Page: {page}")


def compare(given: argparse.Namespace) -> int:
    from bench.campaign.comparison import compare_campaigns
    from bench.cli.store import print_comparisons
    from bench.cli.terminal import working

    with working("comparing the campaigns"):
        found = compare_campaigns(
            given.folder,
            given.detector,
            margin_mm=given.margin_mm,
            margin_rate=given.margin_rate,
            confidence=given.confidence,
        )
    return print_comparisons(given, found)


def chunk(given: argparse.Namespace) -> int:
    from bench.api.campaigns import executor, plan_of
    from bench.campaign.chunk import ASIDE, Scene
    from bench.campaign.pool import PoolError
    from bench.campaign.run import Campaign

    plan = plan_of(given.plan)
    if given.number is None:
        print(plan.chunk_count)
        return CODES.met
    if given.number >= plan.chunk_count:
        raise ConfigError.plain(
            f"there is no chunk {given.number}: {given.plan} has {plan.chunk_count}, from 0 to"
            f" {plan.chunk_count - 1}"
        )
    campaign = Campaign(plan, given.out or given.plan.parent)
    campaign.begin()
    try:
        with executor(campaign, 1, None, _say) as made:
            rows = campaign.do_chunk(given.number, made)
    except PoolError as error:
        return complain(str(error), CODES.fault)
    name = plan.chunk(given.number).name
    print(f"{name}: {'was done before' if rows is None else 'done'}")
    pairs = zip(rows.scenes, rows.taken, strict=True) if rows else ()
    return _aside(
        {
            Scene(row.family, row.member).name: one.reason or ""
            for row, one in pairs
            if row.failure == ASIDE
        }
    )


def query(given: argparse.Namespace) -> None:
    from bench.campaign.shards import query as ask

    names, rows = ask(given.folder, given.sql)
    if given.json:
        objects = [dict(zip(names, row, strict=True)) for row in rows]
        print(json_of({"rows": objects}, default=str))
        return
    texts = [["" if value is None else str(value) for value in row] for row in rows]
    print(plain_table(names, texts))


def keep(given: argparse.Namespace) -> None:
    from bench.testing.found import keep as kept

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


def _plan(given: argparse.Namespace) -> CampaignPlan:
    """Of the file, or of the flags. Raises ConfigError."""
    from bench.api.campaigns import plan_of

    flags = {
        key: value
        for flag, key in FLAGS.items()
        if (value := getattr(given, flag, None)) not in (None, [])
    }
    if perturbed := getattr(given, "perturb", None):
        flags["perturbations"] = perturbed
    if given.plan is not None:
        if flags:
            raise ConfigError.plain(
                f"{', '.join(flags)}: both a plan and flags say what is asked for; put it into"
                f" {given.plan}, or leave that out"
            )
        return plan_of(given.plan)
    return plan_of(flags)


def _say(text: str) -> None:
    complain(text, CODES.met)


def _print_result(given: argparse.Namespace, result: CampaignResult) -> int:
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
        print(json_of(found))
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
    if other := campaign.shards.ledger.compare_rows(status.done, digest):
        return complain(other, CODES.fault)
    return _aside(aside)


def _aside(scenes: Mapping[str, str]) -> int:
    """Name what was set aside; gives back the exit code."""
    for name, why in scenes.items():
        complain(f"scene {name} was set aside: {why}", CODES.inconclusive)
    return CODES.inconclusive if scenes else CODES.met

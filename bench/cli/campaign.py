"""The commands of campaigns: many simulated scenes, scored or searched without instruments."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import asdict, astuple
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.cli.arguments import CODES, complain, json_of
from bench.config import ConfigError

if TYPE_CHECKING:
    from bench.campaign.dask_cluster import DaskPool
    from bench.campaign.plan import Plan
    from bench.campaign.run import Campaign, Executor, Status

# flag -> key of a plan, in its order
SAME = ("first", "seed", "rig", "calibration", "limit_mm", "chunk_scenes")
FLAGS = {"family": "families", "scenes": "scenes", "half_width": "half_width"}
FLAGS |= {"detector": "detectors", **{name: name for name in SAME}}


def run(given: argparse.Namespace) -> int:
    from bench.campaign.run import Campaign, locked
    from bench.report.campaign import write_campaign_page
    from bench.results.answers import close_detectors

    campaign = Campaign(_plan(given), given.out)
    with locked(given.out):
        status = finish(campaign, "campaign", given.workers, given.dask)
        if status is None:
            return CODES.fault
        job = campaign.job
        detectors = job.make_detectors()
        try:
            bench = job.bench(job.renderer(), detectors)
            page = write_campaign_page(given.out, campaign.plan, campaign.made_by, bench)
        finally:
            close_detectors(detectors)
        return _print_status(given, campaign, status, page)


def finish(campaign: Campaign, what: str, workers: int | None, dask: str | None) -> Status | None:
    """Do what is left of a campaign; None where it was stopped, which is said."""
    from bench.campaign.pool import PoolError
    from bench.cli.terminal import working

    campaign.begin()
    try:
        with (
            working(what, pace="scenes") as shown,
            executor(campaign, workers, dask, shown.say) as made,
        ):
            return campaign.run(made, lambda status: shown(*progress(status)), shown.say)
    except KeyboardInterrupt:
        complain("interrupted; give the same command again to go on where it stopped", CODES.fault)
    except PoolError as error:
        complain(f"{error} The same command goes on where it stopped.", CODES.fault)
    return None


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
    from bench.campaign.chunk import ASIDE, Scene
    from bench.campaign.plan import read_plan
    from bench.campaign.pool import PoolError
    from bench.campaign.run import Campaign

    plan = read_plan(given.plan)
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


def search(given: argparse.Namespace) -> int:
    from bench.campaign.failures import SEARCH, Searching
    from bench.cli.terminal import working

    searching = Searching(_plan(given), given.out, given.members)
    try:
        with working("search", pace="scenes") as shown:
            found = searching.run(given.rate_scenes, shown)
    except KeyboardInterrupt:
        return complain(
            f"interrupted; {given.out / SEARCH} has the members that were done", CODES.fault
        )
    if given.json:
        rates = [{"family": family, **asdict(rate)} for family, rate in found.rates.items()]
        hits = [asdict(one) for one in found.hits]
        failures = [asdict(one) for one in found.failures]
        print(json_of({"hits": hits, "failures": failures, "rates": rates}))
        return CODES.met
    counts = ["scenes", "failures", "distinct"]
    rows = [[one.family, *map(str, astuple(one)[1:])] for one in found.hits]
    print("Hits of the search (no rate):")
    print(plain_table(["family", "member", *counts], rows))
    rows = [
        [str(one.number), f"{one.family} {one.member}", one.failure, f"{one.grade_mm:.1f}"]
        for one in found.failures
    ]
    if rows:
        print(plain_table(["failure", "member", "kind", "grade (mm)"], rows))
    for family, rate in found.rates.items():
        print(
            f"Rate of {family}, from {rate.scenes} weighted scenes: {rate.value:.2%} (95 %"
            f" interval, two-sided: {rate.low:.2%} to {rate.high:.2%})"
        )
    print(f"Written: {given.out / SEARCH}")
    return CODES.met


def herd(given: argparse.Namespace) -> None:
    from bench.campaign.herd import run_herd, score
    from bench.cli.terminal import working

    with working("herd", pace="visits") as shown:
        found = run_herd(given.out, given.cows, given.visits, given.seed, given.workers, shown)
    one = score(found, given.cows, given.visits)
    if given.json:
        print(json_of({k: v if v == v else None for k, v in asdict(one).items()}))
        return
    print(f"{one.visits} visits with a history; {one.unseen} unseen ends, {one.found} found.")
    rows = [
        ["own history", f"{one.median_mm:.1f}", f"{one.within_5_mm:.1%}"],
        ["the last visit", f"{one.last_median_mm:.1f}", f"{one.last_within_5_mm:.1%}"],
        ["another cow's history", "", f"{one.swapped_within_5_mm:.1%}"],
    ]
    print(plain_table(["by", "median (mm)", "within 5 mm"], rows))
    print(
        f"{one.predicted} predicted, {one.inside:.1%} of them within their 95 % region"
        f" ({one.median_volume_ml:.1f} ml in the median); a teat invented at {one.invented_visits}"
        " visits."
    )
    print(f"Written: {given.out}")


def keep(given: argparse.Namespace) -> None:
    from bench.campaign.failures import keep as kept

    frame = kept(given.folder, given.number, given.into, given.name)
    print(f"{frame} in {given.into}")


def plain_table(names: list[str], rows: list[list[str]]) -> str:
    """Columns with two blanks between them."""
    widths = [max(map(len, column)) for column in zip(names, *rows, strict=True)]
    lines = (
        "  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip()
        for row in (names, *rows)
    )
    return "\n".join(lines)


def _plan(given: argparse.Namespace) -> Plan:
    """Of the file, or of the flags. Raises ConfigError."""
    from pydantic import ValidationError

    from bench.campaign.plan import Plan, read_plan, with_whole_paths

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
        return read_plan(given.plan)
    try:
        return with_whole_paths(Plan.model_validate(flags), Path())
    except ValidationError as error:
        why = "; ".join(str(one["msg"]).removeprefix("Value error, ") for one in error.errors())
        raise ConfigError.plain(why) from error


@contextmanager
def executor(
    campaign: Campaign, workers: int | None, dask: str | None, say: Callable[[str], None]
) -> Iterator[Executor]:
    """Processes of this machine, all its processors for None, or a cluster. Raises ConfigError."""
    from bench.campaign.pool import LocalPool, usable_processors

    pool: LocalPool | DaskPool
    if dask is None:
        pool = LocalPool(campaign.job, workers or usable_processors(), say=say)
    else:
        try:
            from bench.campaign.dask_cluster import DaskPool
        except ImportError as error:
            raise ConfigError.plain(
                f"--dask needs another package: pip install 'teatbench[campaign]' ({error})"
            ) from error
        pool = DaskPool(campaign.job, dask, say=say)
    with closing(pool):
        yield pool


def _say(text: str) -> None:
    complain(text, CODES.met)


def progress(status: Status) -> tuple[int, int, str]:
    """Scenes done, planned, and failures so far, for a bar."""
    failed = ", ".join(f"{name} {count}" for name, count in sorted(status.failures.items()))
    aside = f"; set aside {status.aside}" if status.aside else ""
    return status.done, status.planned, f"failures: {failed or 'none yet'}{aside}"


def _print_status(given: argparse.Namespace, campaign: Campaign, status: Status, page: Path) -> int:
    from bench.campaign.numbers import family_rates, scenes_aside
    from bench.scoring.rates import percent

    with campaign.shards.connect() as db:
        rates, aside = family_rates(db), scenes_aside(db)
    of = campaign.plan.interval
    spans = [(rate, of(rate.failures, rate.scenes) or (None, None)) for rate in rates]
    digest = campaign.shards.digest()
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

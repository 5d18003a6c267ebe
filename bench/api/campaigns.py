"""A campaign: detectors scored on many simulated scenes, in a folder that can be gone on with."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from bench.campaign.chunk import ASIDE, Scene
from bench.campaign.plan import CampaignPlan, read_plan, with_whole_paths
from bench.campaign.run import Campaign, Executor, locked
from bench.campaign.run import Status as Status
from bench.config import ConfigError

if TYPE_CHECKING:
    from bench.campaign.dask_cluster import DaskPool
    from bench.campaign.numbers import FamilyRate
    from bench.campaign.pool import LocalPool

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class CampaignResult:
    """What came of a campaign: ``rates`` by family and detector, each with its 95 % interval in
    ``intervals``; scenes set ``aside`` with the reason; ``page``: its report; ``digest`` of all
    rows, and ``unlike``: says so where as many scenes had another one before.
    """

    campaign: Campaign
    status: Status
    rates: tuple[FamilyRate, ...]
    intervals: tuple[tuple[float, float] | None, ...]
    aside: Mapping[str, str]
    digest: str
    page: Path
    unlike: str = ""


def plan_of(plan: CampaignPlan | Path | str | Mapping[str, Any]) -> CampaignPlan:
    """A plan of its file, or of its keys (docs/campaigns.md). Raises ConfigError."""
    if isinstance(plan, CampaignPlan):
        return plan
    if isinstance(plan, str | Path):
        return read_plan(Path(plan))
    try:
        return with_whole_paths(CampaignPlan.model_validate(plan), Path())
    except ValidationError as error:
        why = "; ".join(str(one["msg"]).removeprefix("Value error, ") for one in error.errors())
        raise ConfigError.plain(why) from error


@contextmanager
def executor(
    campaign: Campaign, workers: int | None, dask: str | None, say: Say
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


def finish(
    campaign: Campaign,
    *,
    workers: int | None = None,
    dask: str | None = None,
    progress: Callable[[Status], None] = lambda _: None,
    say: Say = lambda _: None,
) -> Status:
    """Do what is left of a campaign. Raises PoolError where no worker can be started."""
    campaign.begin()
    with executor(campaign, workers, dask, say) as made:
        return campaign.run(made, progress, say)


def run_campaign(
    plan: CampaignPlan | Path | str | Mapping[str, Any],
    out: Path | str,
    *,
    workers: int | None = None,
    dask: str | None = None,
    progress: Callable[[Status], None] = lambda _: None,
    say: Say = lambda _: None,
) -> CampaignResult:
    """Run a campaign in the folder ``out``, or go on with it, and write its page: `teatbench
    campaign run`. ``plan``: a file, or its keys (``{"families": ("ideal",), "scenes": 50}``).
    ``workers``: processes. Raises ConfigError, PoolError.
    """
    from bench.campaign.numbers import family_rates, scenes_aside
    from bench.report.campaign import write_campaign_page
    from bench.results.answers import close_detectors

    folder = Path(out)
    campaign = Campaign(plan_of(plan), folder)
    with locked(folder):
        status = finish(campaign, workers=workers, dask=dask, progress=progress, say=say)
        job = campaign.job
        detectors = job.make_detectors()
        try:
            bench = job.bench(job.renderer(), detectors)
            page = write_campaign_page(folder, campaign.plan, campaign.made_by, bench)
        finally:
            close_detectors(detectors)
        with campaign.shards.connect() as db:
            rates, aside = tuple(family_rates(db)), scenes_aside(db)
        spans = tuple(campaign.plan.interval(rate.failures, rate.scenes) for rate in rates)
        digest = campaign.shards.digest()
        unlike = campaign.shards.ledger.compare_rows(status.done, digest)
        return CampaignResult(campaign, status, rates, spans, aside, digest, page, unlike)


def run_chunk(
    plan: CampaignPlan, number: int, out: Path | str, *, say: Say = lambda _: None
) -> dict[str, str] | None:
    """Do one chunk of a campaign, as a batch system gives them out: `teatbench campaign chunk`. The
    scenes set aside, each with the reason; None where it was done before. Raises ConfigError,
    PoolError.
    """
    if not 0 <= number < plan.chunk_count:
        last = plan.chunk_count - 1
        raise ConfigError.plain(
            f"there is no chunk {number}: there are {last + 1}, from 0 to {last}"
        )
    campaign = Campaign(plan, Path(out))
    campaign.begin()
    with executor(campaign, 1, None, say) as made:
        rows = campaign.do_chunk(number, made)
    if rows is None:
        return None
    return {
        Scene(row.family, row.member).name: one.reason or ""
        for row, one in zip(rows.scenes, rows.taken, strict=True)
        if row.failure == ASIDE
    }

"""A campaign: detectors scored on many simulated scenes, in a folder that can be gone on with."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bench.campaign.plan import CampaignPlan, make_plan
from bench.campaign.pool import Say
from bench.campaign.run import Campaign, CampaignStatus, executor, locked
from bench.config import check_within
from textfiles.bounds import COUNT

if TYPE_CHECKING:
    from bench.campaign.numbers import FamilyRate


@dataclass(frozen=True, slots=True, eq=False)
class CampaignResult:
    """What came of a campaign: ``rates`` by family and detector, each with its 95 % interval in
    ``intervals``; scenes set ``aside`` with the reason; ``page``: its report; ``digest`` of all
    rows, and ``unlike``: says so where as many scenes had another one before.
    """

    campaign: Campaign
    status: CampaignStatus
    rates: tuple[FamilyRate, ...]
    intervals: tuple[tuple[float, float] | None, ...]
    aside: Mapping[str, str]
    digest: str
    page: Path
    unlike: str = ""


def run_campaign(
    plan: CampaignPlan | Path | str | Mapping[str, Any],
    out: Path | str,
    *,
    workers: int | None = None,
    dask: str | None = None,
    progress: Callable[[CampaignStatus], None] = lambda _: None,
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
    check_within(COUNT, workers=workers)
    campaign = Campaign(make_plan(plan), folder)
    with locked(folder):
        campaign.begin()
        job = campaign.job
        with executor(job, workers, dask, say) as made:
            status = campaign.run(made, progress, say)
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

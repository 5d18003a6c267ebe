"""A campaign's page from a million rows: processor seconds, and bytes a scene and detector. Printed,
not asserted. The rows are made up by the database, with the columns, ranges and shares of real ones.
"""

from __future__ import annotations

from pathlib import Path

import duckdb
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from bench.campaign.ledger import Ledger
from bench.campaign.numbers import campaign_numbers
from bench.campaign.plan import CampaignPlan
from bench.campaign.shards import SHARDS, TABLE, quoted
from bench.report.campaign import campaign_page
from instruments.clock import processor_s
from instruments.world.situations import SITUATIONS, member
from tests.benchmarks.figures import figure

ROWS, DETECTORS, IN_FILE = 1_000_000, ("fused", "thesis"), 1600
OF_FAMILY = ROWS // len(SITUATIONS) // len(DETECTORS)

# fused fails on 1 %, more often where the first parameter is large; thesis on half
MADE_UP = f"""
INSERT INTO rows
SELECT $family, member, detector, 4, 0, 4 - missed, missed, (u < 0.002)::UTINYINT, NULL,
  CASE WHEN missed = 4 THEN NULL ELSE size END, 0.6 * size,
  CASE WHEN u < 0.002 THEN 'false' WHEN missed > 0 THEN 'missed' WHEN size > 5 THEN 'error'
    ELSE '' END,
  md5(member::VARCHAR)[:16], (u < 0.001)::UTINYINT, 4 - missed, 4 - missed, size * size,
  $names, list_transform(range($count), lambda k: (hash(member * 100 + k) % 256)::UTINYINT),
  0.2 + u, 0.1 + u, NULL,
  list_transform(range(4), lambda k: {{'teat': k + 1, 'status': 'found', 'x_mm': size, 'y_mm': 0.1 * k,
    'z_mm': u, 'sd_x_mm': 0.2 * size, 'sd_y_mm': 0.3 + u, 'sd_z_mm': 0.1 + u, 'nees': size * k}})
FROM (
  SELECT *, 0.2 + 0.4 * abs(ln(0.001 + (hash(member, detector, 1) % 100000) / 100000.0)) AS size,
    (hash(member, detector, 2) % 100000) / 100000.0 AS u,
    ((hash(member, detector, 3) % 1000) < CASE WHEN detector = 'thesis' THEN 500
      WHEN hash(member * 100) % 256 > 200 THEN 40 ELSE 3 END)::UTINYINT AS missed
  FROM range({IN_FILE}) AS of_file(nth), unnest({list(DETECTORS)}) AS of_detector(detector),
    LATERAL (SELECT ($first + nth)::INTEGER AS member)
  WHERE $first + nth < {OF_FAMILY}
)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("million")
    write_million(made)
    return made


def write_million(folder: Path) -> None:
    (folder / SHARDS).mkdir()
    for family in SITUATIONS:
        names = [list(member(family, seed)[1]) for seed in range(8)]
        for number, first in enumerate(range(0, OF_FAMILY, IN_FILE)):
            of = names[number % len(names)]
            with duckdb.connect() as db:
                db.execute(f"CREATE TABLE rows ({TABLE})")
                given = {"family": family, "first": first, "names": ",".join(of), "count": len(of)}
                db.execute(MADE_UP, given)
                chunk = 64 * number
                name = f"{SHARDS}/{family}-{chunk:06d}-{chunk + 63:06d}.parquet"
                db.execute(
                    f"COPY (FROM rows ORDER BY family, member, detector) TO {quoted(folder / name)}"
                    " (FORMAT parquet, COMPRESSION zstd, PARQUET_VERSION v2)"
                )
            Ledger(folder).add(name, (folder / name).read_bytes())


def test_page_of_a_million_rows(benchmark: BenchmarkFixture, folder: Path) -> None:
    plan = CampaignPlan(detectors=DETECTORS, scenes=OF_FAMILY, seed=7)
    counted_s: list[float] = []
    drawn_s: list[float] = []

    def page() -> None:
        before_s = processor_s()
        numbers = campaign_numbers(folder, plan)
        between_s = processor_s()
        campaign_page(folder, plan, {}, numbers)
        counted_s.append(between_s - before_s)
        drawn_s.append(processor_s() - between_s)

    benchmark.pedantic(page, rounds=3, iterations=1, warmup_rounds=1)
    figure(benchmark, "numbers of a million rows, processor s", min(counted_s), "below 1")
    figure(benchmark, "the page made of them, processor s", min(drawn_s), "no aim")
    size = sum(path.stat().st_size for path in (folder / SHARDS).iterdir())
    figure(benchmark, "bytes a scene and detector", size / ROWS, "at most 300")

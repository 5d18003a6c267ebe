"""Campaigns: the same rows whoever works on them and in whatever order, whoever is killed; what the
commands write, refuse and answer.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import threading
import tomllib
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from textwrap import dedent

import pytest

from bench.campaign.chunk import ASIDE, ChunkRows
from bench.campaign.plan import CampaignPlan, Chunk, plan_text
from bench.campaign.pool import LocalPool
from bench.campaign.run import Campaign
from bench.campaign.shards import Shards, query_campaign
from bench.rig.scenes import draw, warm
from instruments.world.situations import situation
from tests.bench.campaign.small_campaign import KILLS, Here, module, small_plan
from tests.bench.commands import Said
from tests.bench.forked import Running, begin
from tests.conftest import ROOT
from tests.ports import free_ports
from tests.waiting import within

pytestmark = pytest.mark.slow

# with 50 by hand: 200 scenes
WORKERS = (1, 2, 7) if KILLS else (2,)
WORKER_KILLS = int(KILLS or 1)
KILLED = int(KILLS or 1)  # of a cluster


@pytest.fixture(scope="module")
def plan(tmp_path_factory: pytest.TempPathFactory) -> CampaignPlan:
    return small_plan(tmp_path_factory.mktemp("plan"), scenes=max(8, 2 * WORKER_KILLS))


@pytest.fixture(scope="module")
def plain(plan: CampaignPlan, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The campaign by the plain loop: its folder and digest."""
    folder = tmp_path_factory.mktemp("plain")
    campaign = Campaign(plan, folder)
    campaign.begin()
    campaign.run(Here(campaign.job), lambda _: None)
    return folder, campaign.shards.digest()


class Killing:
    """A pool that gets its chunks shuffled and loses a worker, any of them, after some results."""

    def __init__(self, inner: LocalPool, after: Collection[int]) -> None:
        self._inner, self._after = inner, after
        self._chance, self._hit = random.Random(8), set[int]()

    def results(self, chunks: Iterator[Chunk]) -> Iterator[tuple[Chunk, ChunkRows]]:
        planned = list(chunks)
        shuffled = self._chance.sample(planned, len(planned))
        for number, found in enumerate(self._inner.results(iter(shuffled))):
            whole = [pid for pid in self._inner.pids if pid not in self._hit]
            if number in self._after and whole:
                pid = self._chance.choice(whole)
                self._hit.add(pid)
                os.kill(pid, signal.SIGKILL)
            yield found

    @property
    def hits(self) -> int:
        return len(self._hit)


@pytest.mark.weekly
@pytest.mark.skipif(sys.platform == "win32", reason="sends signals")
@pytest.mark.parametrize("workers", WORKERS)
def test_workers_killed_at_random_change_nothing(
    workers: int, plan: CampaignPlan, plain: tuple[Path, str], tmp_path: Path
) -> None:
    said: list[str] = []
    campaign = Campaign(plan, tmp_path)
    campaign.begin()
    with closing(LocalPool(campaign.job, workers, say=said.append)) as inner:
        killing = Killing(inner, range(WORKER_KILLS))
        status = campaign.run(killing, lambda _: None)
    assert campaign.shards.digest() == plain[1], said
    assert (killing.hits, status.done, status.aside) == (WORKER_KILLS, 2 * plan.most_scenes, 0)
    assert any("ended by SIGKILL" in text for text in said), said
    assert len(campaign.shards.files()) == 2  # merged, a file a family
    assert query_campaign(
        tmp_path, "SELECT count(*), count(DISTINCT (family, member)) FROM scenes"
    )[1] == [(2 * plan.most_scenes,) * 2]


ROGUE = """
import os, time
import numpy as np
from detector.protocol import Detection

DEEDS = {deeds}


class Rogue:
    name, version, parameters = "rogue", "1", {{}}

    def detect(self, frames, calibration):
        deed = DEEDS.get(int(np.sum(frames.left, dtype=np.int64)))
        if deed == "die":
            os._exit(3)
        while deed == "hang":
            time.sleep(0.05)
        return Detection()
"""


def test_a_scene_that_kills_and_one_without_an_end_are_set_aside_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    plan = small_plan(tmp_path, families=("ideal",), scenes=5)
    job = Campaign(plan, tmp_path / "none").job
    renderer = job.renderer()
    sums = [
        int(
            draw(renderer, "ideal", warm(situation("ideal", member)), [7, member]).frames.left.sum()
        )
        for member in (1, 4)
    ]
    package = tmp_path / "site"
    (package / "rogue-1.0.dist-info").mkdir(parents=True)
    deeds = dict(zip(sums, ("die", "hang"), strict=True))
    (package / "rogue.py").write_text(dedent(ROGUE.format(deeds=deeds)), encoding="utf-8")
    (package / "rogue-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: rogue\nVersion: 1.0\n", encoding="utf-8"
    )
    (package / "rogue-1.0.dist-info" / "entry_points.txt").write_text(
        "[teatbench.detectors]\nrogue = rogue:Rogue\n", encoding="utf-8"
    )
    monkeypatch.syspath_prepend(package)
    monkeypatch.setenv("PYTHONPATH", str(package))
    file = tmp_path / "plan.toml"
    file.write_text(
        'families = ["ideal"]\nscenes = 5\nchunk_scenes = 3\nseed = 7\ndetectors = ["rogue"]\n'
        'rig = "rig.toml"\nchunk_limit_s = 4.0\n',
        encoding="utf-8",
    )
    first = said(4, "campaign chunk {} 0 --out {}", file, tmp_path / "out")
    assert first.out == "ideal-000000: done\n"
    assert first.err.count("ended with code 3 at scene ideal-0001") == 3
    assert "scene ideal-0001 was set aside" in first.err
    out = said(4, "campaign run {} --workers 1 --json --out {}", file, tmp_path / "out")
    found = json.loads(out.out)
    assert sorted(found["set_aside"]) == ["ideal-0001", "ideal-0004"]
    assert "ended with code 3" in found["set_aside"]["ideal-0001"]
    assert "no sign of life for 4 s" in found["set_aside"]["ideal-0004"]
    assert all("with this scene alone" in why for why in found["set_aside"].values())
    assert "the scene is tried again alone, in a new process" in out.err
    assert "scene ideal-0004 was set aside" in out.err
    rows = query_campaign(tmp_path / "out", "SELECT member, failure FROM scenes ORDER BY member")[1]
    assert [failure == ASIDE for _, failure in rows] == [False, True, False, False, True]
    assert found["rates"][0]["scenes"] == 3


@pytest.mark.weekly
def test_a_family_stops_when_its_interval_is_tight_enough_whatever_came_first(
    tmp_path: Path,
) -> None:
    # the thesis's detector fails on all of these: tight enough after six
    plan = small_plan(tmp_path, scenes=9, half_width=0.3)
    digests = set()
    for name, order in (("as-planned", list), ("backwards", lambda chunks: chunks[::-1])):
        campaign = Campaign(plan, tmp_path / name)
        campaign.begin()
        status = campaign.run(Here(campaign.job, order), lambda _: None)
        assert (status.done, status.planned) == (12, 12)
        digests.add(campaign.shards.digest())
    assert len(digests) == 1


@pytest.mark.parametrize(
    ("families", "scenes", "in_chunk"), [(1, 40, 10), (2, 1000, 50), (2, 1, 1), (2, 8, 4)]
)
def test_chunks_suit_the_number_of_scenes(families: int, scenes: int, in_chunk: int) -> None:
    names = ("ideal", "overlapping")[:families]
    assert CampaignPlan(families=names, scenes=scenes).chunk_scenes == in_chunk
    asked = CampaignPlan(families=names, scenes=scenes, chunk_scenes=50)
    text = plan_text(asked, {})
    assert CampaignPlan.model_validate(tomllib.loads(text) | {"made_by": {}}) == asked


def test_what_the_commands_write_and_refuse(
    plan: CampaignPlan, plain: tuple[Path, str], tmp_path: Path, said: Said
) -> None:
    folder, digest = plain
    flags = "--family ideal --family overlapping --chunk-scenes 3 --seed 7"
    flags += f" --scenes {plan.most_scenes}"
    line = f"campaign run {flags} --detector {{}} --rig {{}} --out {{}}"
    again = said(0, f"{line} --json", "thesis", plan.rig, folder)  # all is done: no worker starts
    found = json.loads(again.out)
    assert (found["digest"], found["scenes"]) == (digest, 2 * plan.most_scenes)
    assert (folder / "report" / "index.html").is_file()
    assert {rate["scenes"] for rate in found["rates"]} == {8}
    size = sum(file.stat().st_size for file in (folder / "shards").iterdir())
    assert size / (2 * plan.most_scenes) < 1500  # much of it metadata: few scenes a file

    table = said(0, "campaign query {} {}", folder, ["SELECT count(*) AS n FROM teats"]).out
    assert table.split()[0] == "n"
    alone = [sys.executable, "-m", "bench.cli", "campaign", "query"]
    asked = [*alone, str(folder), "SELECT 1 AS one"]
    ended = subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, check=True)
    assert (ended.stdout.split(), ended.stderr) == (["one", "1"], "")
    rows = said(0, "campaign query {} {} --json", folder, ["SELECT * FROM scenes LIMIT 1"]).out
    assert set(json.loads(rows)["rows"][0]) >= {"family", "member", "detector", "failure", "max_mm"}
    assert "SELEC" in said(2, "campaign query {} SELEC", folder).err
    assert "no campaign is there" in said(2, "campaign query {} SELECT", tmp_path).err

    assert "the query is empty" in said(2, "campaign query {} {}", folder, [" "]).err
    assert "a file of this name" in said(2, line, "thesis", plan.rig, plan.rig).err

    shown = said(0, "campaign show {} overlapping-0002", folder)
    assert "overlapping-0002  thesis    " in shown.out
    page = folder / "scenes" / "overlapping-0002" / "index.html"
    assert "Two teats touching" in page.read_text(encoding="utf-8")
    assert (page.parent / "left.png").is_file()
    for name in ("ideal-0099", "ideal", "../x-1"):
        assert "has members 0 to 7 of ideal" in said(2, "campaign show {} {}", folder, name).err
    assert "no campaign is there" in said(2, "campaign show {} ideal-0001", tmp_path).err

    other = said(2, line, "fused", plan.rig, folder).err
    assert "detectors: ['thesis'] there, ['fused'] here" in other
    both = said(2, "campaign run {} --seed 3 --out {}", folder / "plan.toml", tmp_path / "x").err
    assert "both a plan and flags" in both

    own = tmp_path / "own" / "plan.toml"
    own.parent.mkdir()
    own.write_text(plan_text(plan, {}), encoding="utf-8")
    assert "a folder of its own" in said(2, "campaign chunk {} 0", own).err

    assert said(0, "campaign chunk {}", folder / "plan.toml").out == f"{plan.chunk_count}\n"
    assert "was done before" in said(0, "campaign chunk {} 0", folder / "plan.toml").out
    assert "there is no chunk 999" in said(2, "campaign chunk {} 999", folder / "plan.toml").err


@pytest.mark.weekly
@pytest.mark.timeout(420 + 20 * KILLED)  # longer than it waits for an end
def test_a_dask_cluster_makes_the_same_rows_whoever_of_it_is_killed(
    plan: CampaignPlan, plain: tuple[Path, str], tmp_path: Path
) -> None:
    """Worker, scheduler and client are killed in turn; each is started again, as by a person."""
    file, out = tmp_path / "plan.toml", tmp_path / "out"
    quick = plan.model_copy(update={"chunk_limit_s": 5.0})
    file.write_text(plan_text(quick, {}), encoding="utf-8")
    address = f"tcp://127.0.0.1:{free_ports(1)}"
    shards = Shards(out)
    campaign = ("campaign", "run", file, "--dask", address, "--json", "--out", out)
    at = ("--host", "127.0.0.1", "--no-dashboard")
    words: dict[str, tuple[object, ...]] = {
        "scheduler": ("distributed.cli.dask_scheduler", "--port", address.split(":")[-1], *at),
        "worker": ("distributed.cli.dask_worker", address, "--nthreads", 1, "--no-nanny", *at),
        "client": campaign,
    }
    going: dict[str, Running] = {}
    chance, kills = random.Random(6), Counter[str]()

    def ended(enough: int) -> bool:
        for name in words:
            if name not in going or (name != "client" and going[name].poll() is not None):
                if name in going:
                    going[name].communicate()
                client = name == "client"
                started = (
                    begin(campaign, stderr=subprocess.PIPE) if client else module(*words[name])
                )
                going[name] = started
        if (code := going["client"].poll()) not in (None, 0):
            assert code == 3, going["client"].communicate()  # told that it can go on
            del going["client"]
        return code == 0 or len(shards.done()) >= enough

    try:
        for number in range(KILLED):
            # every other time a chunk is waited for: the campaign must not end before
            within(partial(ended, len(shards.done()) + number % 2), "a chunk is done")
            name = ("worker", "scheduler", "client")[number % 3]
            if going["client"].poll() is None:
                threading.Event().wait(chance.uniform(0.0, 2.0 - 1.5 * (number % 2)))
                going[name].kill()
                kills[name] += 1
                going.pop(name).communicate()
        within(partial(ended, sys.maxsize), "the campaign ends")
        told, err = going.pop("client").communicate()
    finally:
        for process in going.values():
            process.kill()
            process.communicate()
    assert json.loads(told)["digest"] == plain[1], err
    assert (json.loads(told)["scenes"], json.loads(told)["set_aside"]) == (2 * plan.most_scenes, {})
    assert kills.total() == KILLED, kills

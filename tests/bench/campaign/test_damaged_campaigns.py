"""A campaign's files after bits were flipped, cuts and edits: what is damaged is done again or
refused, and never used in silence; and a query reaches nothing but the rows.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from errno import ENOSPC
from pathlib import Path
from unittest.mock import patch

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bench.campaign import ledger
from bench.campaign.chunk import CallTime, ChunkRows, SceneRow, TeatRow
from bench.campaign.ledger import LEDGER
from bench.campaign.plan import Chunk
from bench.campaign.run import Campaign, locked, plan_of
from bench.campaign.shards import SHARDS, Shards
from bench.campaign.shards import query_campaign as query
from bench.config import ConfigError
from tests.bench.campaign.small_campaign import small_plan
from tests.bench.commands import Said
from tests.examples import examples

SQL = "SELECT family, member, detector, failure, found, max_mm FROM scenes ORDER BY ALL"


@pytest.fixture(autouse=True)
def no_run_is_under_way(monkeypatch: pytest.MonkeyPatch) -> None:
    """So a file need not be looked at again."""
    monkeypatch.setattr(ledger, "LOOKS", 1)


class Made:
    """An executor whose rows are the same each time."""

    def results(self, chunks: Iterator[Chunk]) -> Iterator[tuple[Chunk, ChunkRows]]:
        for chunk in chunks:
            keys = [(chunk.family, member, "d") for member in chunk.members]
            yield (
                chunk,
                ChunkRows(
                    tuple(
                        SceneRow(*key, 4, 0, 4, 0, 0, 0, 0.1 * key[1], 0.1, "", "") for key in keys
                    ),
                    tuple(TeatRow(*key, 1, "found", 0.1, 0.2, 0.3) for key in keys),
                    (CallTime(0.1, 0.1),) * len(keys),
                ),
            )


def run(folder: Path) -> tuple[Campaign, list[str]]:
    said: list[str] = []
    campaign = Campaign(small_plan(folder.parent, scenes=12), folder)
    campaign.begin()
    status = campaign.run(Made(), lambda _: None, said.append)
    assert status.done == status.planned
    return campaign, said


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sound") / "campaign"
    run(folder)
    return folder


@pytest.fixture(scope="module")
def files(sound: Path) -> list[str]:
    names = [path.relative_to(sound).as_posix() for path in sound.rglob("*") if path.is_file()]
    return sorted(name for name in names if not name.endswith(".lock"))


def damaged(data: bytes, how: str, place: int, bit: int) -> bytes:
    """One bit flipped, or what is behind a place cut off, or bytes put in."""
    at = place % max(1, len(data))
    if how == "flip":
        return data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]
    return data[:at] if how == "cut" else data[:at] + b"\x00 edited" + data[at:]


@pytest.mark.slow
@settings(
    max_examples=examples(8),
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
@given(
    st.integers(0, 99), st.sampled_from(["flip", "cut", "edit"]), st.integers(0), st.integers(0, 7)
)
def test_no_damage_is_used_in_silence(
    sound: Path, files: list[str], which: int, how: str, place: int, bit: int
) -> None:
    wanted, digest = query(sound, SQL), Shards(sound).digest()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "campaign"
        shutil.copytree(sound, folder)
        path = folder / files[which % len(files)]
        data = path.read_bytes()
        path.write_bytes(damaged(data, how, place, bit))
        try:
            plan_of(folder)
            assert query(folder, SQL) == wanted
        except ConfigError:
            pass
        try:
            campaign, _ = run(folder)
        except ConfigError:
            return
        assert campaign.shards.digest() == digest
        assert query(folder, SQL) == wanted


@pytest.mark.slow
def test_rows_that_come_out_otherwise_are_told(sound: Path) -> None:
    campaign, _ = run(sound)
    book, digest = campaign.shards.ledger, campaign.shards.digest()
    assert book.compare_rows(24, digest) == ""
    assert book.compare_rows(24, digest) == ""
    assert "does not repeat itself" in book.compare_rows(24, "0" * 64)


def test_a_file_that_the_ledger_does_not_name_is_refused(sound: Path, tmp_path: Path) -> None:
    folder = tmp_path / "campaign"
    shutil.copytree(sound, folder)
    (shard, *_) = sorted((folder / SHARDS).glob("*.parquet"))
    shutil.copy(shard, shard.with_name("ideal-000099.parquet"))
    with pytest.raises(ConfigError, match="ideal-000099"):
        query(folder, SQL)
    _, said = run(folder)
    assert "ideal-000099" in " ".join(said)
    assert query(folder, SQL) == query(sound, SQL)
    (folder / LEDGER).unlink()
    with pytest.raises(ConfigError, match="not as the campaign wrote it"):
        plan_of(folder)


@pytest.mark.parametrize(
    "sql",
    [
        "COPY scenes TO '{0}/out.csv'",
        "COPY (SELECT 1) TO '{0}/campaign/shards/ideal-000000.parquet' (FORMAT parquet)",
        "SELECT * FROM read_text('{0}/secret.txt')",
        "ATTACH '{0}/other.db'",
        "INSTALL httpfs",
        "SET enable_external_access = true",
        "PRAGMA enable_profiling = 'json'; SET profiling_output = '{0}/p.json'; SELECT 1",
        "SELECT '\ud800'",
        "SELEC",
        "",
        "SELECT * FROM range(2000000)",
    ],
)
def test_a_query_reaches_nothing_but_the_rows(
    sql: str, sound: Path, tmp_path: Path, said: Said
) -> None:
    folder = tmp_path / "campaign"
    shutil.copytree(sound, folder)
    (tmp_path / "secret.txt").write_text("mine", encoding="utf-8")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(ConfigError) as refused:
        query(folder, sql.format(tmp_path))
    assert refused.value
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


def test_a_query_may_ask_for_the_time(sound: Path) -> None:
    _, ((year,),) = query(sound, "SELECT year(now())")
    assert year > 2000
    query(sound, "SELECT now()")


def test_rows_that_a_full_disk_did_not_take_are_missing_not_damaged(
    sound: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(sound, tmp_path / "campaign")
    gone = next((folder / SHARDS).glob("*.parquet"))
    gone.unlink()  # its line in the ledger comes first
    (said,) = run(folder)[1]
    assert f"rows are missing: {SHARDS}/{gone.name} (no room for them, killed " in said


def test_a_campaign_that_has_no_room_for_its_plan_leaves_nothing(tmp_path: Path) -> None:
    plan, folder = small_plan(tmp_path, scenes=12), tmp_path / "campaign"
    full = OSError(ENOSPC, "No space left on device")
    with (
        patch("bench.campaign.run.write_synced", side_effect=full),
        pytest.raises(ConfigError, match="No space left"),
        locked(folder),
    ):
        Campaign(plan, folder).begin()
    assert not folder.exists()

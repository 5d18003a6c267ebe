"""What all rooms' tests share."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.bench.commands import Said

if TYPE_CHECKING:
    from tests.bench.safety.guards import HotBath


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Said:
    """Runs a command that must end with a code; gives back what it wrote."""
    return Said(capsys)


@pytest.fixture(scope="module", autouse=True)
def kept() -> Iterator[None]:
    """A module that adds to the run which this process keeps for all changes what others read."""
    yield
    if small_run := sys.modules.get("tests.bench.small_run"):
        kept, written = (
            {
                one.relative_to(run)
                for one in run.rglob("*")
                if not one.name.startswith("run.sqlite")
            }
            for run in (small_run.KEPT, small_run.WRITTEN)
        )
        assert kept == written


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording that benches in processes of their own play back."""
    from tests.bench.real_rig import record_one

    return record_one(tmp_path_factory.mktemp("frames") / "recording")


@pytest.fixture
def hot(tmp_path: Path) -> Iterator[HotBath]:
    """A bath that heats."""
    from tests.bench.safety.guards import hot_bath

    with hot_bath(tmp_path) as bath:
        yield bath

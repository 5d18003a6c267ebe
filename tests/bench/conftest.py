"""What all rooms' tests share."""

from __future__ import annotations

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

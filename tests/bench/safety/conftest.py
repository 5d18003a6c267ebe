"""What benches in processes of their own play back, and baths that heat."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.bench.safety.guards import HotBath, Measured, hot_bath


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of one frame."""
    from tests.bench.real_rig import record_one

    return record_one(tmp_path_factory.mktemp("frames") / "recording")


@pytest.fixture
def measured(request: pytest.FixtureRequest) -> Measured:
    """Notes how long standby took, for the summary of the tests and their JUnit file."""
    return lambda what, seconds: request.node.user_properties.append(
        (f"s to standby, {what}", round(seconds, 3))
    )


@pytest.fixture
def hot(tmp_path: Path) -> Iterator[HotBath]:
    with hot_bath(tmp_path) as bath:
        yield bath

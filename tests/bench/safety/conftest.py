"""What the tests of safety measure."""

from __future__ import annotations

import pytest

from tests.bench.safety.guards import Measured


@pytest.fixture
def measured(request: pytest.FixtureRequest) -> Measured:
    """Notes how long standby took, for the summary of the tests and their JUnit file."""
    return lambda what, seconds: request.node.user_properties.append(
        (f"s to standby, {what}", round(seconds, 3))
    )

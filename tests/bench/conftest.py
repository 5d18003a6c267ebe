"""What all rooms' tests share."""

from __future__ import annotations

import pytest

from tests.bench.commands import Said


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Said:
    """Runs a command that must end with a code; gives back what it wrote."""
    return Said(capsys)

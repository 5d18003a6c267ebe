"""What the tests of a page in a browser begin with."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from reports.render import write_report
from tests.reports.sample import sample_page

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's page, written."""
    folder = tmp_path_factory.mktemp("report")
    return write_report(sample_page(folder), folder)


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """A browser for the tests of one file."""
    from tests.chromium import launched

    with launched() as running:
        yield running

"""The stand that the bath's tests share; whoever leaves a thread behind fails."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from tests.instruments.bath.devices import Stand


@pytest.fixture
def stand() -> Iterator[Stand]:
    before = threading.active_count()
    with Stand() as stand:
        yield stand
    assert threading.active_count() == before

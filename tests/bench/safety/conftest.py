"""What benches in processes of their own play back."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of one frame, and a server from which benches are forked."""
    from tests.bench.marked_bench import serve  # not on Windows
    from tests.bench.real_rig import record_one

    serve()
    return record_one(tmp_path_factory.mktemp("frames") / "recording")

"""What the stage's tests share: a driver with its emulator, and the bare board. No test may leave a
thread behind.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing

import pytest

from instruments.stage.emulator.store import CLASSIC, GRBL_HAL
from tests.instruments.stage.board import Bench, Board


@pytest.fixture(autouse=True)
def _no_thread_is_left() -> Iterator[None]:
    yield
    assert [
        thread.name
        for thread in threading.enumerate()
        if thread.name in ("stage emulator", "clock")
    ] == []


@pytest.fixture
def make() -> Iterator[Callable[..., Bench]]:
    """Benches with the arguments of `Bench`."""
    with ExitStack() as stack:
        yield lambda *given, **more: stack.enter_context(closing(Bench(*given, **more)))


@pytest.fixture
def make_board() -> Callable[..., Board]:
    """Boards with the arguments of `Board`."""
    return Board


@pytest.fixture(params=[CLASSIC, GRBL_HAL], ids=["grbl", "grblHAL"])
def bench(make: Callable[..., Bench], request: pytest.FixtureRequest) -> Bench:
    return make(dialect=request.param)


@pytest.fixture
def board() -> Board:
    return Board()


@pytest.fixture
def free() -> Board:
    """Unlocked without homing, soft limits off, count 0 in the middle of the table."""
    board = Board({20: 0})
    board.unlock()
    return board

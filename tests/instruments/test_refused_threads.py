"""A system that starts no more threads: what was opened can still be closed."""

from __future__ import annotations

import threading
from contextlib import closing

import pytest

from instruments.clock import VirtualClock
from instruments.listener import Listener
from instruments.stage.emulator.board import StageEmulator


def test_an_emulator_whose_thread_was_refused_can_be_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = VirtualClock()
    listener = Listener(StageEmulator(clock), clock, lock=threading.RLock(), name="stage")
    with closing(listener), monkeypatch.context() as patch:

        def refused(_: threading.Thread) -> None:
            raise RuntimeError("can't start new thread")

        patch.setattr(threading.Thread, "start", refused)
        with pytest.raises(RuntimeError, match="can't start"):
            listener._start(lambda: None)

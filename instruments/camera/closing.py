"""Closes cameras side by side and in bounded time: one that is dead answers no command, and its
library waits for each answer.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

CLOSE_S = 2.0


def close_within(closers: Sequence[Callable[[], object]], seconds: float = CLOSE_S) -> None:
    """Run all at once and wait ``seconds`` at most. Raises the first error."""
    errors: list[BaseException] = []

    def run(closer: Callable[[], object]) -> None:
        try:
            closer()
        except BaseException as error:
            errors.append(error)

    threads = [
        threading.Thread(target=run, args=(closer,), name="closes a camera", daemon=True)
        for closer in closers
    ]
    for thread in threads:
        thread.start()
    end_s = time.monotonic() + seconds
    for thread in threads:
        thread.join(max(0.0, end_s - time.monotonic()))
    if errors:
        raise errors[0]

"""Notifications by apprise: a person is asked, an interlock has tripped, something is not safe, the
run has ended. At most one a minute and kind; an address that fails is reported once and stops
nothing.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from bench.config import ConfigError
from bench.results.status import RunStatus
from bench.run.events import NOT_SAFE, PROMPTED, TRIPPED
from instruments.clock import stopwatch_s

EVERY_S = 60.0  # of real time, between two of a kind
LAST_S = 20.0  # for the last messages, once all is safe
OPTION, HIDDEN = "--notify", "…"
Message = Callable[[], "tuple[str, str] | None"]  # title and text, as things are when it is sent


def text_of(kind: str, status: RunStatus | None) -> tuple[str, str] | None:
    """Title and text of ``status``; None where there is nothing to say any more."""
    if status is None:
        return None
    lines = [status.headline]
    if kind == PROMPTED:
        if not status.asked:
            return None
        lines = [status.asked.text or status.asked.kind, *lines]
    elif kind == TRIPPED:
        lines = [status.tripped, *status.unsafe]
    elif kind == NOT_SAFE:
        lines = [*status.unsafe]
    else:
        by_detector = [f"{name}: {verdict}" for name, verdict in status.verdicts.items()]
        lines += [status.mark, *by_detector, status.why, *status.next]
    where = f" ({status.rig})" if status.rig else ""  # another rig may run the same script
    title = " ".join(f"{status.title}{where}: {kind}".split())  # a mail's subject is one line
    return title, "\n".join(line for line in lines if line)


class Notifier:
    """Sends to ``urls`` on a thread of its own. Raises ConfigError for one unknown to apprise."""

    def __init__(
        self, urls: Sequence[str], warn: Callable[[str], object], every_s: float = EVERY_S
    ) -> None:
        self._servers = [_server(os.path.expandvars(url)) for url in urls]
        self._warn = warn
        self._every_s = every_s
        self._waiting: dict[str, Message] = {}
        self._sent_s: dict[str, float] = {}
        self._failed: set[int] = set()
        self._closing = False
        self._changed = threading.Condition()
        # no daemon, which apprise's own threads would become: Python waits for those without end,
        # and the command (bench/cli/process.py) sees only the others
        self._thread = threading.Thread(target=self._work, name="messages")
        self._thread.start()

    def send(self, kind: str, message: Message) -> None:
        """Send ``message`` as soon as one of this kind may be sent; a later one takes its place."""
        with self._changed:
            self._waiting[kind] = message
            self._changed.notify()

    def close(self) -> None:
        """Send what may be sent now, and end."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(LAST_S)

    def _work(self) -> None:
        while following := self._next():
            kind, message = following
            found = None
            with suppress(Exception):  # of a run that is just ending
                found = message()
            if found:
                self._sent_s[kind] = stopwatch_s()
            for number, server in enumerate(self._servers if found else ()):
                title, body = found or ("", "")
                sent = False
                with suppress(Exception):  # whatever a service's plug-in raises
                    sent = bool(server.notify(title=title, body=body))
                if not sent and number not in self._failed:
                    self._failed.add(number)
                    address = str(server[0].url(privacy=True)).partition("?")[0]  # no secrets in it
                    self._warn(f"no message can be sent to {address}")

    def _next(self) -> tuple[str, Message] | None:
        """The next message that may be sent, with its kind, waited for; None at the end."""
        with self._changed:
            while True:
                left_s = {kind: self._left_s(kind) for kind in self._waiting}
                kind = min(left_s, key=left_s.__getitem__, default=None)
                if kind is not None and left_s[kind] <= 0.0:
                    return kind, self._waiting.pop(kind)
                if self._closing:
                    return None
                self._changed.wait(None if kind is None else left_s[kind])

    def _left_s(self, kind: str) -> float:
        sent_s = self._sent_s.get(kind)
        return 0.0 if sent_s is None else sent_s + self._every_s - stopwatch_s()


def _server(url: str) -> Any:
    try:
        import apprise
    except ImportError as error:
        raise ConfigError.plain(
            f"{OPTION} needs apprise, which isn't installed: pip install 'teatbench[notify]'"
        ) from error
    log = logging.getLogger("apprise")  # what fails is said here
    log.addHandler(logging.NullHandler())
    log.propagate = False
    server = apprise.Apprise()
    if not server.add(url):
        scheme = url.partition("://")[0]
        raise ConfigError.plain(
            f"{OPTION}: no address that apprise knows, which begins with {scheme[:20]!r}. Such as"
            " ntfy://ntfy.sh/TOPIC or mailto://NAME:PASSWORD@example.com."
        )
    return server


@contextmanager
def notifying(
    urls: Sequence[str], warn: Callable[[str], object]
) -> Iterator[Callable[[str, Message], None]]:
    """Gives what takes a kind and its message; nothing is loaded without ``urls``."""
    if not urls:
        yield lambda _kind, _message: None
        return
    notifier = Notifier(urls, warn)
    try:
        yield notifier.send
    finally:
        notifier.close()


def without_secrets(words: Sequence[str]) -> list[str]:
    """A command line without the addresses that it notifies, for the record."""
    kept: list[str] = []
    follows = False
    for word in words:
        name, given, _ = word.partition("=")
        is_it = name.startswith("--n") and OPTION.startswith(name)  # it may be abbreviated
        kept.append(HIDDEN if follows else f"{OPTION}={HIDDEN}" if is_it and given else word)
        follows = is_it and not given
    return kept

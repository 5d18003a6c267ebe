"""A plug-in of pytest that runs files of tests in several processes: `-p tests.workers --workers 8`.

They are forked from one process that has collected all tests. Each process of pytest-xdist collects
for itself, which takes it longer than most files. Only for Linux.
"""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import random
import sys
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import groupby
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import pytest
from _pytest.config import create_terminal_writer

INDEX_BYTES = 2


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--workers", type=int, default=0, help="so many processes, a file at a time")


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Hands out the files in their order, and passes on what the processes report."""
    options = session.config.option
    if not options.workers or options.collectonly or session.testsfailed:
        return None  # pytest's own loop says what could not be collected
    files = [list(items) for _, items in groupby(session.items, lambda item: item.path)]
    session.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]
    # the numbers of all files; whoever reads one has that file
    files_left, fill = os.pipe()
    os.write(fill, b"".join(number.to_bytes(INDEX_BYTES, "big") for number in range(len(files))))
    os.close(fill)
    workers = [Worker(session, number, files, files_left) for number in range(options.workers)]
    left = {item.nodeid for item in session.items}
    try:
        while at_work := [worker for worker in workers if worker.works]:
            # what a test has left behind may hold the end of a dead worker's pipe
            ready = wait([worker.reports for worker in at_work], timeout=0.5)
            for worker in at_work:
                if worker.reports in ready or not worker.process.is_alive():
                    left.discard(worker.finished())
            if session.shouldfail:
                raise session.Failed(session.shouldfail)
    finally:
        os.close(files_left)
        for worker in workers:
            worker.process.terminate()
            worker.process.join()
    if left:
        session.shouldfail = f"not run to the end: {', '.join(sorted(left))}"
        raise session.Failed(session.shouldfail)
    return True


class Worker:
    """A process that runs tests, seen from the one that has collected them."""

    def __init__(self, session: pytest.Session, *job: Any) -> None:
        self.config, self.works, self.runs = session.config, True, "no test"
        forking = multiprocessing.get_context("fork")  # type: ignore[attr-defined, unused-ignore]
        self.reports, sent = forking.Pipe(duplex=False)
        self.process = forking.Process(target=work, args=(session, sent, *job))
        self.process.start()
        sent.close()

    def finished(self) -> str:
        """Passes on the next that it has sent; gives back the test that is finished by that."""
        try:
            event, given = self.reports.recv() if self.reports.poll() else ("died", {})
        except EOFError:
            event, given = "died", {}
        self.works = event not in ("died", "done")
        if event == "died":
            self.process.join(5.0)
            why = f"a worker crashed while running {self.runs!r} ({self.process.exitcode})"
            place = (self.runs.partition("::")[0], None, self.runs)
            given = {"report": pytest.TestReport(self.runs, place, {}, "failed", why, "call")}
            event = "logreport"
        elif event == "logreport":
            load = self.config.hook.pytest_report_from_serializable
            given = {"report": load(config=self.config, data=given)}
        elif event == "logstart":
            self.runs = given["nodeid"]
        if event != "done":
            getattr(self.config.hook, f"pytest_runtest_{event}")(**given)
        return self.runs if event == "logfinish" else ""


Files = Sequence[Sequence[pytest.Item]]


def work(session: pytest.Session, sent: Connection, number: int, files: Files, left: int) -> None:
    """In a process of its own: runs files while there are any."""
    config, plugins = session.config, session.config.pluginmanager
    capture: Any = plugins.get_plugin("capturemanager")
    capture.stop_global_capturing()  # its files are the other processes' too
    capture.start_global_capturing()
    capture.suspend_global_capture()
    plugins.unregister(name="terminalreporter")
    # pytest-timeout writes to it
    terminal = SimpleNamespace(_tw=create_terminal_writer(config, sys.__stderr__))
    plugins.register(terminal, "terminalreporter")
    plugins.register(Reporter(config, sent))
    temporary: Any = config._tmp_path_factory  # type: ignore[attr-defined]
    temporary._basetemp = temporary.getbasetemp() / f"worker-{number}"
    temporary._basetemp.mkdir(mode=0o700)
    resource_tracker.ensure_running()
    with patch("multiprocessing.util.spawnv_passfds", forked_server):
        forkserver.ensure_running()
    random.seed()  # each draws its own names and ports
    todo = items_of(files, left)
    item = next(todo, None)
    while item:
        # a file is taken when the last test of the one before begins: fixtures of both stay
        following = next(todo, None)
        config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        item = following
    sent.send(("done", {}))


def forked_server(_path: bytes, words: Sequence[str], passed: Sequence[int]) -> int:
    """The server of `multiprocessing` that forks, forked instead of started: it has loaded all."""
    if process := os.fork():
        return process
    try:
        faulthandler.disable()
        for entry in list(Path("/proc/self/fd").iterdir()):
            if int(entry.name) > 2 and int(entry.name) not in passed:
                with suppress(OSError):
                    os.close(int(entry.name))
        exec(words[-1])
    finally:
        os._exit(0)


def items_of(files: Files, left: int) -> Iterator[pytest.Item]:
    while taken := os.read(left, INDEX_BYTES):
        yield from files[int.from_bytes(taken, "big")]


class Reporter:
    """Sends what a worker has to say."""

    def __init__(self, config: pytest.Config, sent: Connection) -> None:
        self.config, self.sent = config, sent

    def pytest_runtest_logstart(self, nodeid: str, location: object) -> None:
        self.sent.send(("logstart", {"nodeid": nodeid, "location": location}))

    def pytest_runtest_logfinish(self, nodeid: str, location: object) -> None:
        self.sent.send(("logfinish", {"nodeid": nodeid, "location": location}))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        data = self.config.hook.pytest_report_to_serializable(config=self.config, report=report)
        self.sent.send(("logreport", data))

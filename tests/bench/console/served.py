"""The console as a process, asked over HTTP; and a run whose operator is asked in the browser."""

from __future__ import annotations

import http.client
import json
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from instruments.operators.mailbox import read_prompt
from tests.bench.forked import Running, begin
from tests.bench.operated_runs import files

SOON_S = 120.0  # for a machine with ten times too much to do


@dataclass(frozen=True, slots=True)
class Reply:
    """Status and JSON of an answer."""

    status: int
    body: Any


@dataclass(slots=True)
class Served:
    """A console that runs; ``address`` is what it printed."""

    process: Running
    address: str

    @property
    def port(self) -> int:
        return int(self.address.split(":")[2].split("/")[0])

    @property
    def token(self) -> str:
        return self.address.split("#")[1]

    def ask(
        self, path: str, body: Mapping[str, object] | None = None, client: str = "one"
    ) -> Reply:
        """One request as the page makes it. Raises OSError where the console has gone."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=SOON_S)
        headers = {"Authorization": f"Bearer {self.token}", "X-Client": client}
        with_body = {} if body is None else {"Content-Type": "application/json"}
        try:
            connection.request(
                "GET" if body is None else "POST",
                f"/api{path}",
                None if body is None else json.dumps(body),
                {**headers, **with_body},
            )
            answer = connection.getresponse()
            return Reply(answer.status, json.loads(answer.read()))
        except http.client.HTTPException as error:
            raise OSError(str(error)) from error
        finally:
            connection.close()


def serve(runs: Path, here: Path) -> Served:
    """Start a console over ``runs``, with the rig files and scripts in ``here``."""
    process = begin(["console", "--runs", runs, "--no-open"], cwd=here)
    assert process.stdout is not None
    word, address = process.stdout.readline().split()
    assert word == "console"
    return Served(process, address)


@contextmanager
def console(runs: Path, here: Path) -> Iterator[Served]:
    """A console that is ended."""
    served = serve(runs, here)
    try:
        yield served
    finally:
        end(served)


def end(served: Served) -> None:
    """Kill it, whatever it does."""
    served.process.kill()
    served.process.wait()
    if served.process.stdout:
        served.process.stdout.close()


@contextmanager
def operated_run(folder: Path, **more: Any) -> Iterator[tuple[Running, Path]]:
    """A run in real time on emulators, without a terminal; gives its process and its folder."""
    arguments = files(folder, operator="browser:", **more)
    (folder / "runs").mkdir(exist_ok=True)
    with (folder / "run.log").open("wb") as log:
        process = begin(arguments, stdout=log.fileno(), stderr=subprocess.STDOUT)
    try:
        yield process, eventually(lambda: folder_of(folder), process)
    finally:
        with suppress(OSError):
            process.kill()
        process.wait()


def folder_of(folder: Path) -> Path | None:
    """The run's folder, once a prompt stands in it."""
    found = [one for one in (folder / "runs").iterdir() if read_prompt(one)]
    return found[0] if found else None


def eventually(look: Any, process: Running | None = None) -> Any:
    """What ``look`` gives once it gives something."""
    end_s = time.monotonic() + SOON_S
    while time.monotonic() < end_s:
        if found := look():
            return found
        assert process is None or process.poll() is None, "the run has ended"
        time.sleep(0.02)
    raise AssertionError("it never came")

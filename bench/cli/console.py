"""`console`: the page in the browser, served until Ctrl-C."""

from __future__ import annotations

import argparse
import secrets
import socket
import subprocess
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bench.cli.verdict import on_a_desktop
from bench.config import ConfigError
from bench.rig.urls import is_loopback

HERE = "127.0.0.1"
EXPOSED = (
    "Other machines can reach this console, over a network that can be read and without"
    " encryption. Whoever has the address above, token included, may answer prompts and start and"
    " end runs."
)


def console(given: argparse.Namespace) -> None:
    try:
        import uvicorn

        from bench.console.app import Console, make_app
    except ImportError as error:
        raise ConfigError.plain(
            f"the console needs {error.name}, which isn't installed: pip install"
            " 'teatbench[console]'"
        ) from error
    token, address = secrets.token_urlsafe(24), given.listen
    with _listening(address, given.port) as listener:
        port = listener.getsockname()[1]
        names = {address, HERE, "localhost"} if is_loopback(address) else {address}
        if address in ("0.0.0.0", "::"):  # noqa: S104 - asked for, and said what it means
            raise ConfigError.plain(
                "--listen takes the one address of this machine that others may use, not all of"
                " them: its name is checked in each request"
            )
        hosts = [f"[{name}]:{port}" if ":" in name else f"{name}:{port}" for name in names]
        origin = f"http://{hosts[0]}" if len(names) == 1 else f"http://{HERE}:{port}"
        page = f"{origin}/#{token}"
        print(f"console {page}", flush=True)
        if not is_loopback(address):
            print(EXPOSED, file=sys.stderr, flush=True)
        if not given.no_open and on_a_desktop():
            webbrowser.open(page)
        given.runs.mkdir(parents=True, exist_ok=True)
        app = make_app(Console(given.runs.resolve(), Path.cwd(), origin), token, hosts)
        config = uvicorn.Config(
            app,
            log_level="error",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=1,
            ws="none",
        )
        uvicorn.Server(config).run(sockets=[listener])


@contextmanager
def _listening(address: str, port: int) -> Iterator[socket.socket]:
    """Raises ConfigError where the address can't be had."""
    kind = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        listener = socket.create_server((address, port), family=kind)
    except OSError as error:
        why = f"the console can't listen on {address}, port {port}: {error.strerror or error}"
        raise ConfigError.plain(f"{why}. Name another one with --port.") from error
    with listener:
        yield listener


@contextmanager
def beside(runs: Path) -> Iterator[None]:
    """A console over ``runs`` in a process of its own, which prints its address. Whatever becomes
    of it changes nothing for the run. At a terminal it stays after the run until Ctrl-C.
    """
    command = [sys.executable, "-m", "bench.cli", "console", "--runs", str(runs)]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    try:
        yield
        if sys.stdout.isatty() and process.poll() is None:
            print("The console stays open until Ctrl-C.")
            with suppress(KeyboardInterrupt):
                process.wait()
    finally:
        process.terminate()
        process.wait()

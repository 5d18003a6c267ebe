"""`console`: the page in the browser, served until Ctrl-C."""

from __future__ import annotations

import argparse
import ipaddress
import secrets
import socket
import subprocess
import sys
import threading
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, cast

from bench.cli.verdict import on_a_desktop
from bench.config import ConfigError
from textfiles.text import sentence

HERE = "127.0.0.1"
BROADCAST = ipaddress.IPv4Address("255.255.255.255")
UP_S = 20.0  # a busy machine reads its modules slowly; then the run begins without its address
EXPOSED = (
    "Other machines can reach this console, over a network that can be read and without"
    " encryption. Whoever has the address above, token included, may answer prompts and start and"
    " end runs."
)


def console(given: argparse.Namespace) -> None:
    try:
        import segno
        import uvicorn

        from bench.console.app import WebConsole, make_app, pairing_url
        from bench.console.guard import Pairing, shedding
    except ImportError as error:
        raise ConfigError.plain(
            f"the console needs {error.name}, which isn't installed: pip install"
            " 'teatbench[console]'"
        ) from error
    try:
        given.runs.mkdir(parents=True, exist_ok=True)
        next(given.runs.iterdir(), None)
    except OSError as error:
        why = f"the folder of runs, {given.runs}, can't be used: {error.strerror or error}"
        raise ConfigError.plain(f"{why}. Name another one with --runs.") from error
    token = secrets.token_urlsafe(24)
    with _listening(given.listen, given.port) as listener:
        bound, port = listener.getsockname()[:2]
        inside = _numbered(bound).is_loopback
        names = dict.fromkeys([bound, given.listen, *([HERE, "localhost"] if inside else [])])
        hosts = [f"[{name}]:{port}" if ":" in name else f"{name}:{port}" for name in names]
        origin = f"http://{hosts[0]}"
        print(f"console {origin}/#{token}", flush=True)
        if not inside:
            print(EXPOSED, file=sys.stderr, flush=True)
        if not given.no_open and on_a_desktop():
            webbrowser.open(f"{origin}/#{token}")
        served = WebConsole(given.runs, Path.cwd(), origin, Pairing(token))
        if not inside and sys.stdout.isatty():
            print("To pair a phone, once and within 10 min:")
            segno.make(pairing_url(served)).terminal(compact=True)
        app = make_app(served, hosts)
        config = uvicorn.Config(
            app,
            http=shedding(),
            log_level="critical",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=1,
            ws="none",
        )
        with suppress(KeyboardInterrupt):
            uvicorn.Server(config).run(sockets=[listener])
        print(f"\n{sentence(given.left)}")


def _numbered(address: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address:
    """A bound address; one of IPv4 where it is mapped into IPv6."""
    found = ipaddress.ip_address(address.partition("%")[0])
    return getattr(found, "ipv4_mapped", None) or found


@contextmanager
def _listening(address: str, port: int) -> Iterator[socket.socket]:
    """Raises ConfigError where the address can't be had, or is all of the machine's, however that
    was spelled: what counts is what the socket is bound to.
    """
    kind = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        listener = socket.create_server((address, port), family=kind)
    except (OSError, UnicodeError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        why = f"the console can't listen on {address!r}, port {port}: {reason}"
        raise ConfigError.plain(f"{why}. Name another one with --listen or --port.") from error
    with listener:
        bound = _numbered(listener.getsockname()[0])
        if bound.is_unspecified or bound.is_multicast or bound == BROADCAST:
            what = "every address of this machine" if bound.is_unspecified else "no machine's own"
            raise ConfigError.plain(
                f"--listen {address!r} is {what}: give the one that others may use, whose name is"
                " checked in each request"
            )
        yield listener


@contextmanager
def beside(runs: Path) -> Iterator[None]:
    """A console over ``runs`` in a process of its own, which prints its address before the run
    begins. Whatever becomes of it changes nothing for the run. At a terminal it stays after the run
    until Ctrl-C.
    """
    command = [sys.executable, "-X", "utf8", "-m", "bench.cli", "console", "--runs", str(runs)]
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, encoding="utf-8"
    )
    lines = cast(IO[str], process.stdout)
    printing = threading.Thread(
        target=lambda: print(lines.readline(), end="", flush=True), name="console", daemon=True
    )
    printing.start()
    printing.join(UP_S)
    try:
        yield
        if sys.stdout.isatty() and process.poll() is None:
            print("The console stays open until Ctrl-C.")
            with suppress(KeyboardInterrupt):
                process.wait()
    finally:
        process.terminate()
        process.wait()
        printing.join()
        lines.close()

"""Drivers and emulators of other packages by entry point: ``plugin:NAME?key=value`` in a rig file.

The groups are ``teatbench.arms``, ``.baths``, ``.cameras`` and ``.stages``. An emulator has the
name of its driver, in the group ``teatbench.emulators.baths`` and so on: it is called with the
world and the clock, and gives a device (`instruments.listener.Device`) that the bench serves on a
port of this machine. The driver gets the port as its key ``url``.
"""

from __future__ import annotations

import builtins
import hashlib
import json
import logging
import os
import select
import signal
import socket
import sqlite3
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from inspect import signature
from operator import is_not
from pathlib import Path
from types import ModuleType
from typing import Any, Literal
from urllib.parse import parse_qsl, urlencode

import numpy as np

from instruments.clock import Clock
from instruments.errors import LimitError
from textfiles.text import named, short

PLUGIN, EMULATOR = "plugin:", "emulator:"
SAID = 200  # characters of another's words
LIMITS = ("AS", "DATA", "FSIZE", "NOFILE", "NPROC")  # bytes, files, threads
LIBRARY = (builtins, hashlib, json, logging, os, sqlite3, time)  # whose functions are put back
# by whose functions threads and links wait already: there is no way back to others
WAITING = (select, socket, threading)
# the bench's own libraries, of which a driver's `logging.basicConfig` would show each step
QUIET = ("filelock", "fontTools", "matplotlib", "numba", "PIL", "pymodbus")
ENDING = [one for one in signal.Signals if one.name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGBREAK")]
Kind = Literal["arm", "bath", "camera", "stage"]
KINDS: tuple[Kind, ...] = ("arm", "bath", "camera", "stage")
GROUPS: Mapping[Kind, str] = {kind: f"teatbench.{kind}s" for kind in KINDS}
EMULATORS: Mapping[Kind, str] = {kind: f"teatbench.emulators.{kind}s" for kind in KINDS}


@dataclass(frozen=True, slots=True)
class PluginUrl:
    """``plugin:NAME?key=value&…``, or ``emulator:NAME?…`` for its emulator."""

    name: str
    keys: Mapping[str, str] = field(default_factory=dict)
    emulated: bool = False

    def at(self, url: str) -> str:
        """The URL of its driver for what is served at ``url``."""
        keys = urlencode({**self.keys, "url": url}, safe=",:/")
        return f"{PLUGIN}{self.name}?{keys}"


def plugin_url(url: str) -> PluginUrl | None:
    """``url`` where it names a plug-in, else None. Raises ValueError without a name, for a key that
    is given twice, and for what is no text.
    """
    place = next((one for one in (PLUGIN, EMULATOR) if url.startswith(one)), None)
    if place is None or url == EMULATOR or url.startswith("emulator://"):
        return None
    name, _, query = url.removeprefix(place).partition("?")
    if not name:
        raise ValueError('which plug-in? write "plugin:NAME" or "plugin:NAME?key=value"')
    pairs = parse_qsl(query, keep_blank_values=True)
    for key, value in pairs:
        if sum(key == one for one, _ in pairs) > 1:
            raise ValueError(f"the key {key} is given twice")
        if not value.isprintable() or "\ufffd" in value:
            raise ValueError(f"the value of {key} is no text in UTF-8: {value!r}")
    return PluginUrl(name, dict(pairs), place == EMULATOR)


@dataclass(frozen=True, slots=True)
class Plugin:
    """A driver of another package: what makes it, and who wrote it."""

    name: str
    source: str
    maker: Any
    keys: Mapping[str, str] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"the plug-in {self.name} of {self.source}"

    @property
    def url(self) -> str:
        """What another process opens it by."""
        return f"{PLUGIN}{self.name}" + (f"?{urlencode(self.keys)}" if self.keys else "")

    def make(self, *given: Any) -> Any:
        """Open it with the clock, or an emulator's world and clock. LimitError: a key is wrong."""
        with suppress(ValueError):  # one without a signature
            try:
                shape = signature(self.maker)
                shape.bind(*given, **self.keys)
            except TypeError as error:
                takes = ", ".join(list(shape.parameters)[len(given) :]) or "none"
                hint = f"Correct the url's keys; {self} takes: {takes}."
                raise LimitError(self.name, f"{error}", asked=self.url, hint=hint) from error
        return self.maker(*given, **self.keys)

    def with_keys(self, **keys: str) -> Plugin:
        """The same with further keys."""
        return Plugin(self.name, self.source, self.maker, {**self.keys, **keys})


def available(group: str) -> dict[str, str]:
    """Name -> the package that it is of; nothing is loaded."""
    found: dict[str, list[str]] = {}
    for plug in entry_points(group=group):
        found.setdefault(plug.name, []).append(_source(plug))
    return {name: " and ".join(of) for name, of in found.items()}


def load(kind: Kind, url: PluginUrl, *, emulator: bool = False) -> Plugin:
    """The driver, or the emulator, that ``url`` names; not opened. Raises LimitError."""
    group = (EMULATORS if emulator else GROUPS)[kind]
    plugs = entry_points(group=group)
    if not (named := [plug for plug in plugs if plug.name == url.name]):
        near = get_close_matches(url.name, plugs.names, n=1)
        there = ", ".join(sorted(plugs.names)) or "none"
        hint = f"Did you mean {near[0]!r}?" if near else f"Installed: {there}."
        what = f"no {'emulator' if emulator else 'driver'} {url.name!r} is installed ({group})"
        raise LimitError(kind, what, hint=hint)
    plug, *others = named
    if others:
        both = " and ".join(_source(one) for one in named)
        raise LimitError(kind, f"{url.name!r} is of {both}", hint="Uninstall one of them.")
    try:
        if not plug.pattern.match(plug.value):
            raise ValueError("no module:name")
        # a module may put other streams in place of these as it is loaded
        with loading(plug.module), redirect_stdout(sys.stdout), redirect_stderr(sys.stderr):
            maker = plug.load()
    except BaseException as error:  # another's code
        if by_ctrl_c(error):
            raise
        hint = "Install what it needs, or correct it."
        raise LimitError(
            kind, f"{_source(plug)} can't be loaded: {said(error)}", hint=hint
        ) from error
    if not callable(maker):
        what = f"{_source(plug)} gives {type(maker).__name__}, no class"
        raise LimitError(kind, what, hint="Correct its entry point.")
    return Plugin(url.name, _source(plug), maker, url.keys)


def emulator_of(make: Callable[..., Any], world: object, clock: Clock) -> Any:
    """The device that ``make`` gives. Raises LimitError for none, such as the driver itself."""
    try:
        with undisturbed():
            made = make(world, clock)
        _ = made.connect, made.receive, made.disconnect
    except LimitError:  # a key of its url
        raise
    except BaseException as error:  # another's code
        if by_ctrl_c(error):
            raise
        who = f"{getattr(make, '__self__', make)}"  # a plug-in says whose it is
        what = f"makes no emulator of a world and a clock: {said(error)}"
        raise LimitError(who, what, hint="Correct it.") from error
    return made


def _source(plug: EntryPoint) -> str:
    package = f"{plug.dist.name} {plug.dist.version}" if plug.dist else "an unknown package"
    return f"{package} ({plug.value})"


def one_line(said: str) -> str:
    """Another's words on one line, as far as they have room in a message, and can be printed."""
    said = "".join(filter(str.isprintable, " ".join(said.split())))
    return short(said, SAID)


def said(what: object) -> str:
    """An error, or what was given, in a message."""
    return one_line(named(what))


def by_ctrl_c(error: BaseException) -> bool:
    """Whether a signal may have raised it: that of the bench's own handler is a subclass."""
    plain = type(error) is KeyboardInterrupt and signal.getsignal(signal.SIGINT)
    return isinstance(error, KeyboardInterrupt) and plain in (False, signal.default_int_handler)


def _handle(handle: Callable[[Any], Any], record: logging.LogRecord) -> Any:
    """What another's handler of logs makes of ``record``, whatever it raises."""
    with suppress(Exception):
        return handle(record)


def _limits() -> dict[int, tuple[int, int]]:
    """What the system lets this process have: a soft and a hard limit by its number for it."""
    if sys.platform == "win32":
        return {}
    import resource

    return {
        one: resource.getrlimit(one)
        for name in LIMITS
        if (one := getattr(resource, f"RLIMIT_{name}", None)) is not None
    }


def _put_back(limits: Mapping[int, tuple[int, int]]) -> None:
    """As before, where it was lowered."""
    now = _limits()
    if sys.platform == "win32" or now == limits:
        return
    import resource

    for one, (soft, hard) in limits.items():
        low, most = now[one]
        if low != resource.RLIM_INFINITY and (low < soft or soft == resource.RLIM_INFINITY):
            with suppress(OSError, ValueError):
                resource.setrlimit(one, (soft if most == hard else most, most))


_Before = list[tuple[ModuleType, dict[str, Any]]]


def _names(modules: tuple[ModuleType, ...]) -> _Before:
    """What the names in ``modules`` stand for now."""
    return [(module, vars(module).copy()) for module in modules]


def _replaced(before: _Before) -> Iterator[tuple[ModuleType, str, Any]]:
    """Functions and classes that are others now, or gone: module, name, what it was."""
    for module, names in before:
        now = vars(module)
        if len(now) < len(names) or any(map(is_not, names.values(), now.values())):
            for name, one in names.items():
                if callable(one) and now.get(name) is not one:
                    yield module, name, one


_refused: dict[str, str] = {}  # by the name of what was loaded: what it replaced then


@contextmanager
def loading(name: str) -> Iterator[None]:
    """As `undisturbed`, while a module of another's is loaded, for what is called ``name``. Raises
    ImportError where it replaces functions by which the bench's own threads and links wait.
    """
    before = _names(WAITING)
    for one in QUIET:
        logging.getLogger(one).setLevel(logging.WARNING)
    with undisturbed():
        yield
    gone = [f"{module.__name__}.{function}" for module, function, _ in _replaced(before)]
    if what := _refused.setdefault(name, ", ".join(gone[:3])):
        raise ImportError(
            f"it replaces functions of Python that the bench waits by, such as {what}: leave out"
            " what does so, as gevent's monkey.patch_all"
        )


@contextmanager
def undisturbed() -> Iterator[None]:
    """Some libraries change what the whole process has: the working folder, by which files of a run
    are named, who may read new files, what Ctrl-C does, where modules are found, what the names in
    `LIBRARY` are, what is an error to NumPy, how much memory and how many files there may be, how
    deep calls go, what traces new threads, and the stack that a thread gets and what it does with
    its errors, without which none starts. A handler that one gives the root logger, which every
    library's words go to, raises nothing in the bench. A copy of the process that one forks ends
    where it would come back.
    """
    given: Any = threading.excepthook, sys.excepthook  # None, by a thread of a driver's
    hooks = given[0] or threading.__excepthook__, given[1] or sys.__excepthook__
    threading.excepthook, sys.excepthook = hooks
    folder, path, finders = Path(), [*sys.path], [*sys.meta_path]
    stack = threading.stack_size(0)
    threading.stack_size(stack)  # to ask for it sets it
    calls = _names(LIBRARY)
    logs, limits, depth = [*logging.root.handlers], _limits(), sys.getrecursionlimit()
    traced, profiled = threading.gettrace(), threading.getprofile()
    with suppress(OSError):  # it may be gone
        folder = Path.cwd()
    handlers = {one: signal.getsignal(one) for one in ENDING}
    process, mask = os.getpid(), os.umask(0o022)
    os.umask(mask)
    try:
        with np.errstate():
            yield
    finally:
        if os.getpid() != process:
            os._exit(0)
        os.umask(mask)
        threading.stack_size(stack)
        threading.excepthook, sys.excepthook = hooks
        for module, name, one in _replaced(calls):
            setattr(module, name, one)
        for log in logging.root.handlers:
            if log not in logs:
                log.handle = partial(_handle, log.handle)  # type: ignore[method-assign]
        _put_back(limits)
        threading.settrace(traced)
        threading.setprofile(profiled)
        sys.setrecursionlimit(max(depth, sys.getrecursionlimit()))
        with suppress(OSError):
            os.chdir(folder)
        sys.path.extend(one for one in path if one not in sys.path)
        sys.meta_path.extend(one for one in finders if one not in sys.meta_path)
        for one, handler in handlers.items():
            if handler is not None and signal.getsignal(one) is not handler:
                with suppress(ValueError):  # the main thread alone has them
                    signal.signal(one, handler)

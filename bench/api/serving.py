"""A rig's emulators served at ports, in real time, for whatever opens them by their URLs."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager
from functools import partial

from bench.api.loading import AnyRig, load_rig
from bench.config import ConfigError
from bench.rig.emulated_rig import PORTS, EmulatedRig, port_of
from bench.rig.loading import LoadedRig
from bench.rig.practice import Practice, page_of, served_text
from bench.rig.urls import ELSEWHERE
from instruments.camera.stream import StreamServer
from instruments.clock import RealClock
from instruments.listener import Listener
from instruments.operators.remote import OperatorPort

HERE = "127.0.0.1"


class ServedRig:
    """A rig's emulators, and the page at ``page_url`` to pull their cables by."""

    def __init__(self, page_url: str, rig: LoadedRig, twin: EmulatedRig, at: Mapping[str, str]):
        self.page_url = page_url
        self._rig, self._twin, self._at = rig, twin, at

    @property
    def urls(self) -> Mapping[str, str]:
        """Each instrument's, by name; a pseudo-terminal's is another one once it was closed."""
        return {**self._twin.urls, **self._at}

    def rig_file(self, note: str = "") -> str:
        """A rig file that opens them, good in any folder while they are served."""
        return served_text(self._rig, self.urls, note)


@contextmanager
def serve_rig(
    rig: AnyRig, *, host: str = HERE, pty: bool = False, paced: bool = False, port_base: int = 0
) -> Iterator[ServedRig]:
    """Serve the instruments of ``rig``, all emulated. ``pty``: serial ports as pseudo-terminals,
    ``paced`` at their baud; ``port_base``: the first port, or 0. Raises ConfigError.
    """
    loaded = load_rig(rig)
    with ExitStack() as stack:
        clock = stack.enter_context(closing(RealClock()))
        try:
            at, seed = partial(port_of, base=port_base), loaded.rig.seed
            made = partial(EmulatedRig, loaded, clock, seed, host=host, port_base=port_base)
            twin = stack.enter_context(made(pty=pty, paced=paced))
            practice = Practice(twin)
            served = partial(StreamServer, twin.cameras, clock, host=host, port=at("streams"))
            streams = served(page=partial(page_of, practice), act=practice.do)
            stack.enter_context(closing(streams))
            listener = partial(Listener, OperatorPort(twin.operator), clock, lock=threading.RLock())
            hands = listener(name="operator", host=host, port=at("operator"))
            stack.enter_context(closing(hands))
        except OSError as error:
            where = f"{host}, ports {port_base} to {at(PORTS[-1])}" if port_base else host
            at_all = "pseudo-terminals" if pty else where
            why = f"can't listen on {at_all}: {error.strerror or error}"
            raise ConfigError.plain(why) from error
        out_of = streams.pulled
        practice.pull_camera = lambda one, out: (out_of.add if out else out_of.discard)(one)
        plugged = "cameras" in twin.listeners
        more = {} if plugged else {name: f"opencv:{url}" for name, url in streams.urls.items()}
        more["operator"] = hands.url.replace("socket://", ELSEWHERE)
        practice.keep_jammed(clock)
        yield ServedRig(streams.page_url, loaded, twin, more)

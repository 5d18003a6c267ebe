"""Who may ask the console anything: each request is looked at before any route.

The token goes in the header ``Authorization: Bearer TOKEN``, which no form, link, picture or other
site can send; cookies are never read. A phone gets it in exchange for a code that is good once.
Host has to be the console's own (else a foreign name that resolves to it could read answers),
Origin too where there is one, and what changes something has to come as JSON.
"""

from __future__ import annotations

import asyncio
import hmac
import secrets
from collections.abc import Collection
from dataclasses import dataclass, field

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from instruments.clock import stopwatch_s

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:;"
    " connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
}
PAIRED, PAIR_S = "/api/paired", 600.0  # where a code is exchanged; how long it is good
MOST_BYTES = 1 << 16  # of a request's body
REQUEST_S = 8.0  # a request's head has come by then


@dataclass(slots=True)
class Pairing:
    """The token, and codes that are exchanged for it once, each within `PAIR_S`."""

    token: str
    _until_s: dict[str, float] = field(default_factory=dict)

    def code(self) -> str:
        code = secrets.token_urlsafe(18)
        self._until_s[code] = stopwatch_s() + PAIR_S
        return code

    def takes(self, code: str) -> bool:
        """Whether ``code`` is good; it is no longer, from now on."""
        return stopwatch_s() < self._until_s.pop(code, 0.0)


class Guard:
    """``app`` behind the checks. ``hosts``: allowed values of Host, as ``127.0.0.1:8421``."""

    def __init__(self, app: ASGIApp, pairing: Pairing, hosts: Collection[str]) -> None:
        self._app = app
        self._pairing = pairing
        self._token = pairing.token.encode()
        self._hosts = frozenset(hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":  # the program's own start and end; no web sockets
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        if refused := self._refused(scope):
            code, why = refused
            await JSONResponse({"error": why}, code)(scope, receive, with_headers)
        else:
            await self._app(scope, receive, with_headers)

    def _refused(self, scope: Scope) -> tuple[int, str] | None:
        headers = Headers(scope=scope)
        if headers.get("host", "").lower() not in self._hosts:
            return 421, "another Host than this console's"
        origin = headers.get("origin")
        if origin is not None and origin.lower() not in {f"http://{host}" for host in self._hosts}:
            return 403, "another Origin than this console's"
        if not scope["path"].startswith("/api"):
            return None if scope["method"] in ("GET", "HEAD") else (405, "only to be read")
        kind, _, token = headers.get("authorization", "").partition(" ")
        paired = scope["path"] == PAIRED and self._pairing.takes(token)
        known = paired or hmac.compare_digest(token.encode(), self._token)
        if kind.lower() != "bearer" or not known:
            return 401, "no token, or a wrong one: open the address that the console printed"
        if scope["method"] in ("GET", "HEAD"):
            return None
        if headers.get("content-type", "").split(";")[0].strip() != "application/json":
            return 415, "a request that changes something has to be JSON"
        length = headers.get("content-length", "")
        if not length.isdecimal() or int(length) > MOST_BYTES:
            return 413, f"a request's body has a stated length of at most {MOST_BYTES} bytes"
        return None


def shedding() -> type[asyncio.Protocol]:
    """uvicorn's protocol, which closes a connection on which no whole head of a request came within
    REQUEST_S of its first byte or of the connection.
    """
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class Shedding(H11Protocol):
        _deadline: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)  # type: ignore[arg-type]
            self._watch()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._watch()

        def connection_lost(self, exc: Exception | None) -> None:
            super().connection_lost(exc)
            if self._deadline:
                self._deadline.cancel()

        def _watch(self) -> None:
            """A request that is being answered has no deadline here; half of one has."""
            answering = self.cycle is not None and not self.cycle.response_complete
            if answering and self._deadline:
                self._deadline.cancel()
                self._deadline = None
            elif not answering and self._deadline is None and not self.transport.is_closing():
                self._deadline = self.loop.call_later(REQUEST_S, self._shed)

        def _shed(self) -> None:
            self._deadline = None
            if self.cycle is None or self.cycle.response_complete:
                self.transport.abort()

    return Shedding

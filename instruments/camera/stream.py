"""Cameras served as MJPEG streams over HTTP (multipart/x-mixed-replace), one path a camera.

One frame set a tick for all readers; ticks that a slow reader misses, or whose frame never came,
are left out. Each part has its length and time of exposure. ``/`` may show a page, whose buttons
post their ``words``.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Protocol
from urllib.parse import parse_qs

import cv2

from instruments.camera.cameras import KNOWN
from instruments.camera.frame import FrameError, FrameSet
from instruments.clock import Clock, VirtualClock

BOUNDARY = "frame"
QUALITY = 95
MOST_BYTES = 200  # of a form
STALLED_S = 5.0  # a reader that takes nothing for so long is disconnected
LOOK_S = 0.05


class Source(Protocol):
    """What gives frame sets. Raises FrameError where a frame does not come."""

    def capture(self) -> FrameSet: ...


class StreamServer:
    """Serves a frame set a tick of ``fps``. Raises OSError, ValueError in virtual time."""

    def __init__(
        self,
        source: Source,
        clock: Clock,
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        fps: float = 5.0,
        page: Callable[[], str] | None = None,
        act: Callable[[str], None] | None = None,
    ) -> None:
        if isinstance(clock, VirtualClock):
            raise ValueError("streams are served in real time, not under virtual time")
        self.clock = clock
        self.period_s = 1.0 / fps
        self.closing = False
        self.page = page
        self.act = act
        self.pulled: set[str] = set()  # cameras whose cable is out
        self._source = source
        self._lock = threading.Lock()
        self._tick = -1
        self._frames: FrameSet | None = None
        self._server = _Server((host, port), _Handler)
        self._server.owner = self
        self.urls: Mapping[str, str] = {
            name: f"http://{host}:{self._server.server_address[1]}/{name}.mjpg" for name in KNOWN
        }
        self.page_url = self.urls[KNOWN[0]].rpartition("/")[0] + "/"
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(LOOK_S,), name="camera streams", daemon=True
        )
        self._thread.start()

    def frames(self, tick: int) -> FrameSet | None:
        """The set of ``tick``, or a later one already taken; None where a camera gave none."""
        with self._lock:
            if tick > self._tick:
                self._tick = tick
                try:
                    self._frames = self._source.capture()
                except FrameError:  # the reader gets nothing, as on a real network
                    self._frames = None
            return self._frames

    def wait_until(self, when_s: float) -> None:
        """Wait, but not past the closing."""
        while not self.closing and (left_s := when_s - self.clock.now()) > 0.0:
            self.clock.sleep(min(left_s, LOOK_S))

    def close(self) -> None:
        """Stop, break all streams, and wait for the threads to end; may be called again."""
        if not self.closing:
            self.closing = True
            self._server.shutdown()
            self._server.server_close()
            self._thread.join()


class _Server(ThreadingHTTPServer):
    daemon_threads = False  # so that closing waits for them
    # a port whose connections have just ended is free at once; on Windows that is so anyway, and
    # this would let a second server have a port that is taken
    allow_reuse_address = os.name != "nt"
    owner: StreamServer

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A reader that has gone is no error; anything else is printed as in the base class."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = STALLED_S

    def do_GET(self) -> None:
        """Send one camera's pictures until the client disconnects."""
        camera = self.path.partition("?")[0].strip("/").removesuffix(".mjpg")
        page = self.server.owner.page
        if page and not camera:
            data = page().encode("utf-8")
            self.send_response(HTTPStatus.OK)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)
            return
        if camera not in KNOWN or camera in self.server.owner.pulled:
            there = ", ".join(f"/{name}.mjpg" for name in KNOWN)
            self.send_error(HTTPStatus.NOT_FOUND, f"no such camera; there are {there}")
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={BOUNDARY}")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        with contextlib.suppress(OSError):  # the reader has gone, or takes nothing
            owner, tick = self.server.owner, 0
            while not owner.closing and camera not in owner.pulled:
                tick = max(tick, int(owner.clock.now() / owner.period_s)) + 1
                owner.wait_until(tick * owner.period_s)
                frames = owner.frames(tick) if not owner.closing else None
                picture = getattr(frames, camera) if frames else None
                if frames is None or picture is None:
                    continue
                exposed_s = frames.exposed_s.get(camera, 0.0)
                first_s = min(frames.exposed_s.values(), default=exposed_s)
                # one exposed later arrives later
                owner.wait_until(owner.clock.now() + exposed_s - first_s)
                jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
                self.wfile.write(part(jpeg.tobytes(), exposed_s))

    def do_POST(self) -> None:
        """One button of the page, then the page again. What isn't understood changes nothing."""
        length, act = self.headers.get("Content-Length", ""), self.server.owner.act
        host, origin = self.headers.get("Host"), self.headers.get("Origin")
        from_page = origin in (None, f"http://{host}")  # else another site's
        if act is None or not from_page or not length.isdecimal() or int(length) > MOST_BYTES:
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        given = parse_qs(self.rfile.read(int(length)).decode("utf-8", "replace"))
        with contextlib.suppress(ValueError):
            act(given.get("words", [""])[0])
        self.send_response(HTTPStatus.SEE_OTHER)
        self.send_header("Location", "/")
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the base class's name for it
        """Nothing is printed."""


def part(jpeg: bytes, exposed_s: float) -> bytes:
    """One picture of the stream."""
    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n"
    stamp = f"X-Exposed-Seconds: {exposed_s:.6f}\r\n\r\n"
    return (head + stamp).encode("ascii") + jpeg + b"\r\n"

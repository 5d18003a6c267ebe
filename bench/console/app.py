"""The console's program: the page, and the API under `/api` that it speaks (docs/record.md).

Its state is what the runs' folders say; of its own it has only who may answer prompts (the
lease). It can be killed at any moment: a run notices nothing, and an answer that was acknowledged
is a file.
"""

from __future__ import annotations

import asyncio
import json
import secrets
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from ipaddress import ip_address
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import segno
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool as _off
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from bench.config import ConfigError
from bench.console import starting, watching
from bench.console.guard import PAIRED, Guard, Pairing
from bench.results.queue import queues
from bench.results.status import under_way
from bench.rig.practice import leave
from bench.run.interruptions import ABORT, leave_request, parse_request
from instruments.clock import RealClock, wall_time
from instruments.operators.mailbox import AlreadyAnsweredError, NotOpenError, give_answer
from instruments.operators.operator import ABORT as ABORTS

STATIC = Path(__file__).parent / "static"
POLL_S = 0.05  # between two looks at a run's files
BEAT_S = 10.0  # a comment, so that a connection that went away is noticed
SPEEDS = {1: ["--realtime"], 10: ["--speed", "10"]}  # of a run on emulators that is watched
LONGEST = 400  # of a name or an answer
MOST_PAGES, QUEUED = 500, 2000  # pages that follow runs; news that one may not have read yet
NO_CLIENT = "a page says its own number in the header X-Client"
BODY_S = 8.0  # a request's body has come by then
# a report has scripts and styles of its own, and may reach nothing of the console's
REPORT_POLICY = (
    "sandbox allow-scripts allow-popups; default-src 'none'; img-src {0} data:; connect-src 'none';"
    " script-src {0} 'unsafe-inline'; style-src {0} 'unsafe-inline'; font-src {0} data:"
)


@dataclass(slots=True)
class Lease:
    """Who answers prompts: one page at a time; another may take over, which both see."""

    client: str = ""
    name: str = ""
    since: str = ""

    def held_by(self, client: str, name: str) -> bool:
        """Whether ``client`` has it; a free one is given."""
        if not self.client and client:
            self.take(client, name)
        return bool(client) and self.client == client

    def take(self, client: str, name: str) -> None:
        self.client, self.name = client, name or "a browser"
        self.since = wall_time().isoformat(timespec="seconds")

    def as_seen_by(self, client: str) -> dict[str, Any]:
        """Who has it, without the other's number."""
        return {"mine": self.client == client, "name": self.name, "since": self.since}


FOLLOWED = ("status", "live", "prompt", "practice", "lease")
News = tuple[str, Any]  # "event" or one of FOLLOWED, and its value


@dataclass(slots=True, eq=False)
class OpenPage:
    """A page that follows a run: what it has not read yet. ``lost``: it reads too slowly."""

    news: asyncio.Queue[News] = field(default_factory=lambda: asyncio.Queue(QUEUED))
    lost: bool = False

    def put(self, news: News) -> None:
        try:
            self.news.put_nowait(news)
        except asyncio.QueueFull:
            self.lost = True  # the browser connects anew, from the last number that it has


@dataclass(slots=True)
class OpenPages:
    """Which pages follow which run: each run's folder is polled once for all of them."""

    following: dict[Path, set[OpenPage]] = field(default_factory=dict)
    polls: dict[Path, asyncio.Task[None]] = field(default_factory=dict)

    @property
    def count(self) -> int:
        return sum(map(len, self.following.values()))

    def add(self, folder: Path, lease: Lease) -> OpenPage | None:
        """A page for this run; None where there are too many."""
        if self.count >= MOST_PAGES:
            return None
        page = OpenPage()
        self.following.setdefault(folder, set()).add(page)
        if folder not in self.polls:
            self.polls[folder] = asyncio.create_task(self._poll(folder, lease))
        return page

    def remove(self, folder: Path, page: OpenPage) -> None:
        pages = self.following.get(folder, set())
        pages.discard(page)
        if not pages:
            self.following.pop(folder, None)
            if poll := self.polls.pop(folder, None):
                poll.cancel()

    async def _poll(self, folder: Path, lease: Lease) -> None:
        events = watching.EventFile(folder)
        came = await _off(lambda: list(events.recent()))
        seen: dict[str, Any] = {}
        while True:
            now: dict[str, Any] = {
                "status": watching.status(folder),
                "live": watching.live(folder),
                "prompt": watching.prompt(folder),
                "practice": watching.practice(folder),
                "lease": (lease.client, lease.name, lease.since),
            }
            news: list[News] = [("event", event) for event in came]
            news += [(name, value) for name, value in now.items() if seen.get(name) != value]
            seen = now
            for page in self.following.get(folder, ()):
                for one in news:
                    page.put(one)
            if not came:
                await asyncio.sleep(POLL_S)
            came = await _off(lambda: list(events.new()))


@dataclass(slots=True)
class WebConsole:
    """The routes. ``runs`` is the folder of runs, ``rigs`` the one with rig files and scripts."""

    runs: Path
    rigs: Path
    origin: str
    pairing: Pairing
    lease: Lease = field(default_factory=Lease)
    tickets: dict[str, Path] = field(default_factory=dict)
    pages: OpenPages = field(default_factory=OpenPages)

    def routes(self) -> list[Route | Mount]:
        one = "/api/runs/{run}"
        return [
            Route("/", partial(_file, STATIC / "index.html")),
            Mount("/static", StaticFiles(directory=STATIC)),
            Route("/report/{ticket}/{path:path}", self.report_file),
            Route("/api/runs", self.listed),
            Route("/api/queue", self.queue),
            Route("/api/choices", self.choices),
            Route("/api/dry-run", self.dry_run, methods=["POST"]),
            Route("/api/start", self.start, methods=["POST"]),
            Route("/api/lease", self.take_lease, methods=["POST"]),
            Route("/api/pair", self.pair, methods=["POST"]),
            Route(PAIRED, self.paired, methods=["POST"]),
            Route(one, self.snapshot),
            Route(f"{one}/stream", self.stream),
            Route(f"{one}/thumbnails", self.thumbnails),
            Route(f"{one}/trials", self.trials),
            Route(f"{one}/trials/{{trial}}/{{camera}}", self.frame),
            Route(f"{one}/live/{{camera}}", self.live_frame),
            Route(f"{one}/set-up", self.set_up),
            Route(f"{one}/answers/{{number:int}}", self.answer, methods=["POST"]),
            Route(f"{one}/control", self.control, methods=["POST"]),
            Route(f"{one}/practice", self.practise, methods=["POST"]),
            Route(f"{one}/resume", self.resume, methods=["POST"]),
            Route(f"{one}/report", self.open_report, methods=["POST"]),
        ]

    async def listed(self, _: Request) -> Response:
        found = await _off(watching.listed, self.runs)
        return JSONResponse({"runs": found, "pages": self.pages.count})

    async def queue(self, _: Request) -> Response:
        """The last one; null where there is none."""
        last = await _off(lambda: next(queues(self.runs, 1), None))
        return JSONResponse({"queue": last.as_dict() if last else None})

    async def snapshot(self, request: Request) -> Response:
        found = await _off(watching.snapshot, self._folder(request))
        return JSONResponse({**found, "lease": self.lease.as_seen_by(_client(request))})

    async def stream(self, request: Request) -> Response:
        """Server-sent events: `snapshot`, then `event` (by number) and what is in FOLLOWED."""
        folder, last = self._folder(request), request.headers.get("last-event-id", "")
        after = int(last) if last.isdecimal() else None
        if (page := self.pages.add(folder, self.lease)) is None:
            return _refused(503, f"{MOST_PAGES} pages follow runs already: close some")
        lines = self._watched(page, folder, _client(request), after)
        return StreamingResponse(lines, media_type="text/event-stream")

    async def _watched(
        self, page: OpenPage, folder: Path, client: str, after: int | None
    ) -> AsyncIterator[bytes]:
        """Generates as fast as the client reads; ends where it reads too slowly."""
        try:
            lease = self.lease.as_seen_by(client)
            first = {**await _off(watching.snapshot, folder), "lease": lease}
            yield _sse("snapshot", first)
            recent = await _off(lambda: list(watching.EventFile(folder).recent()))
            if after is None:
                after = first["number"]
            seen: dict[str, Any] = {name: first[name] for name in FOLLOWED}
            news: list[News] = [("event", event) for event in recent]
            while True:
                for kind, value in news:
                    if kind == "event":
                        if value["number"] > after:
                            after = value["number"]
                            yield _sse("event", value, after)
                        continue
                    now = self.lease.as_seen_by(client) if kind == "lease" else value
                    if now != seen[kind]:
                        seen[kind] = now
                        yield _sse(kind, now)
                if page.lost:
                    return
                try:
                    news = [await asyncio.wait_for(page.news.get(), BEAT_S)]
                except TimeoutError:
                    news = []
                    yield b": still here\n\n"
        finally:
            self.pages.remove(folder, page)

    async def trials(self, request: Request) -> Response:
        return JSONResponse({"trials": await _off(watching.trials, self._folder(request))})

    async def thumbnails(self, request: Request) -> Response:
        """The worst trial's frames, small: ``[[what it is, JPEG in base64], ...]``."""
        found = await _off(watching.thumbnails, self._folder(request))
        return JSONResponse({"thumbnails": found})

    async def frame(self, request: Request) -> Response:
        at = request.path_params
        return _picture(
            await _off(watching.frame, self._folder(request), at["trial"], at["camera"])
        )

    async def live_frame(self, request: Request) -> Response:
        folder = self._folder(request)
        return _picture(watching.live_frame(folder, request.path_params["camera"]))

    async def set_up(self, request: Request) -> Response:
        """The picture of what the open prompt wants set up."""
        folder = self._folder(request)
        return _picture(await _off(watching.set_up_picture, folder))

    async def answer(self, request: Request) -> Response:
        """``{"words": "go"}`` as at the terminal. 409: not open, or another came first."""
        folder, given = self._folder(request), await _body(request)
        words, name = _text(given, "words"), _text(given, "name")
        number = request.path_params["number"]
        ends = words.strip().lower() in ABORTS
        if not ends and (refused := self._held_by_another(request, name)):
            return refused
        if not under_way(folder):
            return _refused(409, "this run is not under way")
        try:
            taken = await _off(give_answer, folder, number, words, name or "a browser")
        except AlreadyAnsweredError as error:
            return JSONResponse({"error": str(error), "by": error.by}, 409)
        except NotOpenError as error:
            return _refused(409, str(error))
        except ValueError as error:
            return _refused(422, str(error))
        return JSONResponse({"taken": asdict(taken)})

    async def control(self, request: Request) -> Response:
        """``{"words": "pause"}``: pause, go on, skip REASON, repeat REASON, abort."""
        folder, given = self._folder(request), await _body(request)
        words = _text(given, "words")
        try:
            wish, _ = parse_request(words)
        except ValueError as error:
            return _refused(422, str(error))
        name = _text(given, "name")
        if wish != ABORT and (refused := self._held_by_another(request, name)):
            return refused
        if not under_way(folder):
            return _refused(409, "this run is not under way")
        await _off(leave_request, folder, words)
        return JSONResponse({"left": words})

    def _held_by_another(self, request: Request, name: str) -> Response | None:
        """The refusal of who has not the lease."""
        client = _client(request)
        if self.lease.held_by(client, name):
            return None
        if not client:
            return _refused(422, NO_CLIENT)
        return _refused(403, f"{self.lease.name} answers prompts; take over first")

    async def practise(self, request: Request) -> Response:
        """``{"words": "pull arm"}``: one of those that the emulated rig shows."""
        folder, given = self._folder(request), await _body(request)
        words, now = _text(given, "words"), watching.practice(folder)
        if now is None or not any(words in one["words"].values() for one in now["choices"]):
            return _refused(409, "that can't be done to this run's rig just now")
        await _off(leave, folder, words)
        return JSONResponse({"left": words})

    async def take_lease(self, request: Request) -> Response:
        given, client = await _body(request), _client(request)
        if not client:
            return _refused(422, NO_CLIENT)
        self.lease.take(client, _text(given, "name"))
        return JSONResponse(self.lease.as_seen_by(client))

    async def pair(self, request: Request) -> Response:
        """A link that another browser opens once, and its QR code as a data URI."""
        await _body(request)
        url = pairing_url(self)
        svg = segno.make(url, error="m").svg_data_uri(scale=6, light="white")
        return JSONResponse({"url": url, "qr": svg, "here": is_here(self.origin)})

    async def paired(self, request: Request) -> Response:
        """The token, for a code that the guard has taken."""
        await _body(request)
        return JSONResponse({"token": self.pairing.token})

    async def choices(self, _: Request) -> Response:
        found = asdict(await _off(starting.choices, self.rigs))
        return JSONResponse({kind: list(names) for kind, names in found.items()})

    async def dry_run(self, request: Request) -> Response:
        arguments = await self._chosen(await _body(request))
        return JSONResponse(await _off(starting.dry_run, arguments, self.runs))

    async def start(self, request: Request) -> Response:
        given = await _body(request)
        arguments = [*await self._chosen(given), "--out", str(self.runs)]
        if (speed := given.get("speed")) in SPEEDS:
            arguments += SPEEDS[speed]
        return await self._started(arguments)

    async def resume(self, request: Request) -> Response:
        folder = self._folder(request)
        await _body(request)
        return await self._started(["resume", str(folder)], folder.name)

    async def _chosen(self, given: Mapping[str, Any]) -> list[str]:
        def names(key: str) -> list[str]:
            named = given.get(key, [])
            return [str(name) for name in named] if isinstance(named, list) else []

        found = await _off(starting.choices, self.rigs)
        scripts = names("scripts") or [_text(given, "script")]
        return found.command(_text(given, "rig"), scripts, names("detectors"))

    async def _started(self, arguments: list[str], known: str = "") -> Response:
        name = await _off(starting.start, arguments, self.runs, RealClock(), known)
        return JSONResponse({"run": name})

    async def open_report(self, request: Request) -> Response:
        """An address for the run's report, which a tab can open without the token."""
        folder = self._folder(request)
        await _body(request)
        if not await _off(watching.reported, folder):
            return _refused(404, "this run has no report of its record as it is")
        ticket = secrets.token_urlsafe(24)
        self.tickets[ticket] = folder.resolve()  # the page shows the frames beside it
        return JSONResponse({"url": f"/report/{ticket}/report/index.html"})

    async def report_file(self, request: Request) -> Response:
        folder = self.tickets.get(request.path_params["ticket"])
        if folder is None:
            return _refused(404, "there is no such report")
        path = (folder / request.path_params["path"]).resolve()
        if not path.is_relative_to(folder) or not path.is_file():
            return _refused(404, "there is no such page in the report")
        policy = REPORT_POLICY.format(self.origin)
        return FileResponse(path, headers={"content-security-policy": policy})

    def _folder(self, request: Request) -> Path:
        return watching.run_folder(self.runs, request.path_params["run"])


def pairing_url(console: WebConsole) -> str:
    return f"{console.origin}/#pair-{console.pairing.code()}"


def is_here(origin: str) -> bool:
    """Whether only this machine reaches it."""
    host = urlsplit(origin).hostname or ""
    return ip_address(host.partition("%")[0]).is_loopback


def make_app(console: WebConsole, hosts: list[str]) -> ASGIApp:
    handlers: dict[Any, Any] = {watching.NoRunError: _said(404), OSError: _said(500)}
    handlers |= dict.fromkeys((starting.NotStartedError, BadBodyError, ConfigError), _said(422))
    return Guard(
        Starlette(routes=console.routes(), exception_handlers=handlers), console.pairing, hosts
    )


class BadBodyError(ValueError):
    """The body of a request is not what the route takes."""


def _said(code: int) -> Callable[[Request, Exception], Response]:
    def say(_: Request, error: Exception) -> Response:
        return _refused(code, str(error))

    return say


def _refused(code: int, why: str) -> JSONResponse:
    return JSONResponse({"error": why}, code)


async def _file(path: Path, _: Request) -> Response:
    return FileResponse(path)


def _picture(path: Path | None) -> Response:
    return FileResponse(path) if path else _refused(404, "there is no such picture")


def _client(request: Request) -> str:
    return request.headers.get("x-client", "")[:LONGEST]


async def _body(request: Request) -> dict[str, Any]:
    """Raises BadBodyError."""
    try:
        found = json.loads(await asyncio.wait_for(request.body(), BODY_S))
        json.dumps(found, ensure_ascii=False).encode()
    except TimeoutError as error:
        raise BadBodyError(f"the body has not come within {BODY_S:g} s") from error
    except UnicodeEncodeError as error:
        raise BadBodyError("the body has a lone surrogate, which is no character") from error
    except (ValueError, RecursionError) as error:
        raise BadBodyError(f"the body is not JSON: {error}") from error
    if not isinstance(found, dict):
        raise BadBodyError("the body is not a JSON object")
    return found


def _text(given: Mapping[str, Any], name: str) -> str:
    """Raises BadBodyError."""
    found = given.get(name, "")
    if not isinstance(found, str) or len(found) > LONGEST:
        raise BadBodyError(f'"{name}" is a text of at most {LONGEST} characters')
    return " ".join(found.split())


def _sse(kind: str, value: Any, number: int | None = None) -> bytes:
    text = json.dumps(value, ensure_ascii=False)
    head = f"id: {number}\n" if number is not None else ""
    return f"{head}event: {kind}\ndata: {text}\n\n".encode()

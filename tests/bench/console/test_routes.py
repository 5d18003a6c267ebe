"""No route does anything for a request that may not ask: property tests over all of them."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
from collections.abc import Iterator
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.routing import Mount, Route

from bench.config import ConfigError
from bench.console import guard
from bench.console.app import WebConsole, make_app
from bench.console.guard import PAIR_S, Pairing
from bench.console.watching import curve, listed, snapshot
from bench.record.reader import read_run
from bench.record.state import run_lock
from bench.record.writer import Store
from bench.report.page import write_run_report
from bench.results.status import LIVE, RUN_JSON
from bench.rig.lock import locked
from instruments.clock import stopwatch_s
from instruments.operators import operator as op
from instruments.operators.mailbox import Mailbox, read_answer
from reports.frames import ANSWER_COLOURS, TRUTH_COLOUR
from tests.bench.small_run import KEPT

TOKEN, HOST, TICKET = "right-token", "127.0.0.1:8421", "ticket"
GOOD = {"host": HOST, "authorization": f"Bearer {TOKEN}", "content-type": "application/json"}
NAMES = ("..", "%2e%2e", "run/../run", "/etc", "C:\\", "", "<script>", "\x00", "a" * 300)


@pytest.fixture(scope="module")
def console(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WebConsole]:
    here = tmp_path_factory.mktemp("here")
    folder = Path(shutil.copytree(KEPT, here / "runs" / "kept"))
    Mailbox(folder).open(op.Prompt("touch", "Touch it."))
    with locked(run_lock(folder), "a run", print, "run"):
        yield WebConsole(here / "runs", here, f"http://{HOST}", Pairing(TOKEN))


def call(console: WebConsole, method: str, path: str, headers: dict[str, str], body: bytes) -> Any:
    """Status, headers and body of one request to the program itself."""
    sent: list[dict[str, Any]] = []

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": body, "more_body": False}

    async def send(message: Any) -> None:
        sent.append(message)

    scope = {
        "type": "http",
        "asgi": {"version": "3.0", "spec_version": "2.4"},
        "method": method,
        "path": path,
        "raw_path": path.encode(errors="replace"),
        "query_string": b"",
        "root_path": "",
        "scheme": "http",
        "server": ("127.0.0.1", 8421),
        "http_version": "1.1",
        "headers": [(k.encode(), v.encode()) for k, v in headers.items()],
    }
    app: Any = make_app(console, [HOST])
    asyncio.run(app(scope, receive, send))
    text = b"".join(message.get("body", b"") for message in sent[1:])
    return sent[0]["status"], dict(sent[0]["headers"]), text


def routes(console: WebConsole) -> list[tuple[str, str]]:
    """Method and path with names in place."""
    (run,) = (one.name for one in console.runs.iterdir())
    found = []
    for route in console.routes():
        if isinstance(route, Mount):
            continue
        assert isinstance(route, Route)
        path = route.path.replace("{run}", run).replace("{number:int}", "1")
        path = path.replace("{trial}", "001").replace("{camera}", "left")
        path = path.replace("{ticket}", TICKET).replace("{path:path}", "index.html")
        found += [(method, path) for method in (route.methods or set()) - {"HEAD"}]
    return found


def digest(console: WebConsole) -> str:
    """Of all that is on the disk."""
    files = sorted(path for path in console.runs.rglob("*") if path.is_file())
    return sha256(b"".join(f"{path}".encode() + path.read_bytes() for path in files)).hexdigest()


FAULTS: tuple[tuple[dict[str, str | None], int], ...] = (
    ({"authorization": None}, 401),
    ({"authorization": "Bearer wrong"}, 401),
    ({"authorization": TOKEN}, 401),
    ({"authorization": None, "cookie": f"token={TOKEN}"}, 401),
    ({"host": "evil.example:8421"}, 421),
    ({"host": "127.0.0.1"}, 421),
    ({"origin": "http://evil.example"}, 403),
    ({"origin": "null"}, 403),
    ({"content-type": "application/x-www-form-urlencoded"}, 415),
    ({"content-type": "text/plain"}, 415),
    ({"content-length": None}, 413),
    ({"content-length": "99999999"}, 413),
)


@pytest.mark.slow
@given(data=st.data())
def test_a_request_with_a_fault_does_nothing(console: WebConsole, data: st.DataObject) -> None:
    method, path = data.draw(st.sampled_from(routes(console)))
    fault, code = data.draw(st.sampled_from(FAULTS))
    if code in (413, 415) and method == "GET":
        return
    body = json.dumps({"words": data.draw(st.sampled_from(("abort", "go", "pause")))}).encode()
    headers = {**GOOD, "content-length": str(len(body)), "x-client": "one"}
    wrong = {name: value for name, value in {**headers, **fault}.items() if value is not None}
    before = digest(console)
    status, answered, text = call(console, method, path, wrong, body)
    assert digest(console) == before
    if path.startswith("/api") or code in (421, 403):
        assert status == code
        assert set(json.loads(text)) == {"error"}
    assert b"script-src 'self'" in answered[b"content-security-policy"]


@pytest.mark.slow
@given(name=st.sampled_from(NAMES) | st.text(max_size=20), data=st.data())
def test_a_path_for_a_name_reaches_nothing(
    console: WebConsole, name: str, data: st.DataObject
) -> None:
    (run,) = (one.name for one in console.runs.iterdir())
    method, path = data.draw(st.sampled_from([one for one in routes(console) if run in one[1]]))
    words = json.dumps({"words": "abort", "rig": name, "script": name}).encode()
    headers = {**GOOD, "content-length": str(len(words)), "x-client": "one"}
    before = digest(console)
    if name == run:
        return
    status, _, _ = call(console, method, path.replace(run, name), headers, words)
    assert status in (404, 405, 307)
    for place in ("/api/start", "/api/dry-run"):
        if name not in ("emulated", "emulated-browser", "emulated-depth"):
            assert call(console, "POST", place, headers, words)[0] == 422
    status, _, _ = call(console, "GET", f"/report/{TICKET}/{name}", GOOD, b"")
    assert status in (404, 405, 307)
    assert digest(console) == before


@pytest.mark.slow
def test_a_report_is_served_by_its_ticket_alone_and_can_reach_nothing(console: WebConsole) -> None:
    (folder,) = console.runs.iterdir()
    (folder / "report").mkdir(exist_ok=True)
    (folder / "report" / "index.html").write_text("<p>all good", encoding="utf-8")
    headers = {**GOOD, "content-length": "2"}
    _, _, text = call(console, "POST", f"/api/runs/{folder.name}/report", headers, b"{}")
    url = json.loads(text)["url"]
    status, answered, text = call(console, "GET", url, {"host": HOST}, b"")
    assert (status, text) == (200, b"<p>all good")
    assert answered[b"content-security-policy"].startswith(b"sandbox allow-scripts")
    beside = url.replace("report/index.html", "rig.toml")  # as the frames are
    assert (
        call(console, "GET", beside, {"host": HOST}, b"")[2] == (folder / "rig.toml").read_bytes()
    )
    outside = url.replace("index.html", "../../../etc/passwd")
    assert call(console, "GET", outside, {"host": HOST}, b"")[0] == 404


def test_one_operator_at_a_time_and_whoever_has_the_token_may_abort(console: WebConsole) -> None:
    (run,) = (one.name for one in console.runs.iterdir())

    def post(path: str, client: str, **body: str) -> tuple[int, Any]:
        data = json.dumps(body).encode()
        headers = {**GOOD, "content-length": str(len(data)), "x-client": client}
        status, _, text = call(console, "POST", path, headers, data)
        return status, json.loads(text)

    answers = f"/api/runs/{run}/answers/1"
    assert post("/api/lease", "one", name="the desk")[1]["mine"]
    status, said = post(answers, "two", words="go")
    assert (status, said["error"]) == (403, "the desk answers prompts; take over first")
    status, said = post(answers, "", words="go")
    assert (status, said["error"]) == (422, "a page says its own number in the header X-Client")
    assert post(answers, "two", words="abort")[0] == 200
    status, said = post(answers, "one", words="go", name="the desk")
    assert (status, said["by"]) == (409, "a browser")


def test_a_phone_is_paired_once_and_in_time(
    console: WebConsole, monkeypatch: pytest.MonkeyPatch
) -> None:
    def post(path: str, bearer: str) -> tuple[int, Any]:
        headers = {**GOOD, "content-length": "2", "authorization": f"Bearer {bearer}"}
        status, _, text = call(console, "POST", path, headers, b"{}")
        return status, json.loads(text)

    assert post("/api/pair", "wrong")[0] == 401
    status, made = post("/api/pair", TOKEN)
    origin, code = made["url"].split("/#pair-")
    assert (status, origin, made["here"]) == (200, f"http://{HOST}", True)
    assert made["qr"].startswith("data:image/svg+xml")
    assert post("/api/lease", code)[0] == 401  # good for nothing else, and still good
    assert post("/api/paired", code) == (200, {"token": TOKEN})
    assert post("/api/paired", code)[0] == 401
    _, late = post("/api/pair", TOKEN)
    there_s = stopwatch_s() + PAIR_S + 1.0
    monkeypatch.setattr(guard, "stopwatch_s", lambda: there_s)
    assert post("/api/paired", late["url"].split("#pair-")[1])[0] == 401


@pytest.mark.parametrize("body", [b'{"name": "\\ud800"}', b'{"\\udfff": 1}', b'{"a": ["\\ud83d"]}'])
def test_a_lone_surrogate_is_no_text(console: WebConsole, body: bytes) -> None:
    length = {"content-length": str(len(body)), "x-client": "one"}
    status, _, text = call(console, "POST", "/api/lease", GOOD | length, body)
    assert (status, b"surrogate" in text) == (422, True)


def test_what_a_killed_bench_left_open_is_neither_shown_nor_answered(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(KEPT, tmp_path / "runs" / "killed"))
    Mailbox(folder).open(op.Prompt("touch", "Touch it."))
    for name in (LIVE, "left.jpg"):
        (folder / "console" / name).write_text('{"state": "running"}', encoding="utf-8")
    console = WebConsole(tmp_path / "runs", tmp_path, f"http://{HOST}", Pairing(TOKEN))
    at = "/api/runs/killed"
    status, _, text = call(console, "GET", at, {**GOOD, "x-client": "one"}, b"")
    assert (status, json.loads(text)["live"], json.loads(text)["prompt"]) == (200, None, None)
    assert call(console, "GET", f"{at}/live/left", GOOD, b"")[0] == 404
    body = json.dumps({"words": "go"}).encode()
    more = {**GOOD, "content-length": str(len(body)), "x-client": "one"}
    status, _, text = call(console, "POST", f"{at}/answers/1", more, body)
    assert (status, json.loads(text)["error"]) == (409, "this run is not under way")
    assert read_answer(folder, 1) is None


def test_the_curve_ends_with_the_last_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bench.console.watching.CURVE", 3)
    assert curve(KEPT)[0][-1] == read_run(KEPT).bath[-1, 0]


@pytest.mark.slow
def test_a_verdict_of_an_earlier_session_is_not_the_run_s(tmp_path: Path) -> None:
    """The first was ended and has a report; the second finished, and was killed before its own."""
    folder = Path(shutil.copytree(KEPT, tmp_path / "runs" / "twice"))
    write_run_report(folder)
    right = listed(tmp_path / "runs")[0]["status"]
    assert right["state"] == "finished"
    path = folder / RUN_JSON
    written = json.loads(path.read_text(encoding="utf-8"))
    written["status"]["verdicts"] = dict.fromkeys(right["verdicts"], "of the report")
    for digest, verdict in ((written["chain"]["wall_digest"], "of the report"), ("0", None)):
        written["chain"]["wall_digest"] = digest
        path.write_text(json.dumps(written), encoding="utf-8")
        (card,) = listed(tmp_path / "runs")
        wanted = dict.fromkeys(right["verdicts"], verdict) if verdict else right["verdicts"]
        assert card["status"]["verdicts"] == wanted


def test_a_run_that_never_began_or_can_t_be_read_hides_no_other(tmp_path: Path) -> None:
    shutil.copytree(KEPT, tmp_path / "whole")
    Store.create(tmp_path / "never-began", {}).close()
    torn = Store(Path(shutil.copytree(KEPT, tmp_path / "torn")))
    torn._db.execute("UPDATE facts SET value = '{' WHERE key = 'items'")
    torn.close()
    assert [card["name"] for card in listed(tmp_path)] == ["whole"]
    for name in ("never-began", "torn"):
        with pytest.raises(ConfigError):
            snapshot(tmp_path / name)


def test_a_detector_has_the_colour_that_it_has_over_the_frames_of_a_report() -> None:
    script = files("bench.console").joinpath("static/console.js").read_text(encoding="utf-8")
    tones = re.search(r"TONES = (\[.*?\])", script)
    truth = re.search(r'TRUTH = "(#\w+)"', script)
    assert tones
    assert truth
    assert (tuple(json.loads(tones[1])), truth[1]) == (ANSWER_COLOURS, TRUTH_COLOUR)
    style = files("reports").joinpath("templates/frames.css").read_text(encoding="utf-8")
    assert f".layer-truth{{color:{TRUTH_COLOUR}}}" in style

"""The page in a real browser: a run done by clicks, two tabs, no network for a while, Abort always
within reach, hostile names as text, and nothing asked for beyond this machine.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
from contextlib import closing
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from bench.record.reader import read_run
from bench.record.schema import DATABASE
from bench.record.state import State, run_lock
from bench.results.queue import QueueNote
from bench.results.status import GOING_TO_SAFE, LinkState, OpenPrompt
from bench.rig.lock import locked
from instruments.clock import wall_time
from instruments.operators.mailbox import read_prompt
from tests.bench.console import served
from tests.bench.operated_runs import SCRIPT, texts
from tests.bench.results.test_status import LIVES, said_by, stopped
from tests.bench.small_run import KEPT, written_anew
from tests.chromium import browser_page, violations, weak_texts

pytestmark = [pytest.mark.browser, pytest.mark.slow]
HOSTILE = "<img src=x onerror=document.title='pwned'> & </script>"
SIZES = ((360, 640), (768, 1024), (1920, 1080))
SOON_MS = 60_000
OFFLINE_S = float(os.environ.get("TEATBENCH_OFFLINE_S", "0.5"))  # 30 by hand
ON_TOP = """() => { const box = document.getElementById('abort').getBoundingClientRect();
 const at = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
 return at && at.id === 'abort' && box.bottom <= innerHeight && box.right <= innerWidth; }"""


def hostile_script() -> str:
    return SCRIPT.replace('"Short"', f'"{HOSTILE}"').replace("Teats as in table 5.1.", HOSTILE)


def abort_in_reach(page: Page) -> None:
    expect(page.locator("#abort")).to_be_visible(timeout=SOON_MS)  # the page of a run, not the list
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        assert page.evaluate(ON_TOP), (width, height)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), (width, height)


def another_tab_takes_over(page: Page, address: str, folder: Path) -> None:
    """It sees the same prompt, and may not answer before; then this one takes over again."""
    other = page.context.new_page()
    other.goto(address)
    other.get_by_role("link", name=folder.name).click()
    expect(other.locator("#ask .what")).to_contain_text(HOSTILE, timeout=SOON_MS)
    expect(other.locator("#answer-done")).to_be_disabled()
    other.locator("#take").click()
    expect(other.locator("#answer-done")).to_be_enabled(timeout=SOON_MS)
    expect(page.locator("#answer-done")).to_be_disabled(timeout=SOON_MS)
    page.locator("#take").click()
    other.close()


def offline_for_a_while(page: Page, folder: Path) -> None:
    """A reload, and a time without network: the same prompt, and nothing answered by it."""
    before = number(folder)
    page.reload()
    expect(page.locator("#ask .what")).to_contain_text(HOSTILE, timeout=SOON_MS)
    page.locator("#ask .choice input").first.check()
    page.context.set_offline(True)
    expect(page.locator("#connection")).to_contain_text("no connection", timeout=SOON_MS)
    page.locator("#answer-done").click()  # into nothing
    expect(page.locator("#problem")).to_be_visible(timeout=SOON_MS)
    time.sleep(OFFLINE_S)
    page.context.set_offline(False)
    back_s = time.monotonic()
    expect(page.locator("#connection")).to_have_text("connected", timeout=SOON_MS)
    expect(page.locator("#ask .what")).to_contain_text(HOSTILE, timeout=SOON_MS)
    back_s = time.monotonic() - back_s
    expect(page.locator("#ask .choice input").first).to_be_checked()
    page.locator("#ask .choice input").first.uncheck()
    print(f"after {OFFLINE_S:g} s without network: the same prompt within {back_s:.2f} s")
    assert number(folder) == before


def test_a_run_by_clicks_and_an_abort(tmp_path: Path) -> None:
    script = hostile_script().replace('["thesis"]', '["fused"]')
    with (
        served.operated_run(tmp_path, script=script) as (process, folder),
        served.console(tmp_path / "runs", tmp_path) as one,
        browser_page() as seen,
    ):
        page = seen.page
        page.context.set_offline(False)  # for this machine's own console
        page.goto(one.address)
        page.get_by_role("link", name=folder.name).click()
        expect(page.locator("#ask")).to_contain_text("peg", timeout=SOON_MS)
        assert "#" + one.token not in page.url
        abort_in_reach(page)
        click_done(page, folder)  # homing
        expect(page.locator("#ask .what")).to_contain_text(HOSTILE, timeout=SOON_MS)
        expect(page.locator("#ask img")).to_be_visible(timeout=SOON_MS)
        abort_in_reach(page)
        another_tab_takes_over(page, one.address, folder)
        offline_for_a_while(page, folder)
        abort_in_reach(page)
        click_done(page, folder)
        while "Touch the end of" in page.locator("#ask").inner_text():
            expect(page.locator("#tip")).to_contain_text("off teat", timeout=SOON_MS)
            abort_in_reach(page)
            click_done(page, folder, key="Enter" if "teat 2" in page.inner_text("#ask") else "")
        expect(page.locator("#result")).to_contain_text("4 of 4 found", timeout=SOON_MS)
        abort_in_reach(page)
        assert not violations(page)
        page.locator("#pause").click()
        expect(page.locator("#pause")).to_have_text("Go on", timeout=SOON_MS)
        abort_in_reach(page)
        page.locator("#pause").click()
        expect(page.locator("#pause")).to_have_text("Pause", timeout=SOON_MS)
        page.locator("#skip").click()
        abort_in_reach(page)
        page.locator("#why").fill("the teat came off")
        page.locator("#answer-skip").click()
        expect(page.locator("#ask")).to_contain_text("trial 3 of 3", timeout=SOON_MS)
        page.locator("#abort").click()
        process.wait()
        expect(page.locator("#ending")).to_contain_text("Resume this run", timeout=SOON_MS)
        expect(page.locator("#legend")).to_contain_text("Shaded: the band.")  # as it was watched
        page.locator("h1 a").click()  # all runs
        history = page.locator(".run")
        expect(history.locator(".thumbnails img")).to_have_count(3, timeout=SOON_MS)
        expect(history).to_contain_text("aborted: 1 of 3 trials")
        expect(history.get_by_role("button", name="Resume")).to_be_visible()
        assert not violations(page)
        page.get_by_role("link", name=folder.name).click()
        expect(page.locator("#legend")).to_have_text("Line: the bath. Dashed: its set point.")
        assert page.title() == "teatbench console"
        ours = [f"http://127.0.0.1:{one.port}/", "blob:", "data:"]
        assert not [url for url in seen.requests if not url.startswith(tuple(ours))]
    record = read_run(folder)
    assert (record.ending, len(record.trials), len(record.skipped)) == ("aborted", 1, 1)
    assert record.skipped[0]["reason"] == "the teat came off"
    assert "bath is safe" in texts(record, "safe")


def number(folder: Path) -> int:
    prompt = read_prompt(folder)
    assert prompt is not None
    return int(prompt["number"])


def click_done(page: Page, folder: Path, key: str = "") -> None:
    """Or press the key, and wait for the next prompt on the page."""
    before = number(folder)
    if key:
        page.keyboard.press(key)
    else:
        page.locator("#answer-done").click()
    served.eventually(lambda: number(folder) > before)
    expect(page.locator("#answer-done")).to_be_enabled(timeout=SOON_MS)


@pytest.mark.weekly
def test_practice_by_clicks_and_a_phone_that_is_paired(tmp_path: Path) -> None:
    with (
        served.operated_run(tmp_path) as (_, folder),
        served.console(tmp_path / "runs", tmp_path) as one,
        browser_page() as seen,
    ):
        page = seen.page
        page.context.set_offline(False)
        page.goto(f"{one.address}#{folder.name}")
        arm = page.locator("#rig li").filter(has_text="Arm cable")
        arm.get_by_role("button", name="pull arm").click(timeout=SOON_MS)
        expect(arm).to_contain_text("OUT", timeout=SOON_MS)
        arm.get_by_role("button", name="put back arm").click()
        page.get_by_role("button", name="warm the room").click()
        expect(page.locator("#rig")).to_contain_text("22 °C", timeout=SOON_MS)
        abort_in_reach(page)
        assert not violations(page)
        page.locator("#pair").click()
        expect(page.locator("#pairing img")).to_be_visible(timeout=SOON_MS)
        assert not violations(page)
        link = page.locator("#pairing a").get_attribute("href")
        assert link
        assert one.token not in link
        phone = page.context.browser.new_context().new_page()  # type: ignore[union-attr]
        phone.goto(link)
        expect(phone.locator("#list")).to_contain_text(folder.name, timeout=SOON_MS)
        assert "pair" not in phone.url
        another = page.context.browser.new_context().new_page()  # type: ignore[union-attr]
        another.goto(link)
        expect(another.locator("#problem")).to_contain_text("no token", timeout=SOON_MS)


@pytest.mark.weekly
def test_a_queue_is_followed_from_one_run_to_the_next(tmp_path: Path) -> None:
    """Its card says what runs, on both pages; the page of a run that ended goes on to the next."""
    runs = tmp_path / "runs"
    first, second = (Path(shutil.copytree(KEPT, runs / f"kept-{n}")) for n in "12")
    ended = shutil.copy(second / DATABASE, tmp_path / "ended")
    for under_way in (first, second):
        with closing(sqlite3.connect(under_way / DATABASE)) as db, db:
            db.execute("DELETE FROM facts WHERE key = 'ending'")
        written_anew(under_way)
    note = QueueNote.begin(runs, "a rig", ["one", "two", "three"])
    with served.console(runs, tmp_path) as one, browser_page() as seen:
        page, card = seen.page, seen.page.locator("#queue")
        page.context.set_offline(False)
        page.goto(one.address)
        expect(card).to_contain_text("Script 1 of 3: one", timeout=SOON_MS)
        with locked(run_lock(first), "a run", print, "run"):
            note.runs(first)
            expect(card).to_contain_text("1. one running", timeout=SOON_MS)
            page.get_by_role("link", name=first.name).first.click()
            expect(card).to_contain_text("3. three not begun", timeout=SOON_MS)
            abort_in_reach(page)
            assert not violations(page)
        with locked(run_lock(second), "a run", print, "run"):
            note.runs(second)
            expect(card).to_contain_text("Script 2 of 3: two", timeout=SOON_MS)
            page.wait_for_url(f"**/#/{second.name}", timeout=SOON_MS)
        shutil.copy(ended, second / DATABASE)
        note.ends("tripped by interlock cold")
        expect(card).to_contain_text("Ended early, 1 of 3 scripts finished", timeout=SOON_MS)
        assert page.url.endswith(second.name), "a queue that has ended is left where it is"


BATH = {"temp_c": 33.0, "set_point_c": 33.0, "band_k": 0.2, "state": "stable", "t_s": 60.0}
LAST = "last reading of this run; nothing is read now"
ENDED = {
    one: f"The run was {one} after 2 of 18 trials: bath: no answer for 12 s."
    for one in (State.FAULTED, State.TRIPPED, State.ABORTED)
} | {
    State.INTERRUPTED: "The bench died before the run was over; 2 of 18 trials are kept.",
}
SILENT = replace(LIVES.instruments[0], link=LinkState.SILENT, age_s=600.0)
UNDER_WAY: tuple[tuple[dict[str, Any], tuple[str, ...]], ...] = (
    ({"step": "settling", "doing": "240 s"}, ("Settling", "240 s", "stable at 33.0 °C ± 0.20 K")),
    (
        {"asked": OpenPrompt("touch", number=1)},
        ("Running", "waiting for an answer: touch", "stable"),
    ),
    ({"paused": True, "doing": ""}, ("Running, a pause is asked for", "", "stable at")),
    ({"instruments": (SILENT,)}, ("Running", "", "bath: no answer for 10 min")),
    ({"step": GOING_TO_SAFE}, ("Going to safe", "", "going to safe")),
    (
        {"wall_time": "2026-11-26T10:00+00:00"},
        ("Running", "the bench has said nothing for", "as it was"),
    ),
)


def test_each_state_of_a_run_has_its_lines(tmp_path: Path) -> None:
    """Line by line: what it does or how it ended, why, and how the bath is."""
    runs = tmp_path / "runs"
    folders = {state: stopped(state, tmp_path / state) for state in (*ENDED, State.RUNNING)}
    runs.mkdir()
    running = [one.rename(runs / state) for state, one in folders.items()][-1]
    damaged = shutil.copytree(runs / State.ABORTED, runs / "at 33 degC, 5 %")
    with closing(sqlite3.connect(damaged / DATABASE)) as db, db:
        db.execute("UPDATE events SET text = 'nothing' WHERE rowid = 1")
    with served.console(runs, tmp_path) as one, browser_page() as seen:
        page = seen.page
        page.context.set_offline(False)
        page.goto(one.address)
        page.goto(one.address)  # once more in the same tab
        expect(page.locator("#list")).to_contain_text("interrupted", timeout=SOON_MS)
        expect(page.locator("#list")).to_contain_text("The record is NOT as it was written")
        page.get_by_role("link", name=damaged.name).click()
        expect(page.locator("#doing")).to_contain_text("No verdict", timeout=SOON_MS)
        page.evaluate("() => { location.hash = ''; }")

        def says(*lines: str) -> None:
            for name, line in zip(("#doing", "#step", "#gate"), lines, strict=True):
                expect(page.locator(name)).to_contain_text(line, timeout=SOON_MS)

        with locked(run_lock(running), "a run", print, "run"):
            expect(page.locator("#list")).to_contain_text("running: ", timeout=SOON_MS)
            for state, why in ENDED.items():
                page.evaluate("(run) => { location.hash = `#/${run}`; }", state)
                says(state.capitalize(), why, LAST)
            page.evaluate("() => { location.hash = '#/running'; }")
            says("Starting", "", LAST)
            soon = (wall_time() + timedelta(days=1)).isoformat()  # of no age, however slow we are
            for how, lines in UNDER_WAY:
                status = replace(LIVES, **{"wall_time": soon, **how})
                said_by(running, status, bath=BATH, interlocks=[], tip=None, ends=[], frames=0)
                says(*lines)
                ends = status.step == GOING_TO_SAFE  # by itself: nothing is to be paused or aborted
                for button in ("#pause", "#abort"):
                    expect(page.locator(button)).to_be_visible(visible=not ends)
            assert not violations(page)
            assert not weak_texts(page)

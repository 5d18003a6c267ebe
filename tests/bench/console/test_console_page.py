"""The page in a real browser: a run done by clicks, two tabs, no network for a while, Abort always
within reach, hostile names as text, and nothing asked for beyond this machine.
"""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from bench.record.reader import read_run
from instruments.operators.mailbox import read_prompt
from tests.bench.console import served
from tests.bench.operated_runs import SCRIPT, texts
from tests.chromium import browser_page, violations

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
    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        assert page.evaluate(ON_TOP), (width, height)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), (width, height)


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
        # another tab sees the same prompt, may not answer, and takes over
        other = page.context.new_page()
        other.goto(one.address)
        other.get_by_role("link", name=folder.name).click()
        expect(other.locator("#ask .what")).to_contain_text(HOSTILE, timeout=SOON_MS)
        expect(other.locator("#answer-done")).to_be_disabled()
        other.locator("#take").click()
        expect(other.locator("#answer-done")).to_be_enabled(timeout=SOON_MS)
        expect(page.locator("#answer-done")).to_be_disabled(timeout=SOON_MS)
        page.locator("#take").click()
        other.close()
        # a reload, and a time without network: the same prompt, and nothing answered by it
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
        page.locator("h1 a").click()  # all runs
        history = page.locator(".run")
        expect(history.locator(".thumbnails img")).to_have_count(3, timeout=SOON_MS)
        expect(history).to_contain_text("aborted: 1 of 3 trials")
        expect(history.get_by_role("button", name="Resume")).to_be_visible()
        assert not violations(page)
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

"""Opens pages from disk in the machine's own Chromium, offline, and notes what they ask for and
complain about: `with browser_page() as seen: seen.open(path)`. Without a browser the test is
skipped.
"""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
from axe_playwright_python.sync_playwright import (  # type: ignore[import-untyped]
    DEFAULT_OPTIONS,
    Axe,
)
from playwright.sync_api import Browser, Page, ViewportSize, sync_playwright

from reports.pdf import NAMES

Scheme = Literal["light", "dark"]
ARGUMENTS = (
    *("--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
)


@dataclass(slots=True)
class Seen:
    """One page in the browser, and what happened in it."""

    page: Page
    requests: list[str] = field(default_factory=list)
    # console errors and warnings, exceptions, requests that failed
    complaints: list[str] = field(default_factory=list)

    def open(self, path: Path, fragment: str = "") -> Page:
        """Opens the file, at `#fragment` where one is given, and waits until it has loaded."""
        self.page.goto(path.resolve().as_uri() + (f"#{fragment}" if fragment else ""))
        return self.page

    def network_requests(self) -> list[str]:
        """Everything that was asked for beyond this disk and the page itself."""
        own = ("file:", "data:", "blob:", "about:")
        return [url for url in self.requests if not url.startswith(own)]

    def image_widths(self) -> dict[str, int]:
        """Width in pixels of every image as decoded, by its address; 0 where it could not be. Lazy
        images are fetched first.
        """
        script = """async () => {
            const images = [...document.images];
            images.forEach((image) => { image.loading = 'eager'; });
            await Promise.all(images.map((image) => image.decode().catch(() => null)));
            return Object.fromEntries(images.map((image) => [image.src, image.naturalWidth]));
        }"""
        return dict(self.page.evaluate(script))


def chromium() -> str:
    """The path of the machine's Chromium or Chrome; skips the test where there is none, or fails it
    where CI promised one.
    """
    found = next((path for path in map(shutil.which, NAMES) if path), None)
    if found is None and os.environ.get("TEATBENCH_NEED_BROWSER"):
        pytest.fail("no browser is installed, and TEATBENCH_NEED_BROWSER says that one has to be")
    if found is None:
        names = ", ".join(NAMES)
        pytest.skip(
            f"needs a browser ({names}); on Debian: apt-get install chromium-headless-shell"
        )
    return found


@contextmanager
def launched() -> Iterator[Browser]:
    """The browser, running; one at a time, since Playwright's loop can't be entered twice."""
    executable = chromium()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=executable, args=list(ARGUMENTS))
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def window(
    browser: Browser,
    width: int = 1440,
    height: int = 900,
    scheme: Scheme = "light",
    javascript: bool = True,
) -> Iterator[Seen]:
    """A fresh, offline window of the given size and colour scheme in a browser that runs."""
    size = ViewportSize(width=width, height=height)
    context = browser.new_context(
        viewport=size, color_scheme=scheme, offline=True, java_script_enabled=javascript
    )
    try:
        seen = Seen(context.new_page())
        said = seen.complaints.append
        seen.page.on(
            "console", lambda one: said(one.text) if one.type in {"error", "warning"} else None
        )
        seen.page.on("pageerror", lambda error: said(f"exception: {error}"))
        seen.page.on("requestfailed", lambda one: said(f"failed: {one.url}: {one.failure}"))
        seen.page.on("request", lambda request: seen.requests.append(request.url))
        yield seen
    finally:
        context.close()


@contextmanager
def browser_page(
    width: int = 1440, height: int = 900, scheme: Scheme = "light", javascript: bool = True
) -> Iterator[Seen]:
    """Both in one: a window in a browser of its own."""
    with launched() as browser, window(browser, width, height, scheme, javascript) as seen:
        yield seen


def violations(page: Page, *, contrast: bool = True) -> list[tuple[str, str]]:
    """What axe-core, as its package carries it, finds in an open page: rule and first element.

    Its own look at contrast takes most of its time on a large page: `weak_texts` looks at it too.
    """
    without = {} if contrast else {"rules": {"color-contrast": {"enabled": False}}}
    found = Axe().run(page, options={**DEFAULT_OPTIONS, **without}).response["violations"]
    return [(str(one["id"]), str(one["nodes"][0]["html"])[:200]) for one in found]


def weak_texts(page: Page) -> list[str]:
    """Each text below the 4.5 : 1 of WCAG 2.1, 1.4.3, against the first opaque ground behind it:
    its element, how it begins, and its ratio.
    """
    found: list[str] = page.evaluate(
        """() => { const line = (v) => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4;
        const light = (rgb) => { const [r, g, b] = rgb.map((v) => line(v / 255));
          return .2126 * r + .7152 * g + .0722 * b; };
        const rgb = (css) => css.match(/[\\d.]+/g).map(Number);
        const grounds = new Map(), ground = (node) => { if (!node) return [[255, 255, 255], 1];
          if (!grounds.has(node)) { const css = getComputedStyle(node), c = rgb(css.backgroundColor);
            const [behind, through] = ground(node.parentElement);
            grounds.set(node, [c.length < 4 || c[3] === 1 ? c.slice(0, 3) : behind, through * css.opacity]); }
          return grounds.get(node); };
        const out = new Set(), walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
        while (walk.nextNode()) { const node = walk.currentNode.parentElement, text = walk.currentNode.data.trim();
          if (!text || node.closest('script, title, .pane, .swatch, .kind')) continue;
          const css = getComputedStyle(node), ink = rgb(node.closest('svg') ? css.fill : css.color);
          const [behind, opacity] = ground(node), through = (ink[3] ?? 1) * opacity;
          const seen = ink.slice(0, 3).map((v, i) => v * through + behind[i] * (1 - through));
          const a = light(seen), b = light(behind), ratio = (Math.max(a, b) + .05) / (Math.min(a, b) + .05);
          if (ratio < 4.5) out.add(node.localName + ' ' + text.slice(0, 30) + ' ' + ratio.toFixed(2)); }
        return [...out]; }"""
    )
    return found

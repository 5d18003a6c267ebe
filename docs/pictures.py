"""The two pictures of README and docs/index.md, made from a report: its first screen, and the
three frames of a trial with truth and answers drawn in.

`python docs/pictures.py [RUN]`; without RUN the script `demo` is run in a folder that is then
removed. It needs the package `playwright` (of the extra `test`) and a Chromium or Chrome.
"""

import shutil
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Page, sync_playwright

from bench.cli.main import main as teatbench

FOLDER = Path(__file__).resolve().parent / "pictures"
TRIAL = 13  # of demo: two teats touch, one is behind another
MOST_BYTES = 150_000
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


def shot(png: bytes) -> np.ndarray:
    """A screenshot as rows x columns x BGR."""
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR))


def first_screen(page: Page, report: Path) -> np.ndarray:
    """The report's page as it opens."""
    page.goto((report / "index.html").as_uri())
    return shot(page.screenshot())


def frame_set(page: Page, report: Path) -> np.ndarray:
    """The left, right and thermal frame of TRIAL side by side."""
    page.goto((report / "trials" / f"trial-{TRIAL:03d}.html").as_uri())
    views = page.locator(".frame .pane")
    if views.count() < 3:
        raise SystemExit(f"{page.url}: has {views.count()} frames, three are needed")
    frames = [shot(views.nth(i).screenshot()) for i in range(3)]
    rows = min(len(frame) for frame in frames)
    return np.hstack([frame[:rows] for frame in frames])


def save(picture: np.ndarray, path: Path) -> None:
    """WebP of the best quality within MOST_BYTES. Raises SystemExit where there is none."""
    for quality in range(90, 20, -5):
        data = cv2.imencode(".webp", picture, [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
        if len(data) <= MOST_BYTES:
            path.parent.mkdir(exist_ok=True)
            path.write_bytes(data)
            sys.stdout.write(f"{path}: {len(data)} bytes, quality {quality}\n")
            return
    raise SystemExit(f"{path}: more than {MOST_BYTES} bytes at any quality")


def pictures(run: Path) -> None:
    """Writes both from a run's report. Raises SystemExit where report or browser are missing."""
    report = run.resolve() / "report"
    browser = next((found for found in map(shutil.which, BROWSERS) if found), None)
    if not (report / "trials").is_dir():
        raise SystemExit(f"{run}: no run with a page a trial; give a run of 'teatbench run demo'")
    if browser is None:
        raise SystemExit(f"no browser is installed (looked for {', '.join(BROWSERS)})")
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = launched.new_page(viewport={"width": 1440, "height": 900})
        save(first_screen(page, report), FOLDER / "report.webp")
        save(frame_set(page, report), FOLDER / "frames.webp")


if __name__ == "__main__":
    if sys.argv[1:]:
        pictures(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as folder:
            teatbench(["run", "demo", "--out", folder])
            pictures(*Path(folder).iterdir())

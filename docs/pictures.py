"""The pictures of README and docs: a report's first screen, the three frames of a trial with truth
and answers drawn in, and the console in the middle of an emulated run that is answered in it.

`python docs/pictures.py [RUN]`; without RUN the script `demo` is run in a folder that is then
removed. `python docs/pictures.py console` makes that one alone. It needs the package `playwright`
(of the extra `test`) and a Chromium or Chrome.
"""

import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Page, sync_playwright

from bench.cli.main import main as teatbench
from bench.rig.loading import find_rig
from bench.script.model import find_script
from instruments.operators.mailbox import NotOpenError, give_answer, read_prompt
from reports.pdf import NAMES

FOLDER = Path(__file__).resolve().parent / "pictures"
TRIAL = 13  # of demo: two teats touch, one is behind another
MOST_BYTES = 150_000
# of the console: this touch of demo's, settled in seconds
PROMPT = "trial 2 of 60, teat 2 of 4"
QUICK = {
    "window_s = 600.0": "window_s = 2.0",
    "slope_k_per_min = 0.01": "slope_k_per_min = 10.0\nteat_slope_k_per_min = 10.0",
}
LONG_S = 180.0


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


@contextmanager
def started(*arguments: str, **how: int) -> Iterator[subprocess.Popen[str]]:
    """A command of the bench, ended afterwards."""
    command = [sys.executable, "-m", "bench.cli", *arguments]
    process = subprocess.Popen(  # noqa: S603 - the bench itself
        command, text=True, stdin=subprocess.DEVNULL, **how
    )
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def console(page: Page, folder: Path) -> np.ndarray:
    """The console's page at PROMPT of a run in ``folder``, whose bath is warm already. Raises
    SystemExit where it never comes.
    """
    script, runs = folder / "demo.toml", folder / "runs"
    text = find_script("demo").read_text(encoding="utf-8")
    for slow, quick in QUICK.items():
        text = text.replace(slow, quick)
    script.write_text(text, encoding="utf-8")
    runs.mkdir()
    shipped, warm = find_rig("emulated-browser"), folder / "rig.toml"
    shutil.copy(shipped.parent / "calibration.toml", folder)
    rig_text = shipped.read_text(encoding="utf-8")
    warm.write_text(f"{rig_text}\n[emulation]\nbath_start_c = 33.0\n", encoding="utf-8")
    rig = ("--rig", str(warm), "--out", str(runs))
    served = started("console", "--runs", str(runs), "--no-open", stdout=subprocess.PIPE)
    with started("run", str(script), *rig), served as process:
        if process.stdout is None:
            raise SystemExit("the console says nothing")
        page.goto(process.stdout.readline().split()[1])
        end_s = time.monotonic() + LONG_S
        while time.monotonic() < end_s:
            time.sleep(0.05)
            for run in runs.iterdir():
                asked = read_prompt(run)
                if not asked or not asked["open"]:
                    continue
                if asked["progress"].startswith(PROMPT):
                    page.reload()
                    page.get_by_role("link", name=run.name).click()
                    page.locator("#tip .huge").wait_for()
                    page.locator("#result svg").nth(2).wait_for()
                    time.sleep(1.0)
                    return shot(page.screenshot())
                try:
                    give_answer(run, asked["number"], "go", "a picture's script")
                except NotOpenError:
                    continue  # it was closed meanwhile
    raise SystemExit(f"the prompt {PROMPT!r} never came")


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


@contextmanager
def window() -> Iterator[Page]:
    """A page in the machine's browser. Raises SystemExit where there is none."""
    browser = next((found for found in map(shutil.which, NAMES) if found), None)
    if browser is None:
        raise SystemExit(f"no browser is installed (looked for {', '.join(NAMES)})")
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        yield launched.new_page(viewport={"width": 1440, "height": 900})


def of_report(page: Page, run: Path) -> None:
    """Writes both pictures of a run's report. Raises SystemExit where it is missing."""
    report = run.resolve() / "report"
    if not (report / "trials").is_dir():
        raise SystemExit(f"{run}: no run with a page a trial; give a run of 'teatbench run demo'")
    save(first_screen(page, report), FOLDER / "report.webp")
    save(frame_set(page, report), FOLDER / "frames.webp")


if __name__ == "__main__":
    with window() as page, tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        if sys.argv[1:] != ["console"]:
            if not sys.argv[1:]:
                teatbench(["run", "demo", "--out", str(here / "demo")])
            runs = map(Path, sys.argv[1:]) if sys.argv[1:] else (here / "demo").glob("*-demo")
            of_report(page, *runs)
        page.set_viewport_size({"width": 1280, "height": 1210})
        save(console(page, here), FOLDER / "console.webp")

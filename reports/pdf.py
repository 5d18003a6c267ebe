"""A page printed to PDF by a browser of this machine, where one is installed. The page's own print style sheet says how it looks.

The browser runs once, without a window, with a profile of its own that is thrown away, and is given a time to end in.
"""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from reports.trust import PageError

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge", "microsoft-edge")
PLACES = (  # where they stand on Windows and macOS without being on the path
    *("Google/Chrome/Application/chrome.exe", "Microsoft/Edge/Application/msedge.exe", "Chromium/Application/chrome.exe"),
    *("Google Chrome.app/Contents/MacOS/Google Chrome", "Chromium.app/Contents/MacOS/Chromium"),
)
ROOTS = ("ProgramFiles", "ProgramFiles(x86)", "LOCALAPPDATA")
TIME_LIMIT_S = 120.0


def find_browser(names: Sequence[str] = NAMES) -> str | None:
    """The path of a Chromium, Chrome or Edge; None where there is none."""
    on_path = next((path for path in map(shutil.which, names) if path), None)
    roots = [Path(os.environ[name]) for name in ROOTS if name in os.environ] + [Path("/Applications")]
    return on_path or next((str(root / place) for root in roots for place in PLACES if (root / place).is_file()), None)


def print_pdf(page: Path, target: Path, browser: str, time_limit_s: float = TIME_LIMIT_S) -> Path:
    """Prints the HTML file `page` to `target`. Raises PageError with the browser's own words where it made none."""
    draft = target.with_name(target.name + ".part")
    draft.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [browser, "--headless", "--disable-gpu", "--no-first-run", "--disable-extensions", "--disable-background-networking"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            command.append("--no-sandbox")  # Chromium refuses its sandbox to root, as in containers
        command += [f"--user-data-dir={profile}", "--no-pdf-header-footer", f"--print-to-pdf={draft.resolve()}", page.resolve().as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, timeout=time_limit_s, check=False)  # noqa: S603 a browser of this machine, our own file
        except (OSError, subprocess.TimeoutExpired) as error:
            raise PageError(f"{target}: {browser} could not print it: {error}") from error
    if not draft.is_file() or not draft.read_bytes().startswith(b"%PDF-"):
        said = done.stderr.decode(errors="replace").strip().splitlines()[-3:]
        raise PageError(f"{target}: {browser} ended with code {done.returncode} and printed nothing: {' '.join(said) or 'no word of it'}")
    draft.replace(target)
    return target

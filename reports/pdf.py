"""A page printed to PDF by an installed browser, by the page's print style sheet.

The browser runs once, headless, with a throw-away profile and a time limit; its output goes to a
file, so that a process it leaves behind can't block. The PDF's producer and its links' paths are
replaced in place, byte for byte as long.
"""

import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

from reports.trust import PageError
from textfiles.whole import take_place

NAMES = (  # the first takes a quarter of the others' time
    *("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome"),
    *("google-chrome-stable", "chrome", "msedge", "microsoft-edge"),
)
PLACES = (  # where they stand on Windows and macOS without being on the path
    "Google/Chrome/Application/chrome.exe",
    "Microsoft/Edge/Application/msedge.exe",
    "Chromium/Application/chrome.exe",
    "Google Chrome.app/Contents/MacOS/Google Chrome",
    "Chromium.app/Contents/MacOS/Chromium",
)
ROOTS = ("ProgramFiles", "ProgramFiles(x86)", "LOCALAPPDATA")
# of the environment: the browser's path; empty where none is to be used
BROWSER = "TEATBENCH_BROWSER"
TIME_LIMIT_S = 120.0
SWITCHES = (
    *("--headless", "--disable-gpu", "--no-first-run", "--disable-extensions"),
    *("--disable-background-networking", "--no-pdf-header-footer"),
    *("--generate-pdf-document-outline",),
)
_TEXT = rb"\(((?:[^()\\]|\\.)*)\)"  # a string of a PDF, ISO 32000-1, 7.3.4.2
_CREATOR = re.compile(rb"/Creator " + _TEXT)
_LINK = re.compile(rb"/URI \((file://(?:[^()\\]|\\.)*)\)")
_AUTHOR, _CREATED = b"/Author (teatbench)", b"/Creator (teatbench)"


def find_browser() -> str | None:
    """The path of a Chromium, Chrome or Edge, or what TEATBENCH_BROWSER names; else None."""
    named = os.environ.get(BROWSER)
    if named is not None:
        return shutil.which(named) if named else None
    roots = [os.environ[name] for name in ROOTS if name in os.environ]
    paths = [Path(root) / place for root in (*roots, "/Applications") for place in PLACES]
    on_path = next((path for path in map(shutil.which, NAMES) if path), None)
    return on_path or next((str(path) for path in paths if path.is_file()), None)


def print_pdf(
    page: Path,
    target: Path,
    browser: str,
    time_limit_s: float = TIME_LIMIT_S,
    *,
    appendix: bool = False,
) -> Path:
    """Print `page`, with `appendix` also what is folded. Raises PageError: the browser's output."""
    draft = target.with_name(target.name + ".part")
    draft.unlink(missing_ok=True)
    try:
        address = page.resolve().as_uri() + ("#appendix" if appendix else "")
        code, said = _printed(browser, address, draft, time_limit_s)
        made = draft.read_bytes() if draft.is_file() else b""
        if not made.startswith(b"%PDF-"):
            raise PageError(
                f"{target}: {browser} ended with code {code} and printed nothing:"
                f" {said or 'no output'}"
            )
        draft.write_bytes(travelling(made, target.resolve().parent))
        take_place(draft, target)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PageError(f"{target}: {browser} could not print it: {error}") from error
    finally:
        draft.unlink(missing_ok=True)
    return target


def _printed(browser: str, address: str, draft: Path, time_limit_s: float) -> tuple[int, str]:
    """The browser's exit code and its last lines of output."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [browser, *SWITCHES, f"--user-data-dir={profile}"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            command.append("--no-sandbox")  # Chromium refuses its sandbox to root, as in containers
        command += [f"--print-to-pdf={draft.resolve()}", address]
        words = Path(profile) / "words.txt"
        with words.open("wb") as said:
            process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=said, stderr=said)  # noqa: S603 a browser of this machine, our own file
            try:
                code = process.wait(time_limit_s)
            finally:
                process.kill()
                process.wait()
        lines = words.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return code, " ".join(lines[-3:])


def travelling(pdf: bytes, folder: Path) -> bytes:
    """`pdf` signed by us, its links relative to `folder`. Every part keeps its length: a PDF's
    table of contents counts bytes (ISO 32000-1, 7.5.4).
    """

    def link(found: re.Match[bytes]) -> bytes:
        uri = re.sub(rb"\\(.)", rb"\1", found[1]).decode("ascii", errors="replace")
        local = unquote(urlsplit(uri).path)
        path = Path(local[1:] if re.match(r"/[A-Za-z]:", local) else local)
        relative = os.path.relpath(path, folder) if folder.anchor == path.anchor else path.name
        quoted = quote(Path(relative).as_posix(), safe="/-._~")
        return _as_long(found[0], f"/URI ({quoted})".encode("ascii"))

    def signature(found: re.Match[bytes]) -> bytes:
        return _as_long(_as_long(found[0], _AUTHOR), _AUTHOR + _CREATED)

    return _LINK.sub(link, _CREATOR.sub(signature, pdf))


def _as_long(old: bytes, new: bytes) -> bytes:
    return new.ljust(len(old)) if len(new) <= len(old) else old

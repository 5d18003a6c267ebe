"""A report as one file for mail, with its pictures: trials in the order of `Page.worst`, then of
the page, as long as they fit. What is left out is said at the top of the trials.
"""

import base64
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from reports.page import Page, TrialPart
from reports.render import Place, Press, refuse_missing, write_whole
from reports.trust import PageError

MOST_BYTES = 20_000_000  # what most mail servers take
MOST_TRIALS = 40
_TYPES = {".jpg": "image/jpeg", ".png": "image/png"}


def write_single_file(page: Page, folder: Path, target: Path, most_bytes: int = MOST_BYTES) -> Path:
    """Writes `page` with its images, which stand in `folder`, as the one file `target` of at most
    `most_bytes`.

    Raises PageError where an image is missing or of another kind than JPEG and PNG, or where the
    page is too large without any trial.
    """
    trials = list(_by_order(page))[:MOST_TRIALS]
    refuse_missing(
        (replace(image, original="") for trial in trials for image in trial.images), folder
    )
    room = most_bytes - len(_html(page, (), folder).encode("utf-8"))
    if room < 0:
        raise PageError(
            f"{target}: the page alone is larger than {most_bytes} bytes by {-room}; allow more"
        )
    kept: list[TrialPart] = []
    for trial in trials:
        room -= sum(_encoded_size(folder / image.src) for image in trial.images)
        if room < 0:
            break
        kept.append(trial)
    while (
        (html := _html(page, tuple(kept), folder))
        and len(html.encode("utf-8")) > most_bytes
        and kept
    ):
        kept.pop()
    return write_whole(target, html)


def _by_order(page: Page) -> Iterator[TrialPart]:
    by_id = {trial.id: trial for trial in page.trials}
    yield from (by_id.pop(name) for name in page.worst)
    yield from by_id.values()


def _html(page: Page, kept: tuple[TrialPart, ...], folder: Path) -> str:
    """The page with the trials kept, in the page's order."""
    ids = {trial.id for trial in kept}
    shown = tuple(trial for trial in page.trials if trial.id in ids)
    left_out = len(page.trials) - len(shown)
    told = (
        f"{len(shown)} of {len(page.trials)} trials are in this file, those to look at first; the"
        " whole report has all. "
    )
    note = f"{told if left_out else ''}{page.trials_note}"
    embedded = {
        image.src: _data_uri(folder / image.src) for trial in shown for image in trial.images
    }
    travelling = replace(page, trials_note=note.strip())
    return Press(travelling).page(Place(shown, files=False, embedded=embedded))


def _data_uri(path: Path) -> str:
    kind = _TYPES.get(path.suffix)
    if kind is None:
        raise PageError(
            f"{path}: a file for mail holds JPEG and PNG, no"
            f" {path.suffix or 'file without an ending'}"
        )
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def _encoded_size(path: Path) -> int:
    return 40 + 4 * (path.stat().st_size + 2) // 3

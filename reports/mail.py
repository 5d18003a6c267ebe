"""A report as one file for mail, with its pictures: trials in the order of `Page.worst`, then of
the page, as long as they fit. What is left out is said at the top of the trials.
"""

import base64
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from reports.frames import ImageView
from reports.page import Page, TrialPart
from reports.render import Place, Press, refuse_missing, write_whole
from reports.trust import PageError

MOST_BYTES = 20_000_000  # what most mail servers take
MOST_TRIALS = 40
_TYPES = {".jpg": "image/jpeg", ".png": "image/png"}


def write_single_file(page: Page, folder: Path, target: Path, most_bytes: int = MOST_BYTES) -> Path:
    """Write `page` and its images, from `folder`, as one file. Raises PageError for an image that
    is missing or no JPEG or PNG, or a page too large without any trial.
    """
    by_id = {trial.id: trial for trial in page.trials}
    trials = [by_id[name] for name in dict.fromkeys((*page.worst, *by_id))][:MOST_TRIALS]
    images = _images(page, trials)
    refuse_missing((replace(image, original="") for image in images), folder)
    room = most_bytes - len(_html(page, (), folder).encode("utf-8"))
    if room < 0:
        said = f"the page alone is larger than {most_bytes} bytes by {-room}; allow more"
        raise PageError(f"{target}: {said}")
    kept: list[TrialPart] = []
    for trial in trials:
        # each picture in base 64, and what stands before it
        paths = [folder / image.src for image in trial.images]
        room -= sum(40 + 4 * (path.stat().st_size + 2) // 3 for path in paths)
        if room < 0:
            break
        kept.append(trial)
    html = _html(page, kept, folder)
    while kept and len(html.encode("utf-8")) > most_bytes:
        kept.pop()
        html = _html(page, kept, folder)
    return write_whole(target, html)


def _html(page: Page, kept: Sequence[TrialPart], folder: Path) -> str:
    """The page with the trials kept, in the page's order."""
    ids = {trial.id for trial in kept}
    shown = tuple(trial for trial in page.trials if trial.id in ids)
    note = page.trials_note
    if len(shown) < len(page.trials):
        note = (
            f"{len(shown)} of {len(page.trials)} trials are in this file, those to look at first;"
            f" the whole report has all. {note}"
        )
    sources = {image.src for image in _images(page, shown)}
    embedded = {src: _data_uri(folder / src) for src in sources}
    travelling = replace(page, trials_note=note.strip())
    return Press(travelling).page(Place(shown, embedded=embedded))


def _images(page: Page, trials: Sequence[TrialPart]) -> list[ImageView]:
    """Those of the first page and of these trials."""
    first = [image for look in page.looks() for image in look.images]
    return first + [image for trial in trials for image in trial.images]


def _data_uri(path: Path) -> str:
    kind, other = _TYPES.get(path.suffix), path.suffix or "file without an ending"
    if kind is None:
        raise PageError(f"{path}: a file for mail holds JPEG and PNG, no {other}")
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"

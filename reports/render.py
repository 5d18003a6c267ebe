"""From a `Page` to one HTML file that opens from disk with no network.

Strategy: Jinja2 escapes every text; the only texts let through are our own style sheet and script, the drawings that `page.Figure` has
checked, and numbers. The page carries a content security policy that allows exactly that style sheet and that script, by their hash, and
images. Same page, same bytes: no time, no chance, no machine in it.
"""

import base64
import hashlib
import os
import re
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from reports.frames import ImageView
from reports.page import Figure, Page, PageError, Verdict
from reports.trust import address

_TEMPLATES = Path(__file__).parent / "templates"
_NO_TEXT_IN_HTML = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufdd0-\ufdef\ufffe\uffff]")
_SIGNS: dict[Verdict, str] = {"met": "✓", "not met": "✕", "inconclusive": "?", "not measured": "–", "aborted": "!", "no verdict": "○"}

View = tuple[int, int, int, int, int, int]  # size of an image, and the part of it that is shown: all that a view's style rule needs


def render(page: Page) -> str:
    """The whole HTML text of `page`."""
    views = {view: f"v{number}" for number, view in enumerate(dict.fromkeys(_view(image) for image in page.images()))}
    style = _asset("style.css") + "".join(_view_rule(name, view) for view, name in views.items())
    script = _asset("script.js")
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES, encoding="utf-8"),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_printable,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(drawing=_drawing, number=_number, url=_url, slug=lambda word: word.replace(" ", "-"))
    return environment.get_template("page.html.j2").render(
        page=page,
        layers=page.layers(),
        view_name=lambda image: views[_view(image)],
        signs=_SIGNS,
        style=Markup(style),  # noqa: S704 our own file and numbers
        script=Markup(script),  # noqa: S704 our own file
        policy=_policy(style, script),
    )


def write_report(page: Page, folder: Path) -> Path:
    """Writes `folder/index.html`, whole or not at all, and returns its path. The images must already stand where their `src` says.

    Raises PageError that lists the images which are not there; OSError where the folder can't be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    wanted = dict.fromkeys(path for image in page.images() for path in (image.src, image.original or image.src))
    missing = [path for path in wanted if not (folder / path).is_file()]
    if missing:
        shown = ", ".join(missing[:5]) + (f" and {len(missing) - 5} more" if len(missing) > 5 else "")
        raise PageError(f"report in {folder}: {len(missing)} images are not there: {shown}; write the images before the page")
    target = folder / "index.html"
    draft = folder / "index.html.part"
    with draft.open("w", encoding="utf-8", newline="\n") as file:
        file.write(render(page))
        file.flush()
        os.fsync(file.fileno())
    draft.replace(target)
    return target


def _asset(name: str) -> str:
    text = (_TEMPLATES / name).read_text(encoding="utf-8")
    if "</" in text:
        raise PageError(f"reports/templates/{name} holds '</', which would end its own element")
    return text


def _policy(style: str, script: str) -> str:
    def digest(text: str) -> str:
        return "'sha256-" + base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii") + "'"

    ours = f"style-src {digest(style)}; script-src {digest(script)}"
    return f"default-src 'none'; img-src 'self' data: file:; {ours}; base-uri 'none'; form-action 'none'"


def _printable(value: Any) -> Any:
    """Text without the characters that HTML can't hold: each becomes U+FFFD, so that one sees that something stood there."""
    return value if isinstance(value, Markup) or not isinstance(value, str) else _NO_TEXT_IN_HTML.sub("\ufffd", value)


def _drawing(figure: Figure) -> Markup:
    return Markup(figure.svg)  # noqa: S704 page.Figure has checked every element and attribute


def _url(value: str) -> str:
    return address(value, "link")


def _number(value: float) -> str:
    text = f"{float(value):.2f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text


def _view(image: ImageView) -> View:
    return (image.width, image.height, *image.shown)


def _view_rule(name: str, view: View) -> str:
    """The style rule that shows one part of an image: `style` attributes are closed to us by the page's policy."""
    full_width, full_height, x, y, width, height = view
    place = f"left:{-100 * x / width:.4f}%;top:{-100 * y / height:.4f}%;width:{100 * full_width / width:.4f}%"
    return (
        f".{name}{{aspect-ratio:{width}/{height}}}.{name} img{{{place}}}"
        f".whole .{name}{{aspect-ratio:{full_width}/{full_height}}}.whole .{name} img{{left:0;top:0;width:100%}}\n"
    )

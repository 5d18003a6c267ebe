"""Terms are links to one list, and say what they mean on hovering and by keyboard."""

import dataclasses
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect

from bench.report.glossary import markdown, terms
from reports.glossary import GlossaryLinks, Term
from reports.page import Page
from reports.render import write_report
from tests.chromium import window
from tests.conftest import ROOT
from tests.reports.markup import read
from tests.reports.sample import sample_page

RMS = Term("rms", 'Root mean square: "<b>" \\ size')
EXPLAINED = GlossaryLinks((RMS, Term("rms error", "x"), Term("pose", "y", ("poses",))), "a.html")


def test_whole_words_are_explained_once_and_the_rest_is_escaped() -> None:
    said = EXPLAINED("Poses, poses: <rms> of alarms, rms error, rms")
    links = read(str(said)).all("a")
    assert [link.attributes["href"] for link in links] == [
        "a.html#term-pose",
        "a.html#term-rms",
        "a.html#term-rms-error",
    ]
    assert [link.text for link in links] == ["Poses", "rms", "rms error"]
    assert "&lt;<a" in said
    assert GlossaryLinks(())("a & b") == "a &amp; b"
    assert GlossaryLinks((RMS,), names=("rms",))("rms") == "rms", "a detector may be called so"


def test_the_docs_have_the_same_terms() -> None:
    """`python -m bench.report.glossary` writes the page."""
    assert (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8") == markdown()
    assert len({term.id for term in terms()}) == len(terms())
    spelt = [word for term in terms() for word in (term.name, *term.also)]
    assert len(set(spelt)) == len(spelt)


@pytest.mark.weekly
@pytest.mark.browser
def test_a_term_says_what_it_means_by_keyboard_without_a_script(
    browser: Browser, tmp_path: Path
) -> None:
    page: Page = dataclasses.replace(sample_page(tmp_path), glossary=(RMS, *terms()[:3]))
    banner = dataclasses.replace(page.banner, confidence="The rms is 1 mm.")
    path = write_report(dataclasses.replace(page, banner=banner), tmp_path)
    with window(browser, javascript=False) as seen:
        opened = seen.open(path)
        term = opened.locator("#verdict a.term-rms")
        tip = "e => getComputedStyle(e, '::after').content"
        assert term.evaluate(tip) == "none"
        term.focus()
        assert term.evaluate(tip) == '"Root mean square: \\"<b>\\" \\\\ size"'
        term.click()
        expect(opened.locator("#term-rms dd")).to_be_visible()
        assert seen.complaints == []

"""Zoom and pan of a trial's frames in a real browser: wheel, keys, buttons, drag, pinch, double
click; all frames of a trial together.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from playwright.sync_api import Browser, FloatRect, Locator, Page, expect

from reports.render import write_report
from tests.chromium import Seen, window
from tests.reports.sample import sample_page

pytestmark = [pytest.mark.browser, pytest.mark.slow]  # a browser starts for some seconds

View = list[float]
PART: View = [139.5, 99.5, 400, 240]  # of the left and the right frame, at first
WHOLE: View = [-0.5, -0.5, 640, 480]
# screen pixels: a pointer tells whole ones, and what it is short of grows with the zoom
BY_POINTER = 2.0
TEAT_2 = (285, 215)  # its truth, in pixels of every camera of the sample


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's page with its trials and their list alone: no figure is looked at."""
    folder = tmp_path_factory.mktemp("trials")
    page = sample_page(folder)
    sections = tuple(one for one in page.sections if one.id == "trial-list")
    return write_report(replace(page, sections=sections), folder)


@pytest.fixture
def seen(browser: Browser, report: Path) -> Iterator[Seen]:
    """The report at its first trial; nothing done there asks a network or offends a policy."""
    with window(browser) as fresh:
        fresh.open(report, "trial-001")
        yield fresh
        assert fresh.network_requests() == []
        assert fresh.complaints == []


def pane(page: Page, number: int = 0, trial: str = "trial-001") -> Locator:
    return page.locator(f"#{trial} .pane").nth(number)


def view(page: Page, number: int = 0, trial: str = "trial-001") -> View:
    box = str(pane(page, number, trial).locator("svg").get_attribute("viewBox"))
    return [float(value) for value in box.split()]


def box(page: Page, number: int = 0) -> FloatRect:
    found = pane(page, number).bounding_box()
    assert found is not None
    return found


def on_screen(page: Page, pixel: tuple[float, float], number: int = 0) -> tuple[float, float]:
    """Where a pixel of the image is drawn, by the drawing over it."""
    at, shown = box(page, number), view(page, number)
    return (
        at["x"] + (pixel[0] - shown[0]) / shown[2] * at["width"],
        at["y"] + (pixel[1] - shown[1]) / shown[3] * at["height"],
    )


def changed(page: Page, before: View, number: int = 0) -> View:
    """The view, once it is another than before."""
    old = re.escape(" ".join(f"{v:g}" for v in before))
    svg = pane(page, number).locator("svg")
    expect(svg).not_to_have_attribute("viewBox", re.compile(f"^{old}$"))
    return view(page, number)


def press(page: Page, *keys: str) -> None:
    for key in keys:
        page.keyboard.press(key)


def views(page: Page) -> list[View]:
    return [view(page, number) for number in range(3)]


def test_the_wheel_zooms_a_clicked_frame_where_the_pointer_is_and_else_scrolls_the_page(
    seen: Seen,
) -> None:
    page = seen.page
    page.mouse.move(*on_screen(page, TEAT_2))
    before = page.evaluate("() => scrollY")
    page.mouse.wheel(0, 20)
    page.wait_for_function("before => scrollY > before", arg=before)
    assert view(page) == PART
    x, y = on_screen(page, TEAT_2)
    page.mouse.click(x, y)
    assert view(page) == PART
    page.mouse.wheel(0, -100)
    shown = changed(page, PART)
    assert shown[2] == pytest.approx(400 / 1.35, rel=0.01)
    assert shown[3] / shown[2] == pytest.approx(240 / 400)
    assert on_screen(page, TEAT_2) == pytest.approx((x, y), abs=BY_POINTER)


def test_keys_zoom_and_move_the_frame_with_the_focus(seen: Seen) -> None:
    page = seen.page
    pane(page).focus()
    expect(pane(page)).to_have_attribute(
        "aria-label", "Left camera: + and − zoom, arrow keys move, 0 goes back"
    )
    x, y, width, height = 139.5 + 400 / 6, 99.5 + 240 / 6, 400 / 1.5, 160
    for keys, shown in (
        ("+", [x, y, width, height]),
        ("ArrowLeft ArrowDown", [x - 40, y + 24, width, height]),
        ("-", PART),
        ("-", [139.5 - 100, 99.5 - 60, 600, 360]),
    ):
        press(page, *keys.split())
        assert view(page) == pytest.approx(shown)
    press(page, *"-----")
    assert view(page)[2:] == pytest.approx([640, 384])  # no more than there is
    press(page, "0")
    assert view(page) == PART
    page.evaluate("() => document.activeElement.blur()")
    press(page, "j", "+")  # without a focus, for the trial that is read
    expect(page).to_have_url(re.compile("#trial-002$"))
    assert view(page, trial="trial-002")[2] == pytest.approx(400 / 1.5)
    assert view(page) == PART


def test_a_double_click_takes_all_frames_of_a_trial_nearer_and_with_shift_back_out(
    seen: Seen,
) -> None:
    page = seen.page
    x, y = on_screen(page, TEAT_2)
    page.mouse.dblclick(x, y)
    assert changed(page, PART)[2] == pytest.approx(160)
    assert on_screen(page, TEAT_2) == pytest.approx((x, y), abs=BY_POINTER)
    page.mouse.dblclick(*on_screen(page, TEAT_2))
    left, right, thermal = views(page)
    assert left[2] == pytest.approx(64)
    assert right == pytest.approx(left, abs=0.5)
    assert thermal[2] == pytest.approx(640 / 6.25)
    parts = []
    for number in (0, 2):
        (across, down), at = on_screen(page, TEAT_2, number), box(page, number)
        parts.append(((across - at["x"]) / at["width"], (down - at["y"]) / at["height"]))
    assert parts[1] == pytest.approx(parts[0], abs=0.06)
    assert view(page, trial="trial-002") == PART
    gaps = page.evaluate(
        """([x, y]) => [...document.querySelectorAll('#trial-001 .pane')].map((pane) => {
        const image = pane.querySelector('img').getBoundingClientRect();
        const mark = pane.querySelectorAll('.layer-truth circle')[1].getBoundingClientRect();
        return Math.hypot(mark.left + mark.width / 2 - image.left - (x + .5) / 640 * image.width,
          mark.top + mark.height / 2 - image.top - (y + .5) / 480 * image.height); })""",
        list(TEAT_2),
    )
    assert gaps == pytest.approx([0, 0, 0], abs=0.5), "what is drawn stays over its pixel"
    page.keyboard.down("Shift")
    for _ in range(2):
        page.mouse.dblclick(x, y)
    page.keyboard.up("Shift")
    assert view(page) == pytest.approx(PART)


def test_a_drag_moves_the_picture_with_the_pointer_and_no_further_than_its_edge(seen: Seen) -> None:
    page = seen.page
    x, y = on_screen(page, TEAT_2)
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 30, y + 20, steps=3)
    page.mouse.up()
    assert changed(page, PART)[2:] == pytest.approx([400, 240])
    assert on_screen(page, TEAT_2) == pytest.approx((x + 30, y + 20), abs=0.1)
    page.mouse.move(x, y)  # the button is up: nothing moves
    page.mouse.down()
    page.mouse.move(x + 3000, y + 3000, steps=3)
    page.mouse.up()
    assert view(page)[:2] == [-0.5, -0.5]
    expect(page).to_have_url(re.compile("index.html#trial-001$"))


def test_two_fingers_pinch(seen: Seen) -> None:
    page = seen.page
    touch = page.context.new_cdp_session(page)
    touch.send("Emulation.setTouchEmulationEnabled", {"enabled": True, "maxTouchPoints": 2})
    # buttons are larger then: the page moves
    page.wait_for_function("() => matchMedia('(pointer: coarse)').matches")
    x, y = on_screen(page, TEAT_2)
    for kind, apart in (("touchStart", 20), ("touchMove", 30), ("touchMove", 40)):
        points = [{"x": x - apart, "y": y, "id": 1}, {"x": x + apart, "y": y, "id": 2}]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    page.wait_for_function(
        "() => document.querySelector('#trial-001 .pane svg').viewBox.baseVal.width < 201"
    )
    assert view(page)[2] == pytest.approx(200, rel=0.01)
    assert on_screen(page, TEAT_2) == pytest.approx((x, y), abs=1.0)


def test_switching_overlays_keeps_the_view_and_z_begins_anew(seen: Seen) -> None:
    page = seen.page
    pane(page).focus()
    page.keyboard.press("+")
    zoomed = views(page)
    page.get_by_label("truth").uncheck()
    press(page, "o", "o")
    expect(pane(page, 1).locator(".layer-truth")).to_be_hidden()
    assert views(page) == zoomed
    page.keyboard.press("z")
    assert views(page) == [WHOLE] * 3
    page.keyboard.press("z")
    assert views(page) == [PART, PART, WHOLE]


def test_strokes_and_letters_keep_their_size_and_pixels_become_squares(seen: Seen) -> None:
    page = seen.page
    label, image = pane(page).locator(".layer-other text").nth(1), pane(page).locator("img")
    effects = page.evaluate(
        "() => [...document.querySelectorAll('.pane .layer *')].map((e) =>"
        " getComputedStyle(e).vectorEffect)"
    )
    assert set(effects) == {"non-scaling-stroke"}
    expect(image).to_have_css("image-rendering", "auto")
    height = label.evaluate("e => e.getBoundingClientRect().height")
    pane(page).focus()
    press(page, *"+" * 12)
    assert view(page)[2] == pytest.approx(16)
    expect(image).to_have_css("image-rendering", "pixelated")
    frame = pane(page).locator("xpath=..")
    expect(frame.get_by_role("button", name="Zoom back, Left camera")).to_have_text("25.0×")
    zoomed = label.evaluate("e => e.getBoundingClientRect().height")
    assert zoomed == pytest.approx(height, rel=0.05)
    page.keyboard.press("0")
    expect(image).to_have_css("image-rendering", "auto")


def test_buttons_do_the_same_and_are_large_enough_for_a_finger(seen: Seen) -> None:
    page = seen.page
    page.get_by_role("button", name="Zoom in, Right camera").first.click()
    assert view(page)[2] == pytest.approx(400 / 1.5)
    name = "Zoom back, Thermal camera, un-mirrored"
    back = page.locator("#trial-001").get_by_role("button", name=name)
    expect(back).to_have_text("1.5×")
    back.click()
    assert views(page) == [PART, PART, WHOLE]
    expect(back).to_be_hidden()
    sizes = page.locator("#trial-001 .tools > :not([hidden])").evaluate_all(
        "found => found.map((e) => e.getBoundingClientRect()).map((b) => [b.width, b.height])"
    )
    assert min(min(size) for size in sizes) >= 24  # WCAG 2.2, 2.5.8


def test_what_a_mark_is_shows_on_hovering(seen: Seen) -> None:
    page = seen.page
    x, y = on_screen(page, (TEAT_2[0], TEAT_2[1] - 9))  # on the ring
    text = page.evaluate(
        "([x, y]) => document.elementsFromPoint(x, y).map((e) => e.querySelector(':scope >"
        " title')?.textContent).filter(Boolean)",
        [x, y],
    )
    assert "teat 2" in text


def test_the_original_is_a_link_beside_the_picture_or_without_a_script_the_picture(
    browser: Browser, report: Path, seen: Seen
) -> None:
    link = seen.page.locator("#trial-001").get_by_role("link", name="Original of Left camera")
    expect(link).to_have_attribute("href", "frames/trial-001/left.png")
    assert seen.page.locator(".pane a").count() == 0
    with window(browser, javascript=False) as bare:
        page = bare.open(report, "trial-001")
        assert page.locator(".tools, .pane[tabindex]").count() == 0
        pane(page).locator("a").click()
        page.wait_for_url("**/frames/trial-001/left.png")

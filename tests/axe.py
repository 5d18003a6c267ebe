"""axe-core, as the package axe-playwright-python carries it, run in a page that is open. Nothing is
fetched.
"""

from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]
from playwright.sync_api import Page


def violations(page: Page) -> list[tuple[str, str]]:
    """Rule and first element of each violation."""
    found = Axe().run(page).response["violations"]
    return [(str(one["id"]), str(one["nodes"][0]["html"])[:200]) for one in found]

"""A browser without a window, and pages in it."""

import os
import shutil

import pytest

# Software rendering, which is the same on every machine.
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
         "--no-sandbox"]  # fmt: skip
NAMES = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture(scope="session")
def browser():
    """Chromium, started once; skips where it or Playwright is absent."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    path = os.environ.get("REFLFIELD_CHROMIUM") or next(
        filter(None, map(shutil.which, NAMES)), None
    )
    if path is None:
        pytest.skip("needs Chromium (set REFLFIELD_CHROMIUM to its path)")
    with sync_api.sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=path, args=FLAGS)
        yield running
        running.close()


class Pages:
    """Pages opened from files, as a user opens them who got them by mail."""

    def __init__(self, browser, folder):
        self.browser, self.folder = browser, folder
        self.opened, self.errors = [], []

    def open(
        self, html, fragment="", *, size=(64, 64), waits=True, errors_matter=True, touch=False
    ):
        """A page whose object is there; what it logs as an error counts."""
        path = self.folder / f"object{len(self.opened)}.html"
        path.write_text(html, encoding="utf-8")
        page = self.browser.new_page(
            viewport={"width": size[0], "height": size[1]},
            reduced_motion="reduce",
            has_touch=touch,
            is_mobile=touch,
        )
        page.set_default_timeout(60_000)
        self.opened.append(page)
        if errors_matter:
            page.on("pageerror", lambda error: self.errors.append(str(error)))
            page.on(
                "console", lambda m: self.errors.append(m.text) if m.type == "error" else None
            )
        page.goto(f"{path.as_uri()}{'#' + fragment if fragment else ''}")
        if waits:
            page.evaluate("reflfield.ready")
        return page

    def close(self):
        """Close all; what they logged is the test's error."""
        for page in self.opened:
            page.close()
        assert self.errors == []


@pytest.fixture
def open_page(browser, tmp_path):
    """Function from HTML text to a page, as `Pages.open`."""
    pages = Pages(browser, tmp_path)
    yield pages.open
    pages.close()


@pytest.fixture(scope="module")
def open_shared_page(browser, tmp_path_factory):
    """The same for pages that all tests of a module use."""
    pages = Pages(browser, tmp_path_factory.mktemp("pages"))
    yield pages.open
    pages.close()

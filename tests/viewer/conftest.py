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


@pytest.fixture
def open_page(browser, tmp_path):
    """Function from HTML text to a page whose object is there; fails on errors it logs.

    The page is opened from a file, as a user opens it who got it by mail.
    """
    pages, errors = [], []

    def opened(html, fragment="", *, size=(64, 64), waits=True, errors_matter=True):
        path = tmp_path / f"object{len(pages)}.html"
        path.write_text(html, encoding="utf-8")
        page = browser.new_page(
            viewport={"width": size[0], "height": size[1]}, reduced_motion="reduce"
        )
        page.set_default_timeout(60_000)
        pages.append(page)
        if errors_matter:
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        page.goto(f"{path.as_uri()}{'#' + fragment if fragment else ''}")
        if waits:
            page.evaluate("reflfield.ready")
        return page

    yield opened
    for page in pages:
        page.close()
    assert errors == []

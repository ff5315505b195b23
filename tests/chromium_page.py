"""A page opened in Chromium, and pictures of its parts."""

import contextlib
import pathlib
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from playwright.sync_api import Locator, Page, sync_playwright

CHROMIUM_FLAGS = [
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    # WebGL without a GPU.
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]


DRIVERS_ADVICE = "GL Driver Message (OpenGL, Performance"
"""What Chromium writes to a page's console on behalf of its driver: a screenshot that reads back a drawing is slow."""


@contextlib.contextmanager
def opened(chromium: str, path: pathlib.Path, scheme: str, width: int = 1280) -> Iterator[tuple[Page, list[str], list[str]]]:
    """The page with all plots drawn, its messages on the console and the addresses it asked for."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=CHROMIUM_FLAGS)
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme)
        page, messages, requests = context.new_page(), [], []
        page.on("console", lambda m: None if DRIVERS_ADVICE in m.text else messages.append(f"{m.type}: {m.text}"))
        page.on("pageerror", lambda error: messages.append(f"pageerror: {error}"))
        page.on("request", lambda request: requests.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_selector("html[data-plots=drawn]", timeout=120_000)
        try:
            yield page, messages, requests
        finally:
            browser.close()


def picture(element: Locator) -> np.ndarray:
    """A screenshot, (h, w, 3)."""
    return cv2.imdecode(np.frombuffer(element.screenshot(), np.uint8), cv2.IMREAD_COLOR)


def settled(page: Page, element: Locator) -> np.ndarray:
    """The first of two equal screenshots in a row."""
    last = picture(element)
    for _ in range(40):
        page.wait_for_timeout(250)
        now = picture(element)
        if np.array_equal(now, last):
            return now
        last = now
    pytest.fail("the 3D view does not come to rest in 10 s")

"""A headless Chromium for tests of pages; where there is none, they are skipped."""

import importlib.util
import io
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from PIL import Image

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chrome"))), None)
DRIVER = shutil.which("chromedriver")

needs_browser = pytest.mark.skipif(
    None in (CHROMIUM, DRIVER, importlib.util.find_spec("selenium")),
    reason="no chromium with chromedriver and selenium: apt-get install chromium chromium-driver",
)

SECONDS = 60.0
"""How long anything may take."""


@contextmanager
def browser(width: int = 900, height: int = 600) -> Iterator[Any]:
    """A browser that draws WebGL without a GPU."""
    webdriver: Any = importlib.import_module("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    for word in (
        "headless=new",
        "no-sandbox",
        "disable-dev-shm-usage",
        "use-angle=swiftshader",
        "enable-unsafe-swiftshader",
        f"window-size={width},{height}",
    ):
        options.add_argument(f"--{word}")
    driver = webdriver.Chrome(options, webdriver.ChromeService(DRIVER))
    try:
        yield driver
    finally:
        driver.quit()


def until(condition: Callable[[], Any]) -> None:
    """Wait for something."""
    end = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def canvas_of(page: Any) -> np.ndarray:
    """What a page draws. [H, W, 3]"""
    canvas = page.find_element("css selector", "canvas")
    with Image.open(io.BytesIO(canvas.screenshot_as_png)) as picture:
        return np.asarray(picture.convert("RGB")).astype(int)

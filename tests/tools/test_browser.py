"""A real browser before a field that trains: what it shows, and what its controls do."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.tools.browser import SECONDS, browser, canvas_of, needs_browser, until
from tests.training.runs import small_config
from xplanes.rendering.pictures import to_bytes
from xplanes.run import run
from xplanes.tools import live
from xplanes.tools import viewer as module
from xplanes.tools.viewer import Viewer

pytestmark = [pytest.mark.slow, needs_browser]

pytest.importorskip("viser")
webdriver: Any = pytest.importorskip("selenium.webdriver")
ScrollOrigin = pytest.importorskip("selenium.webdriver.common.actions.wheel_input").ScrollOrigin


class Recorded(Viewer):
    """A viewer whose pictures are kept."""

    made: "list[Recorded]" = []  # noqa: RUF012

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.pictures: list[np.ndarray] = []
        Recorded.made.append(self)


@pytest.fixture(scope="module")
def viewer(scenes: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Recorded]:
    """The viewer of a run that trains until the tests are done."""
    folder = tmp_path_factory.mktemp("browser")
    config = small_config(
        scenes,
        "viewer=true",
        "callbacks.viewer.port=0",
        "callbacks.evaluation.at=[1]",
        "trainer.max_steps=1000000",
    )
    send = module._Browser._send

    def recorded(browser: Any, picture: Any) -> None:
        browser.viewer.pictures.append(to_bytes(picture.colours).numpy())
        send(browser, picture)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(live, "Viewer", Recorded)
        patch.setattr(module._Browser, "_send", recorded)
        thread = threading.Thread(
            target=run, args=(config, folder / "run", []), kwargs={"resume": False}
        )
        thread.start()
        until(lambda: Recorded.made)
        found = Recorded.made[-1]
        yield found
        found.paused = False
        found.module.trainer.should_stop = True
        thread.join(SECONDS)
        assert not thread.is_alive()


@pytest.fixture(scope="module")
def page(viewer: Recorded) -> Iterator[Any]:
    """A browser that shows a picture."""
    with browser() as driver:
        driver.get(f"http://localhost:{viewer.port}")
        until(lambda: viewer.pictures)
        until(lambda: np.ptp(screen(driver)) > 50)
        yield driver


def screen(page: Any) -> np.ndarray:
    """What the page shows left of its controls and below its messages. [H, W, 3]"""
    return canvas_of(page)[170:, :560]


def settled(page: Any) -> np.ndarray:
    """What the page shows once it changes no more."""
    shown = [screen(page)]

    def rests() -> bool:
        time.sleep(1.0)
        shown.append(screen(page))
        return np.array_equal(shown[-1], shown[-2])

    until(rests)
    return shown[-1]


def click(page: Any, text: str) -> None:
    page.find_element("xpath", f"//button[contains(., '{text}')]").click()


def test_the_page_shows_and_steers_a_field_that_trains(viewer, page):
    # It changes as the field is trained.
    first, step = screen(page), viewer.step
    until(lambda: viewer.step > step + 50 and np.abs(screen(page) - first).mean() > 0.5)
    until(lambda: "step" in page.find_element("css selector", "body").text)

    click(page, "Pause training")
    until(lambda: viewer.paused)
    shown, step = settled(page), viewer.step
    assert len(viewer.pictures[-1]) == int(viewer.size.value)

    # The time slider.
    thumb = page.find_element("css selector", "[role=slider]")
    thumb.send_keys("\ue014" * 60)  # Right
    until(lambda: float(thumb.get_attribute("aria-valuenow")) == pytest.approx(0.3))
    later = settled(page)
    assert viewer.time.value == pytest.approx(0.3)
    assert np.abs(later - shown).mean() > 0.2  # Paused, the same picture does not change.

    # What is on the page is what was drawn, as large.
    viewer.cameras.value = False
    plain, drawn = settled(page), viewer.pictures[-1]
    canvas = page.find_element("css selector", "canvas").size
    large = Image.fromarray(drawn).resize(
        (canvas["width"], canvas["height"]), Image.Resampling.BILINEAR
    )
    expected = np.asarray(large)[170:, :560].astype(int)
    assert np.ptp(expected) > 100
    assert np.abs(plain - expected).mean() < 3

    # The wheel comes closer: small pictures on the way, a large one at rest.
    viewer.size.value = "320"
    until(lambda: len(viewer.pictures[-1]) == 320)
    before = len(viewer.pictures)
    origin = ScrollOrigin.from_viewport(280, 380)
    for _ in range(5):
        webdriver.ActionChains(page).scroll_from_origin(origin, 0, -100).perform()
    until(lambda: len(viewer.pictures) > before + 1 and len(viewer.pictures[-1]) == 320)
    closer = settled(page)
    covered = [(np.abs(image - 255).max(axis=-1) > 40).mean() for image in (plain, closer)]
    assert covered[1] > 1.2 * covered[0]
    assert min(map(len, viewer.pictures[before:])) < 320

    assert viewer.step == step
    click(page, "Continue training")
    until(lambda: viewer.step > step + 20)
    assert not viewer.paused

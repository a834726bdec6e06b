"""The page of a training in Debian's Chromium. Skipped, with a reason, without a browser."""

from collections.abc import Iterator

import pytest
from helpers.browser import NEEDED, playwright
from PIL import Image

from flx.viewer.server import serving
from flx.viewer.watch import Watched

pytestmark = NEEDED


@pytest.fixture
def watched(tmp_path) -> Iterator[tuple[Watched, str]]:
    run = Watched("bowl", 200, tmp_path / "metrics.csv", tmp_path / "none", tmp_path / "previews", "y")
    run.previews.mkdir()
    run.metrics.write_text("step,loss\n50,0.9\n100,0.7\n")
    for step, color in ((50, (200, 0, 0)), (100, (0, 200, 0))):
        Image.new("RGB", (60, 40), color).save(run.previews / f"{step}.jpg")
    with serving(run.answers(), run.most) as server:
        yield run, server.url


def test_curves_are_drawn_and_previews_are_turned_to(browser, watched):
    run, url = watched
    page, faults = browser.new_page(), []
    page.on("console", lambda m: faults.append(m.text) if m.type == "error" else None)
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.goto(url)
    page.wait_for_selector("#preview:not([hidden])")
    assert page.inner_text("#done") == "100 of 200 steps" and page.inner_text("#shown") == "100"
    assert page.locator(".uplot").count() == 1
    newest = page.get_attribute("#preview", "src")
    page.focus("#step")
    page.keyboard.press("ArrowLeft")
    playwright.expect(page.locator("#shown")).to_have_text("50")
    assert page.get_attribute("#preview", "src") != newest
    run.metrics.write_text("step,loss,seconds\n50,0.9,1\n100,0.7,1\n150,0.6,1\n")
    playwright.expect(page.locator("#done")).to_have_text("150 of 200 steps", timeout=15_000)
    assert page.locator(".uplot").count() == 2 and page.inner_text("#shown") == "50"
    assert not faults

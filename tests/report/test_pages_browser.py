"""The pages of test_pages.py in Chromium, tested like the report in test_browser.py."""

from pathlib import Path

import pytest

pytest.importorskip("selenium.webdriver", reason="selenium is not installed (pip install fitact[test])")
from tests.report.test_browser import Browser, browser, check_legible, pytestmark
from tests.report.test_pages import WRITE

__all__ = ["browser"]  # a fixture
pytestmark = [pytestmark, pytest.mark.slow]
CHARTS = {"plan": 0, "tradeoff": 4, "measurement": 1, "drive": 2, "population": 2}


@pytest.fixture(params=WRITE)
def page(request, tmp_path: Path) -> Path:
    path = tmp_path / f"{request.param}.html"
    WRITE[request.param](path, True)
    return path


def test_it_opens_alone_draws_its_charts_and_fits_its_window(browser: Browser, page: Path):
    browser.open(page, 400)
    browser.whole()
    assert len(browser.all("figure.live")) == CHARTS[page.stem]
    assert browser.ask("document.documentElement.scrollWidth") == 400
    for button in browser.all(".live button[aria-pressed]"):
        before = button.get_attribute("aria-pressed")
        button.click()
        assert button.get_attribute("aria-pressed") != before
    browser.check_alone(page)


def test_it_reads_aloud_and_is_legible(browser: Browser, page: Path):
    check_legible(browser, page, texts=30)


# pairs of labels of one axis that overlap, by a pixel or more each way
OVERLAPPING = """[...document.querySelectorAll('.plot .xaxislayer-above, .plot .yaxislayer-above')].flatMap((axis) => {
  const labels = [...axis.querySelectorAll('.xtick text, .ytick text')].filter((text) => text.textContent.trim());
  const boxes = labels.map((text) => text.getBoundingClientRect());
  return labels.flatMap((text, i) => labels.slice(i + 1).filter((_, k) => {
    const [a, b] = [boxes[i], boxes[i + 1 + k]];
    return a.left < b.right - 1 && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1;
  }).map((other) => `${text.textContent} and ${other.textContent}`));
})"""


@pytest.mark.parametrize("width", [1280, 420])
def test_no_tick_labels_overlap(browser: Browser, page: Path, width: int):
    browser.open(page, width)
    browser.whole()
    labels = browser.ask("document.querySelectorAll('.plot .xtick text, .plot .ytick text').length")
    assert (labels > 0) == (CHARTS[page.stem] > 0)
    assert browser.ask(OVERLAPPING) == []

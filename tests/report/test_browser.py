"""The report in Chromium: what it loads, what its buttons do, its appearance, its print-out and its accessibility.

Reference pictures are in tests/data/screens, in one font on every machine (matplotlib ships it). To renew them, run
`RENEW_SCREENS=1 pytest tests/report/test_browser.py -k looks` and look at the changes.
"""

import base64
import io
import json
import os
import shutil
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import PIL.Image
import pytest

import fitact
from fitact.report.reproduction import write_reproduction

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed (pip install fitact[test])")
from selenium.webdriver.common.by import By  # noqa: E402
from selenium.webdriver.common.keys import Keys  # noqa: E402
from selenium.webdriver.support.ui import WebDriverWait  # noqa: E402

pytestmark = pytest.mark.skipif(
    not (shutil.which("chromium") and shutil.which("chromedriver")),
    reason="Chromium or its driver is not installed (apt-get install chromium chromium-driver)",
)
SCREENS = Path(__file__).parents[1] / "data" / "screens"
OPTIONS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars")
SAME_TEXT = ("--font-render-hinting=none", "--disable-lcd-text")  # independent of the machine's font settings
SHRUNK = 8  # pixels of the page per pixel of a reference picture
BLOCK = 8  # size of a compared block in pixels of the reference picture
ALIKE = 6.0  # allowed difference in grey levels
PLOTS = 1 + 6 + 3 + 1  # record; three parameters and their pairs; forces; force over time


class Browser:
    """Page in Chromium."""

    def __init__(self, driver: Any):
        self.driver = driver

    def open(self, path: Path, width: int = 1280, height: int = 800) -> None:
        self.driver.get_log("browser"), self.driver.get_log("performance")
        self.size(width, height)
        self.driver.get(path.as_uri())
        # on a busy machine, Chromium may still show the page before
        self.wait("document.readyState === 'complete' && location.href === arguments[0]", path.as_uri())

    def size(self, width: int, height: int) -> None:
        self.command(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False
        )

    def command(self, name: str, **parameters: Any) -> Any:
        return self.driver.execute_cdp_cmd(name, parameters)

    def ask(self, script: str, *arguments: Any) -> Any:
        return self.driver.execute_script(f"return {script}", *arguments)

    def wait(self, script: str, *arguments: Any) -> None:
        WebDriverWait(self.driver, 60, poll_frequency=0.05).until(lambda _: self.ask(script, *arguments), script)

    def all(self, selector: str) -> list[Any]:
        return self.driver.find_elements(By.CSS_SELECTOR, selector)

    def whole(self) -> None:
        """Make the window as high as the page, so that every chart is drawn."""
        self.size(self.ask("innerWidth"), self.ask("document.documentElement.scrollHeight"))
        self.wait("[...document.querySelectorAll('.live .plot')].every((plot) => plot.querySelector('.main-svg'))")
        self.size(self.ask("innerWidth"), self.ask("document.documentElement.scrollHeight"))

    def figure(self, number: int) -> tuple[Any, dict[str, Any]]:
        """Return a drawn chart and its buttons by name."""
        figure = self.all("figure.chart")[number]
        self.ask("arguments[0].scrollIntoView({block: 'center'})", figure)
        self.wait("arguments[0].querySelector('.plot .main-svg') !== null", figure)
        return figure, {button.text: button for button in figure.find_elements(By.TAG_NAME, "button")}

    def range(self, figure: Any, axis: str = "xaxis") -> list[float]:
        return self.ask(f"arguments[0].querySelector('.plot').layout.{axis}.range", figure)

    def check_alone(self, path: Path) -> None:
        """Assert that the page at `path` made no external request and logged no error."""
        assert self.driver.get_log("browser") == []
        events = [json.loads(entry["message"])["message"] for entry in self.driver.get_log("performance")]
        asked = [e["params"]["request"]["url"] for e in events if e["method"] == "Network.requestWillBeSent"]
        assert path.as_uri() in asked
        assert [url for url in asked if not url.startswith(("file:", "data:"))] == []

    def picture(self) -> np.ndarray:
        shot = base64.b64decode(self.command("Page.captureScreenshot", format="png")["data"])
        image = PIL.Image.open(io.BytesIO(shot)).convert("L")
        return np.asarray(image.reduce(SHRUNK))


@pytest.fixture(scope="module")
def browser():
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for each in (*OPTIONS, *SAME_TEXT):
        options.add_argument(each)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))
    yield Browser(driver)
    driver.quit()


@pytest.fixture(scope="module")
def page(finger_fit: fitact.Fit, tmp_path_factory) -> Path:
    """Return the report of the demo with independent draws and a font that are the same on every machine."""
    path = tmp_path_factory.mktemp("report") / "report.html"
    fitact.sample(finger_fit, level="laplace", seed=1, progress=False).report(path)
    path.write_text(path.read_text().replace("</head>", f"<style>{_font()}</style></head>"))
    return path


def _font() -> str:
    fonts = Path(mpl.get_data_path()) / "fonts" / "ttf"
    faces = [("DejaVuSans.ttf", 400), ("DejaVuSans-Bold.ttf", 700)]
    return "* { font-family: Kept !important; }" + "".join(
        f"@font-face {{ font-family: Kept; font-weight: {weight}; src: url(data:font/ttf;base64,"
        f"{base64.b64encode((fonts / name).read_bytes()).decode()}); }}"
        for name, weight in faces
    )


def test_opens_without_complaint_and_without_the_net(browser: Browser, page: Path):
    browser.open(page)
    browser.whole()
    browser.check_alone(page)


def test_charts_take_the_place_of_the_pictures(browser: Browser, page: Path):
    browser.open(page)
    browser.whole()
    assert len([plot for plot in browser.all(".plot") if plot.is_displayed()]) == PLOTS
    assert not any(image.is_displayed() for image in browser.all("figure.chart img"))


def test_without_script_the_pictures_stay(browser: Browser, page: Path):
    browser.command("Emulation.setScriptExecutionDisabled", value=True)
    try:
        browser.open(page)
        assert all(image.is_displayed() for image in browser.all("img"))
        assert not any(each.is_displayed() for each in browser.all(".plot, button"))
    finally:
        browser.command("Emulation.setScriptExecutionDisabled", value=False)


def test_a_chart_that_fails_leaves_its_picture(browser: Browser, page: Path, tmp_path: Path):
    broken = tmp_path / "broken.html"
    broken.write_text(page.read_text().replace("window.Plotly = Plotly", "window.Plotly = null"))
    browser.open(broken)
    image = browser.all("figure.chart img")[0]
    browser.ask("arguments[0].closest('figure').scrollIntoView()", image)  # a chart is drawn once it is near
    WebDriverWait(browser.driver, 10).until(lambda _: image.is_displayed())


def test_a_chart_in_sight_does_not_wait_for_the_observer(browser: Browser, page: Path, tmp_path: Path):
    """A browser that only takes a picture may never call it."""
    still = tmp_path / "still.html"
    still.write_text("<script>IntersectionObserver.prototype.observe = () => {}</script>" + page.read_text())
    browser.open(still)
    browser.wait("document.querySelector('figure.chart .plot .main-svg') !== null")
    assert len(browser.all(".plot .main-svg")) < PLOTS  # the others wait


def test_the_prior_comes_and_goes(browser: Browser, page: Path):
    browser.open(page)
    figure, buttons = browser.figure(1)
    shown = "[...arguments[0].querySelectorAll('.plot')].map((plot) => plot.querySelectorAll('g.trace').length)"
    before, wide = browser.ask(shown, figure), browser.range(figure)
    assert before == [2] * 6
    assert buttons["prior"].get_attribute("aria-pressed") == "true"
    buttons["prior"].click()
    browser.wait(f"({shown}).every((count) => count === 1)", figure)
    assert buttons["prior"].get_attribute("aria-pressed") == "false"
    narrow = browser.range(figure)
    assert narrow[1] - narrow[0] < 0.1 * (wide[1] - wide[0])
    buttons["prior"].click()
    browser.wait(f"({shown}).every((count) => count === 2)", figure)


def test_axes_turn_from_logarithmic_to_linear(browser: Browser, page: Path):
    browser.open(page)
    figure, buttons = browser.figure(1)
    types = (
        "[...arguments[0].querySelectorAll('.plot')].flatMap(({layout: {xaxis, yaxis}}) => [xaxis.type, yaxis.type])"
    )
    marginals, pairs = ["log", "linear"] * 3, ["log", "log"] * 3
    assert browser.ask(types, figure) == marginals + pairs
    heights = "Array.from(arguments[0].querySelector('.plot').calcdata[0].map((point) => point.y))"
    over_logarithm = browser.ask(heights, figure)
    buttons["logarithmic axes"].click()
    browser.wait(f"({types}).every((type) => type === 'linear')", figure)
    assert buttons["logarithmic axes"].get_attribute("aria-pressed") == "false"
    assert browser.ask(heights, figure) != over_logarithm
    assert max(browser.ask(heights, figure)) == 1.0


@pytest.mark.slow
def test_every_control_is_reached_and_pressed_by_keyboard(browser: Browser, page: Path):
    browser.open(page)
    browser.whole()
    wanted = browser.ask("document.querySelectorAll('.live button, .live .plot').length")
    reached = "[...document.querySelectorAll('.live button, .live .plot')].indexOf(document.activeElement)"
    found, unseen = set(), []
    for _ in range(wanted + 10):
        browser.driver.switch_to.active_element.send_keys(Keys.TAB)
        number = browser.ask(reached)
        found.add(number)
        if browser.ask("getComputedStyle(document.activeElement).outlineStyle") == "none":
            unseen.append(number)
    assert set(range(wanted)) <= found
    assert not [number for number in unseen if number >= 0]
    prior = browser.figure(1)[1]["prior"]
    browser.ask("arguments[0].focus()", prior)
    prior.send_keys(Keys.SPACE)
    assert prior.get_attribute("aria-pressed") == "false"


@pytest.mark.slow
def test_the_pointer_asks_for_values_with_units(browser: Browser, page: Path):
    browser.open(page)
    for number, units in ((0, ("ms", " V", " mV")), (1, ("kΩ", "%")), (2, ("µN", "%"))):
        figure, _ = browser.figure(number)
        plot = figure.find_element(By.CSS_SELECTOR, ".plot .nsewdrag")
        webdriver.ActionChains(browser.driver).move_to_element(plot).perform()
        browser.wait("arguments[0].querySelector('.hoverlayer').textContent !== ''", figure)
        text = browser.ask("arguments[0].querySelector('.hoverlayer').textContent", figure)
        assert all(unit in text for unit in units), text


def test_a_drag_zooms_and_a_button_resets(browser: Browser, page: Path):
    browser.open(page)
    figure, buttons = browser.figure(0)
    whole = browser.range(figure)
    plot = figure.find_element(By.CSS_SELECTOR, ".plot .nsewdrag")
    actions = webdriver.ActionChains(browser.driver)
    actions.move_to_element_with_offset(plot, -200, 0).click_and_hold().move_by_offset(100, 0).move_by_offset(100, 0)
    actions.release().perform()
    browser.wait("arguments[0].querySelector('.plot').layout.xaxis.range[0] > arguments[1] + 1", figure, whole[0])
    zoomed = browser.range(figure)
    assert zoomed[1] - zoomed[0] < 0.5 * (whole[1] - whole[0])
    buttons["reset zoom"].click()
    assert browser.range(figure) == whole
    buttons["zoom in"].click()
    webdriver.ActionChains(browser.driver).double_click(plot).perform()
    browser.wait("arguments[0].querySelector('.plot').layout.xaxis.range[0] === arguments[1]", figure, whole[0])
    assert browser.range(figure) == whole
    buttons["zoom in"].click()
    assert np.diff(browser.range(figure)) == pytest.approx(0.5 * np.diff(whole))
    buttons["zoom out"].click()
    assert browser.range(figure) == pytest.approx(whole)


def test_keys_move_and_zoom_a_chart_in_focus(browser: Browser, page: Path):
    browser.open(page)
    figure, _ = browser.figure(0)
    plot = figure.find_element(By.CLASS_NAME, "plot")
    low, high = browser.range(figure)
    for key, expected in (
        ("+", [0.75 * low + 0.25 * high, 0.25 * low + 0.75 * high]),
        (Keys.ARROW_RIGHT, [0.70 * low + 0.30 * high, 0.20 * low + 0.80 * high]),
        ("0", [low, high]),
    ):
        plot.send_keys(key)
        assert browser.range(figure) == pytest.approx(expected)


def test_paper_gets_the_pictures(browser: Browser, page: Path):
    browser.open(page)
    browser.whole()
    browser.command("Emulation.setEmulatedMedia", media="print")
    try:
        assert all(image.is_displayed() for image in browser.all("img"))
        assert not any(each.is_displayed() for each in browser.all(".plot, button"))
    finally:
        browser.command("Emulation.setEmulatedMedia", media="")
    printed = base64.b64decode(browser.command("Page.printToPDF")["data"])
    assert printed.count(b"/Type /Page\n") >= 2
    assert browser.driver.get_log("browser") == []


CONTRASTS = """(() => {
  const numbers = (colour) => colour.match(/[\\d.]+/g).map(Number);
  const light = (colour) => {
    const [r, g, b] = colour.map((x) => x / 255).map((x) => x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const behind = (element) => {
    for (; element; element = element.parentElement) {
      const [r, g, b, a = 1] = numbers(getComputedStyle(element).backgroundColor);
      if (a > 0) return [r, g, b];
    }
    return [255, 255, 255];
  };
  return [...document.body.querySelectorAll("*")]
    .filter((e) => e.checkVisibility() && [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim()))
    .map((e) => {
      const style = getComputedStyle(e), text = e.closest("svg") ? style.fill : style.color;
      const [a, b] = [light(numbers(text)), light(behind(e))];
      return [e.textContent.trim().slice(0, 40), (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05)];
    });
})()"""


def check_legible(browser: Browser, path: Path, texts: int) -> None:
    """Assert WCAG 2.2: names, headings in order, and a contrast of at least 4.5 of more than `texts` texts."""
    browser.open(path)
    browser.whole()
    assert all(each.accessible_name for each in browser.all("button, .plot"))
    levels = [int(heading.tag_name[1]) for heading in browser.all("h1, h2, h3, h4")]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert max(np.diff(levels)) <= 1
    contrasts = browser.ask(CONTRASTS)
    assert len(contrasts) > texts
    assert [each for each in contrasts if each[1] < 4.5] == []


def test_it_reads_aloud_and_is_legible(browser: Browser, page: Path):
    check_legible(browser, page, texts=100)
    assert browser.ask("document.documentElement.lang") == "en"
    assert all(len(image.get_attribute("alt")) > 40 for image in browser.all("img"))


def differences(seen: np.ndarray, kept: np.ndarray) -> float:
    """Return the largest block mean of the absolute difference, in grey levels; infinite if the shapes differ."""
    if seen.shape != kept.shape:
        return np.inf
    gap = np.abs(seen.astype(float) - kept)
    rows, columns = (size // BLOCK * BLOCK for size in gap.shape)
    return float(gap[:rows, :columns].reshape(rows // BLOCK, BLOCK, -1, BLOCK).mean(axis=(1, 3)).max())


@pytest.mark.parametrize("width", [1280, 400])
def test_it_looks_as_it_did(browser: Browser, page: Path, width: int):
    """And would not with one chart less, or wider than its window.

    Sections without a figure, whose text differs between versions, are left out.
    """
    browser.open(page, width)
    hide = "main > section:not(.verdict, :has(figure)) { display: none; }"
    browser.ask(
        "document.head.append(Object.assign(document.createElement('style'), {textContent: arguments[0]}))", hide
    )
    browser.whole()
    assert browser.ask("document.documentElement.scrollWidth") == width
    seen, path = browser.picture(), SCREENS / f"report_{width}.png"
    if os.environ.get("RENEW_SCREENS"):
        path.parent.mkdir(exist_ok=True)
        PIL.Image.fromarray(seen).save(path, optimize=True)
    kept = np.asarray(PIL.Image.open(path))
    assert differences(seen, kept) < ALIKE
    browser.ask("document.querySelectorAll('.plot')[4].replaceChildren()")
    assert differences(browser.picture(), kept) > 2 * ALIKE
    browser.ask("document.querySelector('main').style.width = '1400px'")
    assert browser.ask("document.documentElement.scrollWidth") > width


def test_tables_are_not_cut(browser: Browser, page: Path):
    browser.open(page, 1100)
    for closed in browser.all("details"):
        browser.ask("arguments[0].setAttribute('open', '')", closed)
    assert browser.all("details table th.text")
    widths = browser.ask(
        "[...document.querySelectorAll('.scroll:has(table)')].map((e) => [e.scrollWidth, e.clientWidth])"
    )
    assert [each for each in widths if each[0] > each[1] > 0] == []


@pytest.mark.slow
def test_the_reproduction_opens_and_draws_every_figure(browser: Browser, tmp_path: Path):
    browser.open(write_reproduction(tmp_path, ()))
    browser.whole()
    assert len(browser.all(".live .plot .main-svg")) >= 8
    assert browser.driver.get_log("browser") == []
    assert browser.ask("document.documentElement.scrollWidth") == 1280

"""The page in Chromium as a person uses it: from a file to the report, with mistakes on the way."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import pytest

pytest.importorskip("uvicorn", reason="uvicorn is not installed (pip install fitact[app])")
pytest.importorskip("selenium.webdriver", reason="selenium is not installed (pip install fitact[test])")
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select

from tests.app.server import START, Server
from tests.report.test_browser import Browser, browser, pytestmark

__all__ = ["browser"]  # a fixture
pytestmark = [pytestmark, pytest.mark.slow]  # starts Chromium, a server, and runs with their imports and compilations
ROOT = Path(__file__).parents[2]
RECORDS = ROOT / "data_synth" / "records"
AXE = ROOT / "out" / "axe.min.js"
STATE = "document.body.dataset.state"


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    running = Server(tmp_path_factory.mktemp("walk") / "results")
    yield running
    assert running.close() == 0


@pytest.fixture(scope="module")
def scope_file(tmp_path_factory) -> Path:
    """Return the shipped record as a scope writes it: columns CH1 and CH2, the second in mV, without units."""
    rows = (line.split(",") for line in (RECORDS / "finger_direct.csv").read_text().splitlines()[1:])
    path = tmp_path_factory.mktemp("stick") / "<b>scope & co.csv"
    path.write_text("time_s,CH1,CH2\n" + "".join(f"{t},{v},{1000.0 * float(vsc):.6g}\n" for t, v, vsc in rows))
    return path


class Person:
    """Clicks and keys of a person."""

    def __init__(self, browser: Browser) -> None:
        self.browser, self.driver = browser, browser.driver

    def open(self, address: str, width: int = 1280) -> None:
        self.browser.size(width, 900)
        self.driver.get(address)

    def find(self, name: str):
        return self.driver.find_element("id", name)

    def give(self, *files: Path) -> None:
        self.find("files").send_keys("\n".join(map(str, files)))
        self.browser.wait("document.getElementById('set-up') !== null")

    def choose(self, name: str, text: str, command: str) -> None:
        """Select a choice, and wait until the command shows it."""
        options = Select(self.find(name)).options
        Select(self.find(name)).select_by_index([each.text.split(" ")[0] for each in options].index(text))
        self.browser.wait("document.getElementById('command').textContent.includes(arguments[0])", command)

    def type(self, name: str, text: str) -> None:
        self.find(name).clear()
        self.find(name).send_keys(text, Keys.TAB)

    def press(self, text: str) -> None:
        """Reach a button by the tab key, and press it by Enter."""
        for _ in range(250):
            focused = self.driver.switch_to.active_element
            if focused.tag_name == "button" and focused.text == text:
                style = self.browser.ask("getComputedStyle(arguments[0]).outlineStyle", focused)
                assert style != "none", "the focus cannot be seen"
                ActionChains(self.driver).send_keys(Keys.ENTER).perform()
                return
            ActionChains(self.driver).send_keys(Keys.TAB).perform()
        raise AssertionError(f"no button {text}")

    def wait_state(self, state: str) -> None:
        self.browser.wait(f"{STATE} === arguments[0]", state)


@pytest.fixture(scope="module")
def walked(browser: Browser, server: Server, scope_file: Path) -> tuple[Person, str]:
    """Walk from the file to the report; return the address of the analysis."""
    person = Person(browser)
    browser.driver.get_log("browser")
    person.open(server.address)
    person.give(scope_file)
    address = browser.ask("location.href")
    assert "which is which" not in person.find("inspected").text
    person.choose("column.V", "CH2", "V=CH2")
    person.choose("column.Vsc", "CH1", "Vsc=CH1")
    browser.wait("document.querySelector('.warnings')?.textContent.includes('more than a touch display withstands')")
    person.choose("column.Vsc", "CH2", "Vsc=CH2")
    browser.wait("document.querySelector('.refusal')?.textContent.includes('one column is to be two channels')")
    person.choose("column.V", "CH1", "V=CH1")
    person.type("factor.Vsc", "0.001")
    browser.wait("document.getElementById('command').textContent.includes('Vsc=0.001')")
    browser.wait("!document.querySelector('.warnings, .refusal')")
    person.choose("shipped", "paper", "scene.toml")
    Select(person.find("scene.drive.waveform")).select_by_visible_text("measured")
    person.type("scene.drive.duty", "2")
    browser.wait("document.getElementById('error-scene.drive.duty').textContent.includes('less than 1')")
    assert person.find("scene.drive.duty").get_attribute("aria-invalid") == "true"
    person.find("start").click()  # starts nothing, and leads to the field
    browser.wait("document.activeElement.id === 'scene.drive.duty'")
    person.type("scene.drive.duty", "")
    browser.wait("document.getElementById('error-scene.drive.duty').textContent === ''")
    first = browser.driver.current_window_handle
    browser.driver.switch_to.new_window("tab")
    person.open(address, 420)
    browser.wait("document.getElementById('start') !== null")
    second = browser.driver.current_window_handle
    browser.driver.switch_to.window(first)
    person.press("Start")
    person.wait_state("running")
    browser.driver.switch_to.window(second)
    person.find("start").click()  # the other tab has started it: this one is told, and starts nothing
    browser.wait("document.getElementById('alert').textContent.includes('is running')")
    browser.driver.refresh()
    person.wait_state("running")
    person.press("Stop")
    browser.wait(f"{STATE} === 'stopped' || document.getElementById('start') !== null")
    person.press("Start" if browser.all("#start") else "Go on")
    person.wait_state("running")
    browser.driver.close()
    browser.driver.switch_to.window(first)
    person.open(address)
    server.wait(address.rpartition("/")[2], "finished")
    person.wait_state("finished")
    return person, address


def test_the_report_is_there_and_so_is_everything_else(walked, server: Server, scope_file: Path):
    person, address = walked
    person.open(address, 420)
    assert person.browser.ask("document.querySelector('h1').textContent") == scope_file.name
    person.driver.switch_to.frame(person.driver.find_element("tag name", "iframe"))
    person.browser.wait("document.querySelector('.verdict h2')?.textContent.includes('Prior-limited')")
    chart = person.driver.find_element("css selector", "figure.chart")
    person.browser.ask("arguments[0].scrollIntoView()", chart)
    person.browser.wait("document.querySelector('figure.chart .plot .main-svg') !== null")
    person.driver.switch_to.default_content()
    folder = server.folder / address.rstrip("/").rpartition("/")[2]
    summary = json.loads((folder / "results" / "summary.json").read_text())
    assert summary["command"] == (folder / "command.txt").read_text().strip()
    assert summary["parameters"]["Rsc"]["q50"] == pytest.approx(160e3, rel=0.1)  # of the simulation
    links = {link.get_attribute("href").rpartition("/")[2] for link in person.browser.all("main a[download]")}
    assert links >= {"everything.zip", "report.html", "posterior.nc", "chain.h5", "scene.toml", "command.txt"}
    complaints = [entry for entry in person.driver.get_log("browser") if "422" not in entry["message"]]
    assert complaints == []  # but for the second tab's start


def test_pages_fit_their_window(walked, server: Server):
    person, address = walked
    for width in (420, 1280):
        for page in (server.address, address):
            person.open(page, width)
            assert person.browser.ask("document.documentElement.scrollWidth") == width


def test_a_gigabyte_is_refused_with_a_sentence(walked, server: Server, tmp_path: Path):
    person, _ = walked
    before = sorted(server.folder.iterdir())
    with (tmp_path / "big.csv").open("wb") as file:
        file.truncate(10**9)
    person.open(server.address)
    person.find("files").send_keys(str(tmp_path / "big.csv"))
    person.browser.wait("document.getElementById('alert').textContent.startsWith('big.csv: too large for the page')")
    assert sorted(server.folder.iterdir()) == before


def test_a_run_stopped_while_sampling_goes_on_to_the_same_results(walked, server: Server):
    person, address = walked
    first = server.folder / address.rpartition("/")[2]
    copy = json.loads(server.act(first.name, "copy").body)["analysis"]
    folder = server.folder / copy
    person.open(f"{server.address}analyses/{copy}")
    person.press("Start")
    person.wait_state("running")
    process = halt_sampling(server, copy)
    person.press("Stop")
    person.wait_state("stopping")
    os.kill(process, signal.SIGCONT)
    person.wait_state("stopped")
    before = h5_points(folder / "results" / "chain.h5")
    interrupted = json.loads((folder / "results" / "summary.json").read_text())
    assert interrupted["convergence"]["interrupted"]
    assert person.driver.find_element("partial link text", "preliminary report")
    person.press("Go on")
    person.wait_state("finished")
    person.driver.switch_to.frame(person.driver.find_element("tag name", "iframe"))
    person.browser.wait("document.querySelector('.verdict h2') !== null")
    person.driver.switch_to.default_content()
    after = h5_points(folder / "results" / "chain.h5")
    assert 0 < len(before) < len(after)
    assert (after[: len(before)] == before).all()
    assert (after == h5_points(first / "results" / "chain.h5")).all()
    again, once = (json.loads((each / "results" / "summary.json").read_text()) for each in (folder, first))
    for name in ("parameters", "derived", "identifiability", "fit", "seed"):
        assert again[name] == once[name]


@pytest.mark.skipif(not AXE.exists(), reason="axe-core is not there (make axe)")
@pytest.mark.parametrize("colours", ["light", "dark"])
def test_axe_finds_no_serious_fault(walked, server: Server, colours: str):
    person, address = walked
    copy = json.loads(server.act(address.rpartition("/")[2], "copy").body)["analysis"]
    features = [{"name": "prefers-color-scheme", "value": colours}]
    person.browser.command("Emulation.setEmulatedMedia", features=features)
    try:
        for page in (server.address, f"{server.address}analyses/{copy}", address, f"{address}/report"):
            for width in (1280, 420):
                person.open(page, width)
                for closed in person.browser.all("details:not([open])"):
                    person.browser.ask("arguments[0].setAttribute('open', '')", closed)
                person.browser.command("Runtime.evaluate", expression=AXE.read_text())
                found = person.driver.execute_async_script(
                    "const end = arguments[arguments.length - 1]; axe.run({iframes: false}).then((all) =>"
                    " end(all.violations.map((v) => [v.id, v.impact, v.nodes.map((n) => n.html.slice(0, 200))])))"
                )
                assert [fault for fault in found if fault[1] in ("serious", "critical")] == [], (page, width)
    finally:
        person.browser.command("Emulation.setEmulatedMedia", features=[])


def test_after_the_server_is_killed_the_command_line_goes_on(tmp_path: Path):
    server = Server(tmp_path / "results")
    try:
        analysis = server.upload("finger.csv", (RECORDS / "finger_direct.csv").read_bytes())
        server.ask("POST", f"analyses/{analysis}/scene", (RECORDS / "finger_direct.toml").read_bytes())
        folder = server.folder / analysis
        server.act(analysis, "start")
        process = halt_sampling(server, analysis)
    finally:
        server.process.send_signal(signal.SIGKILL)
        server.process.wait()
    os.kill(process, signal.SIGCONT)
    while find_processes(folder):  # the command notices, and ends
        time.sleep(0.1)
    assert json.loads((folder / "results" / "summary.json").read_text())["convergence"]["interrupted"]
    before = h5_points(folder / "results" / "chain.h5")
    command = (folder / "command.txt").read_text().split()[1:]
    done = subprocess.run([sys.executable, "-c", START, *command], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    after = h5_points(folder / "results" / "chain.h5")
    assert 0 < len(before) < len(after)
    assert (after[: len(before)] == before).all()
    again = Server(server.folder)
    assert again.progress(analysis)["state"] == "finished"
    assert again.close() == 0


def halt_sampling(server: Server, analysis: str) -> int:
    """Halt the command when its first checkpoint is there, so that what follows always finds it sampling."""
    while not (server.folder / analysis / "results" / "chain.h5").exists():
        assert server.progress(analysis)["state"] == "running"
    (process,) = find_processes(server.folder / analysis)
    os.kill(process, signal.SIGSTOP)
    return process


def find_processes(folder: Path) -> list[int]:
    """Return the processes with this working folder (on Linux)."""
    found = []
    for link in Path("/proc").glob("[0-9]*/cwd"):
        with contextlib.suppress(OSError):
            if link.readlink() == folder:
                found.append(int(link.parent.name))
    return found


def h5_points(path: Path):
    with h5py.File(path) as file:
        return file["ensemble_0/chain"][:]

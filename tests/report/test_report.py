import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

import fitact
from fitact.scene.prior_section import PriorSection
from fitact.summary import describe_quantity, format_estimate


class Page(HTMLParser):
    """Parser that collects what a test needs, and checks that tags are closed."""

    def __init__(self, text: str):
        super().__init__()
        self.images: list[dict[str, str | None]] = []
        self.addresses: list[str] = []
        self.words: list[str] = []
        self.styles = ""
        self.scripts: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        if tag == "img":
            self.images.append(attributes)
        self.addresses += [value for name, value in attrs if name in ("src", "href", "srcset", "action") and value]
        if tag not in ("img", "meta", "link", "br", "hr"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if "style" in self.open:
            self.styles += data
        elif "script" in self.open:
            self.scripts.append(data)
        else:
            self.words.append(data)


@pytest.fixture(scope="module")
def path(finger_posterior: fitact.Posterior, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("report") / "report.html"
    finger_posterior.report(path)
    return path


def test_page_is_one_self_contained_file(path: Path):
    text = path.read_text()
    page = Page(text)
    assert page.open == []
    assert all(address.startswith(("data:", "#")) for address in page.addresses)
    assert page.styles
    assert not re.search(r"@import|url\(", page.styles)
    assert len(page.images) == 5
    assert all(len(image["alt"] or "") > 40 for image in page.images)
    assert path.stat().st_size < 5e6


def test_page_says_the_verdict_first_and_how_to_repeat_it(path: Path):
    words = " ".join(" ".join(Page(path.read_text()).words).split())
    places = [
        words.index(part)
        for part in (
            "Prior-limited",
            "contact area",
            "loop current",
            "Diagnostics",
            "--seed 1",
        )
    ]
    assert places == sorted(places)
    assert "Unreliable" not in words


def test_force_law_stands_beside_every_force_and_estimates_stand_in_the_circuit(path: Path, finger_posterior):
    words = " ".join(" ".join(Page(path.read_text()).words).split())
    force = words[words.index("Electrostatic force on the finger") : words.index("Uncertainty budget")]
    assert force.count("computed from Vsc with eq. (22) of the reference paper") >= 2
    Rsc = finger_posterior.summary()["parameters"]["Rsc"]
    median, _, sd = format_estimate(Rsc).partition(" ±")
    assert f"Rsc {median} ±{sd}" in words  # in the drawing


def test_untrusted_answers_say_so_at_the_top(finger_fit: fitact.Fit, tmp_path):
    posterior = fitact.sample(finger_fit, walkers=16, max_steps=50, progress=False)
    posterior.report(tmp_path / "report.html")
    words = " ".join(Page((tmp_path / "report.html").read_text()).words)
    assert words.index("do not use these numbers") < words.index("Determined by the data")


def test_a_plan_is_stated(finger_posterior: fitact.Posterior, tmp_path):
    plan = fitact.plan(fitact.Scene.from_dict({"grounding": {"R_H": "500 ohm"}}))
    finger_posterior.report(tmp_path / "report.html", plan)
    words = " ".join(Page((tmp_path / "report.html").read_text()).words)
    assert "Simplifications of the model" in words
    assert plan.sentence in words


def test_nothing_in_a_record_becomes_markup(finger_posterior: fitact.Posterior, tmp_path):
    import dataclasses

    record = dataclasses.replace(finger_posterior.fit.record, source="<script>alert(1).csv")
    trace = dataclasses.replace(finger_posterior.fit.traces[0], record=record)
    fit = dataclasses.replace(finger_posterior.fit, traces=(trace,))
    dataclasses.replace(finger_posterior, fit=fit).report(tmp_path / "report.html")
    page = Page((tmp_path / "report.html").read_text())
    assert page.open == []
    assert "<script>alert(1).csv" in page.words


def test_whatever_can_be_free_has_a_name_for_people():
    for name in set(PriorSection.model_fields) - {"correlation", "order"}:
        assert describe_quantity(name) != name


def test_results_of_another_version_are_refused(finger_posterior: fitact.Posterior, tmp_path):
    from fitact.report import write_report

    summary = finger_posterior.summary()
    summary["record"] = {name: value for name, value in summary["record"].items() if name != "sources"}
    with pytest.raises(fitact.InputError, match="lack 'sources'"):
        write_report(tmp_path / "report.html", finger_posterior.to_datatree(), summary)
    assert not (tmp_path / "report.html").exists()

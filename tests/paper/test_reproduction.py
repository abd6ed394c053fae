"""Claims of the paper against numbers computed in closed form and with ngspice before this package existed."""

import json
import re
from pathlib import Path

import pytest

from fitact.cli import app


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("reproduction")
    with pytest.raises(SystemExit) as ended:
        app(["reproduce", "--out", str(folder), "--json"])
    assert ended.value.code == 0
    return folder


@pytest.fixture(scope="module")
def claims(folder: Path) -> dict[str, dict]:
    return {claim["id"]: claim for claim in json.loads((folder / "reproduction.json").read_text())}


def test_every_claim_is_there_and_judged(claims: dict[str, dict]):
    verdicts = [claim["verdict"] for claim in claims.values()]
    assert (verdicts.count("agrees"), verdicts.count("differs"), len(verdicts)) == (29, 13, 42)
    for claim in claims.values():
        assert set(claim) == {"id", "claim", "paper", "ours", "unit", "verdict", "reason"}
        assert claim["reason"]


# half a unit of the last printed digit
@pytest.mark.parametrize(
    ("id", "Ci", "value", "half"),
    [
        ("eq3_Ci", None, 3.45e-9, 0.005e-9),
        ("eq7_ZCi_100Hz", "0.69 nF", 2.3e6, 0.05e6),
        ("fig14_amplitude_knee", "1.35 nF", 40.3, 0.05),
        ("fig14_amplitude_knee", "3.45 nF", 34.4, 0.05),
        ("fig4_ratio", "0.69 nF", 6.08, 0.005),
        ("fig4_ratio", "1.35 nF", 11.2, 0.05),
        ("fig15_square", "1.35 nF", 2.56, 0.005),
        ("fig15_sine", "1.35 nF", 1.52, 0.005),
        ("fig15_triangle", "1.35 nF", 1.45, 0.005),
        ("fig6_Csc_8p85nF", "1.35 nF", 13.66, 0.005),
        ("fig6_Csc_44p2nF", "1.35 nF", 15.93, 0.005),
    ],
)
def test_values(claims: dict[str, dict], id: str, Ci: str | None, value: float, half: float):
    ours = claims[id]["ours"]
    assert (ours if Ci is None else ours[Ci]) == pytest.approx(value, abs=half)


def test_what_the_paper_rounds_right_agrees_and_its_contradictions_do_not(claims: dict[str, dict]):
    for id in ("eq11_Rx", "eq13_Cx", "eq14_Rx2", "eq16_Qwith", "eq17_Qwithout", "q_difference", "fig14_amplitude_knee"):
        assert claims[id]["verdict"] == "agrees"
    for id in ("eq3_Ci", "eq7_ZCi_100Hz", "fig4_ratio", "fig6_Csc_44p2nF", "fig15_square", "text_Ztotal", "eq10"):
        assert claims[id]["verdict"] == "differs"


def test_page_stands_alone(folder: Path):
    page = (folder / "reproduction.html").read_text(encoding="utf-8")
    assert page.count('<img src="data:image/svg+xml;base64,') == 8
    assert not re.search(r"(?:src|href)=\"(?!data:)", re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL))
    assert len(page) < 5_000_000

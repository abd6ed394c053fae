"""The server of `fitact app`: who may ask, what an upload may do, and that it shows what the command line says."""

import html
import json
import os
import re
import socket
import subprocess
import sys
import tomllib
import urllib.parse
import zipfile
from io import BytesIO
from pathlib import Path

import pytest

pytest.importorskip("uvicorn", reason="uvicorn is not installed (pip install fitact[app])")
import anyio

import fitact
import fitact.cli
from fitact.app import scene_form
from fitact.app import server as module
from fitact.app.analyses import Analysis
from fitact.scene.fields import describe_fields
from fitact.scene.toml import shipped_scenes
from tests.app.server import Server

MEGABYTE = 10**6
SMALL = b"time_s,V_V,Vsc_V\n" + b"".join(b"%d,%d,%d\n" % (i, i % 7, i % 5) for i in range(60))


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    running = Server(tmp_path_factory.mktemp("app") / "results")
    yield running
    assert running.close() == 0


def content(folder: Path) -> list[str]:
    """Return all files of the results folder but those of the server's empty folder for uploads."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def test_the_first_line_is_the_address_with_a_long_token(server: Server):
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{32}/", server.address)
    page = server.ask("GET", "")
    assert page.status == 200
    assert "<h1>fitact</h1>" in page.text


def test_pages_allow_no_script_but_their_own(server: Server):
    for path in ("", "static/app.js", "static/app.css", "page.css"):
        reply = server.ask("GET", path)
        assert reply.status == 200
        policy = reply.headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert reply.headers["X-Content-Type-Options"] == "nosniff"
        assert reply.headers["Cache-Control"] == "no-store"
    assert not re.search(r"<script(?! src=)| on\w+=|style=", server.ask("GET", "").text)


@pytest.mark.parametrize(
    "path", ["/", "/wrong/", "/static/app.js", "/page.css", "/%C3%A9/", "/analyses/x/report", "//"]
)
def test_without_the_token_nothing_is_shown(server: Server, path: str):
    reply = server.ask("GET", path)
    assert reply.status == 403
    assert server.token not in reply.text


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "localhost", None])
def test_another_host_name_is_refused(server: Server, host: str | None):
    """A page at a foreign name that points to 127.0.0.1 (DNS rebinding) reaches nothing."""
    assert server.ask("GET", "", Host=host and host.format(port=server.port)).status in (400, 403)
    assert server.ask("GET", "", Host=f"localhost:{server.port}").status == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1", "https://{host}", "null", None])
def test_another_origin_changes_nothing(server: Server, origin: str | None):
    before = content(server.folder)
    stated = origin and origin.format(host=server.host)
    assert server.ask("POST", "files?name=x.csv", SMALL, Origin=stated).status == 403
    assert content(server.folder) == before


def test_other_machines_cannot_connect(server: Server):
    with pytest.raises(OSError):  # a server on all interfaces would answer at this address, too  # noqa: PT011
        socket.create_connection(("127.0.0.2", server.port), timeout=2)


def test_a_gigabyte_is_refused_before_it_arrives(server: Server):
    before = content(server.folder)
    reply = server.ask("POST", "files?name=big.csv", None, Content_Length=str(10**9))
    assert reply.status == 413
    assert content(server.folder) == before


def test_an_upload_that_hides_its_size_ends_at_the_limit_and_leaves_nothing(tmp_path: Path, monkeypatch):
    """The body is endless; the test ends because the server stops reading."""
    monkeypatch.setattr(module, "LARGEST_UPLOAD", MEGABYTE)
    (root := tmp_path / "root").mkdir()
    (uploads := tmp_path / "uploads").mkdir()
    app = module.make_app(root, uploads, "token", 80, module.WarmCommands())
    taken, status = [], []

    async def receive():
        taken.append(65536)
        assert uploads.exists()
        return {"type": "http.request", "body": b"x" * 65536, "more_body": True}

    async def send(message):
        status.append(message.get("status"))

    headers = [(b"host", b"127.0.0.1:80"), (b"origin", b"http://127.0.0.1:80")]
    scope = {
        "type": "http", "method": "POST", "path": "/token/files", "raw_path": b"/token/files", "root_path": "",
        "query_string": b"name=x.csv", "headers": headers, "http_version": "1.1", "scheme": "http",
    }  # fmt: skip
    anyio.run(app, scope, receive, send)
    assert status[0] == 413
    assert sum(taken) <= MEGABYTE + 65536
    assert content(tmp_path) == []


HOSTILE = [
    "../../../../tmp/x.csv", "..\\..\\x.csv", "/etc/passwd", "a\0b.csv", "x" * 500 + ".csv", "..", "", "-rf.csv",
    "<script>alert(1)</script>.csv", "--scene=x", "a\nb.csv", "analysis.json", "\u202excod.csv", "%2e%2e%2fx.csv",
    "'; rm -rf ~ #.csv",
]  # fmt: skip


@pytest.mark.parametrize("name", HOSTILE)
def test_a_file_name_is_never_a_path(server: Server, name: str):
    analysis = server.upload(name, SMALL)
    folder = server.folder / analysis
    own, *others = os.listdir(folder / "records")
    assert not others
    assert re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}", own)
    assert (folder / "records" / own).read_bytes() == SMALL
    assert {each.split("/")[0] for each in content(server.folder)} <= {p.name for p in server.folder.iterdir()}
    page = server.ask("GET", f"analyses/{analysis}").text
    assert "<script>alert" not in page
    assert page.count("<script") == 1


def test_two_files_of_one_name_are_both_kept(server: Server):
    analysis = server.upload("a.csv", SMALL)
    server.ask("POST", f"analyses/{analysis}/files?name=A.csv", SMALL + b"60,1,2\n")
    assert sorted(os.listdir(server.folder / analysis / "records")) == ["2_A.csv", "a.csv"]


@pytest.mark.parametrize("name", ["..%2F..%2Fanalysis.json", "%2Fetc%2Fpasswd", "analysis.json", "..", "%00"])
def test_downloads_are_result_files_only(server: Server, name: str):
    analysis = server.upload("a.csv", SMALL)
    for kind in ("results", "pictures"):
        assert server.ask("GET", f"analyses/{analysis}/{kind}/{name}").status in (400, 403, 404)
    assert server.ask("GET", f"analyses/{name}").status in (400, 403, 404, 422)


def test_a_refused_file_has_the_sentence_of_the_command_line(server: Server, monkeypatch, capsys):
    analysis = server.upload("cut.csv", SMALL + b"60,abc,1\n")
    monkeypatch.chdir(server.folder / analysis)
    monkeypatch.setattr(sys, "argv", ["fitact", "inspect", "records/cut.csv"])
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    with pytest.raises(SystemExit) as end:
        fitact.cli.main()
    assert end.value.code == 2
    sentence = capsys.readouterr().err.strip().removeprefix("fitact: ")
    assert sentence.startswith("records/cut.csv, line 62")
    page = html.unescape(server.ask("GET", f"analyses/{analysis}").text)
    assert f'<p class="refusal">{sentence}</p>' in page


def test_records_and_spectra_are_drawn(server: Server):
    spectrum = b"f,Z',Z''\n" + b"".join(b"%d,%d,%d\n" % (10**i, 900 - 100 * i, -900 + 100 * i) for i in range(8))
    for content, count in ((SMALL, "60 samples"), (spectrum, "Impedance spectrum: 8 points")):
        analysis = server.upload("a.csv", content)
        page = server.ask("GET", f"analyses/{analysis}").text
        assert count in page
        picture = server.ask("GET", re.search(r'class="picture" src="([^"]+)"', page)[1])
        assert picture.body.startswith(b"\x89PNG")


def test_the_form_becomes_the_command(server: Server):
    analysis = server.upload("a.csv", SMALL.replace(b"V_V,Vsc_V", b"CH1,CH2"))
    form = {"column.V": "CH2", "column.Vsc": "CH1", "factor.Vsc": "0.001", "rate": "1Hz", "scene.drive.duty": "2"}
    answer = json.loads(server.ask("POST", f"analyses/{analysis}/set-up", urllib.parse.urlencode(form)).body)
    assert answer["command"] == (
        "fitact run records/a.csv --scene scene.toml --channel V=CH2 --channel Vsc=CH1 --scale Vsc=0.001 --rate=1Hz"
        " --out results"
    )
    assert answer["errors"] == {"scene.drive.duty": "scene.toml, line 2: [drive] duty = 2: input should be less than 1"}
    assert "multiplied by 0.001" in answer["files"]
    again = json.loads(server.ask("POST", f"analyses/{analysis}/set-up", urllib.parse.urlencode({})).body)
    assert again["command"] == "fitact run records/a.csv --out results"
    assert not (server.folder / analysis / "scene.toml").exists()


def test_a_run_is_stopped_by_ctrl_c_and_a_refusal_returns_to_the_form(server: Server):
    long = server.upload("long.csv", (Path(__file__).parents[2] / "data_synth/records/finger_direct.csv").read_bytes())
    server.act(long, "start")
    assert server.ask("POST", f"analyses/{long}/set-up", "").status == 422  # it is running, in another tab perhaps
    server.act(long, "stop")
    assert server.wait(long, "set-up", "stopped")["messages"][-1].startswith("fitact: interrupted")
    record = SMALL.replace(b"Vsc_V", b"other_V")  # refused when it is read
    analysis = server.upload("a.csv", record)
    server.act(analysis, "start")
    said = server.wait(analysis, "set-up")["messages"][-1]
    assert "The last run was refused" in server.ask("GET", f"analyses/{analysis}").text
    assert said.startswith("fitact: records/a.csv")
    copy = json.loads(server.act(analysis, "copy").body)["analysis"]
    assert (server.folder / copy / "records" / "a.csv").read_bytes() == record
    archive = zipfile.ZipFile(BytesIO(server.ask("GET", f"analyses/{analysis}/everything.zip").body))
    assert {f"{analysis}/command.txt", f"{analysis}/records/a.csv"} <= set(archive.namelist())


@pytest.mark.parametrize(("interrupted", "state"), [(True, "stopped"), (False, "finished"), (None, "finished")])
def test_results_of_an_interrupted_chain_can_go_on(tmp_path: Path, interrupted: bool | None, state: str):
    analysis = Analysis.create(tmp_path)
    assert analysis.state == "set-up"
    analysis.results.mkdir()
    assert analysis.state == "stopped"
    (analysis.results / "report.html").touch()
    if interrupted is not None:
        summary = {"convergence": {"interrupted": interrupted}}
        (analysis.results / "summary.json").write_text(json.dumps(summary))
    assert Analysis.find(tmp_path, analysis.name).state == state


def test_the_server_imports_no_jax():
    code = "import fitact.app.server, sys; print(sorted({'jax', 'numpy', 'matplotlib'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"


FIELDS = describe_fields()


def test_every_key_of_a_scene_has_help():
    assert [(field["section"], field["key"]) for field in FIELDS if not field["meaning"]] == []
    named = {field["section"] for field in FIELDS if field["section"]}
    assert named == {*fitact.Scene.model_fields} - {"description", "calibration"}


@pytest.mark.parametrize("name", sorted(shipped_scenes()))
def test_a_scene_goes_through_the_form_unchanged(name: str):
    scene = fitact.Scene.load(name)
    text = scene_form.write_scene(scene_form.read_values(str(scene)), FIELDS)
    assert fitact.Scene.from_dict(tomllib.loads(text)) == scene


@pytest.mark.parametrize(
    ("typed", "value"),
    [("22 nF", "22 nF"), ('"22 nF"', "22 nF"), ("2.2e-8", 2.2e-8), ('["0 ms", "5 ms"]', ["0 ms", "5 ms"]),
     ("{low = 1}", {"low": 1}), ("true", True), ("1\n[skin]\nRsc = 5", "1 [skin] Rsc = 5"), ('a"\\b', 'a"\\b')],
)  # fmt: skip
def test_a_field_is_one_value(typed: str, value: object):
    parsed = tomllib.loads(scene_form.write_scene({"scene.device.Ci": typed}, FIELDS))
    assert parsed == {"device": {"Ci": value}}


@pytest.mark.parametrize(
    ("sentence", "field"),
    [("scene.toml, line 3: [drive] duty = 2: too large", "scene.drive.duty"),
     ("x: [skin] Csc and permittivity state the same", "scene.skin.Csc"),
     ("x: [drive]: rise_time belongs to waveform", "scene.drive.rise_time"),
     ("no place", "scene"), ("[no] such", "scene")],
)  # fmt: skip
def test_an_error_is_shown_at_its_field(sentence: str, field: str):
    assert scene_form.locate_error(sentence, FIELDS) == field

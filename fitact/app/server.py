"""The server of the page: addresses, uploads, and what the templates show."""

import contextlib
import hashlib
import html
import json
import os
import re
import secrets
import shutil
import socket
import sys
import tempfile
import threading
import time
import webbrowser
from collections.abc import AsyncIterator, Iterable
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl

import jinja2
import uvicorn
from markupsafe import Markup
from starlette.applications import Starlette
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from fitact.app import scene_form
from fitact.app.analyses import CHANNELS, Analysis
from fitact.app.guard import REPORT_POLICY, Guard
from fitact.app.warm_commands import CommandResult, WarmCommands
from fitact.errors import InputError
from fitact.units import format_engineering

LARGEST_UPLOAD = 500_000_000  # bytes; an inspection of so long a text takes half a minute
_LARGEST_FORM = 1_000_000  # bytes; a scene has some kilobytes
_TOO_LARGE = (
    f"too large for the page, which takes files up to {LARGEST_UPLOAD // 10**6} MB and scenes up to"
    f" {_LARGEST_FORM // 10**6} MB; use `fitact run` on the command line"
)
_PERCENT = re.compile(r"(\d+)%")


def serve(root: Path, port: int, browser: bool, commands: WarmCommands) -> None:
    """Serve the page on 127.0.0.1 until Ctrl-C, with all analyses in the folder `root`; print its address first.

    Raises:
        InputError: the folder cannot be written, or the port is taken.
    """
    token = secrets.token_urlsafe(24)
    try:
        root = root.expanduser().absolute()
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        uploads = tempfile.TemporaryDirectory(prefix=".upload-", dir=root)
    except OSError as error:
        raise InputError(f"{root}: cannot be written ({error.strerror}); choose another folder with --out") from error
    listener = socket.socket()
    if sys.platform != "win32":  # where it would let two servers share a port
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind(("127.0.0.1", port))
    except OSError as error:
        raise InputError(f"--port {port}: cannot be used ({error.strerror}); choose another port") from error
    listener.listen()
    port = listener.getsockname()[1]
    address = f"http://127.0.0.1:{port}/{token}/"
    print(address, flush=True)
    print(f"results go to {root}; Ctrl-C ends the page", file=sys.stderr, flush=True)
    if browser:
        opener = Path(uploads.name) / "open.html"  # other users see the arguments of a browser, but not this file
        opener.write_text(f'<meta http-equiv="refresh" content="0; url={address}">', encoding="utf-8")
        threading.Thread(target=webbrowser.open, args=(opener.as_uri(),), daemon=True).start()
    level = "warning" if os.environ.get("FITACT_DEBUG") else "critical"  # of errors, the page shows a sentence
    config = uvicorn.Config(
        make_app(root, Path(uploads.name), token, port, commands),
        log_level=level, access_log=False, ws="none", server_header=False, timeout_graceful_shutdown=2,
    )  # fmt: skip
    with uploads, contextlib.suppress(KeyboardInterrupt):
        uvicorn.Server(config).run(sockets=[listener])


def make_app(root: Path, uploads: Path, token: str, port: int, commands: WarmCommands) -> Starlette:
    """Return the application; `uploads` is a folder on the same disk as `root`, for files that are still arriving."""
    page = Page(root, uploads, token, commands)
    one = "/analyses/{id}"
    routes = [
        Route("/", page.show_home),
        Route("/files", page.receive_file, methods=["POST"], max_body_size=LARGEST_UPLOAD),
        Route(one, page.show_analysis),
        Route(f"{one}/files", page.receive_file, methods=["POST"], max_body_size=LARGEST_UPLOAD),
        Route(f"{one}/set-up", page.change_set_up, methods=["POST"]),
        Route(f"{one}/scene", page.load_scene, methods=["POST"]),
        Route(f"{one}/actions/{{action}}", page.act, methods=["POST"]),
        Route(f"{one}/progress", page.show_progress),
        Route(f"{one}/pictures/{{file}}", page.send_picture),
        Route(f"{one}/report", page.send_report),
        Route(f"{one}/results/{{file}}", page.send_result),
        Route(f"{one}/everything.zip", page.send_archive),
        Mount("/static", StaticFiles(packages=[("fitact.app", "static")])),
        Route("/page.css", lambda _: FileResponse(str(files("fitact.report") / "templates" / "page.css"))),
    ]
    return Starlette(
        routes=[Mount(f"/{token}", routes=routes, max_body_size=_LARGEST_FORM)],
        middleware=[Middleware(Guard, token=token, port=port)],
        exception_handlers={InputError: _refuse, HTTPException: _refuse, Exception: _refuse},
        lifespan=page.live,
    )


async def _refuse(_: Request, error: Exception) -> Response:
    if isinstance(error, HTTPException):
        return PlainTextResponse(error.detail, error.status_code)
    if isinstance(error, InputError):
        return PlainTextResponse(str(error), 422)
    return PlainTextResponse(f"internal error of the page ({type(error).__name__}: {error}); please report it", 500)


class Page:
    """The handlers of all addresses."""

    def __init__(self, root: Path, uploads: Path, token: str, commands: WarmCommands) -> None:
        self._root, self._uploads, self._commands = root, uploads, commands
        self._inspections: dict[tuple[str, ...], CommandResult] = {}
        self._templates = jinja2.Environment(
            loader=jinja2.PackageLoader("fitact.app"), autoescape=True, undefined=jinja2.StrictUndefined,
            trim_blocks=True, lstrip_blocks=True,
        )  # fmt: skip
        self._templates.globals |= {"root": f"/{token}", "channels": CHANNELS}
        self._templates.globals |= {"largest_upload": LARGEST_UPLOAD, "too_large": _TOO_LARGE}
        self._templates.filters |= {"engineering": format_engineering, "code": _mark_code}
        self._templates.filters |= {"field_name": scene_form.field_name, "display_value": scene_form.display_value}

    @contextlib.asynccontextmanager
    async def live(self, _: Starlette, stale_age: float = 86_400.0) -> AsyncIterator[None]:
        """Remove uploads of killed servers, older than `stale_age` (s); in the end, end the process for commands."""
        for old in self._root.glob(".upload-*"):
            if time.time() - old.stat().st_mtime > stale_age:
                shutil.rmtree(old, ignore_errors=True)
        yield
        self._commands.stop()

    async def show_home(self, _: Request) -> Response:
        """Show where to drop files, and all analyses."""
        self._commands.prepare()  # for the next file
        return self._render("home.html", analyses=list(Analysis.iterate(self._root)), folder=self._root)

    async def show_analysis(self, request: Request) -> Response:
        """Show the set-up, the progress or the results of an analysis."""
        analysis = self._find(request)
        if (state := analysis.state) != "set-up":
            return self._render("analysis.html", analysis=analysis, state=state)
        inspections = await self._inspect_files(analysis)
        return self._render(
            "set_up.html", analysis=analysis, inspections=inspections, columns=_list_columns(inspections),
            scenes=(await self._commands.describe_scenes())["scenes"], form=await self._render_form(analysis),
        )  # fmt: skip

    async def receive_file(self, request: Request) -> Response:
        """Store an uploaded file in an analysis, or in a new one; the file is the body, its name in the query."""
        name = request.query_params.get("name", "")
        if "id" in request.path_params:
            self._find(request).require_editable()
        temporary = self._uploads / secrets.token_hex(8)
        try:
            with temporary.open("wb") as file:
                async for chunk in request.stream():
                    file.write(chunk)
            analysis = self._find(request) if "id" in request.path_params else Analysis.create(self._root)
            own = analysis.add_file(temporary, name)
        except OSError as error:
            raise HTTPException(507, f"the file cannot be stored ({error.strerror})") from error
        finally:
            temporary.unlink(missing_ok=True)
        await self._inspect(analysis, own, [])
        return JSONResponse({"analysis": analysis.name})

    async def change_set_up(self, request: Request) -> Response:
        """Store the form; return the inspected files, the command, and errors by the name of the field."""
        analysis = self._find(request)
        analysis.require_editable()
        form = dict(parse_qsl((await request.body()).decode(), keep_blank_values=True))
        analysis.options = {name: value for name, value in form.items() if not name.startswith("scene.")}
        analysis.save()
        fields = (await self._commands.describe_scenes())["fields"]
        errors = await self._write_scene(analysis, scene_form.write_scene(form, fields), fields)
        inspections = await self._inspect_files(analysis)
        shown = self._template("files.html").render(analysis=analysis, inspections=inspections)
        return JSONResponse({"files": shown, "command": analysis.command, "errors": errors})

    async def load_scene(self, request: Request) -> Response:
        """Take a shipped scene by its name in the query, or the text of a scene file, into the form."""
        analysis = self._find(request)
        analysis.require_editable()
        name, greeting = request.query_params.get("name", ""), await self._commands.describe_scenes()
        if name in greeting["scenes"]:
            answer = await self._commands.run(analysis.folder, "scene", name)
        else:
            given = analysis.folder / "given.toml"
            given.write_bytes(await request.body())
            answer = await self._commands.run(analysis.folder, "scene", given.name)
            given.unlink()
        if answer.code:
            raise InputError(answer.sentence)
        values = scene_form.read_values(answer.out)
        await self._write_scene(analysis, scene_form.write_scene(values, greeting["fields"]), greeting["fields"])
        return HTMLResponse(await self._render_form(analysis))

    async def act(self, request: Request) -> Response:
        """Start or resume, stop, copy an analysis, or remove one of its files."""
        analysis, action = self._find(request), request.path_params["action"]
        if action == "start":
            analysis.start(self._commands)
        elif action == "stop":
            analysis.stop()
        elif action == "copy":
            analysis = await run_in_threadpool(analysis.copy)
        elif action == "remove":
            analysis.require_editable()
            analysis.remove_file(request.query_params.get("file", ""))
        return JSONResponse({"analysis": analysis.name})

    async def show_progress(self, request: Request) -> Response:
        """Return the state and the messages of the command."""
        analysis = self._find(request)
        state, messages = analysis.state, analysis.read("messages.txt").splitlines()
        percent = _PERCENT.search(messages[-1]) if messages else None
        return JSONResponse({"state": state, "messages": messages, "percent": percent and int(percent[1])})

    async def send_picture(self, request: Request) -> Response:
        """Send a picture that `fitact inspect` drew of a file."""
        return _send_by_name((self._find(request).folder / "pictures").glob("*.png"), request)

    async def send_report(self, request: Request) -> Response:
        """Send the report, sandboxed."""
        path = self._find(request).results / "report.html"
        if not path.exists():
            raise HTTPException(404, "there is no report yet")
        return FileResponse(path, headers={"Content-Security-Policy": REPORT_POLICY})

    async def send_result(self, request: Request) -> Response:
        """Send a result file, the scene or the command, for download."""
        return _send_by_name(self._find(request).result_files(), request, is_download=True)

    async def send_archive(self, request: Request) -> Response:
        """Send everything as one file."""
        analysis, path = self._find(request), self._uploads / f"{secrets.token_hex(8)}.zip"
        await run_in_threadpool(analysis.write_archive, path)
        return FileResponse(path, filename=f"{analysis.name}.zip", background=BackgroundTask(path.unlink))

    def _find(self, request: Request) -> Analysis:
        return Analysis.find(self._root, request.path_params["id"])

    def _template(self, name: str) -> jinja2.Template:
        return self._templates.get_template(name)

    def _render(self, name: str, **content: Any) -> Response:
        return HTMLResponse(self._template(name).render(content))

    async def _render_form(self, analysis: Analysis) -> Markup:
        path, greeting = analysis.folder / "scene.toml", await self._commands.describe_scenes()
        values = scene_form.read_values(path.read_text(encoding="utf-8")) if path.exists() else {}
        sections: dict[str, list[dict[str, Any]]] = {}
        for field in greeting["fields"]:
            sections.setdefault(field["section"], []).append(field)
        return Markup(self._template("scene.html").render(sections=sections, values=values))

    async def _write_scene(self, analysis: Analysis, text: str, fields: scene_form.Fields) -> dict[str, str]:
        """Write scene.toml, or remove it if the form states nothing; return its error by the name of the field."""
        path = analysis.folder / "scene.toml"
        if not text:
            path.unlink(missing_ok=True)
            return {}
        path.write_text(text, encoding="utf-8")
        answer = await self._commands.run(analysis.folder, "scene", path.name)
        return {scene_form.locate_error(answer.sentence, fields): answer.sentence} if answer.code else {}

    async def _inspect_files(self, analysis: Analysis) -> dict[str, dict[str, Any]]:
        """Return of each file the inspection as the columns are chosen, the refusal, and all columns."""
        options, found = analysis.column_options(), {}
        for own in analysis.files:
            chosen, plain = await self._inspect(analysis, own, options), await self._inspect(analysis, own, [])
            content = json.loads(chosen.out) if chosen.code == 0 else {}
            columns = content.get("columns") or (json.loads(plain.out) if plain.code == 0 else {}).get("columns", [])
            found[own] = {
                "content": content, "columns": columns, "refusal": chosen.sentence if chosen.code else "",
                "picture": _picture_name(own, options),
            }  # fmt: skip
        return found

    async def _inspect(self, analysis: Analysis, own: str, options: list[str]) -> CommandResult:
        key = (analysis.name, own, *options)
        if key not in self._inspections:
            picture = f"pictures/{_picture_name(own, options)}"
            arguments = "inspect", f"records/{own}", *options, "--json", "--out", picture
            self._inspections[key] = await self._commands.run(analysis.folder, *arguments)
        return self._inspections[key]


def _picture_name(own: str, options: list[str]) -> str:
    return hashlib.sha256(repr((own, options)).encode()).hexdigest()[:16] + ".png"


def _list_columns(inspections: dict[str, dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the columns of all files, each name once."""
    found = {column["name"]: column for each in inspections.values() for column in each["columns"]}
    return list(found.values())


def _mark_code(text: str) -> Markup:
    """Return a text with `code` as HTML."""
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", html.escape(text)))


def _send_by_name(paths: Iterable[Path], request: Request, is_download: bool = False) -> Response:
    """Send the file whose name is asked for, so that a name is never used as a path."""
    for path in paths:
        if path.name == request.path_params["file"]:
            return FileResponse(path, filename=path.name if is_download else None)
    raise HTTPException(404, "there is no such file")

"""A real server of the page in a process of its own, and requests as a browser makes them."""

import http.client
import json
import signal
import subprocess
import sys
import time
import urllib.parse
from pathlib import Path
from typing import Any, NamedTuple

START = "import sys; sys.argv[0] = 'fitact'; from fitact.cli import main; main()"


class Reply(NamedTuple):
    status: int
    headers: http.client.HTTPMessage
    body: bytes

    @property
    def text(self) -> str:
        return self.body.decode()


class Server:
    """`fitact app` with its results in `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.process = subprocess.Popen(
            [sys.executable, "-c", START, "app", "--no-browser", "--out", str(folder)],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
        )  # fmt: skip
        assert self.process.stdout is not None
        self.address = self.process.stdout.readline().strip()
        parts = urllib.parse.urlsplit(self.address)
        self.host, self.port, self.token = parts.netloc, parts.port or 0, parts.path.strip("/")

    def ask(self, method: str, path: str, body: Any = None, **headers: str | None) -> Reply:
        """Send a request; a path that does not begin with / is below the token, a header of None is left out."""
        own: dict[str, str | None] = {"Host": self.host}
        if method == "POST":
            own["Origin"] = f"http://{self.host}"
        own |= {name.replace("_", "-"): value for name, value in headers.items()}
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=120)
        connection.putrequest(method, path if path.startswith("/") else f"/{self.token}/{path}", skip_host=True)
        content = body.encode() if isinstance(body, str) else body
        if content is not None and "Content-Length" not in own:
            own["Content-Length"] = str(len(content))
        for name, value in own.items():
            if value is not None:
                connection.putheader(name, value)
        connection.endheaders(content)
        response = connection.getresponse()
        return Reply(response.status, response.headers, response.read())

    def upload(self, name: str, content: bytes) -> str:
        """Upload a file into a new analysis; return its name."""
        reply = self.ask("POST", f"files?name={urllib.parse.quote(name)}", content)
        assert reply.status == 200, reply.text
        return json.loads(reply.body)["analysis"]

    def act(self, analysis: str, action: str) -> Reply:
        return self.ask("POST", f"analyses/{analysis}/actions/{action}", "")

    def progress(self, analysis: str) -> dict[str, Any]:
        return json.loads(self.ask("GET", f"analyses/{analysis}/progress").body)

    def wait(self, analysis: str, *states: str, timeout: float = 300.0) -> dict[str, Any]:
        """Wait until an analysis has one of the states."""
        end = time.monotonic() + timeout
        while (now := self.progress(analysis))["state"] not in states:
            assert time.monotonic() < end, now
            time.sleep(0.1)
        return now

    def close(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(20)

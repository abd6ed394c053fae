"""Who may ask: only requests with the token, to this machine's own name, and changes only from the page itself."""

import hmac

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

_PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self';"
    " frame-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
# A report is one file with its scripts inside. Sandboxed, it has no origin and no network, so it reaches nothing here.
REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline';"
    " img-src data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)


class Guard:
    """Application that refuses all requests but those of the page, and adds security headers to every answer.

    The token is the first part of the path, not a cookie: browsers send a cookie for 127.0.0.1 to the servers of all
    ports, and with requests that other sites cause. Neither happens to a path, and two servers do not interfere.
    """

    def __init__(self, app: ASGIApp, token: str, port: int) -> None:
        self._app, self._token = app, token
        self._hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers.setdefault("Content-Security-Policy", _PAGE_POLICY)
                headers["X-Content-Type-Options"] = "nosniff"
                headers["Referrer-Policy"] = "same-origin"  # the address holds the token
                headers["Cross-Origin-Resource-Policy"] = "same-origin"
                headers["Cache-Control"] = "no-store"
            await send(message)

        if scope["type"] == "http" and (refusal := self._find_refusal(scope)):
            await PlainTextResponse(refusal, 403)(scope, receive, send_with_headers)
        else:
            await self._app(scope, receive, send_with_headers)

    def _find_refusal(self, scope: Scope) -> str:
        headers = Headers(scope=scope)
        if headers.get("host") not in self._hosts:  # a foreign name that was made to point to 127.0.0.1
            return "This server answers only at 127.0.0.1 and localhost, with its port."
        first = scope["path"].split("/")[1]
        if not hmac.compare_digest(first.encode(), self._token.encode()):
            return "This page needs the address that `fitact app` printed."
        is_own = headers.get("origin", "").removeprefix("http://") in self._hosts
        if scope["method"] not in ("GET", "HEAD") and not is_own:
            return "Only the page itself may change anything."
        return ""

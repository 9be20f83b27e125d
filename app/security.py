"""Who may talk to the server: token, Host and Origin are checked before anything else."""

import hmac
import secrets
import time
from collections import deque
from collections.abc import Iterable
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qsl, urlencode, urlsplit

from starlette.datastructures import Headers
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
MOST_WRONG_TOKENS = 20
"""Wrong tokens that are answered in a minute."""
POLICY = (
    "default-src 'self'; img-src 'self' data: blob:; style-src 'self'; script-src 'self'; "
    "connect-src 'self'; frame-src 'self'; frame-ancestors 'self'; base-uri 'none'; form-action 'self'"
)
VIEWER_POLICY = "frame-ancestors 'self'; base-uri 'none'"
"""viser's page is one file with scripts inside; it runs in a frame of ours and shows no user's HTML."""
_SIGN_IN = """<!doctype html><meta charset="utf-8"><title>PhysHanDI</title>
<h1>Open the address that the server printed</h1>
<p>This page needs the token in that address. It is valid until the server ends; run
<code>physhandi serve</code> again for a new one.</p>"""


def new_token() -> str:
    """Make the secret that the printed address carries."""
    return secrets.token_urlsafe(32)


class Gatekeeper:
    """ASGI middleware for http and websocket; what it refuses never reaches the application.

    The token comes once in the address (``?token=``) and moves into a cookie, or with every request
    as ``Authorization: Bearer``. A request from another site is refused by its Origin, a rebound
    name by its Host.
    """

    def __init__(
        self, app: ASGIApp, *, token: str, port: int, hosts: Iterable[str] = LOOPBACK
    ) -> None:
        """Wrap an application.

        Args:
            app: What is protected.
            token: The secret.
            port: Port of the server; it is part of the allowed hosts and of the cookie's name.
            hosts: Names by which the server may be addressed.
        """
        self._app = app
        self._token = token
        self._cookie = f"physhandi_{port}"
        self._hosts = {f"{host}:{port}" for host in hosts} | (set(hosts) if port == 80 else set())
        self._wrong: deque[float] = deque()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer or pass on."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        refusal = self._refusal(scope, headers)
        if refusal is None:
            await self._app(scope, receive, _with_headers(scope, send))
        elif scope["type"] == "websocket":
            # Closing before accepting makes the server answer the handshake with 403.
            await receive()
            await send({"type": "websocket.close", "code": 4403})
        else:
            await refusal(scope, receive, _with_headers(scope, send))

    def _refusal(self, scope: Scope, headers: Headers) -> Response | None:
        host = headers.get("host", "")
        if host not in self._hosts:
            return _error(400, "wrong_host", f"This server is not called '{host[:80]}'.")
        method = "WEBSOCKET" if scope["type"] == "websocket" else scope["method"]
        bearer = headers.get("authorization", "").removeprefix("Bearer ").strip()
        if not self._is_same_origin(method, headers, host, has_bearer=bool(bearer)):
            return _error(403, "wrong_origin", "Requests from other sites are refused.")
        query = dict(parse_qsl(scope.get("query_string", b"").decode("latin-1")))
        given = bearer or query.get("token") or self._from_cookie(headers)
        if not self._is_token(given):
            return self._unauthorized(headers, is_wrong=bool(given))
        if method == "GET" and "token" in query:
            return self._move_token_to_cookie(scope, query)
        return None

    def _is_same_origin(self, method: str, headers: Headers, host: str, *, has_bearer: bool) -> bool:
        origin = headers.get("origin")
        if origin is None:
            return method in SAFE_METHODS or has_bearer
        if method in SAFE_METHODS:
            return True
        parts = urlsplit(origin)
        return parts.scheme in {"http", "https"} and origin == f"{parts.scheme}://{host}"

    def _from_cookie(self, headers: Headers) -> str:
        try:
            morsel = SimpleCookie(headers.get("cookie", "")).get(self._cookie)
        except CookieError:
            return ""
        return morsel.value if morsel else ""

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._token.encode())

    def _unauthorized(self, headers: Headers, *, is_wrong: bool) -> Response:
        now = time.monotonic()
        while self._wrong and now - self._wrong[0] > 60:
            self._wrong.popleft()
        if is_wrong:
            self._wrong.append(now)
            if len(self._wrong) > MOST_WRONG_TOKENS:
                return _error(429, "too_many_tries", "Too many wrong tokens; wait a minute.")
        if "text/html" in headers.get("accept", ""):
            return HTMLResponse(_SIGN_IN, status_code=401)
        return _error(401, "no_token", "This request needs the token of the printed address.")

    def _move_token_to_cookie(self, scope: Scope, query: dict[str, str]) -> Response:
        """Redirect to the same page without the token, so that it is in no history and no log."""
        rest = urlencode({key: value for key, value in query.items() if key != "token"})
        # A path that begins with two slashes would be another host.
        path = "/" + str(scope["path"]).lstrip("/\\")
        response = RedirectResponse(path + (f"?{rest}" if rest else ""), status_code=303)
        response.set_cookie(self._cookie, self._token, httponly=True, samesite="strict", path="/")
        return response


def _error(status: int, code: str, message: str) -> JSONResponse:
    return JSONResponse({"error": {"code": code, "message": message}}, status_code=status)


def _with_headers(scope: Scope, send: Send) -> Send:
    policy = VIEWER_POLICY if scope["path"].startswith("/viewer/") else POLICY

    async def wrapped(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = list(message.get("headers", []))
            present = {name.lower() for name, _ in headers}
            for name, value in (
                (b"content-security-policy", policy.encode()),
                (b"x-content-type-options", b"nosniff"),
                (b"referrer-policy", b"no-referrer"),
            ):
                if name not in present:
                    headers.append((name, value))
            message["headers"] = headers
        await send(message)

    return wrapped

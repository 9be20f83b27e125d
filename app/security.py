"""Who may come in: one ASGI middleware in front of every http request and websocket."""

import base64
import hashlib
import hmac
import logging
import re
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from urllib.parse import parse_qsl, urlencode

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.settings import ServerSettings, is_loopback

logger = logging.getLogger(__name__)

_SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}
_WRONG_TOKENS_PER_MINUTE = 20
_CLIENTS_REMEMBERED = 1000
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::[0-9]{1,5})?")
"""A Host header: a name or an address, and maybe a port."""

PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; font-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'self'"
)
# viser's page is one file with inline scripts, workers and WebAssembly.
VIEWER_POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval' blob:; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; "
    "connect-src 'self' data: blob:; worker-src 'self' blob:; object-src 'none'; base-uri 'self'; "
    "frame-ancestors 'self'"
)
_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}

_STYLE = (
    "body{font:16px/1.6 system-ui,sans-serif;max-width:34rem;margin:18vh auto;padding:0 1.5rem;"
    "color-scheme:light dark;color:CanvasText;background:Canvas}h1{font-size:1.6rem}"
    "code{padding:.1em .35em;border:1px solid;border-radius:.3em;opacity:.85}"
)
_STYLE_HASH = base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()
_LOCKED = (
    "<p>Open the full address that <code>physhandi serve</code> printed in the terminal; it ends "
    "in <code>?token=…</code>. Your browser then remembers it until the server stops.</p>"
    "<p>Was the server restarted? Then it has a new token: use the new address.</p>"
    # A browser that came from another site brings its cookie only when it is asked again from here.
    "<p>Did you just open that address? <a href=''>Try again</a></p>"
)
SHARED = "/shared/"
"""Where pages are that can be looked at without the token; see `app.exports.shares`."""


class Security:
    """The server's token and what is derived from it."""

    def __init__(
        self,
        settings: ServerSettings,
        *,
        port: int | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Draw a token, unless one is set.

        Args:
            settings: Address, allowed hosts and token.
            port: Port that was taken when the settings leave it open.
            clock: Tells the time [s].
        """
        given = settings.token.get_secret_value() if settings.token else None
        self.token = given or secrets.token_urlsafe(32)
        self.is_open = not settings.auth
        self._clock = clock
        self.cookie = f"physhandi_{settings.port if port is None else port}"
        """Name of the cookie; cookies do not know ports, so it tells servers of one host apart."""
        own = f"[{settings.host}]" if ":" in settings.host else settings.host.lower()
        self._hosts = {"localhost", "127.0.0.1", "[::1]", own, *settings.allowed_hosts}
        self._any_host = not is_loopback(settings.host) and settings.host in {"0.0.0.0", "::"}  # noqa: S104
        self._lock = threading.Lock()
        self._wrong: dict[str, deque[float]] = {}

    def is_token(self, candidate: str) -> bool:
        """Compare in constant time."""
        return hmac.compare_digest(candidate.encode(), self.token.encode())

    def new_pass(self) -> str:
        """Make a cookie value for one browser; it proves the token without containing it."""
        visitor = secrets.token_hex(8)
        return f"{visitor}.{self._sign(visitor)}"

    def owner_of(self, cookie: str) -> str | None:
        """Name the browser that a cookie was made for; None if it is not one of ours."""
        visitor, _, signature = cookie.partition(".")
        is_ours = hmac.compare_digest(signature.encode(), self._sign(visitor).encode())
        return visitor if is_ours else None

    def is_known_host(self, host: str) -> bool:
        """Check a Host header against the allow-list, against DNS rebinding."""
        found = _HOST.fullmatch(host.lower())
        if found is None:
            return False
        return found[1] in self._hosts or (self._any_host and _is_address(found[1]))

    def count_wrong(self, client: str) -> bool:
        """Note a wrong token; returns whether this client sent too many within a minute."""
        now = self._clock()
        with self._lock:
            while len(self._wrong) >= _CLIENTS_REMEMBERED and client not in self._wrong:
                del self._wrong[next(iter(self._wrong))]
            times = self._wrong.setdefault(client, deque(maxlen=_WRONG_TOKENS_PER_MINUTE + 1))
            times.append(now)
            return len(times) > _WRONG_TOKENS_PER_MINUTE and now - times[0] < 60.0

    def _sign(self, visitor: str) -> str:
        return hmac.new(self.token.encode(), visitor.encode(), "sha256").hexdigest()


def _is_address(name: str) -> bool:
    return name.startswith("[") or name.replace(".", "").isdigit()


class Gatekeeper:
    """ASGI middleware: host, token or cookie, origin; then security headers on every answer."""

    def __init__(self, app: ASGIApp, security: Security) -> None:
        self._app = app
        self._security = security

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        refusal = self._judge(scope)
        if refusal is not None:
            await _refuse(refusal, scope, receive, send)
            return
        if scope["type"] == "websocket":
            await self._app(scope, receive, send)
            return
        await self._app(scope, receive, _with_headers(scope, send))

    def _judge(self, scope: Scope) -> Response | None:
        headers = Headers(scope=scope)
        security = self._security
        if len(headers.getlist("host")) != 1 or not security.is_known_host(headers["host"]):
            return _error(400, "unknown_host", "This server does not answer to that host name.")
        offered = _bearer(headers)
        owner = self._identify(headers, offered)
        if owner is None and _is_shared(scope):
            return None
        if owner is None:
            return self._admit(scope, headers, offered)
        if offered is None and not self._has_own_origin(scope, headers):
            return _error(403, "foreign_origin", "The request comes from another site.")
        state = scope.setdefault("state", {})
        state["owner"] = owner
        state["is_foreign"] = offered is None and _is_foreign(headers)
        return _without_token(scope)

    def _identify(self, headers: Headers, offered: str | None) -> str | None:
        if self._security.is_open:
            return "open"
        if offered is not None:
            return "bearer" if self._security.is_token(offered) else None
        return self._security.owner_of(_cookie(headers, self._security.cookie))

    def _admit(self, scope: Scope, headers: Headers, offered: str | None) -> Response:
        """Let a browser in that brings the token in the address; refuse everybody else."""
        token = dict(parse_qsl(scope.get("query_string", b"").decode("latin-1"))).get("token")
        is_visit = scope["type"] == "http" and scope["method"] in {"GET", "HEAD"}
        if token is not None and is_visit and self._security.is_token(token):
            response = _without_token(scope) or Response(status_code=500)
            response.set_cookie(
                self._security.cookie,
                self._security.new_pass(),
                httponly=True,
                samesite="strict",
                path="/",
                secure=scope.get("scheme") == "https",
            )
            return response
        client = (scope.get("client") or ("unknown", 0))[0]
        is_guess = token is not None or offered is not None
        if is_guess and self._security.count_wrong(client):
            limited = _error(429, "too_many_attempts", "Too many wrong tokens. Wait a minute.")
            limited.headers["Retry-After"] = "60"
            return limited
        if is_visit and "text/html" in headers.get("accept", ""):
            return bare_page(401, "This page needs its token", _LOCKED)
        refused = _error(401, "unauthorized", "A valid token is needed.")
        refused.headers["WWW-Authenticate"] = 'Bearer realm="physhandi"'
        return refused

    def _has_own_origin(self, scope: Scope, headers: Headers) -> bool:
        if scope["type"] == "http" and scope["method"] in _SAFE_METHODS:
            # A link on another site may lead here; what such a site loads by itself may not, since
            # looking can cost something, too. `state.is_foreign` tells routes of such visits.
            return not _is_foreign(headers) or _is_navigation(headers)
        secure = {"http": "https", "websocket": "wss"}[scope["type"]]
        scheme = "https" if scope.get("scheme") == secure else "http"
        return headers.getlist("origin") == [f"{scheme}://{headers['host']}"]


def _is_foreign(headers: Headers) -> bool:
    """Tell whether a browser says that another site made it ask; other ports are other sites."""
    if headers.get("sec-fetch-site", "none") not in {"none", "same-origin"}:
        return True
    # Browsers that tell where a request comes from send the origin of a page's own only to unsafe
    # methods; with a safe one it is that of a page elsewhere, or of this one where they are old.
    origin = headers.get("origin")
    return origin is not None and origin.partition("://")[2] != headers["host"]


def _is_navigation(headers: Headers) -> bool:
    """Tell whether a browser shows what it asks for in a tab of its own, and tells no origin."""
    return (
        headers.get("sec-fetch-mode") == "navigate"
        and headers.get("sec-fetch-dest", "document") == "document"
        and "origin" not in headers
    )


def _bearer(headers: Headers) -> str | None:
    kind, _, value = headers.get("authorization", "").partition(" ")
    return value.strip() if kind.lower() == "bearer" else None


def _cookie(headers: Headers, name: str) -> str:
    # As browsers read them: a strange cookie of another program on this host must not hide ours.
    return cookie_parser(headers.get("cookie", "")).get(name, "")


def _without_token(scope: Scope) -> Response | None:
    """Send a browser that is in to the same address without the token."""
    query = parse_qsl(scope.get("query_string", b"").decode("latin-1"), keep_blank_values=True)
    if scope["type"] != "http" or not any(key == "token" for key, _ in query):
        return None
    rest = urlencode([(key, value) for key, value in query if key != "token"])
    # A path that begins with two slashes or a backslash would lead to another site.
    path = "/" + scope["path"].replace("\\", "/").lstrip("/")
    return RedirectResponse(path + (f"?{rest}" if rest else ""), status_code=303)


def _error(status: int, kind: str, message: str) -> Response:
    return JSONResponse({"error": {"code": kind, "message": message}}, status)


def bare_page(status: int, title: str, content: str) -> Response:
    """Answer with a page that needs nothing else of the server, for who may not come in.

    Args:
        status: HTTP status.
        title: Its heading.
        content: HTML below that.
    """
    policy = f"default-src 'none'; style-src 'sha256-{_STYLE_HASH}'; frame-ancestors 'self'"
    page = (
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{title} · PhysHanDI</title>"
        f"<style>{_STYLE}</style><h1>{title}</h1>{content}</html>"
    )
    return HTMLResponse(page, status, {"Content-Security-Policy": policy})


def _is_shared(scope: Scope) -> bool:
    """Whether a request only looks at a page that was shared."""
    is_visit = scope["type"] == "http" and scope["method"] in {"GET", "HEAD"}
    return is_visit and scope["path"].startswith(SHARED)


async def _refuse(response: Response, scope: Scope, receive: Receive, send: Send) -> None:
    logger.info("refused %s with %d", scope["path"], response.status_code)
    if scope["type"] == "http":
        await response(scope, receive, _with_headers(scope, send))
    elif "websocket.http.response" in scope.get("extensions", {}):
        await response(scope, receive, send)
    else:
        await send({"type": "websocket.close", "code": 1008, "reason": "refused"})


def _with_headers(scope: Scope, send: Send) -> Send:
    policy = VIEWER_POLICY if scope["path"].startswith("/viewer/") else PAGE_POLICY

    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in _HEADERS.items():
                headers.setdefault(name, value)
            headers.setdefault("Content-Security-Policy", policy)
            headers.setdefault("Cache-Control", "no-store")
        await send(message)

    return send_with_headers

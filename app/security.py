"""Access control: one ASGI middleware in front of every http request and websocket."""

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
from dataclasses import dataclass
from urllib.parse import parse_qsl, quote, urlencode

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import cookie_parser
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.settings import ServerSettings, is_loopback
from app.token_file import read_or_make_token
from physhandi.errors import UsageError

logger = logging.getLogger(__name__)

_SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}
_WRONG_TOKENS_PER_MINUTE = 20
_CLIENTS_REMEMBERED = 1000
_HOST = re.compile(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(?::[0-9]{1,5})?")
"""A Host header: a name or an address, and maybe a port."""

_ID = "[A-Za-z0-9_-]+"
LOOKING = (
    ("POST", "/api/v1/sessions"),
    ("PATCH", f"/api/v1/sessions/{_ID}"),
    ("DELETE", f"/api/v1/sessions/{_ID}"),
    ("POST", f"/viewer/{_ID}/shape"),
    ("WEBSOCKET", f"/viewer/{_ID}/?"),
    ("WEBSOCKET", f"/viewer/{_ID}/keys"),
    ("POST", "/api/v1/runs/check"),
    ("POST", f"/api/v1/runs/{_ID}/(export|replay)"),
)
"""Requests by other methods than GET that read-only access allows: own live scenes, in which
nothing can be kept, and files. All else is refused, so that a new route is guarded by itself."""
_LOOKING = tuple((method, re.compile(path)) for method, path in LOOKING)

PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; font-src 'self'; frame-src 'self'; form-action 'self'; base-uri 'self'; "
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
    "in <code>?token=…</code>. Your browser then remembers it until the server has another one.</p>"
    "<p>Was the server restarted? Then it has a new token, unless it keeps that in a file "
    "(<code>--token-file</code>): use the new address.</p>"
    # A browser that came from another site brings its cookie only when it is asked again from here.
    "<p>Did you just open that address? <a href=''>Try again</a></p>"
)
READ_ONLY = (
    "You may only look here. Open the server's full address, or ask who runs it, to launch, "
    "change, share or delete."
)
"""Message to a visitor with read-only access whose request is refused."""
PROBES = frozenset({"/healthz", "/readyz"})
"""Paths that are open to everybody and reveal nothing; see `app.health`."""
SHARED = "/shared/"
"""Path below which pages can be read without the token; see `app.exports.shares`."""


@dataclass(frozen=True)
class Visitor:
    """Somebody who may come in."""

    name: str
    """Tells browsers apart; live scenes belong to it."""
    may_change: bool = True
    """Whether also to launch, cancel, delete, share and keep; else only to look."""


class Security:
    """The server's tokens and what is derived from them."""

    def __init__(
        self,
        settings: ServerSettings,
        *,
        port: int | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Draw a token, unless one is set or kept in a file.

        Args:
            settings: Address, allowed hosts and tokens.
            port: Port that was taken when the settings leave it open.
            clock: Tells the time [s].

        Raises:
            UsageError: If a file is no safe place for a token, or both hold the same.
            OSError: If a file can neither be read nor made.
        """
        given = settings.token.get_secret_value() if settings.token else None
        stored = read_or_make_token(settings.token_file) if settings.token_file else None
        self.token = given or stored or secrets.token_urlsafe(32)
        only = settings.read_only_token_file
        self.read_only_token = read_or_make_token(only) if only else None
        if self.read_only_token == self.token:
            raise UsageError(f"{only} holds the token with which everything may be changed.")
        self.is_open = not settings.auth
        self._clock = clock
        self.cookie = f"physhandi_{settings.port if port is None else port}"
        """Name of the cookie; cookies do not know ports, so it tells servers of one host apart."""
        own = f"[{settings.host}]" if ":" in settings.host else settings.host.lower()
        self.cookie_path = settings.root_path or "/"
        """Path below which browsers send the cookie."""
        self._hosts = {"localhost", "127.0.0.1", "[::1]", own, *settings.allowed_hosts}
        self._any_host = not is_loopback(settings.host) and settings.host in {"0.0.0.0", "::"}  # noqa: S104
        self._lock = threading.Lock()
        self._wrong: dict[str, deque[float]] = {}

    def script(self, token: str) -> Visitor | None:
        """Recognise a program by its token, compared in constant time; None if it is wrong."""
        if _is_same(token, self.token):
            return Visitor("bearer")
        if self.read_only_token is not None and _is_same(token, self.read_only_token):
            return Visitor("reader", may_change=False)
        return None

    def new_pass(self, *, may_change: bool = True) -> str:
        """Make a cookie value for one browser; it proves a token without containing it.

        Args:
            may_change: Whether it proves the token with which everything may be changed.
        """
        name = secrets.token_hex(8)
        token = self.token if may_change else (self.read_only_token or "")
        return f"{name}.{_sign(name, token)}"

    def browser(self, cookie: str) -> Visitor | None:
        """Recognise the browser that a cookie was made for; None if it is not one of ours."""
        name, _, signature = cookie.partition(".")
        if _is_same(signature, _sign(name, self.token)):
            return Visitor(name)
        only = self.read_only_token
        if only is not None and _is_same(signature, _sign(name, only)):
            return Visitor(name, may_change=False)
        return None

    def is_known_host(self, host: str) -> bool:
        """Check a Host header against the allow-list, against DNS rebinding."""
        match = _HOST.fullmatch(host.lower())
        if match is None:
            return False
        return match[1] in self._hosts or (self._any_host and _is_address(match[1]))

    def count_wrong(self, client: str) -> bool:
        """Note a wrong token or cookie; returns whether one client sent too many in a minute."""
        now = self._clock()
        with self._lock:
            while len(self._wrong) >= _CLIENTS_REMEMBERED and client not in self._wrong:
                del self._wrong[next(iter(self._wrong))]
            times = self._wrong.setdefault(client, deque(maxlen=_WRONG_TOKENS_PER_MINUTE + 1))
            times.append(now)
            return len(times) > _WRONG_TOKENS_PER_MINUTE and now - times[0] < 60.0


def _is_same(candidate: str, secret: str) -> bool:
    return hmac.compare_digest(candidate.encode(), secret.encode())


def _sign(name: str, token: str) -> str:
    return hmac.new(token.encode(), name.encode(), "sha256").hexdigest()


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
        visitor = self._identify(headers, offered)
        if visitor is None and (_is_shared(scope) or _is_probe(scope)):
            return None
        if visitor is None or (not visitor.may_change and self._brings_more(scope)):
            return self._admit(scope, headers, offered)
        state = scope.setdefault("state", {})
        state["visitor"] = visitor
        if offered is None and not self._has_own_origin(scope, headers):
            return _error(403, "foreign_origin", "The request comes from another site.")
        if not visitor.may_change and not only_looks(scope):
            return _error(403, "read_only", READ_ONLY)
        state["owner"], state["may_change"] = visitor.name, visitor.may_change
        state["is_foreign"] = offered is None and _is_foreign(headers)
        return _without_token(scope)

    def _identify(self, headers: Headers, offered: str | None) -> Visitor | None:
        if self._security.is_open:
            return Visitor("open")
        if offered is not None:
            return self._security.script(offered)
        return self._security.browser(_cookie(headers, self._security.cookie))

    def _brings_more(self, scope: Scope) -> bool:
        """Whether a browser that may only look comes with the token to do more."""
        visitor = self._security.script(_token_in_address(scope) or "")
        return _is_visit(scope) and visitor is not None and visitor.may_change

    def _admit(self, scope: Scope, headers: Headers, offered: str | None) -> Response:
        """Let a browser in that brings the token in the address; refuse everybody else."""
        token, is_visit = _token_in_address(scope), _is_visit(scope)
        visitor = self._security.script(token) if token is not None and is_visit else None
        if visitor is not None:
            response = _without_token(scope) or Response(status_code=500)
            made = self._security.new_pass(may_change=visitor.may_change)
            state = scope.setdefault("state", {})
            state["visitor"], state["signs_in"] = self._security.browser(made), True
            response.set_cookie(
                self._security.cookie,
                made,
                httponly=True,
                samesite="strict",
                path=self._security.cookie_path,
                secure=scope.get("scheme") == "https",
            )
            return response
        client = (scope.get("client") or ("unknown", 0))[0]
        is_guess = token is not None or offered is not None
        is_guess = is_guess or _cookie(headers, self._security.cookie) != ""
        is_limited = is_guess and self._security.count_wrong(client)
        if is_visit and "text/html" in headers.get("accept", ""):
            # A browser whose cookie is of an older token is told what helps, however often it asks.
            return bare_page(429 if is_limited else 401, "This page needs its token", _LOCKED)
        if is_limited:
            limited = _error(429, "too_many_attempts", "Too many wrong tokens. Wait a minute.")
            limited.headers["Retry-After"] = "60"
            return limited
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


def _token_in_address(scope: Scope) -> str | None:
    return dict(parse_qsl(scope.get("query_string", b"").decode("latin-1"))).get("token")


def _is_visit(scope: Scope) -> bool:
    return scope["type"] == "http" and scope["method"] in {"GET", "HEAD"}


def only_looks(scope: Scope) -> bool:
    """Whether a request changes nothing that others see."""
    method = scope["method"] if scope["type"] == "http" else "WEBSOCKET"
    if method in _SAFE_METHODS:
        return True
    path = scope["path"]
    return any(method == allowed and pattern.fullmatch(path) for allowed, pattern in _LOOKING)


def _is_probe(scope: Scope) -> bool:
    """Whether a request only asks if the server lives, or can work."""
    return _is_visit(scope) and scope["path"] in PROBES


def _is_shared(scope: Scope) -> bool:
    """Whether a request only looks at a page that was shared."""
    return _is_visit(scope) and scope["path"].startswith(SHARED)


async def _refuse(response: Response, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "http":  # `app.health` logs it with all others.
        await response(scope, receive, _with_headers(scope, send))
        return
    logger.info("refused the websocket %s with %d", quote(scope["path"]), response.status_code)
    if "websocket.http.response" in scope.get("extensions", {}):
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

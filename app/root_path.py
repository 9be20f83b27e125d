"""Serving below a path of another site, such as ``https://lab.example/physhandi/``.

Everything within the application knows addresses from its own root on. `BelowRootPath` takes the
path off requests and puts it before redirects; pages name their addresses relative to a ``<base>``,
which is that path; answers of the API write theirs by `address_on`.
"""

from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send


def address_on(request: HTTPConnection, path: str) -> str:
    """Write an address of the application as those who asked reach it.

    Args:
        request: Who asked.
        path: The address from the application's own root on.
    """
    return f"{request.app.state.root_path}{path}"


class BelowRootPath:
    """ASGI middleware in front of all others, which know nothing of the path.

    A proxy may pass the path on or take it off itself: both are understood, which is why no address
    of the application may begin as the path does.
    """

    def __init__(self, app: ASGIApp, root_path: str) -> None:
        """Prepare.

        Args:
            app: The application.
            root_path: The path, without a slash at its end.
        """
        self._app = app
        self._root_path = root_path

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        path: str = scope["path"]
        if path == self._root_path or path.startswith(f"{self._root_path}/"):
            scope["path"] = path.removeprefix(self._root_path) or "/"
        asked = Headers(scope=scope)

        async def send_below(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if "location" in headers:
                    headers["location"] = self._below(headers["location"], asked)
            await send(message)

        await self._app(scope, receive, send_below)

    def _below(self, location: str, asked: Headers) -> str:
        """Write where a redirect of the application leads; other sites stay as they are."""
        parts = urlsplit(location)
        is_here = parts.netloc in {"", asked.get("host", "")} and parts.path.startswith("/")
        return parts._replace(path=self._root_path + parts.path).geturl() if is_here else location

"""The application: built by a factory from explicit arguments, served by uvicorn."""

import logging
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import uvicorn
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from starlette.exceptions import HTTPException

from app.api import create_api
from app.jobs.catalog import Catalog
from app.jobs.scheduler import Scheduler
from app.pages import ASSETS, Pages, create_pages
from app.security import LOOPBACK, Gatekeeper, new_token
from app.settings import Settings
from app.viewer.gate import create_gate
from app.viewer.session import Sessions, TooManySessionsError
from physhandi import __version__
from physhandi.errors import PhysHandiError

logger = logging.getLogger(__name__)

DEMO_SEQUENCE = "towel_fold"
_FRAME_LIMIT = 64 * 2**20


def create_app(settings: Settings, *, token: str, port: int) -> FastAPI:
    """Build the application.

    Args:
        settings: What the server was told.
        token: Secret that every request must bring.
        port: Port that the server is addressed by.
    """
    catalog = Catalog(settings)
    scheduler = Scheduler(settings, catalog)
    sessions = Sessions(settings, catalog)
    pages = Pages()

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        scheduler.start()
        yield
        scheduler.shutdown()
        sessions.shutdown()

    app = FastAPI(
        title="PhysHanDI", version=__version__, lifespan=lifespan, docs_url=None, redoc_url=None
    )
    app.state.scheduler = scheduler
    app.state.sessions = sessions
    app.include_router(create_api(catalog, scheduler, sessions))
    app.include_router(create_pages(catalog, scheduler, pages))
    app.include_router(create_gate(sessions))
    app.mount("/assets", StaticFiles(directory=ASSETS), name="assets")

    @app.get("/healthz", include_in_schema=False)
    def healthz() -> dict[str, str]:
        return {"status": "ok", "version": __version__}

    _answer_errors(app, pages)
    hosts = LOOPBACK if settings.host in {"0.0.0.0", "::"} else (*LOOPBACK, settings.host)  # noqa: S104  # compared, not bound
    app.add_middleware(Gatekeeper, token=token, port=port, hosts=hosts)
    return app


def _answer_errors(app: FastAPI, pages: Pages) -> None:
    """Give every error one shape: JSON below /api, a page elsewhere."""

    def answer(request: Request, status: int, code: str, message: str) -> Response:
        if request.url.path.startswith("/api/") or "text/html" not in request.headers.get(
            "accept", ""
        ):
            return JSONResponse({"error": {"code": code, "message": message}}, status_code=status)
        return pages.error(status, message)

    @app.exception_handler(PhysHandiError)
    def on_known(request: Request, error: PhysHandiError) -> Response:
        message = str(error)
        if message.startswith("There is no "):
            return answer(request, 404, "not_found", message)
        if isinstance(error, TooManySessionsError):
            return answer(request, 429, "too_many_sessions", message)
        return answer(request, 409, type(error).__name__, message)

    @app.exception_handler(HTTPException)
    def on_http(request: Request, error: HTTPException) -> Response:
        message = (
            "There is nothing at this address." if error.detail == "Not Found" else error.detail
        )
        return answer(request, error.status_code, "http", str(message))

    @app.exception_handler(RequestValidationError)
    def on_invalid(request: Request, error: RequestValidationError) -> Response:
        first: dict[str, Any] = dict(error.errors()[0])
        where = ".".join(str(part) for part in first.get("loc", ()))
        return answer(request, 422, "invalid", f"{where}: {first.get('msg', 'is not valid')}")

    @app.exception_handler(Exception)
    def on_defect(request: Request, error: Exception) -> Response:
        logger.error("a request failed: %s", request.url.path, exc_info=error)
        return answer(request, 500, "defect", "The server made a mistake; its log tells more.")


def serve(settings: Settings, on_ready: Callable[[str], None], *, queue_demo: bool = False) -> None:
    """Serve until interrupted; running fits go on and are found again by the next server.

    Args:
        settings: What the server was told.
        on_ready: Called with the address to open once it answers.
        queue_demo: Also launch a quick fit of the bundled sequence.

    Raises:
        OSError: If the port is taken.
    """
    listener = socket.socket(socket.AF_INET6 if ":" in settings.host else socket.AF_INET)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((settings.host, settings.port))
    except OSError as error:
        listener.close()
        raise OSError(
            f"Port {settings.port} of {settings.host} cannot be used ({error.strerror}). "
            "Choose another one with --port."
        ) from error
    settings.sequence_dir.mkdir(parents=True, exist_ok=True)
    settings.run_dir.mkdir(parents=True, exist_ok=True)
    port = int(listener.getsockname()[1])
    token = new_token()
    app = create_app(settings, token=token, port=port)
    shown = "127.0.0.1" if settings.host in {"0.0.0.0", "::"} else settings.host  # noqa: S104  # compared, not bound
    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        ws_per_message_deflate=False,
        ws_max_size=_FRAME_LIMIT,
        timeout_graceful_shutdown=3,
    )
    server = _Announcing(config, lambda: on_ready(f"http://{shown}:{port}/?token={token}"))
    if queue_demo:
        app.state.scheduler.launch([DEMO_SEQUENCE], "quick", "Quick fit, running now")
    server.run(sockets=[listener])


class _Announcing(uvicorn.Server):
    """Calls back when the first request can be answered."""

    def __init__(self, config: uvicorn.Config, announce: Callable[[], None]) -> None:
        super().__init__(config)
        self._announce = announce

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, then announce."""
        await super().startup(sockets)
        if self.started:
            self._announce()

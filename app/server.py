"""The application: built by a factory from explicit arguments, served by uvicorn."""

import errno
import logging
import socket
import threading
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CollectorRegistry
from starlette.exceptions import HTTPException

from app.api import create_api
from app.audit import Audited, AuditLog
from app.body_limit import BodyLimit
from app.exports.cache import FileCache, TooManyFilesError
from app.exports.routes import create_exports
from app.exports.shares import Shares
from app.graceful_server import GracefulServer
from app.health import RequestFigures, create_health
from app.jobs.catalog import Catalog, NotFoundError
from app.jobs.engines.device_choice import DeviceChoice
from app.jobs.machine import Cards, Machine
from app.jobs.order import SkippedObjectError
from app.jobs.overview import Overview
from app.jobs.recordings.annotations import Annotations
from app.jobs.recordings.background import BackgroundTasks
from app.jobs.recordings.imports import Imports
from app.jobs.recordings.models import ModelFolders
from app.jobs.recordings.uploads import Uploads
from app.jobs.recovery.recovery import Recovery
from app.jobs.scheduler import QueueFullError, Scheduler
from app.jobs.storage.retention import Retention
from app.jobs.storage.room import NoRoomError
from app.jobs.views import describe_run
from app.jobs.watch import Feed
from app.pages import Pages, create_pages
from app.pages.comparing import create_comparing
from app.previews.store import Previews
from app.root_path import BelowRootPath
from app.security import Gatekeeper, Security
from app.settings import WEB_ASSETS, ServerSettings
from app.slow_requests import ImpatientProtocol
from app.viewer.gate import create_gate
from app.viewer.physics.edit_presets import EditPresetStore
from app.viewer.physics.keep_panel import RunSaver, UserStorage
from app.viewer.physics.presets import PresetStore
from app.viewer.sessions import Sessions, TooManySessionsError
from app.wrong_fields import wrong_fields
from physhandi import __version__
from physhandi.errors import (
    MissingInputError,
    PhysHandiError,
    SequenceError,
    SettingsError,
    SimulationError,
    UsageError,
    describe,
)

logger = logging.getLogger(__name__)

DEMO_SEQUENCE = "towel_fold"
_FRAME_LIMIT = 64 * 2**20
_BODY_LIMIT = 2**20
_ANY_ADDRESS = {"0.0.0.0", "::"}  # noqa: S104  # compared, not bound
_NOWHERE = "There is nothing at this address. It may be mistyped, or what was here was deleted."
_STATUS: tuple[tuple[type[PhysHandiError], int, str], ...] = (
    (NotFoundError, 404, "not_found"),
    (TooManySessionsError, 429, "too_many_sessions"),
    (QueueFullError, 429, "queue_full"),
    (TooManyFilesError, 429, "too_many_files"),
    (NoRoomError, 507, "storage"),
    (UsageError, 422, "invalid"),
    (SequenceError, 422, "unusable_sequence"),
    (SkippedObjectError, 422, "skips_object"),
    (MissingInputError, 422, "missing_input"),
    (SimulationError, 422, "invalid"),
)


def create_app(
    settings: ServerSettings,
    *,
    security: Security | None = None,
    catalog: Catalog | None = None,
    scheduler: Scheduler | None = None,
    sessions: Sessions | None = None,
    tasks: BackgroundTasks | None = None,
) -> FastAPI:
    """Build the application.

    Args:
        settings: Settings of the server.
        security: Holds the token; none draws one from the settings.
        catalog: Finds sequences and runs; none looks where the settings say.
        scheduler: Works through the queue; none makes one for the catalog.
        sessions: Live scenes; none makes them for the catalog.
        tasks: Has recordings worked on; none makes one.
    """
    security = security or Security(settings)
    catalog = catalog or Catalog(settings)
    cards = Cards()
    scheduler = scheduler or Scheduler(settings, catalog, choice=DeviceChoice(settings, cards))
    audit_log = AuditLog(settings.audit_dir)
    sessions = sessions or Sessions(
        settings, catalog, _storage(settings, catalog, scheduler, audit_log)
    )
    machine = Machine(settings.data_dir, cards)
    feed = Feed(lambda: [describe_run(item, scheduler) for item in catalog.runs()])
    tasks = tasks or BackgroundTasks(scheduler.room)
    imports = Imports(settings, catalog, tasks)
    recovery = Recovery(settings, catalog, scheduler, tasks)
    uploads = Uploads(settings, tasks, scheduler.room)
    retention = Retention(settings, catalog, scheduler, uploads, audit_log.note_removed)
    pages = Pages()
    previews = Previews(settings, catalog)
    file_cache = FileCache(settings.data_dir / "cache" / "exports")

    app = FastAPI(
        title="PhysHanDI",
        version=__version__,
        lifespan=_while_serving(
            [scheduler.start, previews.start, recovery.start, retention.start],
            [
                *(retention.shutdown, tasks.shutdown, previews.shutdown),
                *(scheduler.shutdown, sessions.shutdown, file_cache.close),
            ],
        ),
        openapi_url="/api/v1/openapi.json",
        servers=[{"url": settings.root_path}] if settings.root_path else None,
        docs_url=None,
        redoc_url=None,
    )
    app.state.root_path, app.state.stopping = settings.root_path, threading.Event()
    app.state.scheduler, app.state.sessions, app.state.security = scheduler, sessions, security
    models = ModelFolders(settings)
    overview = Overview(settings, catalog, scheduler, machine)
    figures = CollectorRegistry()
    routers = [
        create_api(
            catalog,
            scheduler,
            feed,
            sessions,
            machine=machine,
            overview=overview,
            tasks=tasks,
            annotations=Annotations(catalog, tasks, models),
            imports=imports,
            uploads=uploads,
            recovery=recovery,
            retention=retention,
        ),
        create_pages(
            catalog,
            scheduler,
            feed,
            sessions,
            pages,
            overview=overview,
            previews=previews,
            imports=imports,
            models=models,
            recovery=recovery,
            retention=retention,
            suites=settings.suite_dir,
        ),
        *create_exports(
            catalog,
            sessions,
            pages,
            file_cache,
            Shares(settings.data_dir / "shares"),
            root_path=settings.root_path,
        ),
        create_comparing(catalog, scheduler, pages),
        create_gate(sessions),
        create_health(catalog, scheduler, sessions, machine, figures),
    ]
    for router in routers:
        # Taken over, not included: that would build each route once more at the first request.
        app.routes.extend(router.routes)
    app.mount("/assets", _Assets(directory=WEB_ASSETS), name="assets")

    _answer_errors(app, pages)
    _guard(app, security, figures, audit_log, root_path=settings.root_path)
    return app


class _Assets(StaticFiles):
    """Scripts and styles of pages: browsers keep them, and ask at each page if they are the same.

    A new version of the program changes them without their addresses.
    """

    def file_response(self, *args: Any, **options: Any) -> Response:
        """Answer with the file, or that it is the one that the browser has."""
        response = super().file_response(*args, **options)
        response.headers["Cache-Control"] = "private, no-cache"
        return response


def _while_serving(
    begin: Sequence[Callable[[], None]], end: Sequence[Callable[[], None]]
) -> Callable[[FastAPI], AbstractAsyncContextManager[None]]:
    """Say what is started before the first request, and ended after the last."""

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncGenerator[None]:
        for start in begin:
            start()
        yield
        for stop in end:
            stop()

    return lifespan


def _storage(
    settings: ServerSettings, catalog: Catalog, scheduler: Scheduler, audit_log: AuditLog
) -> UserStorage:
    """Say where live scenes keep what their users make, and where it is noted."""
    saver = RunSaver(catalog, settings.run_dir, scheduler.start_now, settings.sequence_dir)
    presets = PresetStore(settings.data_dir / "presets")
    edit_presets = EditPresetStore(presets.folder)
    return UserStorage(presets, edit_presets, saver, audit_log.note_scene)


def _guard(
    app: FastAPI,
    security: Security,
    registry: CollectorRegistry,
    audit_log: AuditLog,
    *,
    root_path: str,
) -> None:
    """Put in front of all routes what requests have to pass; the last that is added comes first."""
    app.add_middleware(BodyLimit, most_bytes=_BODY_LIMIT)
    app.add_middleware(Gatekeeper, security=security)
    app.add_middleware(Audited, log=audit_log)
    app.add_middleware(RequestFigures, registry=registry)
    if root_path:
        app.add_middleware(BelowRootPath, root_path=root_path)


def _answer_errors(app: FastAPI, pages: Pages) -> None:
    """Give every error one shape: JSON below /api, a page elsewhere."""

    def answer(
        request: Request, status: int, code: str, message: str, fields: Any = None
    ) -> Response:
        wants_page = "text/html" in request.headers.get("accept", "")
        if request.url.path.startswith("/api/") or not wants_page:
            error = {"code": code, "message": message} | ({"fields": fields} if fields else {})
            return JSONResponse({"error": error}, status_code=status)
        return pages.error(request, status, message)

    @app.exception_handler(PhysHandiError)
    @app.exception_handler(OSError)
    def on_known(request: Request, error: PhysHandiError | OSError) -> Response:
        status, code = _status_of(error)
        if status >= 500:
            logger.error("a request failed: %s: %s", request.url.path, describe(error))
        fields = (
            [{"field": path, "message": problem} for path, problem in error.fields.items()]
            if isinstance(error, SettingsError)
            else None
        )
        return answer(request, status, code, describe(error), fields)

    @app.exception_handler(HTTPException)
    def on_http(request: Request, error: HTTPException) -> Response:
        message = _NOWHERE if error.detail == "Not Found" else error.detail
        code = {404: "not_found", 405: "wrong_method", 413: "too_large"}.get(error.status_code)
        response = answer(request, error.status_code, code or "http", str(message))
        response.headers.update(error.headers or {})
        return response

    @app.exception_handler(RequestValidationError)
    def on_invalid(request: Request, error: RequestValidationError) -> Response:
        if request.url.path.startswith(("/runs/", "/live/")):
            return answer(request, 404, "not_found", _NOWHERE)
        wrong = wrong_fields(error.errors())
        first = _first_reason(*wrong[0], error.errors()[0]["type"])
        fields = [{"field": field, "message": message} for field, message in wrong]
        return answer(request, 422, "invalid", first, fields)

    @app.exception_handler(Exception)
    def on_defect(request: Request, error: Exception) -> Response:
        logger.error("a request failed: %s", request.url.path, exc_info=error)
        return answer(request, 500, "defect", "The server made a mistake; its log tells more.")


def _first_reason(place: str, why: str, kind: str) -> str:
    """Say what is wrong with a part of a request."""
    part, _, name = place.partition(".")
    if part == "query" and kind == "missing":
        return f"The address lacks “{name}=…”. It may have been cut off."
    # Several fields that are wrong together have no name.
    return f"{place}: {why}" if name or kind != "value_error" else why


def _status_of(error: PhysHandiError | OSError) -> tuple[int, str]:
    if isinstance(error, OSError):
        is_full = error.errno in {errno.ENOSPC, errno.EDQUOT}
        return (507 if is_full else 500), "storage"
    matches = [(status, code) for kind, status, code in _STATUS if isinstance(error, kind)]
    return matches[0] if matches else (409, "conflict")


def serve(
    settings: ServerSettings, on_ready: Callable[[list[str]], None], *, queue_demo: bool = False
) -> None:
    """Serve until interrupted; running fits go on and are found again by the next server.

    Args:
        settings: Settings of the server.
        on_ready: Called once it answers, with the address to open and, if there is a token for
            people who may only look, the address for them.
        queue_demo: Also launch a quick fit of the bundled sequence.

    Raises:
        RunError: If another server works on the data folder.
        OSError: If the port is taken.
    """
    listener = _listen(settings.host, settings.port)
    try:
        port = int(listener.getsockname()[1])
        security = Security(settings, port=port)
        app = create_app(settings, security=security)
        scheduler: Scheduler = app.state.scheduler
        scheduler.start()  # First: it refuses a data folder that another server works on.
        app.state.sessions.live.start()  # Warm before the first slider moves.
        if queue_demo:
            scheduler.launch([DEMO_SEQUENCE], "quick", "Quick fit, running now")
        config = uvicorn.Config(
            app,
            http=ImpatientProtocol,
            log_config=None,
            log_level=settings.log_level,
            access_log=False,
            server_header=False,
            ws_per_message_deflate=False,
            ws_max_size=_FRAME_LIMIT,
            timeout_graceful_shutdown=3,
        )
        shown = "127.0.0.1" if settings.host in _ANY_ADDRESS else settings.host
        shown = f"[{shown}]" if ":" in shown else shown
        queries = [
            f"?token={token}" for token in (security.token, security.read_only_token) if token
        ]
        home = f"http://{shown}:{port}{settings.root_path}/"
        urls = [f"{home}{query}" for query in ([""] if security.is_open else queries)]
        _Server(config, app.state.stopping, lambda: on_ready(urls)).run(sockets=[listener])
    finally:
        listener.close()


def _listen(host: str, port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        raise OSError(
            f"Port {port} of {host} cannot be used ({error.strerror}). "
            "Choose another --port or --host."
        ) from error
    return listener


class _Server(GracefulServer):
    """Tells when the first request can be answered, and ends event streams when it stops."""

    def __init__(
        self, config: uvicorn.Config, stopping: threading.Event, announce: Callable[[], None]
    ) -> None:
        super().__init__(config)
        self._stopping = stopping
        self._announce = announce

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, then announce."""
        await super().startup(sockets)
        if self.started:
            self._announce()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """End the streams, which would keep the server waiting, and stop."""
        self._stopping.set()
        super().handle_exit(sig, frame)

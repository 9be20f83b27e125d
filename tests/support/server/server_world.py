"""A server inside the test's process, and a small finished run for it to show."""

from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any

import anyio
from anyio.from_thread import BlockingPortal
from fastapi import FastAPI
from pydantic import SecretStr
from starlette.testclient import TestClient

from app.jobs.catalog import Catalog
from app.jobs.scheduler import Scheduler
from app.security import Security
from app.server import create_app
from app.settings import BUNDLED, ServerSettings
from app.viewer.sessions import Sessions
from physhandi import pipeline
from physhandi.fitting.config import PipelineConfig
from physhandi.run import Run
from support.inputs.sheet_sequence import sheet_config
from support.server.route_checks import share_checks

share_checks()

TOKEN = "a-token-that-only-the-tests-know"  # noqa: S105
HOST = "127.0.0.1:8080"
ORIGIN = f"http://{HOST}"


@cache
def event_loop() -> BlockingPortal:
    """The event loop that all worlds of this process share, as requests to one server do.

    A client that has none makes one for each request, which is half of what a request takes.
    """
    begun: SimpleQueue[BlockingPortal] = SimpleQueue()

    async def serve() -> None:
        async with BlockingPortal() as portal:
            begun.put(portal)
            await portal.sleep_until_stopped()

    Thread(target=anyio.run, args=(serve,), name="event-loop", daemon=True).start()
    return begun.get()


@dataclass(frozen=True)
class World:
    """The parts of a server, and the application, which is made when something asks for it."""

    settings: ServerSettings
    security: Security
    catalog: Catalog
    scheduler: Scheduler
    sessions: Sessions

    @cached_property
    def app(self) -> FastAPI:
        return create_app(
            self.settings,
            security=self.security,
            catalog=self.catalog,
            scheduler=self.scheduler,
            sessions=self.sessions,
        )

    def client(self, **headers: str) -> TestClient:
        """A client that sends nothing but these headers by itself."""
        client = TestClient(
            self.app, base_url=ORIGIN, headers=headers, follow_redirects=False, client=("tester", 1)
        )
        client.portal = event_loop()
        return client

    def script(self) -> TestClient:
        """A client with the token in its header."""
        return self.client(Authorization=f"Bearer {TOKEN}")

    def browser(self) -> TestClient:
        """A client with a cookie, as a page of ours."""
        client = self.client(Accept="text/html", Origin=ORIGIN)
        client.cookies.set(self.security.cookie, self.security.new_pass())
        return client


def make_world(data_dir: Path, *, bundled: Path = BUNDLED, **changes: Any) -> World:
    settings = ServerSettings(
        data_dir=data_dir, token=SecretStr(TOKEN), cancel_grace_s=1.0, **changes
    )
    security = Security(settings)
    catalog = Catalog(settings, bundled=bundled)
    scheduler = Scheduler(settings, catalog, worker="support.server.job_worker")
    sessions = Sessions(settings, catalog)
    return World(settings, security, catalog, scheduler, sessions)


def tiny_config() -> PipelineConfig:
    """Settings that fit `sheet_sequence` within a second or two."""
    return sheet_config(generations=2, population=4, iterations=2)


def fit_sheet(folder: Path, sequence: Path) -> Run:
    """Make a finished run of a sequence of `sheet_sequence`."""
    run = Run.create(
        folder,
        name="a sheet",
        kind="reconstruction",
        sequences=[str(sequence)],
        config={"profile": tiny_config().to_dict()},
    )
    pipeline.run_job(run)
    return Run.open(folder)
